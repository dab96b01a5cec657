"""What comes back from the tissue to the probe, as spectra over the pulse's band: bone's facets, layers, speckle.

A spectrum is the sum of echoes, each with the transfer function of its way: attenuation, the dispersion that belongs to it,
diffraction, delay. Multiplied by the pulse's own spectrum they are lines (facet_lines.py).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.ndimage import map_coordinates

from Testing.Studies.simulators.facet_hand import Hand
from Testing.Studies.simulators.facet_plan import ROUGH_SIZE, ROUGH_STEP_MM, Array, Layer, Place, World

Spectra = npt.NDArray[np.complex64]  # (n, B) over the pulse's band
Floats = npt.NDArray[np.float32]

NEPER = np.log(10) / 20  # a decibel
BEHIND_S = 12e-6  # simulated beyond the lines' end: what comes later still must not come back at their start
BAND_LEAST = 1e-3  # of the pulse's largest component
FACETS, FACET_TRIES = 650, 1100
FACET_FREQUENCIES = 96  # of the facets' sum; between them it is interpolated
FACET_BINS = 16  # of height, for a turn of the phase at the highest frequency
SPECKLE_STEP_MM = 0.6  # along the head: speckle there is new
SPECKLE_FADES_MM = 0.15  # before the bone
SPECKLE_RANK = 1e-3  # of the largest component of its transfer functions
SOFT_END_MM = 33.0  # seen without bone
DIPLOE_S, DIPLOE_TAU_S, DIPLOE_STEPS_MM = 4e-6, 1.2e-6, 3.0  # steps a mm: diploe there is new


class Probe:
    """The pulse and the ways of sound as spectra over the pulse's band."""

    def __init__(self, world: World, rng: np.random.Generator) -> None:
        self.world = world
        self.sampling = world.acquisition.sampling_hz
        self.samples = int((world.forerun.time_s + 2e-3 * world.behind_mm / world.speed_m_s) * self.sampling)
        self._set_pulse()
        nominal, omega = world.acquisition.transducer_hz, 2 * np.pi * self.frequency
        self.decay = (2e-7 * NEPER * world.attenuation * self.frequency).astype(np.float32)  # nepers a mm of depth
        self.disperses = 2 / np.pi * self.decay * (1 - np.log(self.frequency / nominal))  # rad a mm; none at the group's delay
        self.delays = omega * 2e-3 / world.speed_m_s  # rad a mm
        self.spreads = (nominal / (world.near_mm * self.frequency)).astype(np.float32)
        facets = rng.uniform(-1, 1, (FACET_TRIES, 2))
        facets = facets[(facets**2).sum(axis=1) < 1][:FACETS]
        weights = np.exp(-world.taper * (facets**2).sum(axis=1))
        self.facets_mm, self.weights = facets * world.footprint_mm, weights / weights.sum()

    def _set_pulse(self) -> None:
        """The pulse's band; the envelope's height is 1, and it peaks at time zero."""
        shape, sampling = self.world.shape, self.sampling
        least = int(self.samples + BEHIND_S * sampling)
        frequency = np.fft.rfftfreq(least, 1 / sampling)
        used = np.flatnonzero(np.abs(self._spectrum(frequency)) > BAND_LEAST)
        self.thinned = max(1, int(0.49 * sampling / frequency[used[-1]]))  # scatterers need no more than the band's rate
        self.size = self.thinned * scipy.fft.next_fast_len(-(-least // self.thinned), real=True)
        frequency = np.fft.rfftfreq(self.size, 1 / sampling)
        pulse = self._spectrum(frequency)
        used = np.flatnonzero(np.abs(pulse) > BAND_LEAST * np.abs(pulse).max())
        self.band = slice(int(used[0]), int(used[-1]) + 1)
        self.frequency = frequency[self.band]
        pulse = pulse[self.band]
        turns = 2j * np.pi * self.frequency
        peak_s = 0.0
        for span in (1.0, 0.1, 0.01):  # cycles, finer and finer
            around = peak_s + np.linspace(-span, span, 21) / shape.centre_hz
            level = np.abs(np.exp(np.outer(around, turns)) @ pulse) * 2 / self.size
            peak_s = around[level.argmax()]
        pulse = pulse / level.max() * np.exp(turns * peak_s)
        self.scatter = np.sqrt(4 / self.size * (np.abs(pulse) ** 2).sum())  # envelope's rms of a unit scatterer a sample
        self.pulse = pulse.astype(np.complex64)

    def _spectrum(self, frequency: Array) -> npt.NDArray[np.complex128]:
        shape = self.world.shape
        off = frequency - shape.centre_hz
        band = np.exp(-0.5 * (off / np.where(off < 0, shape.below_hz, shape.above_hz)) ** 2)
        band[(frequency < 0.05 * shape.centre_hz) | (frequency > 0.485 * self.sampling)] = 0
        filtered = band / np.sqrt(1 + (frequency / (0.46 * self.sampling)) ** 16)  # against aliasing
        backing = 1 + shape.backing * np.exp(-2j * np.pi * off * shape.backing_cycles / shape.centre_hz)
        return np.asarray(filtered * np.exp(1j * shape.phase) * backing)

    def way(self, depth_mm: Array, delayed: bool = True) -> Spectra:
        """Transfer function of tissue down to depths (n,), there and back; `delayed`: with the time it takes."""
        turns = self.disperses + self.delays if delayed else self.disperses
        angle = np.outer(depth_mm, turns).astype(np.float32)
        depth = np.asarray(depth_mm, dtype=np.float32)[:, None]
        height = np.exp(-depth * self.decay) / np.sqrt(1 + (depth * self.spreads) ** 2)
        return _wave(height, angle)

    def delay(self, time_s: npt.ArrayLike) -> Spectra:
        """Transfer function of mere delays (n,)."""
        turns = np.outer(time_s, self.frequency)
        return _wave(np.float32(1.0), (2 * np.pi * (turns - np.rint(turns))).astype(np.float32))

    def lines(self, spectra: Spectra) -> Floats:
        """What spectra over the band are in time (n, samples)."""
        full = np.zeros((len(spectra), self.size // 2 + 1), dtype=np.complex64)
        full[:, self.band] = spectra
        return np.asarray(scipy.fft.irfft(full, self.size, axis=1)[:, : self.samples])

    def envelope(self, spectra: Spectra) -> tuple[Floats, Array]:
        """The envelope, twice as fine as the band needs, and its times (s)."""
        count = scipy.fft.next_fast_len(2 * spectra.shape[1])
        level = np.abs(scipy.fft.ifft(spectra, count, axis=1)) * np.float32(2 * count / self.size)
        return level, np.arange(count) * (self.size / self.sampling / count)

    def skull(self, place: Place, way_mm: float) -> Floats:
        """What is left after a way in bone."""
        return np.asarray(np.exp(-1e-7 * NEPER * place.skull_attenuation * way_mm * self.frequency), dtype=np.float32)


def _wave(height: npt.ArrayLike, angle: Floats) -> Spectra:
    out = np.empty(angle.shape, dtype=np.complex64)
    out.real = height * np.cos(angle)
    out.imag = -height * np.sin(angle)
    return out


def _surface(probe: Probe, place: Place, hand: Hand) -> Spectra:
    """What the bone's facets in the footprint send back, relative to the mean surface at the beam's axis."""
    x, y = probe.facets_mm.T
    tilt = np.tan(hand.tilt_xy)
    height = np.outer(tilt[:, 0], x) + np.outer(tilt[:, 1], y)
    height += x**2 / (2 * place.radii_mm[0]) + y**2 / (2 * place.radii_mm[1])
    where = (hand.at_mm[:, :, None] + probe.facets_mm.T) / ROUGH_STEP_MM + ROUGH_SIZE / 2
    rough = map_coordinates(place.rough_mm, where.transpose(1, 0, 2), order=1, mode="grid-wrap")
    height += rough - (rough @ probe.weights)[:, None]
    frequency = np.linspace(probe.frequency[0], probe.frequency[-1], FACET_FREQUENCIES)
    wave_number = 4e-3 * np.pi / probe.world.speed_m_s * frequency  # rad a mm of height
    spectra = _sum_of_waves(height, probe.weights, wave_number)
    at = np.linspace(0, FACET_FREQUENCIES - 1, len(probe.frequency))
    low = np.minimum(at.astype(int), FACET_FREQUENCIES - 2)
    share = (at - low).astype(np.float32)
    return np.asarray(spectra[:, low] * (1 - share) + spectra[:, low + 1] * share)


def _sum_of_waves(height: Array, weights: Array, wave_number: Array) -> Spectra:
    """Weighted sums of exp(-i k height) over the facets (n, facets), by a histogram of the heights."""
    step = 2 * np.pi / FACET_BINS / wave_number[-1]
    first = height.min()
    place = (height - first) / step
    low = place.astype(int)
    share = place - low
    bins = int(low.max()) + 2
    index = (low + bins * np.arange(len(height))[:, None]).ravel()
    lower, upper = ((weights * part).ravel() for part in (1 - share, share))
    size = len(height) * bins
    counts = np.bincount(index, lower, size) + np.bincount(index + 1, upper, size)
    waves = np.exp(-1j * np.outer(first + step * np.arange(bins), wave_number))
    waves /= np.sinc(wave_number * step / (2 * np.pi)) ** 2  # facets are shared between the two bins beside them
    return counts.reshape(len(height), bins).astype(np.float32) @ waves.astype(np.complex64)


def _speckle(probe: Probe, place: Place, rng: np.random.Generator, across_mm: Array, end_mm: Array) -> Spectra:
    """What scatters in the tissue down to `end_mm` (n,), in beams at `across_mm` (n,)."""
    world = probe.world
    step = probe.thinned / probe.sampling * world.speed_m_s * 500
    depth = np.arange(int(end_mm.max() / step) + 2) * step
    skin = place.layers[0].depth_mm if place.layers else 0.0
    level = np.where(depth < skin, place.level[0], np.where(depth < 0.7 * place.thick_mm, place.level[1], place.level[2]))
    level = level * np.sqrt(probe.thinned) / probe.scatter
    knot = np.floor(across_mm / SPECKLE_STEP_MM).astype(int)
    angle = (across_mm / SPECKLE_STEP_MM - knot)[:, None] * np.pi / 2
    knot -= knot.min()
    fields = rng.standard_normal((int(knot.max()) + 2, len(depth)), dtype=np.float32) * level.astype(np.float32)
    fade = np.clip((end_mm[:, None] - depth) / SPECKLE_FADES_MM, 0, 1).astype(np.float32)
    field = (np.cos(angle).astype(np.float32) * fields[knot] + np.sin(angle).astype(np.float32) * fields[knot + 1]) * fade
    spacing = max(1.2, 0.012 * world.near_mm)
    knots = np.arange(0, depth[-1] + spacing, spacing)
    ways = probe.way(knots, delayed=False)
    seen = ways * np.abs(probe.pulse)
    power, parts = np.linalg.eigh((seen @ seen.conj().T).real.astype(float))
    parts = parts[:, power > SPECKLE_RANK**2 * power[-1]].astype(np.float32)
    total = np.zeros((len(field), len(probe.frequency)), dtype=np.complex64)
    for part in parts.T:  # a few products of depth and frequency make the transfer functions of all depths
        weighted = field * np.interp(depth, knots, part).astype(np.float32)
        spectra = scipy.fft.rfft(weighted, probe.size // probe.thinned, axis=1)
        total += spectra[:, probe.band] * (part @ ways)
    return total


def _layer(probe: Probe, place: Place, layer: Layer, hand: Hand) -> Spectra:
    """A layer's echo: it follows the bone's depth and some of its tilt, and its brightness changes along the head."""
    depth = np.full(len(hand.depth_mm), layer.depth_mm)
    if place.what != "soft":
        depth *= hand.depth_mm / place.thick_mm
    tilt = np.hypot(*(layer.follows * hand.tilt_xy + np.radians(layer.tilt_deg)).T)
    turn = np.outer(np.sin(tilt), 4e-3 * np.pi / probe.world.speed_m_s * probe.world.footprint_mm * probe.frequency)
    along, aside = hand.at_mm.T
    bright = 1 + 0.35 * np.sin(along / 2.5 + layer.phases[0]) + 0.25 * np.sin(aside / 1.7 + layer.phases[1])
    height = 0.8 * np.exp(-(turn.astype(np.float32) ** 2) / 8) + np.float32(0.2)
    height *= (layer.height * bright).astype(np.float32)[:, None]
    echo = probe.way(depth)
    if layer.thick_mm:
        echo -= np.float32(0.7) * probe.way(depth + layer.thick_mm)
    return height * echo


def _diploe(probe: Probe, place: Place, rng: np.random.Generator, across_mm: Array) -> Spectra:
    """What scatters behind the bone's surface, relative to the way to it."""
    time = np.arange(int(DIPLOE_S * probe.sampling / probe.thinned)) * probe.thinned / probe.sampling
    level = place.diploe * np.sqrt(probe.thinned) / probe.scatter * np.exp(-time / DIPLOE_TAU_S)
    _, spot = np.unique((np.abs(across_mm) * DIPLOE_STEPS_MM).astype(int), return_inverse=True)
    field = rng.standard_normal((int(spot.max()) + 1, len(time)), dtype=np.float32) * level.astype(np.float32)
    spectra = scipy.fft.rfft(field, probe.size // probe.thinned, axis=1)[:, probe.band]
    return np.asarray((spectra * probe.skull(place, place.table_mm))[spot])


def _bone(probe: Probe, place: Place, rng: np.random.Generator, hand: Hand, across_mm: Array) -> tuple[Spectra, Spectra]:
    """The bone's echo, and what else comes of bone: periosteum, inner table, diploe, and the ways back from the probe's face."""
    world = probe.world
    surface, way = _surface(probe, place, hand), probe.way(hand.depth_mm)
    bone = surface * way * np.float32(place.bone)
    inner = (1 - place.bone**2) * place.inner / place.bone
    delay = probe.delay([2e-3 * place.table_mm / place.skull_m_s])
    rest = bone * (np.float32(inner) * probe.skull(place, 2 * place.table_mm) * delay)
    rest += way * _diploe(probe, place, rng, across_mm)
    before, height = place.periosteum
    rest += np.float32(height) * surface * probe.way(np.maximum(hand.depth_mm - before, 0.3))
    face = np.float32(world.forerun.face if world.forerun.time_s else -world.back)
    again = bone * bone * -face
    rest += again - again * bone * face
    return bone, rest


def tissue(probe: Probe, place: Place, rng: np.random.Generator, hand: Hand) -> tuple[Spectra, Spectra]:
    """The bone's echo and all else from behind the skin, time from there."""
    across = hand.at_mm @ [1.0, 0.6] + np.tan(hand.tilt_xy[:, 0]) * place.thick_mm / 2
    bone = np.zeros((len(across), len(probe.frequency)), dtype=np.complex64)
    rest = bone.copy()
    if place.what == "bone":
        bone, rest = _bone(probe, place, rng, hand, across)
    for layer in place.layers:
        rest += _layer(probe, place, layer, hand)
    if place.what != "water":
        end = hand.depth_mm if place.what == "bone" else np.full(len(across), SOFT_END_MM)
        rest += _speckle(probe, place, rng, across, end)
    return bone, rest
