"""Simulated A-lines whose trigger comes late: where a delay line ends is told by its echo in the line alone.

What the other families lack: a delay line's stated time is off by the trigger's latency, its true speed and its warming, as much
as a millimetre of tissue. A pulse rises faster than it falls and is off the stated frequency; the disc averages a mirror's
arrivals, which refraction in the delay line shifts; the shortest path to a spherical bone comes first. Drops hang on the face in
air, bubbles and hair take single lines away, the glide passes a burr hole. No network is ever fitted to this family: it judges
those that were fitted to others. What a recording is drawn from is in latency_plan.py, how the hand goes in latency_hand.py, what
answers in latency_echoes.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.latency_echoes import (
    Band,
    Complex,
    Floats,
    Scene,
    after_bone,
    bone_echo,
    delay_line,
    draw_scene,
    tissue,
)
from Testing.Studies.simulators.latency_hand import draw_poses, draw_statuses, wander
from Testing.Studies.simulators.latency_plan import Array, Bools, Setup, World, decibel, draw_setup
from Testing.Studies.simulators.line_truth import Truth

TIME_ZERO_DB = 14.0  # the delay line's echo stands so far over the noise
GAIN_MM = 18.0  # the gain rises down to here
LEAST_CODES, MOST_BITS = 12.0, 16  # of the bone's echo; otherwise a better converter is taken
WEAK_DB, HIDES_CYCLES, RINGS = 12.0, 2.5, 0.7  # bone is lost: in noise, near the second echo, in ringing over its height


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines, at least LEAST_LINES, the truth about it, and what it was drawn from."""
    setup = setup or draw_setup(rng)
    scene = draw_scene(rng, setup, frames)
    hand, bone_rows = scene.hand, scene.ground.bone
    reach_mm = max(17.0, 1.3 * float(hand.depth_mm[hand.on].max(initial=0.0))) + float(rng.uniform(2, 12))
    band = Band(setup, int((setup.delay_us + 2 * reach_mm / setup.mm_us) * setup.sampling_mhz))
    bone = bone_echo(scene, band, rng)
    whole_peak = band.peaks(bone)
    bone *= bone_rows.astype(np.float32)[:, None]
    spectra = bone + bone * after_bone(scene, band, rng) + tissue(scene, band, rng)
    if setup.delay.length_mm:
        spectra += delay_line(scene, band, rng)
    levels = _levels(scene, band, whole_peak)
    rf = _received(band, rng, spectra * band.pulse, levels.noise)
    lines, converted = _record(scene, rng, rf, levels, whole_peak * bone_rows)
    statuses = draw_statuses(rng, setup, len(rf))
    tracked = np.array(statuses) == "OK"
    recording = Recording(
        lines=lines,
        acquisition=setup.acquisition,
        probe_to_reference=np.where(tracked[:, None, None], draw_poses(rng, setup, hand), np.nan),
        statuses=statuses,
        timestamps_s=10 + np.cumsum(1 / rng.uniform(20, 60) + np.abs(rng.normal(0, 0.001, len(rf)))),
        palpation_points=hand.place,
    )
    truth = Truth(np.where(bone_rows, hand.depth_mm, np.nan), hand.askew_deg, setup.speed_m_s, converted.snr_db)
    return recording, truth, _judge(scene, converted, tracked)


@dataclass(frozen=True)
class Levels:
    """Heights that the noise and the converter go by."""

    bone: float  # four of five lines that meet bone squarely are higher
    face: float  # of the delay line; 0: none
    noise: float


def _levels(scene: Scene, band: Band, whole_peak: Array) -> Levels:
    """Where too little bone is met squarely, as if it were everywhere; in air, as if in 5 mm. Time zero must be readable."""
    clear, wet = scene.clear, scene.ground.wet
    if clear.sum() < 3:
        clear = scene.hand.square & (scene.coupling > 0.4)
    if clear.any():
        bone = float(np.percentile(whole_peak[clear], 20))
    else:
        bone = 0.6 / band.size * float((np.abs(band.pulse) * np.exp(-band.lost(5.0) * band.mhz)).sum())
    face, noise = 0.0, bone / float(decibel(scene.setup.snr_db))
    held = wet & scene.hand.on
    if scene.setup.delay.length_mm and held.any():
        one = band.peaks(band.echo(np.ones(1), np.full(1, band.lost_in_delay)))[0]
        face = float(one * np.median(np.abs(scene.face_r[held])))
        noise = min(noise, face / float(decibel(TIME_ZERO_DB)))
    return Levels(bone, face, noise)


def _received(band: Band, rng: np.random.Generator, spectra: Complex, noise: float) -> Floats:
    """Lines (n, samples) of the echoes, and of noise that is limited to the receiver's band."""
    heard = np.append(0.0, band.receiver(band.every_mhz[1:]))
    whole = rng.standard_normal((len(spectra), 2 * len(heard)), dtype=np.float32).view(np.complex64)
    whole *= (heard * (0.5 * band.size * noise / np.linalg.norm(heard))).astype(np.float32)
    whole[:, band.bins] += spectra
    return np.asarray(scipy.fft.irfft(whole, band.size, axis=1)[:, : band.samples])


@dataclass(frozen=True, eq=False)
class Converted:
    """What became of the bone's echo (n,)."""

    bits: int
    snr_db: Array  # over the noise and the rounding; -inf: no bone
    rings: Bools  # lost in the ringing


def _record(
    scene: Scene, rng: np.random.Generator, rf: Floats, levels: Levels, peak: Array
) -> tuple[npt.NDArray[np.int16], Converted]:
    """The lines as codes. The gain rises, the bang rings, the base line recovers from it and wanders; the converter clips."""
    setup, centre, (count, samples) = scene.setup, scene.setup.transducer.centre_mhz, rf.shape
    time = np.arange(samples) / setup.sampling_mhz
    _disturb(scene, rng, rf, levels, time)
    gain = decibel(setup.gain_db * np.clip((time - setup.delay_us) * setup.mm_us / (2 * GAIN_MM), 0, 1))
    bone_us = scene.skin_us + np.minimum(scene.shortest_us, scene.axial_us)
    at = np.clip((bone_us * setup.sampling_mhz).astype(int), 0, samples - 1)
    peak = peak * gain[at]
    full = 4 * levels.bone
    if scene.clear.any():
        full = float(np.percentile(peak[scene.clear], 95) * rng.uniform(1.2, 4))
    full = max(full, levels.face * float(rng.uniform(0.85, 1.5)))
    ringing = full * rng.uniform(8, 30) * np.exp(-time * centre / rng.uniform(0.55, 0.75))
    ringing *= np.cos(2 * np.pi * 0.92 * centre * time + rng.uniform(0, 2 * np.pi))
    typical_us = setup.delay_us + 2 * float(np.median(scene.hand.thick_mm)) / setup.mm_us
    bits = int(rng.choice([10, 12, 12, 14]))
    while levels.bone * np.interp(typical_us, time, gain) / full * 2 ** (bits - 1) < LEAST_CODES and bits < MOST_BITS:
        bits += 2
    largest = 2 ** (bits - 1) - 1
    base = rng.normal(0, 0.02) + rng.normal(0, 0.03) * np.exp(-time / rng.uniform(3, 10))
    base += 0.006 * np.sin(2 * np.pi * rng.uniform(0.02, 0.12) * time)
    rf *= (gain / full).astype(np.float32)
    rf += (ringing / full).astype(np.float32) * (1 + 0.002 * rng.standard_normal((count, 1), dtype=np.float32))
    rf += base.astype(np.float32)
    rf += wander(rng, count, 10, 0.003).astype(np.float32)
    codes = np.clip(np.rint(rf * np.float32(largest)), -largest - 1, largest).astype(np.int16)
    noise = np.hypot(levels.noise * gain[at], full / largest / np.sqrt(12))
    bone = scene.ground.bone
    snr = np.where(bone, 20 * np.log10(np.maximum(peak, 1e-12 * full) / noise), -np.inf)
    before = np.maximum(at - int(0.5 * setup.sampling_mhz / centre), 0)
    rings = bone & (np.abs(ringing)[before] > RINGS * peak) & (setup.delay.length_mm == 0)
    return codes, Converted(bits, np.asarray(snr, dtype=float), rings)


def _disturb(scene: Scene, rng: np.random.Generator, rf: Floats, levels: Levels, time: Array) -> None:
    """Put in a tone from without, and spikes."""
    setup, (count, samples) = scene.setup, rf.shape
    if setup.tone:
        tone_mhz = rng.uniform(0.5, 1.3) * setup.transducer.centre_mhz
        turning = 2 * np.pi * tone_mhz * time + rng.uniform(0, 2 * np.pi, (count, 1))
        rf += (levels.noise * rng.uniform(0.3, 0.7) * np.sin(turning)).astype(np.float32)
    if setup.spikes:
        for row in np.flatnonzero(rng.random(count) < 0.15):
            at = rng.integers(20, samples - 20, int(rng.integers(1, 3)))
            rf[row, at] += rng.choice([-1, 1]) * levels.bone * rng.uniform(0.5, 2)
            rf[row, at + 1] -= levels.bone * rng.uniform(0, 0.8)


def _judge(scene: Scene, converted: Converted, tracked: Bools) -> World:
    """What each line is to a judge."""
    setup, hand, kind, bone = scene.setup, scene.hand, scene.ground.kind, scene.ground.bone
    second_us = scene.start_us + 2 * scene.line_us
    bone_us = scene.skin_us + np.minimum(scene.shortest_us, scene.axial_us)
    near = np.abs(bone_us - second_us) < HIDES_CYCLES / setup.transducer.centre_mhz
    multiple = bone & near & (setup.delay.length_mm > 0)
    weak = bone & hand.square & (converted.snr_db < WEAK_DB)
    clash = np.full(len(kind), "", dtype="U8")
    for name, rows in (("weak", weak), ("ringing", converted.rings), ("multiple", multiple)):
        clash[rows & (kind != "edge")] = name
    ignore = np.isin(kind, ["edge", "rim"]) | (clash != "")
    must = bone & ~ignore & tracked & hand.square & hand.on
    return World(**vars(setup), bits=converted.bits, kind=kind, clash=clash, ignore=ignore, must=must)
