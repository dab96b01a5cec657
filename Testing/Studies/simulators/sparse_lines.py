"""Simulated A-lines of a hand that dwells, sweeps, or takes a single line of each place; the lobe of a disc at every frequency.

What the other families lack: the transmitted pulse rises faster than it decays, time zero is its peak; bone answers a tilt as the
diffraction of a disc has it, by frequency, until only the facets frozen on it are seen; the delay line's true speed is not the
stated one and drifts with its warmth; a strong galea can outshout bone; hair or a bubble comes under the probe, gel rings under a
lifted one; the trigger jitters; in sparse recordings no line is like the one before. What a recording is drawn from is in
sparse_plan.py, what answers from under the skin in sparse_echoes.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.sparse_band import Band, Floats
from Testing.Studies.simulators.sparse_echoes import ECHO_US, Parts, Scene, draw_parts, face_echoes
from Testing.Studies.simulators.sparse_plan import (
    Array,
    Bools,
    Hand,
    Setup,
    World,
    draw_beam,
    draw_ground,
    draw_hand,
    draw_poses,
    draw_setup,
    draw_statuses,
)

AIR_R = -0.98
FACE_OVER_NOISE, FACE_R_MOST = 4.0, 0.14  # the delay line's echo is made to stand out of the noise, by skin of such reflection
WEAK_DB, TILTED_DEG, CLIPS, MASKS, BESIDE = 12.0, 3.0, 0.97, 2.0, 0.316


def _draw_scene(rng: np.random.Generator, setup: Setup, frames: int) -> Scene:
    hand = draw_hand(rng, setup, frames)
    ground = draw_ground(rng, setup, int(hand.place[-1]) + 1)
    count, delay = len(hand.place), setup.delay
    trigger_us: Array = np.zeros(count)
    if rng.random() < 0.5:
        trigger_us = rng.uniform(-0.5, 0.5, count) / setup.sampling_mhz
    warmth = 2e-5 * np.cumsum(rng.normal(size=count)) + np.linspace(0, rng.uniform(-0.002, 0.002), count)
    skin_us = trigger_us + 2e3 * delay.length_mm / delay.speed_m_s * (1 + warmth)
    lost_db = np.full(count, np.inf)
    lost_db[hand.touches] = np.abs(rng.normal(0, 0.4, count))[hand.touches]
    lost_db[hand.state == "hair"] = rng.uniform(24, 40, count)[hand.state == "hair"]
    lost_db[hand.state == "edge"] = rng.uniform(3, 30, count)[hand.state == "edge"]
    beam = draw_beam(rng, setup, hand, ground)
    return Scene(setup, hand, ground, beam, trigger_us, skin_us, 10 ** (-lost_db / 20), _draw_face(rng, setup, hand))


def _draw_face(rng: np.random.Generator, setup: Setup, hand: Hand) -> Array:
    """Reflection of the delay line's face in every line (n,)."""
    count = len(hand.place)
    face_r = setup.delay.face_r * (1 + 0.08 * rng.normal(size=count) * hand.touches)
    dry, edge, hair = (hand.state == state for state in ("air", "edge", "hair"))
    face_r[dry] = AIR_R
    face_r[hair] = AIR_R + 0.3 * rng.random(count)[hair]
    face_r[edge] = -rng.uniform(0.2, 0.95, count)[edge]
    return np.asarray(face_r)


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines, at least LEAST_LINES, the truth about it, and what it was drawn from."""
    setup = setup or draw_setup(rng)
    scene = _draw_scene(rng, setup, frames)
    hand, count = scene.hand, len(scene.skin_us)
    reach_us = 2e3 * setup.delay.length_mm / setup.delay.speed_m_s + setup.window_mm * setup.us_mm
    band = Band(setup, int(np.ceil(reach_us * setup.sampling_mhz / 32)) * 32)
    parts = draw_parts(scene, band, rng)
    levels = _draw_levels(scene, band, rng, parts)
    rf = _received(scene, band, rng, parts, levels)
    spiked = _add_receiver(scene, rng, rf, levels)
    largest = 2 ** (levels.bits - 1)
    codes = np.clip(np.rint(rf * np.float32((largest - 1) / levels.full_scale)), -largest, largest - 1)
    statuses = draw_statuses(rng, setup, count)
    tracked = np.array(statuses) == "OK"
    poses = draw_poses(rng, setup, hand, scene.ground, scene.beam)
    recording = Recording(
        lines=codes.astype(np.int16),
        acquisition=setup.acquisition,
        probe_to_reference=np.where(tracked[:, None, None], poses, np.nan),
        statuses=statuses,
        timestamps_s=rng.uniform(0, 100) + np.cumsum(np.clip(1 + 0.03 * rng.normal(size=count), 0.5, 1.5)) / setup.rate_hz,
        palpation_points=hand.place + 1 if rng.random() < 0.7 else np.full(count, -1),
    )
    rounding = levels.full_scale / (largest - 1) / np.sqrt(12)
    snr_db = 20 * np.log10(np.maximum(parts.bone_peak, 1e-12) / np.hypot(levels.noise, rounding))
    heard = scene.bone & ~((hand.state == "hair") & (snr_db < 0))
    depth, tilt = np.where(heard, scene.beam.depth_mm, np.nan), np.degrees(scene.beam.tilt_rad)
    truth = Truth(depth, tilt, setup.speed_m_s, np.where(heard, snr_db, -np.inf))
    return recording, truth, _judge(scene, band, truth, parts, levels, spiked, tracked)


@dataclass(frozen=True, eq=False)
class Levels:
    """How the receiver is set."""

    noise: float  # standard deviation
    full_scale: float
    bits: int
    face_gain: float  # of the delay line's echo on the skin
    soft_gain: float  # of layers where tissue has no bone
    least_bone: float  # peak of bone met squarely on the place where it is faintest


def _draw_levels(scene: Scene, band: Band, rng: np.random.Generator, parts: Parts) -> Levels:
    """The noise is as far under bone met squarely as drawn; then what keeps a recording readable to a person."""
    setup, hand = scene.setup, scene.hand
    noise = float(np.median(parts.square)) / 10 ** (setup.snr_db / 20)
    depth = (np.arange(band.samples) / setup.sampling_mhz - scene.skin_us.mean()) / setup.us_mm
    soft_gain = 1.0
    if setup.without == "soft":  # tissue that goes on must be seen to go on
        shown = band.waves(parts.layers[:8]) / scene.coupling[:8, None] + parts.speckle[:8]
        noise = float(np.sqrt((shown[:, (depth > 9) & (depth < 12)] ** 2).mean())) / 10 ** (rng.uniform(0, 12) / 20)
    elif scene.soft.any():  # a soft place: visible tissue behind its layers, or next to nothing
        speckle = parts.speckle[scene.soft][:, (depth > 7) & (depth < 10)]
        if np.sqrt((speckle**2).mean()) < noise:
            soft_gain = min(1.0, 2 * noise / float(parts.layer_peak[scene.soft].max()))
    face, face_gain = 0.0, 1.0
    if setup.delay.length_mm and hand.touches.any():
        face = np.abs(scene.face_r[hand.touches]).max() * float(band.peaks(band.loss(scene.delay_db)[None], ECHO_US)[0])
        if face < FACE_OVER_NOISE * noise and not setup.without:  # it is the time zero
            most = max(FACE_R_MOST / abs(setup.delay.face_r), 1.0)
            face_gain = float(np.clip(FACE_OVER_NOISE * noise / face, 1, most))
            face *= face_gain
            noise = min(noise, face / FACE_OVER_NOISE)
    loudest = float(parts.square.max())
    full_scale = loudest / rng.uniform(1.2, 2.5) if setup.saturated else max(face, loudest) / rng.uniform(0.25, 0.9)
    bits = setup.bits
    while noise / full_scale * (2 ** (bits - 1) - 1) < 0.5 and bits < 16:  # nobody records under the least bit
        bits += 2
    if setup.without == "unplugged":
        noise = full_scale * 10 ** (-rng.uniform(20, 45) / 20)
    return Levels(noise, full_scale, bits, face_gain, soft_gain, float(parts.square.min()))


def _received(scene: Scene, band: Band, rng: np.random.Generator, parts: Parts, levels: Levels) -> Floats:
    """Lines (n, samples) of all echoes, and noise of the receiver's band."""
    over = band.every_mhz / scene.setup.centre_mhz
    receiver = 0.15 + 1 / (1 + (0.3 / np.maximum(over, 1e-6)) ** 4) / (1 + (over / 1.9) ** 6)
    whole = rng.standard_normal((len(scene.skin_us), 2 * len(over)), dtype=np.float32).view(np.complex64)
    whole *= (receiver * (0.5 * band.size * levels.noise / np.linalg.norm(receiver))).astype(np.float32)
    if scene.setup.without == "unplugged":
        return np.asarray(scipy.fft.irfft(whole, band.size, axis=1)[:, : band.samples])
    echoes = parts.bone + parts.behind + face_echoes(scene, band, rng, levels.face_gain)
    echoes += parts.layers * np.where(scene.soft, levels.soft_gain, 1.0).astype(np.float32)[:, None]
    whole[:, band.bins] += echoes * band.pulse
    waves = scipy.fft.irfft(whole, band.size, axis=1)[:, : band.samples]
    waves += parts.speckle * scene.coupling.astype(np.float32)[:, None]
    return np.asarray(waves)


def _add_receiver(scene: Scene, rng: np.random.Generator, rf: Floats, levels: Levels) -> Bools:
    """Put in the transmitted pulse, which rings down, an offset, drift, hum and spikes; the lines with spikes (n,)."""
    setup, (count, samples) = scene.setup, rf.shape
    time = (np.arange(samples) / setup.sampling_mhz).astype(np.float32)
    full_scale = levels.full_scale
    if setup.without != "unplugged":
        rf += _transmitted(scene, rng, time, levels) * (1 + 0.01 * rng.standard_normal((count, 1), dtype=np.float32))
    drift = np.exp(-time / np.float32(rng.uniform(3, 20)))
    rf += np.float32(0.02 * full_scale * rng.normal())
    rf += np.float32(0.01 * full_scale) * rng.standard_normal((count, 1), dtype=np.float32) * drift
    hum = np.exp(2j * np.pi * rng.uniform(0.01, 0.08) * time).astype(np.complex64)
    started = (0.003 * full_scale * np.exp(2j * np.pi * rng.random((count, 1)))).astype(np.complex64)
    rf += started.real * hum.imag
    rf += started.imag * hum.real
    spiked = setup.spikes & (rng.random(count) < 0.08)
    for row in np.flatnonzero(spiked):
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.integers(0, samples - 3))
            height = full_scale * rng.uniform(0.1, 0.6) * rng.choice([-1, 1])
            rf[row, at : at + 2] += (height * np.array([1, -0.4])).astype(np.float32)
    return np.asarray(spiked)


def _transmitted(scene: Scene, rng: np.random.Generator, time_us: Floats, levels: Levels) -> Floats:
    """The transmitted pulse and its ringing (samples,): faint before the shallowest bone, or early in the delay line."""
    setup = scene.setup
    height = levels.full_scale * float(rng.uniform(2, 12))
    faint = 0.08 * min(levels.least_bone, levels.full_scale)
    gone_us = 3.0 if setup.delay.length_mm else 0.55 * setup.us_mm * float(scene.ground.depth_mm.min())
    lasts_us = min(gone_us / np.log(height / faint), 0.5)
    turns = 2 * np.pi * setup.centre_mhz * float(rng.uniform(0.8, 1)) * time_us + float(rng.uniform(0, 2 * np.pi))
    return np.asarray(height * np.exp(-time_us / np.float32(lasts_us)) * np.cos(turns), dtype=np.float32)


def _judge(scene: Scene, band: Band, truth: Truth, parts: Parts, levels: Levels, spiked: Bools, tracked: Bools) -> World:
    """What each line is to a judge."""
    setup, hand = scene.setup, scene.hand
    bone = hand.state == "bone"
    near = scene.bone & _on_multiple(scene, band, parts, levels)
    kinds = {
        "bone-spike": spiked,
        "bone-tilted": truth.tilt_deg > TILTED_DEG,
        "bone-weak": (truth.tilt_deg <= TILTED_DEG) & (truth.snr_db < WEAK_DB),
        "bone-masked": parts.layer_peak > MASKS * parts.bone_peak,
        "bone-saturated": parts.bone_peak > CLIPS * levels.full_scale,
        "bone-on-multiple": near,
    }
    kind = hand.state.astype("U16")
    for name, rows in kinds.items():
        kind[bone & rows] = name
    hidden = (hand.state == "hair") & np.isfinite(truth.depth_mm)
    ignore = (hand.state == "edge") | hidden | near
    demanded = np.isin(kind, ["bone", "bone-spike"]) & ~ignore & tracked
    attenuation = scene.ground.attenuation
    return World(**vars(setup), attenuation=attenuation, kind=kind, ignore=ignore, demanded=demanded, skin_us=scene.skin_us)


def _on_multiple(scene: Scene, band: Band, parts: Parts, levels: Levels) -> Bools:
    """Where a later echo of the delay line is beside bone's echo, and not far below it (n,)."""
    setup, near = scene.setup, np.zeros(len(scene.skin_us), dtype=bool)
    if not setup.delay.length_mm:
        return near
    way_mm = (scene.skin_us - scene.trigger_us) / setup.us_mm
    face_r = abs(setup.delay.face_r) * levels.face_gain
    for number in (2, 3):
        left = band.peaks(band.loss(number * scene.delay_db)[None], ECHO_US)[0]
        peak = face_r**number * setup.back_r ** (number - 1) * left
        apart_mm = np.abs((number - 1) * way_mm - scene.beam.depth_mm)
        near |= (apart_mm < setup.pulse_mm) & (peak > BESIDE * parts.bone_peak)
    return near
