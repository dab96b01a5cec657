"""Simulated A-lines of a disc transducer over a rough sphere: what comes back is summed over the disc that receives it.

What the other families lack: the reflected wave's walk-off through a delay line that refracts it, the spread of the beam by
diffraction, and a diffuse part that shimmers as the probe moves. In some recordings tissue without bone has several strong layers
and speckle that go on for long, gel has nothing behind it, or no transducer is connected; in others the hand glides off the skull
at the end. The pulse rings once more in some, the noise is limited to the receiver's band, bone clips or comes under the delay
line's second echo. What a recording is drawn from is in disc_plan.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.disc_plan import (
    Array,
    Beam,
    Bools,
    Hand,
    Rows,
    Setup,
    World,
    decibel,
    draw_beam,
    draw_hand,
    draw_poses,
    draw_setup,
    draw_statuses,
    wander,
)
from Testing.Studies.simulators.echo_spectra import echo_spectra, short_peaks
from Testing.Studies.simulators.line_truth import Truth

Floats = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]

NEPER = np.log(10) / 20  # a decibel
GUARD_US = 5.0  # behind the last sample: what rings there does not come round to the first
WIDE = 3.6  # standard deviations of the pulse's spectrum that are simulated
STRIPS, SCATTERERS = 25, 14  # the disc; the rough bone
ECHO_US = 8.0  # no echo of bone is longer
MULTIPLES = 5  # of the delay line's echo
SKULL_MM_US, INNER_MM_US = 2.9, 2.6
SPECKLE_MM = 0.15  # it begins so far under the skin
LAYERS_MM = 21.0  # tissue without bone has layers down to here
WEAK_DB, TILTED_DEG, CLIPS, HIDES = 12.0, 3.0, 0.95, 0.3


class Band:
    """The frequencies of a recording's pulse: only these are simulated."""

    def __init__(self, setup: Setup, samples: int) -> None:
        self.setup, self.samples = setup, samples
        self.size = scipy.fft.next_fast_len(samples + int(GUARD_US * setup.sampling_mhz), real=True)
        self.step_mhz = setup.sampling_mhz / self.size
        self.every_mhz = np.arange(self.size // 2 + 1) * self.step_mhz
        near = np.flatnonzero(np.abs(self.every_mhz - setup.centre_mhz) < WIDE * setup.spread_mhz)
        self.bins = slice(int(near[0]), int(near[-1]) + 1)
        self.mhz = self.every_mhz[self.bins]
        self.last_us = samples / setup.sampling_mhz + 2.0  # what comes later is not heard
        self.pulse = self._pulse()

    def _pulse(self) -> Complex:
        """The transmitted pulse, whose envelope has its peak of 1 at time zero."""
        setup = self.setup
        off = (self.mhz - setup.centre_mhz) / setup.spread_mhz
        spectrum = np.exp(-0.5 * off**2 + 1j * (setup.phase + setup.chirp * off**2))
        rings_us = setup.tail_cycles / setup.centre_mhz
        spectrum *= 1 + setup.tail * np.exp(-2j * np.pi * self.mhz * rings_us)
        whole = np.zeros(self.size, dtype=complex)
        whole[self.bins] = spectrum
        return np.asarray(spectrum / (2 * np.abs(scipy.fft.ifft(whole)).max()), dtype=np.complex64)

    def delay(self, time_us: float) -> Complex:
        """What a delay does to a spectrum."""
        return np.asarray(np.exp(-2j * np.pi * time_us * self.mhz), dtype=np.complex64)

    def echoes(self, time_us: Array, height: Array, depth_mm: Array) -> Complex:
        """Sum of echoes (n, m) over the pulse, as spectra (n, band): when, how high unattenuated, from how deep."""
        heard = time_us < self.last_us
        time = np.where(heard, time_us, 0.0)
        lost = 0.2 * NEPER * self.setup.attenuation * depth_mm
        return echo_spectra(time, np.where(heard, height, 0.0), lost, self.mhz, self.step_mhz)

    def peaks(self, spectra: Complex) -> Array:
        """Height of the envelope's peak (n,) of one short echo each."""
        every = max(int(1 / (ECHO_US * self.step_mhz)), 1)
        return short_peaks(spectra * self.pulse, every, self.size)


@dataclass(frozen=True, eq=False)
class Scene:
    """The lines of a recording under way, and what their parts need of it; arrays (n,)."""

    setup: Setup
    hand: Hand
    beam: Beam
    skin_us: Array
    coupling: Array
    face_r: Array  # of the delay line: total in air
    alike: Array  # how much of its scatterers a line shares with the line before

    @property
    def soft(self) -> Bools:
        """Where the probe looks into tissue without bone."""
        return self.hand.contact & ~self.hand.over_skull & (self.setup.without != "gel")

    @property
    def typical(self) -> float:
        """Height of bone met squarely in the recording's median depth."""
        over_skull = self.hand.depth_mm[self.hand.over_skull]
        depth = np.median(over_skull) if len(over_skull) else self.setup.depth_mm
        return float(decibel(-self.setup.loss_db_mm * depth))

    def multiple(self, number: Rows) -> Array:
        """Heights of the delay line's echoes of these numbers (n, m), from 1."""
        between = (-self.setup.back_r) ** (number - 1)
        return np.asarray(self.face_r[:, None] ** number * between / self.setup.bone_r)

    def wander(self, rng: np.random.Generator, lasts_s: float, spread: float, columns: int = 1) -> Array:
        """Slow changes (n, columns)."""
        return wander(rng, len(self.skin_us), 1 / self.setup.rate_hz, lasts_s, spread, columns)

    def arrival_us(self, depth_mm: Array) -> Array:
        """When a layer (n, m) that lies square to the beam answers."""
        return np.asarray(self.skin_us[:, None] + 2 * depth_mm / self.setup.mm_us)


def _draw_scene(rng: np.random.Generator, setup: Setup, frames: int) -> Scene:
    hand = draw_hand(rng, setup, frames)
    beam = draw_beam(rng, setup, hand)
    count = len(hand.place)
    skin_us: Array = np.zeros(count)
    if setup.delay.length_mm:
        warmth = setup.delay.late + np.cumsum(rng.normal(0, 0.0001, count))
        skin_us = 2e3 * setup.delay.length_mm / setup.delay.speed_m_s * (1 + warmth)
    moved_mm = np.linalg.norm(np.diff(beam.bone_mm, axis=0, prepend=beam.bone_mm[:1]), axis=1)
    alike = np.exp(-((moved_mm / (0.35 * setup.disc_mm)) ** 2))
    coupling = decibel(-np.abs(wander(rng, count, 1 / setup.rate_hz, 1.5, 1.5)[:, 0]))
    wet = setup.delay.face_r * (1 + 0.1 * wander(rng, count, 1 / setup.rate_hz, 0.5, 1.0)[:, 0])
    return Scene(setup, hand, beam, skin_us, coupling, np.where(hand.contact, wet, -1.0), alike)


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines, at least LEAST_LINES, the truth about it, and what it was drawn from."""
    setup = setup or draw_setup(rng)
    scene = _draw_scene(rng, setup, frames)
    hand, count = scene.hand, len(scene.skin_us)
    reach_us = float(scene.skin_us.max()) + 2 * float(rng.uniform(19, 24)) / setup.mm_us
    band = Band(setup, int(reach_us * setup.sampling_mhz))
    bone = _bone(scene, band, rng)
    peak, noise = band.peaks(bone), scene.typical / float(decibel(setup.snr_db))
    spectra = np.zeros_like(bone)
    if setup.without != "noise":
        spectra = _all_echoes(scene, band, rng, bone) * band.pulse
    rf = _received(band, rng, spectra, noise)
    _add_receiver(scene, rng, rf, noise)
    lines, share = _convert(scene, rf)
    statuses = draw_statuses(rng, setup, count)
    tracked = np.array(statuses) == "OK"
    recording = Recording(
        lines=lines,
        acquisition=setup.acquisition,
        probe_to_reference=np.where(tracked[:, None, None], draw_poses(rng, setup, hand, scene.beam), np.nan),
        statuses=statuses,
        timestamps_s=100 + np.cumsum(rng.uniform(0.95, 1.05, count)) / setup.rate_hz,
        palpation_points=hand.place + 1,
    )
    snr_db = np.where(hand.bone, 20 * np.log10(np.maximum(peak, 1e-12) / noise), -np.inf)
    depth, tilt = np.where(hand.bone, hand.depth_mm, np.nan), np.degrees(scene.beam.tilt_rad)
    truth = Truth(depth, tilt, setup.speed_m_s, np.asarray(snr_db, dtype=float))
    return recording, truth, _judge(scene, truth, peak, hand.bone & (peak * share > CLIPS))


def _bone(scene: Scene, band: Band, rng: np.random.Generator) -> Complex:
    """Bone's echo over the pulse (n, band): the wave it reflects, weighted over the disc, and what its roughness scatters."""
    setup, beam, depth = scene.setup, scene.beam, scene.hand.depth_mm
    tilt, disc, speed, delay = beam.tilt_rad, setup.disc_mm, setup.mm_us, setup.delay
    slower = delay.speed_m_s / setup.speed_m_s
    sine = np.sin(2 * tilt)  # of the returning wave; refracted into the delay line
    refracted = np.minimum(sine * slower, 0.9)
    cosine = np.sqrt(1 - refracted**2)
    arrival = 2 * depth * np.cos(tilt) / speed + scene.skin_us / 4 * (3 + cosine)
    walked_off = depth * np.tan(2 * tilt) + delay.length_mm * refracted / cosine
    width = 1.2 * disc * np.hypot(1, 2 * (depth + delay.length_mm * slower) * setup.wave_mm / (2.6 * disc**2))  # by diffraction
    across = (np.arange(STRIPS) + 0.5) * 2 * disc / STRIPS - disc
    chord = np.sqrt(1 - (across / disc) ** 2)
    weight = chord * np.exp(-(((across - walked_off[:, None]) / width[:, None]) ** 2))
    weight /= (chord * np.exp(-((across / width[:, None]) ** 2))).sum(axis=1, keepdims=True)
    time = arrival[:, None] + (across * sine[:, None] + across**2 / setup.head_mm) / speed
    mirrored = band.echoes(time, weight, np.broadcast_to(depth[:, None], time.shape))
    mirrored *= np.exp(-2 * (2 * np.pi * band.mhz * setup.rough_mm / speed) ** 2).astype(np.float32)
    where = rng.normal(0, 0.35 * disc, SCATTERERS)
    strength = _alike(scene, rng.standard_normal((len(depth), SCATTERERS), dtype=np.float32))
    further = depth[:, None] + where * np.tan(tilt)[:, None]
    height = strength * (setup.diffuse / np.sqrt(SCATTERERS))
    scattered = band.echoes(scene.arrival_us(further), height, np.broadcast_to(depth[:, None], further.shape))
    return np.asarray((mirrored + scattered) * (scene.coupling * scene.hand.bone).astype(np.float32)[:, None])


def _alike(scene: Scene, fresh: Floats) -> Floats:
    """Normal numbers (n, m), made to change from line to line no faster than the probe moves over the scatterers."""
    keeps = scene.alike.astype(np.float32)
    fresh[1:] *= np.sqrt(1 - keeps[1:, None] ** 2)
    for row in range(1, len(fresh)):
        fresh[row] += keeps[row] * fresh[row - 1]
    return fresh


def _all_echoes(scene: Scene, band: Band, rng: np.random.Generator, bone: Complex) -> Complex:
    """All that comes back, over the pulse (n, band)."""
    parts = [_layers_over_bone(scene, rng), _layers_without_bone(scene, rng)]
    if scene.setup.delay.length_mm:
        parts.append(_face(scene))
    time, height, depth = (np.concatenate(columns, axis=1) for columns in zip(*parts))
    total = band.echoes(time, height, depth)
    total += bone * _after_bone(scene, band, rng)
    total += _speckle(scene, band, rng)
    return total


def _after_bone(scene: Scene, band: Band, rng: np.random.Generator) -> Complex:
    """Bone and what follows it, over bone (n, band): diploe, inner table, bone again by way of the face or the delay line."""
    setup, depth = scene.setup, scene.hand.depth_mm
    diploe_us = 2 * rng.uniform(1.2, 2.5) / SKULL_MM_US
    inner_us = diploe_us + 2 * rng.uniform(2, 5) / INNER_MM_US
    diploe, inner = decibel((rng.uniform(-30, -20), rng.uniform(-40, -28)))
    behind = 1 - np.float32(diploe) * band.delay(diploe_us) + np.float32(inner) * band.delay(inner_us)
    bone_us = 2 * depth / setup.mm_us
    delayed = setup.delay.length_mm > 0
    face = -setup.delay.face_r if delayed else 0.7 * setup.back_r
    heard = 2 * scene.skin_us + bone_us < band.last_us
    through_line = np.where(heard & delayed, -2 * setup.back_r * setup.delay.face_r, 0.0)
    height = np.stack([np.full(len(depth), -face * setup.bone_r), through_line], axis=1)
    again = band.echoes(np.stack([bone_us, scene.skin_us], axis=1), height, np.stack([depth, np.zeros(len(depth))], axis=1))
    return np.asarray(behind + again)


def _response(setup: Setup, tilt_rad: npt.ArrayLike) -> Array:
    """Of a layer to tilt: wavier than bone, it answers wider."""
    return np.asarray(np.exp(-0.69 * (np.asarray(tilt_rad) / (1.6 * setup.lobe_rad)) ** 2) + 0.06)


def _layers_over_bone(scene: Scene, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Up to three layers, the deepest mostly the galea, near the bone: time, height, depth (n, m)."""
    setup, hand = scene.setup, scene.hand
    galea = 1 - np.clip(rng.uniform(0.7, 2.2) / setup.depth_mm, 0.12, 0.5)
    shares = np.sort([rng.uniform(0.15, 0.4), rng.uniform(0.4, 0.75), galea])[: int(rng.integers(1, 4))]
    count = len(shares)
    level = rng.choice([-1, 1], count) * rng.uniform(0.03, 0.12, count) / setup.bone_r
    seen = _response(setup, np.hypot(scene.beam.tilt_rad[:, None], rng.normal(0, 0.02, count)))
    fades = decibel(scene.wander(rng, 0.5, 1.5, count)) * scene.coupling[:, None]
    depth = hand.depth_mm[:, None] * shares
    return scene.arrival_us(depth), level * seen * fades * hand.bone[:, None], depth


def _layers_without_bone(scene: Scene, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Tissue that goes on: time, height, depth (n, m). Shallow layers are weaker: none stands alone before silence."""
    setup, hand = scene.setup, scene.hand
    places = np.cumsum(rng.uniform(2, 5, 8))
    places = places[places < LAYERS_MM]
    count = len(places)
    above_mm = np.maximum(min(float(places[-1]), 15.0) - places, 0)
    reflection = rng.uniform(0.05, 0.13, count) * np.maximum(decibel(-0.35 * setup.loss_db_mm * above_mm), 0.25)
    level = rng.choice([-1, 1], count) * reflection / setup.bone_r
    seen = _response(setup, scene.wander(rng, 0.4, 0.02, count))
    pressed = (hand.depth_mm / np.median(hand.depth_mm))[:, None]
    depth = places * pressed
    sways = 1 + scene.wander(rng, 0.8, 0.03)
    return scene.arrival_us(depth * sways), level * seen * (scene.coupling * scene.soft)[:, None], depth


def _face(scene: Scene) -> tuple[Array, Array, Array]:
    """The delay line's echo and its multiples: time, height, depth (n, m)."""
    number = np.arange(1, MULTIPLES + 1)
    time = scene.skin_us[:, None] * number
    return time, scene.multiple(number), np.zeros(time.shape)


def _speckle(scene: Scene, band: Band, rng: np.random.Generator) -> Complex:
    """What scatters in the tissue, over the pulse (n, band): from the skin to the bone, or on and on where there is none."""
    setup, hand = scene.setup, scene.hand
    ends_mm = np.where(hand.bone, hand.depth_mm, np.where(scene.soft, np.inf, -1.0))
    if ends_mm.max() < 0:
        return np.zeros((len(ends_mm), len(band.mhz)), dtype=np.complex64)
    first = int(scene.skin_us.min() * setup.sampling_mhz)
    last_us = min(float((scene.skin_us + 2 * ends_mm / setup.mm_us).max()), band.size / setup.sampling_mhz)
    time = np.arange(first, int(last_us * setup.sampling_mhz)) / setup.sampling_mhz
    depth = ((time - scene.skin_us[:, None]) * (setup.mm_us / 2)).astype(np.float32)
    strength = np.exp(depth * np.float32(-NEPER * setup.loss_db_mm))
    strength *= (depth > SPECKLE_MM) & (depth < ends_mm.astype(np.float32)[:, None])
    scale = setup.speckle / np.sqrt(setup.sampling_mhz / (2 * np.sqrt(np.pi) * setup.spread_mhz))
    strength *= (scale * scene.coupling).astype(np.float32)[:, None]
    source = np.zeros((len(depth), band.size), dtype=np.float32)
    source[:, first : first + len(time)] = strength * _alike(scene, rng.standard_normal(depth.shape, dtype=np.float32))
    return np.asarray(scipy.fft.rfft(source, axis=1)[:, band.bins])


def _received(band: Band, rng: np.random.Generator, spectra: Complex, noise: float) -> Floats:
    """Lines (n, samples) of the echoes, and of noise that is limited to the receiver's band."""
    over = band.every_mhz / band.setup.centre_mhz
    receiver = over**2 / (over**2 + 0.3**2) / (1 + (over / 1.9) ** 6)
    whole = rng.standard_normal((len(spectra), 2 * len(over)), dtype=np.float32).view(np.complex64)
    whole *= (receiver * (0.5 * band.size * noise / np.linalg.norm(receiver))).astype(np.float32)
    whole[:, band.bins] += spectra
    return np.asarray(scipy.fft.irfft(whole, band.size, axis=1)[:, : band.samples])


def _add_receiver(scene: Scene, rng: np.random.Generator, rf: Floats, noise: float) -> None:
    """Put in the transmitted pulse, which rings longer in air, hum, spikes and an offset."""
    setup, (count, samples) = scene.setup, rf.shape
    time = np.arange(samples) / setup.sampling_mhz
    if setup.without != "noise":
        rings = scene.typical * setup.bang * np.cos(2 * np.pi * 0.9 * setup.centre_mhz * time + 1)
        rings *= time > 0.1 / setup.centre_mhz
        for longer, rows in ((1.0, scene.hand.contact), (1.25, ~scene.hand.contact)):
            rf[rows] += (rings * np.exp(-time / (setup.ring_us * longer))).astype(np.float32)
    if setup.spikes:
        for row in np.flatnonzero(rng.random(count) < 0.15):
            at = int(rng.integers(0, samples - 40))
            rf[row, at : at + 4] += (rng.normal(0, 1, 4) * noise * rng.uniform(4, 15)).astype(np.float32)
    height, hum_mhz = noise * rng.uniform(0, 3), rng.uniform(0.005, 0.05)
    turning = np.exp(2j * np.pi * hum_mhz * time).astype(np.complex64)
    started = height * np.exp(2j * np.pi * rng.random((count, 1)))
    rf += started.real.astype(np.float32) * turning.imag
    rf += started.imag.astype(np.float32) * turning.real
    rf += np.float32(noise * rng.uniform(-4, 4))


def _convert(scene: Scene, rf: Floats) -> tuple[npt.NDArray[np.int16], float]:
    """The lines as codes, and how much of the converter's range a height of 1 takes. The converter clips."""
    setup = scene.setup
    largest, share = 2 ** (setup.bits - 1), setup.fill / scene.typical
    codes = np.rint(rf * np.float32(share * largest))
    np.clip(codes, -largest, largest - 1, out=codes)
    if setup.left:
        codes *= 2 ** (16 - setup.bits)
    return codes.astype(np.int16), share


def _judge(scene: Scene, truth: Truth, peak: Array, clipped: Bools) -> World:
    """What each line is to a judge."""
    setup, hand = scene.setup, scene.hand
    kind = np.full(len(peak), setup.without or "air", dtype="U20")
    kind[scene.soft] = "soft"
    kind[hand.bone] = "bone"
    kind[hand.bone & (truth.tilt_deg > TILTED_DEG)] = "bone-tilted"
    kind[hand.bone & (truth.snr_db < WEAK_DB)] = "bone-weak"
    apart_mm = np.abs(scene.skin_us * setup.mm_us / 2 - hand.depth_mm)
    near = apart_mm < 0.4 + 0.75 * setup.mm_us / (setup.bandwidth * setup.centre_mhz)
    second = np.abs(scene.multiple(np.array([2]))[:, 0])
    hidden = hand.bone & near & (second > HIDES * peak) & (setup.delay.length_mm > 0)
    for name, rows in (("bone-under-multiple", hidden), ("bone-clipped", clipped), ("edge", hand.edge)):
        kind[rows] = name
    return World(**vars(setup), kind=kind, ignore=hand.edge | hidden | clipped)
