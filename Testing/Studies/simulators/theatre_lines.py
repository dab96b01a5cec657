"""Simulated A-lines of sessions in the operating theatre: dwells, eighteen places in bursts, sweeps over an ellipsoid head.

Other families give bone an echo of a drawn strength. Here bone is a row of facets under the beam, curved and rough, and how it
answers tilt, fades and spreads comes out of it. Hair takes the gel away from part of the face: the echo weakens, the delay
line's own echo turns over, and bubbles answer at once; contact is lost for a moment; a hand goes over an old burr hole, where
scar and brain answer instead of bone. Scalps are those of children, of swelling, or fixed in formalin; the receiver recovers
slowly, and the bang clips. Probe, receiver, hand and poses are drawn in theatre_plan.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.echo_spectra import echo_spectra
from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.theatre_plan import Array, Bools, Hand, Theatre, draw_hand, draw_poses, draw_status, draw_theatre

Floats = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]

NEPER = np.log(10) / 20  # a decibel
BONE_R = 0.60  # amplitude that bone reflects under soft tissue
BONE_US_MM = 2 / 2.85  # there and back in bone
HALF = 1.177  # standard deviations of a Gaussian's half width at half height
FAINT = 2e-4  # of the pulse's largest frequency: not simulated below
GUARD_US = 4.0  # behind the last sample: what begins there goes round to the first
ECHO_US = 8.0  # no echo of bone is longer
FACETS, FACETS_WIDE = 35, 2.6  # across the beam, standard deviations to each side
FINE_MM = 0.05  # of the bone's profile
APART_MM = 25.0  # places on the profile
KNOTS_MM = np.linspace(0, 30, 13)  # depths at which the speckle's attenuation is exact
STILL_MM = 0.6  # moved by so much, the probe sees other speckle
TOUCHING = 0.2  # wetted share below which nothing comes out of the tissue
FLOOR_CODES = 0.29  # noise of rounding


class Pulse:
    """The transmitted pulse: its envelope is 1 at time zero and falls more slowly than it rises."""

    def __init__(self, theatre: Theatre, size: int) -> None:
        self.theatre, self.size = theatre, size
        self.rise_us = HALF / (np.pi * theatre.bandwidth * theatre.centre_mhz)
        self.fall_us = self.rise_us * theatre.fall
        spectrum = scipy.fft.fft(self.around_zero(size))[: size // 2 + 1]
        heard = np.flatnonzero(np.abs(spectrum) > FAINT * np.abs(spectrum).max())
        self.band = slice(int(heard[0]), int(heard[-1]) + 1)
        self.spectrum = spectrum[self.band].astype(np.complex64)
        self.step_mhz = float(theatre.sampling_mhz / size)
        self.mhz = np.asarray(np.arange(self.band.start, self.band.stop) * self.step_mhz, dtype=float)

    def around_zero(self, size: int) -> npt.NDArray[np.complex128]:
        """The pulse in `size` samples, its early half at their end."""
        time = ((np.arange(size) + size // 2) % size - size // 2) / self.theatre.sampling_mhz
        width = np.where(time < 0, self.rise_us, self.fall_us)
        turns = 2j * np.pi * self.theatre.centre_mhz * time + 1j * self.theatre.phase
        return np.asarray(np.exp(turns - 0.5 * (time / width) ** 2))

    def series(self, time_us: Array, height: Array, path_mm: Array) -> Complex:
        """Sum of echoes (n, m) over the pulse, as spectra (n, band)."""
        lost = 0.2 * NEPER * self.theatre.attenuation * path_mm
        return echo_spectra(time_us, height, lost, self.mhz, self.step_mhz)

    def peaks(self, shape: Complex, height: Array, path_mm: Array) -> Array:
        """Height of the envelope of echoes at time zero (n,), of spectra `shape` over the pulse."""
        every = max(int(1 / (ECHO_US * self.step_mhz)), 1)
        lost = 0.2 * NEPER * self.theatre.attenuation * path_mm[:, None] * self.mhz[::every]
        spectra = self.spectrum[::every] * shape[:, ::every] * np.exp(-lost).astype(np.float32)
        size = scipy.fft.next_fast_len(4 * spectra.shape[1])
        envelope = np.abs(scipy.fft.ifft(spectra, size, axis=1)).max(axis=1)
        return np.asarray(envelope * (height * (size * every / self.size)), dtype=float)


class Echoes:
    """A list of echoes, each in every line."""

    def __init__(self, pulse: Pulse, frames: int, last_us: float) -> None:
        self.pulse, self.frames, self.last_us = pulse, frames, last_us
        self.parts: list[tuple[Array, ...]] = []

    def add(self, time_us: npt.ArrayLike, height: npt.ArrayLike, path_mm: npt.ArrayLike = 0.0) -> None:
        """When, its height before attenuation, how deep it has been: each (n,) or one for all; without a time it is silent."""
        time, high, path = (np.broadcast_to(np.asarray(x, dtype=float), self.frames) for x in (time_us, height, path_mm))
        heard = np.isfinite(time) & (time < self.last_us)
        if (heard & (high != 0)).any():
            self.parts.append((np.where(heard, time, 0.0), np.where(heard, high, 0.0), np.nan_to_num(path)))

    def spectra(self) -> Complex:
        """Their sum over the pulse (n, band)."""
        if not self.parts:
            return np.zeros((self.frames, len(self.pulse.mhz)), dtype=np.complex64)
        time, high, path = (np.stack(column, axis=1) for column in zip(*self.parts))
        return self.pulse.series(time, high, path)


@dataclass(frozen=True, eq=False)
class Scene:
    """What is under the face in each line (n,)."""

    theatre: Theatre
    hand: Hand
    skin_us: Array
    jitter_us: Array  # of the trigger
    own: Array  # (n, 8) from 0 to 1: what is particular to the place

    @property
    def through(self) -> Array:
        """What comes of an echo through the face."""
        return np.asarray(self.hand.wet**2 * self.theatre.entering)

    @property
    def touching(self) -> Bools:
        return self.hand.wet > TOUCHING

    @property
    def bone_mm(self) -> Array:
        """NaN: none."""
        return np.where(self.hand.bone, self.hand.depth_mm, np.nan)

    @property
    def skin_mm(self) -> Array:
        """Where dermis meets fat."""
        return np.minimum(0.30 * self.hand.about_mm, 1.2 + 0.7 * self.own[:, 3])

    @property
    def gap_mm(self) -> Array:
        """From galea to bone."""
        return np.minimum(0.35 * self.hand.about_mm, 0.6 + 1.6 * self.own[:, 5])

    @property
    def layer_response(self) -> Array:
        """Of layers to tilt: wavier than bone, they answer wider."""
        off = HALF * self.hand.angle_deg / self.theatre.lobe_deg / 1.6
        return np.asarray(0.9 * np.exp(-0.5 * off**2) + 0.1)

    def arrival_us(self, depth_mm: npt.ArrayLike) -> Array:
        return np.asarray(self.skin_us + np.asarray(depth_mm) / self.theatre.mm_per_us + self.jitter_us)


def simulate(rng: np.random.Generator, frames: int, theatre: Theatre | None = None) -> tuple[Recording, Truth, Theatre]:
    """A recording of about `frames` lines (a session has whole places), and the truth about it."""
    theatre = theatre or draw_theatre(rng)
    hand = draw_hand(theatre, rng, frames)
    count = len(hand.place)
    own = rng.random((int(hand.place.max()) + 1, 8))[hand.place]
    scene = Scene(theatre, hand, theatre.face_us(count), rng.normal(0, 0.003, count), own)
    reach_mm = max(float(hand.about_mm.max()) + 4, 12.0) + float(rng.uniform(2, 10))
    samples = int((scene.skin_us.max() + reach_mm / theatre.mm_per_us + 2) * theatre.sampling_mhz)
    pulse = Pulse(theatre, scipy.fft.next_fast_len(samples + int(GUARD_US * theatre.sampling_mhz), real=True))
    typical_mm = np.array([np.median(hand.about_mm)])
    flat = np.ones((1, len(pulse.mhz)), dtype=np.complex64)
    typical = float(pulse.peaks(flat, np.ones(1), typical_mm)[0]) * theatre.entering
    facets = _facets(scene, pulse, rng)
    spectra = _echoes(scene, pulse, rng, facets, samples)
    noise = theatre.noise(typical)
    rf = _received(theatre, rng, pulse, spectra, noise)[:, :samples]
    _add_speckle(scene, pulse, rng, rf)
    _add_receiver(scene, rng, rf, typical)
    lines, codes = _convert(theatre, rng, rf, typical, noise, float(scene.skin_us.max()))
    statuses = draw_status(rng, count)
    tracked = np.array(statuses) == "OK"
    recording = Recording(
        lines=lines,
        acquisition=theatre.acquisition,
        probe_to_reference=np.where(tracked[:, None, None], draw_poses(theatre, rng, hand), np.nan),
        statuses=statuses,
        timestamps_s=rng.uniform(0, 100) + np.cumsum(1 + rng.uniform(-0.1, 0.1, count)) / theatre.rate_hz,
        palpation_points=np.full(count, -1) if theatre.mode == "sweep" else hand.place + 1,
    )
    height = pulse.peaks(facets, scene.through, np.nan_to_num(scene.bone_mm)) * codes
    answers = hand.bone & (scene.through > 0)
    snr = np.where(answers, 20 * np.log10(np.maximum(height, 1e-9) / np.hypot(noise * codes, FLOOR_CODES)), -np.inf)
    return recording, Truth(np.where(answers, hand.depth_mm, np.nan), hand.angle_deg, theatre.speed_m_s, snr), theatre


def _facets(scene: Scene, pulse: Pulse, rng: np.random.Generator) -> Complex:
    """Bone's answer over that of a mirror met squarely (n, band): facets across the beam, tilted, curved and rough."""
    theatre, hand = scene.theatre, scene.hand
    across = np.linspace(-FACETS_WIDE, FACETS_WIDE, FACETS)
    weight = np.exp(-0.5 * across**2)
    across = across * theatre.beam_mm
    under = hand.aside_mm[:, :1] + APART_MM * hand.place[:, None] + 30 + across
    grid = np.arange(0, under.max() + 1, FINE_MM)
    kernel = np.exp(-0.5 * (np.arange(-40, 41) * FINE_MM / (0.5 * theatre.alike_mm)) ** 2)
    profile = np.convolve(rng.normal(size=grid.size), kernel, "same") * (theatre.rough_mm / np.linalg.norm(kernel))
    slope = np.tan(np.radians(hand.angle_deg))[:, None]
    further_mm = across * slope + across**2 / 2 / theatre.round_mm + np.interp(under, grid, profile)
    share = np.broadcast_to(weight / weight.sum(), further_mm.shape)
    return pulse.series(further_mm / theatre.mm_per_us, share, np.zeros_like(further_mm))


def _echoes(scene: Scene, pulse: Pulse, rng: np.random.Generator, facets: Complex, samples: int) -> Complex:
    """All echoes but the speckle, over the pulse (n, band)."""
    last_us = samples / scene.theatre.sampling_mhz + GUARD_US / 2

    def listed() -> Echoes:
        return Echoes(pulse, len(scene.skin_us), last_us)

    once, twice, others = listed(), listed(), listed()
    _bone(scene, once, twice)
    _layers(scene, others)
    _tissue_without_bone(scene, others)
    _face(scene, others, rng)
    total = once.spectra() * facets + others.spectra()
    if twice.parts:
        total += twice.spectra() * facets**2
    return total


def _bone(scene: Scene, once: Echoes, twice: Echoes) -> None:
    """Bone, its inner table or a sinus, and what goes again between bone and galea; `twice`, between bone and face."""
    theatre, own = scene.theatre, scene.own
    depth, arrival = scene.bone_mm, scene.arrival_us(scene.bone_mm)
    height = np.where(scene.hand.bone, scene.through, 0.0)
    thick = np.where(scene.hand.kind == "temple", 2 + 2 * own[:, 0], 3.5 + 4 * own[:, 0])
    lost_mm = (2 + 4 * own[:, 1]) * thick / theatre.attenuation  # in bone, as a way in tissue
    sinus = np.where(own[:, 2] > 0.85, 1.0, 0.55)
    face = -theatre.face_r if theatre.acquisition.forerun_length_mm else theatre.back_r
    once.add(arrival, height, depth)
    once.add(arrival + BONE_US_MM * thick, -0.64 * height * sinus, depth + lost_mm)
    once.add(arrival + scene.gap_mm / theatre.mm_per_us, height * (0.03 + 0.06 * own[:, 7]) * BONE_R, depth + scene.gap_mm)
    twice.add(arrival + depth / theatre.mm_per_us, height * face * BONE_R, 2 * depth)


def _layers(scene: Scene, echoes: Echoes) -> None:
    """Dermis to fat, galea, the three fasciae of the temple, periosteum."""
    hand, own = scene.hand, scene.own
    about, bone = hand.about_mm, hand.bone
    height = scene.through * scene.layer_response / BONE_R
    echoes.add(scene.arrival_us(scene.skin_mm), -height * scene.touching * (0.05 + 0.08 * own[:, 4]), scene.skin_mm)
    covered = scene.touching & (bone | (hand.kind == "burr"))
    sign = np.where(own[:, 6] > 0.5, 1, -1)
    galea_mm = about - scene.gap_mm
    echoes.add(scene.arrival_us(galea_mm), height * covered * sign * (0.03 + 0.06 * own[:, 7]), galea_mm)
    muscle = (hand.kind == "temple") & (about > 5)
    for number in range(3):
        fascia_mm = about * (0.40 + 0.13 * number + 0.05 * own[:, number])
        level = (-1) ** number * (0.025 + 0.06 * own[:, number + 3])
        echoes.add(scene.arrival_us(fascia_mm), height * muscle * level, fascia_mm)
    echoes.add(scene.arrival_us(about - 0.35), height * bone * 0.04, about - 0.35)


def _tissue_without_bone(scene: Scene, echoes: Echoes) -> None:
    """Fasciae of neck and cheek; scar, dura and arachnoid in a burr hole."""
    hand, own = scene.hand, scene.own
    soft = scene.touching & np.isin(hand.kind, ["soft", "burr"])
    height = soft * scene.through * scene.layer_response / BONE_R
    pressed = hand.about_mm / max(float(hand.about_mm.mean()), 1.0)
    for number in range(4):
        if scene.theatre.without:
            depth = (2.5 + 3.5 * number + 3 * own[:, number]) * pressed
        else:
            depth = hand.about_mm + 1.5 * number + 3 * own[:, number]
        level = (-1) ** number * (0.02 + 0.06 * own[:, number + 4])
        echoes.add(scene.arrival_us(depth), height * level, depth)


def _face(scene: Scene, echoes: Echoes, rng: np.random.Generator) -> None:
    """Bubbles in the hair at the face; the delay line's echo, which turns over where the face is dry, and its multiples."""
    theatre, wet, skin_us = scene.theatre, scene.hand.wet, scene.skin_us
    count = len(wet)
    bubbles = scene.touching & (wet < 0.9)
    echoes.add(skin_us + 0.25 + 0.5 * rng.random(count), bubbles * 0.15 * rng.random(count))
    if not theatre.acquisition.forerun_length_mm:
        return
    dry = np.clip(1 - wet / 0.85, 0, 1)
    reflection = theatre.face_r * (1 - dry) - dry
    for number in range(4):
        height = reflection / BONE_R * (reflection * theatre.back_r) ** number
        echoes.add((number + 1) * skin_us + scene.jitter_us, height)
    echoes.add(1.13 * skin_us + scene.jitter_us, 0.01 * reflection / BONE_R)


def _received(theatre: Theatre, rng: np.random.Generator, pulse: Pulse, spectra: Complex, noise: float) -> Floats:
    """Lines (n, size of the pulse) of the echoes, and of noise that is white within the receiver's band."""
    size = pulse.size
    mhz = np.maximum(np.arange(size // 2 + 1) * pulse.step_mhz, 1e-6)
    highest = min(3e-6 * theatre.acquisition.transducer_hz, 0.42 * theatre.sampling_mhz)
    band = 1 / np.sqrt((1 + (0.3 / mhz) ** 4) * (1 + (mhz / highest) ** 8))
    whole = rng.standard_normal((len(spectra), 2 * len(mhz)), dtype=np.float32).view(np.complex64)
    whole *= (band * (0.5 * size * noise / np.linalg.norm(band))).astype(np.float32)
    whole[:, pulse.band] += spectra * (0.5 * pulse.spectrum)
    return np.asarray(scipy.fft.irfft(whole, size, axis=1))


def _strength_of_speckle(scene: Scene, depth_mm: Floats) -> Floats:
    """Speckle's amplitude at depths (n, samples): layered, and ending at the bone."""
    kind = scene.hand.kind
    column = (len(kind), 1)
    level = np.where(depth_mm < 0.75 * scene.hand.about_mm.astype(np.float32)[:, None], np.float32(0.7), np.float32(0.45))
    soft, temple = (np.isin(kind, names).reshape(column) for names in (["soft", "burr"], ["temple"]))
    skin = depth_mm < scene.skin_mm.astype(np.float32)[:, None]
    level[skin] = 1.5
    level[temple & (depth_mm > 3)] = 1.0
    level[soft & ~skin] = 0.9
    ends = np.nan_to_num(scene.bone_mm, nan=1e3).astype(np.float32)[:, None]
    level *= (depth_mm > 0.05) & (depth_mm < ends)
    level *= (scene.touching * scene.through * scene.theatre.speckle).astype(np.float32)[:, None]
    return np.asarray(level)


def _scatterers(scene: Scene, rng: np.random.Generator, samples: int) -> Floats:
    """Normal numbers (n, samples): while the probe hardly moves, a line's are like the line's before."""
    moved = np.linalg.norm(np.diff(scene.hand.aside_mm, axis=0), axis=1) + 20 * np.diff(scene.hand.place)
    keeps = 0.98 * np.exp(-((moved / STILL_MM) ** 2))
    out = rng.standard_normal((len(moved) + 1, samples), dtype=np.float32)
    out[1:] *= np.sqrt(1 - keeps**2).astype(np.float32)[:, None]
    for row, keep in enumerate(keeps.astype(np.float32), start=1):
        if keep > 0:
            out[row] += keep * out[row - 1]
    return out


def _add_speckle(scene: Scene, pulse: Pulse, rng: np.random.Generator, rf: Floats) -> None:
    """Put in what scatters in the tissue: the pulse, attenuated as at each knot of depth, over a stretch around it."""
    if not scene.touching.any():
        return
    theatre, mhz, per_us = scene.theatre, scene.theatre.sampling_mhz, scene.theatre.mm_per_us
    earliest, latest = float(scene.skin_us.min()), float(scene.skin_us.max())
    first = int(earliest * mhz)
    depth = ((np.arange(first, rf.shape[1]) / mhz - scene.skin_us[:, None]) * per_us).astype(np.float32)
    strength = _strength_of_speckle(scene, depth)
    used = int(np.flatnonzero(strength.any(axis=0))[-1]) + 1
    depth = np.clip(depth[:, :used], 0, KNOTS_MM[-1])
    source = strength[:, :used] * _scatterers(scene, rng, used)
    margin, spacing = int(4.5 * pulse.fall_us * mhz) + 2, float(KNOTS_MM[1])
    stretch = int((latest - earliest + 2 * spacing / per_us) * mhz) + 3
    size = scipy.fft.next_fast_len(stretch + 2 * margin, real=True)
    echo = pulse.around_zero(size).real
    spectrum = scipy.fft.rfft(echo / np.linalg.norm(echo))
    lost = 0.2 * NEPER * theatre.attenuation * np.arange(size // 2 + 1) * (mhz / size)
    total = np.zeros((len(rf), used + 2 * margin + stretch), dtype=np.float32)
    for knot in KNOTS_MM:
        start = max(int((knot - spacing) / per_us * mhz) - 1, 0)
        part = slice(start, min(start + stretch, used))
        if start >= used:
            break
        share = np.maximum(1 - np.abs(depth[:, part] - np.float32(knot)) * np.float32(1 / spacing), 0) * source[:, part]
        filtered = scipy.fft.rfft(share, size, axis=1) * (spectrum * np.exp(-lost * knot)).astype(np.complex64)
        wave = scipy.fft.irfft(filtered, size, axis=1)
        length = share.shape[1]
        total[:, start : start + margin + length + margin] += np.roll(wave, margin, axis=1)[:, : length + 2 * margin]
    before = min(margin, first)
    last = min(first + used + margin, rf.shape[1])
    rf[:, first - before : last] += total[:, margin - before : margin + last - first]


def _add_receiver(scene: Scene, rng: np.random.Generator, rf: Floats, typical: float) -> None:
    """Put in the bang, which rings longer in air, the receiver's recovery from it, a switching supply's hum, and spikes."""
    theatre, count = scene.theatre, len(rf)
    time = np.arange(rf.shape[1]) / theatre.sampling_mhz
    rings = 100 * typical * np.cos(2 * np.pi * theatre.centre_mhz * time + 1)
    for longer, rows in ((1.0, scene.hand.wet >= TOUCHING), (1.15, scene.hand.wet < TOUCHING)):
        bang = rings * np.exp(-time / (theatre.dead_us / 8.1 * longer))
        rf[rows] += (bang + typical * theatre.recovery * np.exp(-time / theatre.recovery_us)).astype(np.float32)
    if theatre.hum:
        phase = rng.uniform(0, 6.3, (count, 1))
        rf += (typical * theatre.hum * np.cos(2 * np.pi * theatre.hum_mhz * time + phase)).astype(np.float32)
    for row in np.flatnonzero(rng.random(count) < theatre.spikes):
        at = int(rng.integers(len(time) // 20, len(time) - 4))
        rf[row, at : at + 2] += typical * rng.uniform(0.3, 1.5) * np.array([1, -0.6])


def _convert(
    theatre: Theatre, rng: np.random.Generator, rf: Floats, typical: float, noise: float, skin_us: float
) -> tuple[npt.NDArray[np.int16], float]:
    """The lines as codes, and how many codes a height of 1 has. The converter clips."""
    largest = 2 ** (theatre.bits - 1) - 1
    usual = typical
    if theatre.without == "soft":
        behind = np.abs(rf[:, int((skin_us + 2) * theatre.sampling_mhz) :])
        usual = max(float(np.percentile(behind, 99.5)), 6 * noise)
    codes = largest * theatre.fill / usual
    offset = largest * (theatre.offset + 0.01 * np.sin(np.linspace(0, theatre.wander, len(rf))))
    scaled = np.rint(rf * np.float32(codes) + offset.astype(np.float32)[:, None])
    return np.clip(scaled, -largest - 1, largest).astype(np.int16), codes
