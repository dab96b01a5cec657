"""Simulated A-lines over a skull in relief: what the bone answers is a sum over a patch of a rough, curved surface.

Other families give a line one row of facets, or an echo of drawn strength. Here the beam's footprint is a patch of 64 x 64 facets
of a surface that is rough in both directions, so that an oblique echo breaks up and depth follows the relief. The pulse rings
on asymmetrically with an unknown phase; loss comes with its dispersion. Soft places are stacks of sheets none of which stands
out, speckle changes along the skin together with the layers, a delay line warms while one measures, hair leaves a faint echo
of the bone, and a craniotomy shows dura below its rims. The receiver has a time gain, drifts, recovers, spikes, and clips.
The set-up and the hand are drawn in relief_plan.py, the echoes in relief_echoes.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.relief_echoes import (
    Band,
    Floats,
    Scene,
    Spectra,
    add_bone,
    add_face,
    add_layers,
    add_speckle,
    draw_scene,
)
from Testing.Studies.simulators.relief_plan import (
    SQUARE_DEG,
    Array,
    Bools,
    Setup,
    World,
    decibel,
    draw_ground,
    draw_hand,
    draw_poses,
    draw_setup,
    draw_statuses,
    wander,
)

FAINT_DB = 12.0  # squarely met bone below is judged by nobody
ROUNDING = 0.29  # codes


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, World]:
    """A recording of about `frames` lines (a person goes to whole places), the truth about it, and what it was drawn from."""
    setup = setup or draw_setup(rng)
    hand = draw_hand(rng, setup, frames)
    ground = draw_ground(rng, setup, hand)
    scene, samples = draw_scene(rng, setup, hand, ground)
    from_skin = np.zeros((len(hand.kind), len(scene.band.mhz)), dtype=np.complex64)
    peak, relief_mm = add_bone(rng, scene, from_skin)
    add_layers(rng, scene, from_skin)
    add_speckle(rng, scene, from_skin)
    spectra = from_skin * scene.entered * scene.band.delayed(scene.skin_us)
    if setup.delay_line is not None:
        add_face(scene, spectra)
    lines, level = _receive(rng, scene, spectra, peak, samples)
    statuses = draw_statuses(rng, len(lines))
    tracked = np.array(statuses) == "OK"
    poses = draw_poses(rng, setup, hand, ground.depth_mm)
    apart = np.diff(hand.place, prepend=hand.place[0]) != 0
    recording = Recording(
        lines=lines,
        acquisition=setup.acquisition,
        probe_to_reference=np.where(tracked[:, None, None], poses, np.nan),
        statuses=statuses,
        timestamps_s=np.cumsum(np.where(apart, rng.uniform(0.6, 2), hand.step_s)),
        palpation_points=np.full(len(lines), -1) if setup.sweeps else hand.place + 1,
    )
    answers = scene.bone & (hand.kind != "hair") & (level.snr_db > -np.inf)
    depth_mm = np.where(answers, ground.depth_mm + relief_mm, np.nan)
    truth = Truth(depth_mm, hand.tilt_deg, setup.speed_m_s, np.where(answers, level.snr_db, -np.inf))
    return recording, truth, _judge(scene, level)


@dataclass(frozen=True, eq=False)
class Level:
    """How loud bone is in the codes of each line."""

    snr_db: Array  # (n,)
    clipped: Bools  # (n,)


def _receive(
    rng: np.random.Generator, scene: Scene, spectra: Spectra, peak: Array, samples: int
) -> tuple[npt.NDArray[np.int16], Level]:
    """Codes (n, samples): noise, time gain, spikes and baseline come in, and the converter clips. `peak` is bone's height."""
    setup, band, square = scene.setup, scene.band, scene.square
    fastest = np.abs(band.pulse).sum()
    if square.any():
        usual = float(np.median(peak[square]))
    else:
        way = np.abs(band.way(np.array([setup.depth_mm]))[0] * band.pulse) * band.through_line
        usual = 0.5 * scene.bone_r * float(way.sum() / fastest)
    noise = usual / float(decibel(setup.snr_db))
    lines = _heard(rng, band, spectra, noise)[:, :samples]
    _add_bang(rng, scene, lines)
    gain = _draw_gain(rng, scene, samples)
    lines *= gain.astype(np.float32)
    bone_at = ((scene.face_us + scene.ground.depth_mm * setup.us_mm) * setup.sampling_mhz).astype(np.int64)
    gain_at = gain[np.minimum(bone_at, samples - 1)]
    if rng.random() < 0.15:
        _add_spikes(rng, lines, usual)
    face = 1.15 * abs(scene.face_r) * float((band.through_line * np.abs(band.pulse)).sum() / fastest)
    loudest = float(np.percentile((peak * gain_at)[square], 98)) if square.any() else usual
    largest = max(loudest, usual, 8 * noise * gain.max(), face)
    full = largest * (0.75 if rng.random() < 0.1 else float(rng.uniform(1.3, 3)))
    bits = int(rng.choice([12, 12, 14, 16]))
    codes = 2 ** (bits - 1) / full
    offset = _add_baseline(rng, scene, lines, full)
    lines *= np.float32(codes)
    np.rint(lines, out=lines)
    np.clip(lines, -(2 ** (bits - 1)), 2 ** (bits - 1) - 1, out=lines)
    left = 1 if rng.random() < 0.5 else 2 ** (16 - bits)
    heard = np.hypot(noise * gain_at, ROUNDING / codes)
    with np.errstate(divide="ignore"):
        snr_db = np.where(scene.bone, 20 * np.log10(peak * gain_at / heard), -np.inf)
    return lines.astype(np.int16) * np.int16(left), Level(snr_db, peak * gain_at + offset > 0.98 * full)


def _heard(rng: np.random.Generator, band: Band, spectra: Spectra, noise: float) -> Floats:
    """Lines (n, size of the band) of the echoes, and of noise that is white within the receiver's band."""
    setup, size = band.setup, band.size
    mhz = np.maximum(np.arange(size // 2 + 1) * band.step_mhz, 1e-6)
    highest = min(2.2 * setup.centre_mhz, 0.45 * setup.sampling_mhz)
    passed = 1 / np.sqrt(1 + (0.25 * setup.centre_mhz / mhz) ** 4) / np.sqrt(1 + (mhz / highest) ** 8)
    whole = rng.standard_normal((len(spectra), 2 * len(mhz)), dtype=np.float32).view(np.complex64)
    whole *= (passed * (0.5 * size * noise / np.linalg.norm(passed))).astype(np.float32)
    whole[:, band.slice] += spectra * np.float32(0.5 * size)
    return np.asarray(scipy.fft.irfft(whole, size, axis=1, overwrite_x=True))


def _add_bang(rng: np.random.Generator, scene: Scene, lines: Floats) -> None:
    """Put in the transmitted pulse, which rings on."""
    centre = scene.setup.centre_mhz
    height, lasts_us = rng.uniform(8, 30) * scene.bone_r, rng.uniform(0.5, 1.1) / centre
    count = min(int(30 * lasts_us * scene.setup.sampling_mhz), lines.shape[1])
    since_us = np.maximum(np.arange(count) / scene.setup.sampling_mhz - scene.trigger_us[:, None], 0)
    lines[:, :count] += (height * np.exp(-since_us / lasts_us) * np.cos(2 * np.pi * centre * since_us + 1)).astype(np.float32)


def _draw_gain(rng: np.random.Generator, scene: Scene, samples: int) -> Array:
    """Time gain (samples,): of some receivers it grows from the skin on."""
    if rng.random() >= 0.25:
        return np.ones(samples)
    since_us = np.clip(np.arange(samples) / scene.setup.sampling_mhz - scene.face_us.mean(), 0, 18)
    return decibel(since_us * rng.uniform(0.4, 1.2))


def _add_spikes(rng: np.random.Generator, lines: Floats, usual: float) -> None:
    """Put in a disturbance of one to three samples, in a few lines."""
    for row in np.flatnonzero(rng.random(len(lines)) < 0.07):
        at = int(rng.integers(20, lines.shape[1] - 4))
        lines[row, at : at + int(rng.integers(1, 4))] += np.float32(rng.choice([-1, 1]) * rng.uniform(0.4, 1.5) * usual)


def _add_baseline(rng: np.random.Generator, scene: Scene, lines: Floats, full: float) -> float:
    """Put in an offset that drifts, and an amplifier's recovery; how far from zero the baseline comes."""
    drift = wander(rng, len(lines), scene.hand.step_s, 1.0, 1.0) * 0.004 * full + rng.normal() * 0.01 * full
    recovery: Array = np.zeros(lines.shape[1])
    if rng.random() < 0.4:
        time_us = np.arange(lines.shape[1]) / scene.setup.sampling_mhz
        recovery = 0.02 * full * rng.normal() * np.exp(-time_us / rng.uniform(4, 15))
    lines += drift.astype(np.float32)[:, None]
    lines += recovery.astype(np.float32)
    return float(max(abs(drift.max() + recovery.max()), abs(drift.min() + recovery.min())))


def _judge(scene: Scene, level: Level) -> World:
    """What each line is, and which nobody is judged by."""
    hand, edge = scene.hand, scene.ground.edge
    bone = hand.kind == "bone"
    square = hand.tilt_deg <= SQUARE_DEG
    clipped, faint = bone & level.clipped, bone & square & (level.snr_db < FAINT_DB)
    kind = np.where(faint, "bone-faint", hand.kind)
    kind = np.where(bone & ~square, "bone-oblique", kind)
    kind = np.where(clipped, "clipped", kind)
    kind = np.where(edge, "edge", kind)
    ignore = (hand.kind == "touch") | edge | clipped | faint
    return World(**vars(scene.setup), kind=kind, ignore=ignore, skin_us=scene.skin_us)
