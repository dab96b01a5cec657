"""Simulated A-lines over bone that is hundreds of coherent facets of a tilted, curved, rough surface.

In the other families a law says how a bone's echo fades with tilt. Here the facets under the footprint are summed, so that loss
by tilt, early arrival, broadened and split echoes come out of the surface itself. Every echo is the pulse's spectrum times the
transfer function of its way: attenuation with the dispersion that belongs to it, and diffraction. The delay line answers with
the second and third power of all that comes back at its end, so that bone and tissue have ghosts, too. Speckle is fixed to the
head and changes as the beam moves over it. What a recording is drawn from is in facet_plan.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording
from scipy.ndimage import map_coordinates

from Testing.Studies.simulators.facet_plan import (
    ROUGH_SIZE,
    ROUGH_STEP_MM,
    Array,
    Hand,
    Layer,
    Part,
    Place,
    World,
    draw_hand,
    draw_parts,
    draw_place,
    draw_poses,
    draw_world,
    ratio,
    wander,
)
from Testing.Studies.simulators.line_truth import Truth

Spectra = npt.NDArray[np.complex64]  # (n, B) over the pulse's band
Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]

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
EDGE_MM = 1.2  # beside the footprint: a beam partly on a hole
RING_DECAYS = 25  # of the ring-down, until nothing of it is left
MOST_SNR_DB = 42.0
NO_BONE = 0.3  # echo that the noise is measured by in a recording without bone


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


def _tissue(probe: Probe, place: Place, rng: np.random.Generator, hand: Hand) -> tuple[Spectra, Spectra]:
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


@dataclass(frozen=True, eq=False)
class Echoes:
    """What comes back in n lines, and what stands behind it."""

    bone: Spectra
    rest: Spectra
    face: Array  # (n,) reflection of the probe's end
    has_bone: Bools
    contact: Bools
    partly: Bools  # on the edge of a hole, or the hand comes or goes
    bare: Bools  # soft tissue that goes on where bone would be


def _in_air(probe: Probe, lines: int) -> Echoes:
    """Air at the face, or at the end of a film of gel that hangs on it; nothing at all when the cable is out."""
    world = probe.world
    rest = np.zeros((lines, len(probe.frequency)), dtype=np.complex64)
    no, face = np.zeros(lines, dtype=bool), -1.0
    if world.without == "noise":
        face = 0.0
    elif world.forerun.time_s and world.gel_mm:
        face = world.forerun.face
        film = probe.delay([2e-3 * world.gel_mm / world.speed_m_s])
        rest -= film * (1 - face**2) * sum((face * film) ** number for number in range(6))
    return Echoes(rest * 0, rest, np.full(lines, face), no, no, no, no)


def _hole(world: World, rng: np.random.Generator, hand: Hand) -> tuple[Bools, Bools]:
    """Lines of a sweep over a hole of 12 to 18 mm, or a good third of a short way, and those at its edge."""
    along = hand.at_mm[:, 0]
    middle = rng.uniform(0.3, 0.7) * along.max()
    half = min(rng.uniform(6, 9), 0.2 * np.ptp(along))
    off = np.abs(along - middle) - half
    return off < 0, np.abs(off) < world.footprint_mm + EDGE_MM


def _part(probe: Probe, rng: np.random.Generator, part: Part, hand: Hand, after_air: bool) -> Echoes:
    """The echoes of one stretch of the recording."""
    world, lines = probe.world, part.lines
    if part.kind == "air" or world.without in ("air", "noise"):
        return _in_air(probe, lines)
    inside, partly = np.zeros(lines, dtype=bool), np.zeros(lines, dtype=bool)
    if world.sweeps and world.hole:
        inside, partly = _hole(world, rng, hand)
    bone = np.zeros((lines, len(probe.frequency)), dtype=np.complex64)
    rest = bone.copy()
    for rows in (np.flatnonzero(~inside), np.flatnonzero(inside)):
        if len(rows):
            place = draw_place(rng, world, "hole", part.place.thick_mm) if inside[rows[0]] else part.place
            bone[rows], rest[rows] = _tissue(probe, place, rng, hand.take(rows))
    lost_db = np.zeros(lines)
    if part.kind == "hair":
        lost_db = np.maximum(rng.uniform(8, 18) + wander(rng, lines, 1.0, 5.0, 2.0)[:, 0], 0)
    comes_or_goes = np.zeros(lines, dtype=bool)
    comes_or_goes[0] |= after_air
    comes_or_goes[-1] |= world.lifts and not world.sweeps
    loss = ratio(-lost_db - comes_or_goes * rng.uniform(3, 20, lines))
    own = world.forerun.face
    face = np.where(loss == 1, own * rng.uniform(0.97, 1.03, lines), own - (1 - loss) * 0.5)
    has_bone = (part.place.what == "bone") & ~inside
    bare = (inside | np.full(lines, part.place.what in ("hole", "soft"))) & ~partly & ~comes_or_goes
    lost = loss.astype(np.float32)[:, None]
    return Echoes(bone * lost, rest * lost, face, has_bone, np.ones(lines, dtype=bool), partly | comes_or_goes, bare)


def _through_forerun(probe: Probe, echoes: Echoes, late_s: Array) -> tuple[Spectra, Spectra]:
    """What arrives through the delay line, with all that its two ends send to and fro."""
    world = probe.world
    if not world.forerun.time_s:
        return echoes.bone, echoes.rest
    line = probe.delay(world.forerun.time_s + late_s)
    answer = echoes.rest + echoes.face.astype(np.float32)[:, None]
    back = (answer + echoes.bone) * line
    again = back * back * np.float32(world.back)
    return echoes.bone * line, answer * line + again + again * back * np.float32(world.back)


@dataclass(frozen=True, eq=False)
class Levels:
    """Of what is received."""

    peak: Array  # (n,) of the envelope of the bone's echo
    noise: float
    good: Bools  # (n,) lines within 3 degrees that tell the recording's SNR
    enough: bool  # of them


def _levels(probe: Probe, echoes: Echoes, bone: Spectra, rest: Spectra, tilt: Array, skin_s: Array) -> Levels:
    """The noise that gives the recording its SNR; where no bone is under soft tissue, the speckle behind it can be seen."""
    world = probe.world
    peak = np.zeros(len(bone))
    if echoes.has_bone.any():
        peak[echoes.has_bone] = probe.envelope(bone[echoes.has_bone])[0].max(axis=1)
    good = echoes.has_bone & (tilt < np.radians(3)) & ~echoes.partly
    enough = int(good.sum()) > 3
    typical = NO_BONE * float(ratio(-0.2e-6 * world.attenuation * world.acquisition.transducer_hz * world.thick_mm))
    reference = float(np.median(peak[good])) if enough else typical
    noise = reference / float(ratio(world.snr_db))
    if echoes.bare.any():
        level, time = probe.envelope(rest[echoes.bare])
        behind = skin_s[echoes.bare] + 2e-3 * (0.6 * world.thick_mm + 2) / world.speed_m_s
        near = np.abs(time - behind[:, None]) < 4e-3 / world.speed_m_s
        shown = 0.6 * np.sqrt((level**2 * near).sum(axis=1) / near.sum(axis=1))
        noise = min(noise, max(float(shown.min()), reference / float(ratio(MOST_SNR_DB))))
    return Levels(peak, noise, good, enough)


def _converter(world: World, rng: np.random.Generator, largest: float, levels: Levels) -> tuple[float, int]:
    """Full scale of the converter and its bits; a twentieth of the recordings clips its bone."""
    clips = rng.random() < 0.06 and levels.enough
    full = max(largest, 6 * levels.noise) / rng.uniform(0.3, 0.85)
    if clips:
        full = max(4 * levels.noise, float(np.percentile(levels.peak[levels.good], 60)))
    bits = int(rng.choice([10, 12, 14]))
    while levels.noise / full * 2 ** (bits - 1) < 0.4 and bits < 16:
        bits += 1
    return full, bits


def _receive(probe: Probe, rng: np.random.Generator, signal: Floats, echoes: Echoes, levels: Levels, jitter_s: Array) -> Floats:
    """Ring-down, drifting base line, noise, interference; in codes."""
    world, (frames, samples), sigma = probe.world, signal.shape, levels.noise
    heard = signal[echoes.contact] if echoes.contact.any() else signal
    full, bits = _converter(world, rng, float(np.percentile(np.abs(heard).max(axis=1), 95)), levels)
    frequency = np.fft.rfftfreq(probe.size, 1 / probe.sampling)
    passed = (frequency / world.highpass_hz) ** 2 / np.sqrt(1 + (frequency / world.highpass_hz) ** 4)
    passed = (passed / np.sqrt(1 + (frequency / world.lowpass_hz) ** 8)).astype(np.float32)
    white = rng.standard_normal((frames, 2 * len(passed)), dtype=np.float32).view(np.complex64)
    scale = sigma * probe.size / (2 * np.sqrt((passed**2).sum()))
    rf = signal + scipy.fft.irfft(white * (passed * np.float32(scale)), probe.size, axis=1)[:, :samples]
    time = np.arange(samples) / probe.sampling
    if world.without != "noise":
        early = min(samples, int(RING_DECAYS * world.dead_s / np.log(30) * probe.sampling))
        rf[:, :early] += np.float32(full) * _ring(world, rng, time[:early], jitter_s)
    base = rng.uniform(-0.06, 0.06) + rng.uniform(-0.08, 0.08) * np.exp(-time / rng.uniform(6e-6, 30e-6))
    rf += (full * base).astype(np.float32) + (full * 0.004 * rng.normal(size=(frames, 1))).astype(np.float32)
    if rng.random() < 0.15:
        for row in np.flatnonzero(rng.random(frames) < 0.08):  # short interference
            rf[row] += sigma * _spike(rng, passed, probe.size, samples)
    if rng.random() < 0.08:
        turns = 2 * np.pi * rng.uniform(0.4, 1.4) * world.acquisition.transducer_hz * time
        tone = np.cos((turns + rng.uniform(0, 2 * np.pi, (frames, 1))).astype(np.float32))
        rf += np.float32(sigma * rng.uniform(0.5, 1.2)) * tone
    top = 2 ** (bits - 1) - 1
    return np.clip(np.rint(rf * np.float32(top / full)), -top - 1, top)


def _ring(world: World, rng: np.random.Generator, time: Array, jitter_s: Array) -> Floats:
    """The transducer's ring-down over the converter's full scale; it begins clipped."""
    since = (time - jitter_s[:, None]).astype(np.float32)
    turn = np.float32(2 * np.pi * world.acquisition.transducer_hz * rng.uniform(0.75, 1.1))
    decays = np.maximum(since, 0) * np.float32(np.log(30) / world.dead_s)
    level = (3 * (1 + 0.01 * rng.normal(size=(len(since), 1)))).astype(np.float32)
    return np.asarray(level * np.exp(-decays) * np.cos(turn * since + np.float32(rng.uniform(0, 2 * np.pi))))


def _spike(rng: np.random.Generator, passed: Floats, size: int, samples: int) -> Floats:
    impulses = np.zeros(size, dtype=np.float32)
    impulses[rng.integers(0, samples, rng.integers(1, 3))] = 1
    heard = scipy.fft.irfft(scipy.fft.rfft(impulses) * passed, size)[:samples]
    return np.asarray(heard / np.abs(heard).max() * rng.choice([-1, 1]) * ratio(rng.uniform(10, 24)), dtype=np.float32)


def _statuses(rng: np.random.Generator, frames: int) -> tuple[str, ...]:
    """The tracker loses the probe for a few lines of some recordings."""
    status = ["OK"] * frames
    if rng.random() < 0.3:
        for _ in range(rng.integers(1, 4)):
            first, word = int(rng.integers(0, frames)), str(rng.choice(["MISSING", "OUT_OF_VIEW", "INVALID"]))
            for row in range(first, min(first + int(rng.integers(1, 7)), frames)):
                status[row] = word
    return tuple(status)


def simulate(rng: np.random.Generator, frames: int, world: World | None = None) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines, and the truth about it."""
    world = world or draw_world(rng)
    probe = Probe(world, rng)
    parts = draw_parts(rng, world, frames)
    hands = [draw_hand(rng, world, part.place, part.lines) for part in parts]
    found, before = [], ""
    for part, hand in zip(parts, hands):
        found.append(_part(probe, rng, part, hand, before == "air"))
        before = part.kind
    echoes = Echoes(*(np.concatenate([getattr(one, name) for one in found]) for name in Echoes.__dataclass_fields__))
    late = world.forerun.warming_s * np.arange(frames) / frames
    jitter = rng.uniform(-8e-9, 8e-9, frames) if world.forerun.time_s else rng.normal(0, 1.5e-9, frames)
    bone, rest = _through_forerun(probe, echoes, late)
    sent = probe.pulse * probe.delay(jitter)
    bone, rest = bone * sent, rest * sent
    depth, tilt = (np.concatenate([getattr(hand, name) for hand in hands]) for name in ("depth_mm", "tilt"))
    levels = _levels(probe, echoes, bone, rest, tilt, world.forerun.time_s + late)
    codes = _receive(probe, rng, probe.lines(bone + rest), echoes, levels, jitter)
    statuses = _statuses(rng, frames)
    poses = draw_poses(rng, world, hands)
    poses[np.array([status != "OK" for status in statuses])] = np.nan
    steps = (1 + 0.05 * np.clip(rng.normal(size=frames), -2, 2)) / world.rate_hz
    recording = Recording(
        lines=codes.astype(np.int16),
        acquisition=world.acquisition,
        probe_to_reference=poses,
        statuses=statuses,
        timestamps_s=np.cumsum(steps) + rng.uniform(0, 100),
        palpation_points=np.repeat([part.point for part in parts], [part.lines for part in parts]),
    )
    snr = np.full(frames, -np.inf)
    snr[echoes.has_bone] = 20 * np.log10(levels.peak[echoes.has_bone] / levels.noise + 1e-9)
    return recording, Truth(np.where(echoes.has_bone, depth, np.nan), np.degrees(tilt), world.speed_m_s, snr), world
