"""Simulated A-lines over bone that is hundreds of coherent facets of a tilted, curved, rough surface.

In the other families a law says how a bone's echo fades with tilt. Here the facets under the footprint are summed, so that loss
by tilt, early arrival, broadened and split echoes come out of the surface itself. Every echo is the pulse's spectrum times the
transfer function of its way: attenuation with the dispersion that belongs to it, and diffraction. The delay line answers with
the second and third power of all that comes back at its end, so that bone and tissue have ghosts, too. Speckle is fixed to the
head and changes as the beam moves over it. What a recording is drawn from is in facet_plan.py, the hand's way in facet_hand.py,
the echoes of bone and tissue in facet_echoes.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.facet_echoes import Floats, Probe, Spectra, tissue
from Testing.Studies.simulators.facet_hand import Hand, draw_hand, draw_poses, wander
from Testing.Studies.simulators.facet_plan import Array, Part, World, draw_parts, draw_place, draw_world, ratio
from Testing.Studies.simulators.line_truth import Truth

Bools = npt.NDArray[np.bool_]

EDGE_MM = 1.2  # beside the footprint: a beam partly on a hole
RING_DECAYS = 25  # of the ring-down, until nothing of it is left
MOST_SNR_DB = 42.0
NO_BONE = 0.3  # echo that the noise is measured by in a recording without bone


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
            bone[rows], rest[rows] = tissue(probe, place, rng, hand.take(rows))
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
