"""What comes back from the tissue to the probe, as spectra over the pulse's band: surfaces as sums over the footprint, speckle.

A surface is the sum of its parts under an unfocused disc, each with the delay of its height; it is tilted, curved and rough, and
may end at a hole. Speckle is scatterers at places of their own, which the beam meets in another mixture half a footprint on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft

from Testing.Studies.simulators.kirchhoff_hand import Hand
from Testing.Studies.simulators.kirchhoff_plan import Array, Places, World, nepers

Spectra = npt.NDArray[np.complex64]  # (n, B) over the pulse's band
Floats = npt.NDArray[np.float32]
Rows = npt.NDArray[np.int64]

LONGER = 2.3  # than the lines: later multiples must not come back at their start
PULSE_RATE, SPECKLE_RATE, TOP = 9.0, 6.0, 3.0  # over the nominal frequency
BAND_LEAST = 1e-4  # of the pulse's largest component
TAIL_S = 0.35e-6
GRID = 19  # parts across the footprint
HEIGHT_BINS = 16  # for a turn of the phase at the highest frequency
TURN = 0.04  # of the phase, from a frequency at which a surface is summed to the next
SPECKLE_DENSITY, SPECKLE_FROM_MM, SPECKLE_GAP_MM = 10, 0.3, 0.15  # scatterers a wavelength; from the skin, before the bone
SPECKLE_PEAK = 0.57  # bone's reflection that the speckle's level is meant beside
ZONE_DB = 6.0  # of loss, in which the pulse is taken to stay the same
LAYERS_TILT, LAYERS_ROUGH = 0.8, 1.5  # of the bone's
SKULL_M_S = 2900.0


class Probe:
    """The pulse, the footprint, and the ways of sound as spectra over the pulse's band."""

    def __init__(self, world: World) -> None:
        self.world, self.sampling = world, world.acquisition.sampling_hz
        self.samples = int((world.forerun.time_s + 2e-3 * world.behind_mm / world.speed_m_s) * self.sampling)
        self.size = scipy.fft.next_fast_len(int(LONGER * self.samples), real=True)
        self.period_s = self.size / self.sampling
        self._set_pulse()
        self.decay = (nepers(world.attenuation) * self.frequency).astype(np.float32)  # a mm of depth
        self.to_s = 2e-3 / world.speed_m_s
        across = np.linspace(-1, 1, GRID) * world.footprint_mm / 2
        parts = np.stack([one.ravel() for one in np.meshgrid(across, across)])
        weights = 1 - (parts**2).sum(axis=0) / (world.footprint_mm / 2) ** 2
        self.parts_mm = parts[:, weights > 0]  # (2, G)
        self.weights = weights[weights > 0] / weights[weights > 0].sum()

    def _set_pulse(self) -> None:
        """The pulse's band: its envelope rises faster than it falls, peaks at time zero with height 1, and rings on a little."""
        world, centre = self.world, self.world.acquisition.transducer_hz
        count = scipy.fft.next_fast_len(int(PULSE_RATE * centre * self.period_s), real=True)
        time = (np.arange(count) - count // 2) * (self.period_s / count)
        rise = np.sqrt(2 * np.log(2)) / (np.pi * world.bandwidth * centre)
        fall = rise * world.fall
        after = np.maximum(time, 0)
        envelope = np.exp(-0.5 * (time / np.where(time < 0, rise, fall)) ** 2)
        envelope += world.tail * np.exp(-after / TAIL_S) * -np.expm1(-after / fall)
        wave = envelope * np.cos(2 * np.pi * centre * time + world.phase)
        spectrum = scipy.fft.rfft(np.fft.ifftshift(wave)) * (self.size / count)
        top = min(self.size // 2, int(TOP * centre * self.period_s)) + 1
        level = np.abs(spectrum[:top])
        used = np.flatnonzero(level > BAND_LEAST * level.max())
        self.band = slice(int(used[0]), int(used[-1]) + 1)
        self.frequency = np.arange(self.band.start, self.band.stop) / self.period_s
        self.pulse = spectrum[self.band].astype(np.complex64)

    def delay(self, time_s: npt.ArrayLike) -> Spectra:
        """Transfer function of mere delays (n,)."""
        turns = np.outer(np.asarray(time_s, dtype=float), self.frequency)
        return _wave(np.float32(1.0), (2 * np.pi * (turns - np.rint(turns))).astype(np.float32))

    def way(self, depth_mm: Array, path_mm: Array) -> Spectra:
        """Transfer function of tissue (n,): the loss down to a depth, the time of a path."""
        angle = np.outer(path_mm, 2 * np.pi * self.to_s * self.frequency).astype(np.float32)
        return _wave(self.loss(depth_mm), angle)

    def loss(self, depth_mm: Array) -> Floats:
        """What attenuation leaves of each frequency, there and back."""
        return np.asarray(np.exp(-np.multiply.outer(np.asarray(depth_mm, dtype=np.float32), self.decay)))

    def lines(self, spectra: Spectra) -> Floats:
        """What spectra over the band are in time (n, samples)."""
        full = np.zeros((len(spectra), self.size // 2 + 1), dtype=np.complex64)
        full[:, self.band] = spectra
        return np.asarray(scipy.fft.irfft(full, self.size, axis=1)[:, : self.samples])

    def envelope(self, spectra: Spectra) -> tuple[Floats, Array]:
        """The envelope, finer than the band needs, and its times (s), to the lines' end."""
        count = scipy.fft.next_fast_len(int(2.5 * spectra.shape[1]))
        time = np.arange(count) * (self.period_s / count)
        time = time[time < self.samples / self.sampling]
        level = np.abs(scipy.fft.ifft(spectra, count, axis=1)[:, : len(time)])
        return level * np.float32(2 * count / self.size), time


def _wave(height: Floats | np.float32, angle: Floats) -> Spectra:
    out = np.empty(angle.shape, dtype=np.complex64)
    out.real = height * np.cos(angle)
    out.imag = -height * np.sin(angle)
    return out


class Surfaces:
    """The surfaces under the footprint in the lines of a recording."""

    def __init__(self, probe: Probe, places: Places, hand: Hand) -> None:
        self.probe, self.radius = probe, places.radius_mm[hand.place]
        waves = places.waves[hand.place]  # (n, 2, W)
        here = np.exp(1j * (np.einsum("ni,niw->nw", hand.at_mm, waves) + places.phases[hand.place]))
        self.relief = np.empty((len(hand.place), len(probe.weights)))  # (n, G) mm, of the roughness
        for place in np.unique(hand.place):
            rows = hand.place == place
            there = np.exp(1j * (places.waves[place].T @ probe.parts_mm))
            self.relief[rows] = places.relief_mm[place] * (here[rows] @ there).real

    def echo(
        self, rows: Rows, depth_mm: Array, tilt: Array, reflection: Array, rough: float = 1.0, part: Array | None = None
    ) -> Spectra:
        """Spectra of a surface in `rows`: depth along the beam, tilt (n, 2) rad, reflection, the part that is there (n, G)."""
        probe = self.probe
        height = np.tan(tilt) @ probe.parts_mm + rough * self.relief[rows]
        height += (probe.parts_mm**2).sum(axis=0) / (2 * self.radius[rows, None])
        weights = probe.weights * reflection[:, None]
        spectra = _sum_of_waves(height, weights if part is None else weights * part, probe)
        return spectra * probe.way(depth_mm, depth_mm * np.cos(np.hypot(*tilt.T)))


def _sum_of_waves(height: Array, weights: Array, probe: Probe) -> Spectra:
    """Weighted sums of the delays by `height` (n, G): a histogram of the heights, at few frequencies, interpolated between."""
    first, last = probe.frequency[0], probe.frequency[-1]
    turns = np.abs(height).max() * probe.to_s * (last - first)
    wave_number = 2 * np.pi * probe.to_s * np.linspace(first, last, int(turns / TURN) + 3)  # rad a mm of height
    step = 2 * np.pi / HEIGHT_BINS / wave_number[-1]
    lowest = height.min()
    place = (height - lowest) / step
    low = place.astype(int)
    share = place - low
    bins = int(low.max()) + 2
    index = (low + bins * np.arange(len(height))[:, None]).ravel()
    size = len(height) * bins
    lower = (weights * (1 - share)).ravel()
    counts = np.bincount(index, lower, size) + np.bincount(index + 1, (weights * share).ravel(), size)
    heights = lowest + step * np.arange(bins)
    waves = _wave(np.float32(1.0), np.outer(heights, wave_number).astype(np.float32))
    waves /= (np.sinc(wave_number * step / (2 * np.pi)) ** 2).astype(np.float32)  # parts are shared by the two bins beside them
    sums = counts.reshape(len(height), bins).astype(np.float32) @ waves
    at = np.linspace(0, len(wave_number) - 1, len(probe.frequency))
    before = np.minimum(at.astype(int), len(wave_number) - 2)
    late = (at - before).astype(np.float32)
    return np.asarray(sums[:, before] * (1 - late) + sums[:, before + 1] * late)


def _scatterers(probe: Probe, rng: np.random.Generator, places: Places, hand: Hand, rows: Rows) -> tuple[Array, Array]:
    """Depths and heights (n, S) of the scatterers: their places move with the pressure, their mixture along the way."""
    world = probe.world
    wavelength = world.speed_m_s / world.acquisition.transducer_hz * 1e3
    count = int(world.behind_mm / wavelength * SPECKLE_DENSITY)
    level = 10 ** (world.speckle_db / 20) * SPECKLE_PEAK / np.sqrt(SPECKLE_DENSITY / world.bandwidth)
    depth, height = np.empty((len(rows), count)), np.empty((len(rows), count))
    for place in np.unique(hand.place[rows]):
        here = hand.place[rows] == place
        way = hand.at_mm[rows[here], 0] / (0.5 * world.footprint_mm)
        knot = np.floor(way).astype(int)
        angle = (way - knot)[:, None] * np.pi / 2
        knot -= knot.min()
        fields = rng.standard_normal((int(knot.max()) + 2, count), dtype=np.float32)
        height[here] = level * (np.cos(angle) * fields[knot] + np.sin(angle) * fields[knot + 1])
        depth[here] = rng.uniform(SPECKLE_FROM_MM, world.behind_mm, count)
    return depth * (hand.depth_mm[rows, None] / world.depth_mm), height


def speckle(probe: Probe, rng: np.random.Generator, places: Places, hand: Hand, rows: Rows) -> Spectra:
    """What scatters before the bone in `rows`, or to the lines' end."""
    world, centre = probe.world, probe.world.acquisition.transducer_hz
    boneless = hand.boneless[rows]
    end = np.where(boneless, world.behind_mm, hand.depth_mm[rows])
    zones = 2 + int(world.attenuation * centre * 0.2e-6 * world.depth_mm / ZONE_DB)
    depth, height = _scatterers(probe, rng, places, hand, rows)
    zone = (depth * (zones / end)[:, None]).astype(int)
    zone[depth >= (end - np.where(boneless, 0, SPECKLE_GAP_MM))[:, None]] = zones  # none there
    middle = (zone + 0.5) * (end / zones)[:, None]
    height *= np.exp(-nepers(world.attenuation) * centre * (depth - middle))
    count = scipy.fft.next_fast_len(max(int(SPECKLE_RATE * centre * probe.period_s), 2 * probe.band.stop), real=True)
    rate = count / probe.period_s
    at = depth * (probe.to_s * rate)
    low = at.astype(int)
    share = at - low
    long = int(world.behind_mm * probe.to_s * rate) + 2
    total = np.zeros((len(rows), len(probe.frequency)), dtype=np.complex64)
    low += long * np.arange(len(rows))[:, None]
    for number in range(zones):
        inside = zone == number
        index, much, upper = low[inside], height[inside], share[inside]
        size = len(rows) * long
        laid = np.bincount(index, much * (1 - upper), size) + np.bincount(index + 1, much * upper, size)
        spectra = scipy.fft.rfft(laid.reshape(-1, long).astype(np.float32), count, axis=1)[:, probe.band]
        total += spectra * probe.loss((number + 0.5) * end / zones)
    total /= (np.sinc(probe.frequency / rate) ** 2).astype(np.float32)  # shared by the two points beside them
    return total


@dataclass(frozen=True, eq=False)
class Tissue:
    """What comes back from behind the skin in n lines, time from there."""

    bone: Spectra
    behind: Spectra  # inside the bone, of the bone's echo
    rest: Spectra


def tissue(probe: Probe, rng: np.random.Generator, places: Places, hand: Hand) -> Tissue:
    """Layers, speckle, the bone with its inner table, and the dura where bone is missing."""
    world, tilt = probe.world, np.radians(hand.tilt_deg)
    bone = np.zeros((len(tilt), len(probe.frequency)), dtype=np.complex64)
    rest, behind = bone.copy(), bone.copy()
    touches = np.flatnonzero(~np.isin(hand.kind, ("air", "gel")))
    if not len(touches):
        return Tissue(bone, behind, rest)
    surfaces = Surfaces(probe, places, hand)
    rest[touches] = speckle(probe, rng, places, hand, touches)
    end = np.where(hand.boneless, world.behind_mm, hand.depth_mm)
    for number in range(places.layer.shape[1]):
        depth = places.layer_share[hand.place, number] * hand.depth_mm
        rows = touches[depth[touches] < end[touches]]
        if len(rows):
            where = hand.place[rows]
            slanted = LAYERS_TILT * tilt[rows] + np.radians(places.slant_deg[where, number])
            rest[rows] += surfaces.echo(rows, depth[rows], slanted, places.layer[where, number], LAYERS_ROUGH)
    rows = np.flatnonzero(hand.kind == "hole")
    if len(rows):
        where = hand.place[rows]
        rest[rows] += surfaces.echo(rows, hand.depth_mm[rows] + places.dura_mm[where], tilt[rows], places.dura[where])
    rows = np.flatnonzero(~hand.boneless)
    if len(rows):
        middle, half = hand.hole_mm[rows].T[:, :, None]
        there = np.abs(hand.at_mm[rows, :1] + probe.parts_mm[0] - middle) > half
        bone[rows] = surfaces.echo(rows, hand.depth_mm[rows], tilt[rows], places.bone[hand.place[rows]], part=there)
        inner = probe.delay(2e-3 / SKULL_M_S * places.table_mm)
        inner *= np.exp(-nepers(world.skull_attenuation) * np.outer(places.table_mm, probe.frequency)).astype(np.float32)
        behind[rows] = -0.5 * inner[hand.place[rows]]
    return Tissue(bone, behind, rest)
