"""Simulated A-lines as a pulser with a board of ten bits and an unsteady hand make them.

What the other families lack is the device. The pulse is causal: it starts when the pulser fires, rises at once and decays slowly,
driven both ways, and its frequency is not the stated one. The trigger is off by up to a sample, a line starts with stale samples
and the clock's spike, a switch that ends the damping leaves its mark, the base line recovers and wanders, the delay line's sides
answer behind its face, and the operator turns the gain in mid recording, which is stated nowhere. Attenuation leaves the lowest
frequencies alone, as it does in tissue: a deep echo stands on a slow swell. Where the bone has a hole, dura and brain answer.
What a recording is drawn from, and how the hand goes, is in device_plan.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.device_plan import (
    BARE_FACE_R,
    Array,
    Hand,
    Setup,
    World,
    decibel,
    draw_hand,
    draw_poses,
    draw_setup,
    draw_statuses,
)
from Testing.Studies.simulators.echo_spectra import echo_spectra
from Testing.Studies.simulators.line_truth import Truth

Floats = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]

NEPER = np.log(10) / 20  # a decibel
PULSE_STEPS, PULSE_CYCLES = 16, 14  # the pulse's samples a cycle; it ends after so many cycles
WHOLE_PULSE = 2048  # samples of the attenuated pulse, which is no longer causal
FAINT = 1e-3  # of the pulse's spectrum: not simulated above
LOSS_LEVELS = 10  # of the table of what attenuation leaves of the pulse's height
GRAIN = 100  # samples to each side of a scatterer's echo

FIRED, RINGS, RING_CYCLES, LAST_RING_CYCLES = 40.0, 1.5, 1.4, 28  # the transmitted pulse, and how the element rings on
DRIVEN_BACK = 0.6  # the second half of the drive, half a cycle later
SWITCH = 0.02  # of the damping
FACE_ECHOES, AGAIN = 6, 0.35  # of the delay line; reflection of the transducer
DRY_R, AIR_R = -0.95, -0.97  # of a dry part of the face; of the face in air
TRIGGER_SAMPLES, DELAY_JITTER_US = 0.7, 0.004
BUBBLES, BUBBLE_R, BUBBLE_MM = 8, 0.25, 0.8
DIFFUSE_PARTS, DIFFUSE_US = 10, 0.22  # what rough bone scatters comes so much later
GALEAS, FASCIAE = 2, 5
DURA_MM, DURA_R = 5.5, 0.06  # behind a hole
TURNING_MM = 1.1  # of the way: the speckle turns by a radian in 1 / 1.1 mm

FULL = 512  # codes
LEAST_NOISE_CODES = 0.6
ROUNDING_CODES = 0.29
STALE = 100.0  # what the first samples hold
CLOCK_SPIKE = (150, -160, 90, -40)
STALE_SAMPLES = 6


class Pulse:
    """The transmitted pulse: its envelope peaks with height 1 at time zero of `time_us`."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        stated = setup.centre_mhz
        self.step_us = 1 / (PULSE_STEPS * stated)
        time = np.arange(PULSE_STEPS * PULSE_CYCLES) * self.step_us
        decay_us = 0.42 / (setup.bandwidth * stated) * (1.3 if setup.order == 1 else 1.0)
        over = time / decay_us
        made = over**setup.order * np.exp(-over)
        made *= np.sin(2 * np.pi * stated * (1 + setup.off_centre) * time + setup.phase)
        back = PULSE_STEPS // 2
        made[back:] -= DRIVEN_BACK * made[:-back].copy()
        spectrum = scipy.fft.rfft(made, WHOLE_PULSE)
        envelope = np.abs(_analytic(spectrum[None])[0])
        peak = int(envelope[: len(made)].argmax())
        self.height = made / envelope[peak]
        self.late_us = peak * self.step_us  # from the firing to the peak
        self.time_us: Array = np.asarray(time - self.late_us, dtype=float)
        self._spectrum = (spectrum / envelope[peak]).astype(np.complex64)
        self._mhz = np.arange(WHOLE_PULSE // 2 + 1) * (PULSE_STEPS * stated / WHOLE_PULSE)

    def _attenuated(self, lost: Array) -> Complex:
        """Spectra of the pulse that has lost so many neper a MHz (n,)."""
        return np.asarray(self._spectrum * np.exp((-lost[:, None] * self._mhz).astype(np.float32)))

    def peaks(self, lost: Array) -> Array:
        """Height of the envelope (n,) after losses in neper a MHz."""
        levels = np.linspace(lost.min(), lost.max() + 1e-9, LOSS_LEVELS)
        heights = np.abs(_analytic(self._attenuated(levels))).max(axis=1)
        return np.asarray(np.exp(np.interp(lost, levels, np.log(heights))))

    def grains(self, lost: Array) -> Floats:
        """Echoes of scatterers (n, 2 GRAIN + 1), of energy 1, sampled as the lines are; time zero in the middle."""
        made = np.roll(scipy.fft.irfft(self._attenuated(lost), WHOLE_PULSE, axis=1), WHOLE_PULSE // 2, axis=1)
        whole_us = (np.arange(WHOLE_PULSE) - WHOLE_PULSE // 2) * self.step_us - self.late_us
        wanted_us = np.arange(-GRAIN, GRAIN + 1) / self.setup.sampling_mhz
        grains = np.stack([np.interp(wanted_us, whole_us, row, 0, 0) for row in made])
        return np.asarray(grains / np.linalg.norm(grains, axis=1, keepdims=True), dtype=np.float32)


def _analytic(spectra: npt.NDArray[np.complexfloating]) -> npt.NDArray[np.complexfloating]:
    """Analytic signals (n, WHOLE_PULSE) of spectra of real ones (n, WHOLE_PULSE / 2 + 1)."""
    return np.asarray(scipy.fft.ifft(2 * spectra[:, 1:-1], WHOLE_PULSE, axis=1))


class Scene:
    """The lines of a recording under way; arrays (n,)."""

    def __init__(self, rng: np.random.Generator, setup: Setup, hand: Hand) -> None:
        self.rng, self.setup, self.hand, self.pulse = rng, setup, hand, Pulse(setup)
        count, rate = len(hand.kind), setup.sampling_mhz
        trigger_us = self.pulse.late_us + rng.uniform(-TRIGGER_SAMPLES, TRIGGER_SAMPLES, count) / rate
        self.fired_us: Array = trigger_us  # the transmitted pulse's peak
        warmth = rng.normal(0, 0.003) + rng.normal(0, 0.002) * np.arange(count) / count
        self.delay_us: Array = setup.delay_us * (1 + warmth)
        if setup.face_r:
            self.delay_us += rng.normal(0, DELAY_JITTER_US, count)
        self.skin_us = self.fired_us + self.delay_us
        self.samples = int((setup.delay_us + setup.reach_mm / setup.mm_us) * rate)
        longest = int(np.ceil((PULSE_CYCLES + 2) / setup.centre_mhz * rate))
        self.size = scipy.fft.next_fast_len(self.samples + max(longest, 2 * GRAIN), real=True)
        self.through = hand.wet**1.5 * setup.entering / decibel(hand.hair_db) * hand.touching
        self.specular = np.exp(-np.log(2) * (hand.tilt_deg / setup.lobe_deg) ** 2)
        self.bone = np.where(hand.bone, self.through * setup.bone_r * hand.covered, 0.0)

    def lost(self, depth_mm: npt.ArrayLike) -> Array:
        """Neper a MHz, there and back."""
        return np.asarray(0.2 * NEPER * self.setup.attenuation * np.asarray(depth_mm, dtype=float))


def _echoes(scene: Scene) -> Complex:
    """Spectra (n, size / 2 + 1) of all that comes out of the tissue but speckle."""
    parts = [_bone(scene), _layers(scene)]
    time, height, depth = (np.concatenate(column, axis=1) for column in zip(*parts))
    setup, pulse = scene.setup, scene.pulse
    step_mhz = setup.sampling_mhz / scene.size
    highest = min(setup.sampling_mhz, PULSE_STEPS / 2 * setup.centre_mhz)
    mhz = np.arange(int(highest / step_mhz)) * step_mhz
    flat = np.zeros((1, len(pulse.time_us)))
    shape = echo_spectra(pulse.time_us[None], pulse.height[None], flat, mhz, step_mhz)[0]
    shape *= np.float32(setup.sampling_mhz * pulse.step_us)
    heard = int(np.flatnonzero(np.abs(shape) > FAINT * np.abs(shape).max())[-1]) + 1
    last_us = scene.samples / setup.sampling_mhz + 2 / setup.centre_mhz
    late = time > last_us
    time, height = np.where(late, 0.0, time), np.where(late, 0.0, height)
    total = echo_spectra(time, height, scene.lost(depth), mhz[:heard], step_mhz) * shape[:heard]
    return _folded(total, scene.size)


def _folded(spectra: Complex, size: int) -> Complex:
    """Spectra (n, k) from frequency zero on, as samples see them: what is above half the sampling rate folds back."""
    half = size // 2 + 1
    seen = np.zeros((len(spectra), half), dtype=np.complex64)
    below = min(half, spectra.shape[1])
    seen[:, :below] = spectra[:, :below]
    above = spectra[:, half:]
    if above.shape[1]:
        first = size - half  # the bin that the first one above folds to
        rows = np.arange(first, first - above.shape[1], -1)
        seen[:, rows] += above.conj()
    return seen


def _bone(scene: Scene) -> tuple[Array, Array, Array]:
    """When, how high before attenuation, from how deep (n, m): bone's mirror, what is rough on it, bone again by the face."""
    setup, hand, rng = scene.setup, scene.hand, scene.rng
    arrival = (scene.skin_us + hand.depth_mm / setup.mm_us)[:, None]
    lag_us = np.abs(rng.normal(0, DIFFUSE_US, (len(arrival), DIFFUSE_PARTS)))
    rough = 0.5 * setup.floor * rng.normal(size=lag_us.shape) * scene.bone[:, None]
    mirror = (scene.bone * scene.specular)[:, None]
    again = mirror * setup.bone_r * (setup.face_r or BARE_FACE_R)
    depth = np.broadcast_to(hand.depth_mm[:, None], lag_us.shape)
    time = np.concatenate([arrival, arrival + lag_us, arrival + hand.depth_mm[:, None] / setup.mm_us], axis=1)
    return time, np.concatenate([mirror, rough, again], axis=1), np.concatenate([depth[:, :1], depth, 2 * depth[:, :1]], axis=1)


def _layers(scene: Scene) -> tuple[Array, Array, Array]:
    """When, how high before attenuation, from how deep (n, m): two galeas, five fasciae, the dura behind a hole."""
    setup, hand, rng = scene.setup, scene.hand, scene.rng
    tissue = (scene.through * (hand.kind != "water"))[:, None]
    depth = hand.depth_mm[:, None]
    galea_mm = np.sort(rng.uniform(0.25, 0.85, GALEAS)) * depth
    galea = rng.uniform(0.02, 0.12, GALEAS) * rng.choice([-1, 1], GALEAS) * rng.uniform(0.8, 1.2, galea_mm.shape) * tissue
    fascia_mm = np.sort(rng.uniform(0.1, 0.95, FASCIAE)) * depth
    fascia = rng.normal(0, 0.015, FASCIAE) * tissue
    apart = np.where(hand.bone, 1.0, 1.6)[:, None]  # without bone the fasciae lie further apart
    dura_mm = depth + DURA_MM
    open_ = np.where(np.isin(hand.kind, ["bone", "hole"]), 1 - hand.covered, 0.0)[:, None]
    met_mm = np.concatenate([galea_mm, apart * fascia_mm, dura_mm], axis=1)
    height = np.concatenate([galea, fascia, DURA_R * open_ * tissue], axis=1)
    return scene.skin_us[:, None] + met_mm / setup.mm_us, height, np.concatenate([galea_mm, fascia_mm, dura_mm], axis=1)


def _add_noise(scene: Scene, spectra: Complex, noise: float) -> None:
    """Noise behind the analogue filter, 0.2 to 1.8 of the stated frequency."""
    setup = scene.setup
    low, high = 0.2 * setup.centre_mhz, min(1.8 * setup.centre_mhz, 0.47 * setup.sampling_mhz)
    # a Butterworth band-pass of two poles to each side, by the bilinear transform
    edge_low, edge_high = (np.tan(np.pi * edge / setup.sampling_mhz) for edge in (low, high))
    warped = np.tan(np.pi * np.arange(1, spectra.shape[1]) / scene.size)
    off = (warped**2 - edge_low * edge_high) / (warped * (edge_high - edge_low))
    passes = np.append(0.0, 1 / np.sqrt(1 + off**4)).astype(np.float32)
    white = scene.rng.standard_normal((len(spectra), 2 * len(passes)), dtype=np.float32).view(np.complex64)
    white *= passes
    level = np.linalg.norm(white, axis=1, keepdims=True) * np.float32(np.sqrt(2) / scene.size)
    spectra += white * (np.float32(noise) / level)


def _add_speckle(scene: Scene, rf: Floats) -> None:
    """What scatters in the tissue: it turns as the hand goes on, lies in patches, and there is none in the shadow of bone."""
    setup, hand = scene.setup, scene.hand
    rows = np.flatnonzero(hand.touching & (hand.kind != "water"))
    if not len(rows):
        return
    field = scipy.fft.rfft(scene.rng.standard_normal((2, scene.size), dtype=np.float32), axis=1)
    turned = TURNING_MM * hand.way_mm[rows]
    grains = scene.pulse.grains(scene.lost(hand.depth_mm[rows] / 2))
    spectra = scipy.fft.rfft(grains, scene.size, axis=1)
    spectra *= np.stack([np.cos(turned), np.sin(turned)], axis=1).astype(np.float32) @ field
    waves = scipy.fft.irfft(spectra, scene.size, axis=1)[:, GRAIN : GRAIN + scene.samples]
    depth = np.arange(scene.samples) * (setup.mm_us / setup.sampling_mhz)
    skin_mm = scene.skin_us[rows] * setup.mm_us
    fades = float(scene.lost(1.0)) * setup.centre_mhz
    patch = 2 * np.pi / 1.7
    ahead = hand.way_mm[rows] / 3 - patch * skin_mm
    swell = np.stack([np.sin(ahead), np.cos(ahead)], axis=1) @ np.stack([np.cos(patch * depth), np.sin(patch * depth)])
    waves *= (1 + 0.6 * swell).astype(np.float32)
    waves *= np.exp(-fades * depth).astype(np.float32)
    waves *= (setup.speckle * scene.through[rows] * np.exp(fades * skin_mm)).astype(np.float32)[:, None]
    first = np.floor(skin_mm / depth[1]).astype(int) + 1
    bone = np.floor((skin_mm + hand.depth_mm[rows]) / depth[1]).astype(int) + 1
    for number, row in enumerate(rows):
        waves[number, : first[number]] = 0
        if hand.bone[row]:
            waves[number, bone[number] :] *= np.float32(1 - hand.covered[row])
    rf[rows, : scene.samples] += waves


def _add_pulses(scene: Scene, rf: Floats, time_us: Array, height: npt.ArrayLike) -> None:
    """One echo of the pulse that has lost nothing, in every line: when it peaks, how high; each (n,)."""
    pulse, rate = scene.pulse, scene.setup.sampling_mhz
    high = np.broadcast_to(height, time_us.shape)
    first = np.ceil((time_us + pulse.time_us[0]) * rate).astype(int)
    length = int(np.ceil(PULSE_CYCLES / scene.setup.centre_mhz * rate)) + 1
    rows = np.flatnonzero((high != 0) & (first < scene.samples))
    at = first[rows, None] + np.arange(length)
    wave = np.interp(at / rate - time_us[rows, None], pulse.time_us, pulse.height, 0, 0) * high[rows, None]
    inside = (at >= 0) & (at < scene.samples)
    np.add.at(rf, (np.broadcast_to(rows[:, None], at.shape)[inside], at[inside]), wave[inside].astype(np.float32))


def _add_probe(scene: Scene, rf: Floats) -> None:
    """The transmitted pulse and its ringing, the damping's switch, the delay line's face and sides, bubbles in the hair."""
    setup, hand, rng = scene.setup, scene.hand, scene.rng
    on = hand.kind != "empty"
    _add_pulses(scene, rf, scene.fired_us, FIRED * on)
    _add_ringing(scene, rf, RINGS * on)
    if setup.face_r:
        _add_pulses(scene, rf, scene.fired_us + rng.uniform(0.3, 0.9) * setup.delay_us, SWITCH * on)
        wet = hand.wet * setup.face_r + (1 - hand.wet) * DRY_R
        face = np.where(hand.kind == "air", AIR_R, wet) * on
        for number in range(1, FACE_ECHOES + 1):
            _add_pulses(scene, rf, scene.fired_us + number * scene.delay_us, face * (AGAIN * face) ** (number - 1))
        for after_us, side in zip(rng.uniform(0.6, 2.5, 3), rng.normal(0, 0.02, 3)):
            _add_pulses(scene, rf, scene.skin_us + after_us, face * side)
    hairy = hand.touching & (hand.hair_db > 0)
    if hairy.any():
        for _ in range(BUBBLES):
            bubble_mm = np.abs(rng.normal(0, BUBBLE_MM, len(on)))
            height = BUBBLE_R * rng.normal(size=len(on)) * setup.entering * hairy
            _add_pulses(scene, rf, scene.skin_us + bubble_mm / setup.mm_us, height)


def _add_ringing(scene: Scene, rf: Floats, height: Array) -> None:
    """The element rings on behind the transmitted pulse."""
    setup = scene.setup
    last = min(int((scene.fired_us.max() + LAST_RING_CYCLES / setup.centre_mhz) * setup.sampling_mhz), scene.samples)
    cycles = (np.arange(last) / setup.sampling_mhz - scene.fired_us[:, None]) * setup.centre_mhz
    rings = np.exp(-np.maximum(cycles, 0) / RING_CYCLES) * np.cos(2 * np.pi * cycles) * (cycles >= 0)
    rf[:, :last] += (height[:, None] * rings).astype(np.float32)


def _board_gain(scene: Scene, square: float, noise: float) -> float:
    """Codes a unit: bone fits also where the operator turns the gain up; noise shows in the last bits."""
    rng, without = scene.rng, scene.setup.without
    if without in ("air", "empty", "water"):
        return float(rng.uniform(0.6, 4) / noise)
    turned_up = float(decibel(max(scene.hand.gain_db.max(), 0)))
    return float(max(rng.uniform(0.15, 0.7) * FULL / square / turned_up, LEAST_NOISE_CODES / noise))


def _converted(scene: Scene, rf: Floats, gain: Array) -> npt.NDArray[np.int16]:
    """Codes of ten bits, with the base line, spikes, and what the board puts at a line's start."""
    rng, (count, samples) = scene.rng, rf.shape
    time_us = np.arange(samples) / scene.setup.sampling_mhz
    turns = 2 * np.pi * 0.04 * time_us
    phase = rng.uniform(0, 2 * np.pi, count)
    rf *= gain.astype(np.float32)[:, None]
    shapes = np.stack([np.ones(samples), np.exp(-time_us / 8), np.sin(turns), np.cos(turns)]).astype(np.float32)
    base = rng.normal(0, 25) + rng.normal(0, 4, count)
    heights = np.stack([base, rng.uniform(15, 30, count), 5 * np.cos(phase), 5 * np.sin(phase)], axis=1)
    rf += heights.astype(np.float32) @ shapes
    for row in np.flatnonzero(rng.random(count) < 0.06):
        rf[row, rng.integers(10, samples, 3)] += rng.normal(0, 200, 3).astype(np.float32)
    rf[:, :STALE_SAMPLES] = rng.normal(0, STALE, (count, STALE_SAMPLES))
    rf[:, STALE_SAMPLES : STALE_SAMPLES + len(CLOCK_SPIKE)] = CLOCK_SPIKE
    np.rint(rf, out=rf)
    return np.clip(rf, -FULL, FULL - 1, out=rf).astype(np.int16)


@dataclass(frozen=True, eq=False)
class Received:
    """What the board gave."""

    lines: npt.NDArray[np.int16]
    snr_db: Array  # (n,) of the bone's echo over noise and rounding; -inf: no bone


def _receive(scene: Scene) -> Received:
    """The lines, of all parts."""
    setup, hand = scene.setup, scene.hand
    kept = scene.pulse.peaks(scene.lost(np.append(hand.depth_mm, setup.about_mm)))
    square = setup.bone_r * setup.entering * float(kept[-1])
    noise = square / float(decibel(setup.snr_db))
    spectra = _echoes(scene)
    _add_noise(scene, spectra, noise)
    rf = np.ascontiguousarray(scipy.fft.irfft(spectra, scene.size, axis=1)[:, : scene.samples])
    _add_speckle(scene, rf)
    _add_probe(scene, rf)
    gain = _board_gain(scene, square, noise) * decibel(hand.gain_db)
    peak = scene.bone * np.hypot(scene.specular, setup.floor) * kept[:-1]
    over = peak * gain / np.hypot(noise * gain, ROUNDING_CODES)
    snr = np.where(hand.bone, 20 * np.log10(np.maximum(over, 1e-6)), -np.inf)
    return Received(_converted(scene, rf, gain), snr)


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines, at least LEAST_LINES, the truth about it, and what it was drawn from."""
    setup = setup or draw_setup(rng)
    hand = draw_hand(rng, setup, frames)
    scene = Scene(rng, setup, hand)
    received, count = _receive(scene), len(hand.kind)
    poses, statuses = draw_poses(rng, setup, hand), draw_statuses(rng, count)
    poses[np.array(statuses) != "OK"] = np.nan
    recording = Recording(
        lines=received.lines,
        acquisition=setup.acquisition,
        probe_to_reference=poses,
        statuses=statuses,
        timestamps_s=3 + np.cumsum(rng.uniform(0.03, 0.06, count)),
        palpation_points=np.full(count, int(rng.integers(18)) if setup.style == "dwell" else -1),
    )
    truth = Truth(np.where(hand.bone, hand.depth_mm, np.nan), hand.tilt_deg, setup.speed_m_s, received.snr_db)
    world = World(
        **vars(setup),
        late_us=scene.pulse.late_us,
        kind=hand.kind,
        wet=hand.wet,
        hair_db=hand.hair_db,
        gain_db=hand.gain_db,
        ignore=hand.ignore,
        must=hand.must & (np.array(statuses) == "OK"),
    )
    return recording, truth, world
