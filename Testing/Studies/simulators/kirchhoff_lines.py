"""Simulated A-lines whose surfaces are sums over the beam's footprint (Kirchhoff).

One model makes every line: the delay line answers with the second and third power of all that comes back at its end, and the skin
sends echoes down again, so that all multiples follow from it. What the other families lack: a face that is wet in part, a hand
that leans over for a second, holes and their edges as the part of the footprint that has bone, soft places with fascias as strong
as before bone, short delay lines whose multiples fall into the scalp. The world says which lines a detector has to accept: bone
that stands over noise, tissue and multiples.
What a recording is drawn from is in kirchhoff_plan.py, the hand's way in kirchhoff_hand.py, the echoes in kirchhoff_echoes.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from CranioNavLib.recording import Recording
from scipy.signal import butter, sosfilt

from Testing.Studies.simulators.kirchhoff_echoes import SPECKLE_PEAK, Floats, Probe, Rows, Spectra, Tissue, tissue
from Testing.Studies.simulators.kirchhoff_hand import DEPTH_MM, Hand, draw_hand, draw_poses
from Testing.Studies.simulators.kirchhoff_plan import Array, Bools, World, draw_places, draw_world, nepers
from Testing.Studies.simulators.line_truth import Truth

JITTER_S = 4e-9
BANG = 20.0  # of the transmitted pulse, over the converter's range
SQUARE_DEG, CLEAR_DB, OVER_TISSUE_DB, OVER_ALL_DB = 3.0, 12.0, 3.0, 6.0  # of a line that has to be accepted
FROM_MM, NEAR_MM = 0.6, 0.3  # tissue that the bone is compared with begins; what is beside the bone
SOFT_MM, SOFT_OVER = 12.0, 2.0  # there speckle without bone before it stands so far over the noise: its going on can be seen


@dataclass(frozen=True, eq=False)
class Received:
    """The lines before noise and converter, and how the bone stands in them."""

    rf: Floats
    peak: Array  # (n,) of the envelope of the bone's echo; 0: none
    over_tissue_db: Array  # (n,) over the largest echo before it, after attenuation
    over_all_db: Array  # (n,) over all else beside it


def _skin_s(world: World, lines: int) -> Array:
    """When the skin comes in each line (n,): the delay line is not as fast as stated, and drifts."""
    line = world.forerun
    return np.asarray(line.time_s / (1 + line.faster + line.drift * np.arange(lines) / lines))


def _receive(probe: Probe, rng: np.random.Generator, hand: Hand, found: Tissue) -> Received:
    """All that arrives through the face and the delay line, with what its ends send to and fro."""
    world, line = probe.world, probe.world.forerun
    back, wet = np.float32(world.back), hand.wet.astype(np.float32)[:, None]
    sent = probe.pulse * probe.delay(rng.normal(0, JITTER_S, len(hand.wet)))
    answer = found.rest + found.bone * (1 + found.behind)
    if line.time_s:
        through = probe.delay(_skin_s(world, len(hand.wet)))
        length = world.acquisition.forerun_length_mm
        through *= np.exp(-nepers(line.attenuation) * length * probe.frequency).astype(np.float32)
        own = wet * np.float32(line.face) - (1 - wet)  # where the face is dry it reflects all
        passed = np.float32(1 - line.face**2) * wet
        once = through * (own + passed * answer * (1 - own * answer))
        all_of_it = once * (1 + back * once * (1 + back * once))
        quiet = through * (own + passed * found.rest)
        quiet *= 1 + back * quiet * (1 + back * quiet)
        first = sent * through * passed
    else:
        all_of_it = wet * answer * (1 + back * answer)
        quiet, first = wet * found.rest, sent * wet
    rows = np.flatnonzero(np.abs(found.bone).max(axis=1) > 0)
    levels = _compared(
        probe, hand, rows, first[rows] * found.bone[rows], first[rows] * found.rest[rows], sent[rows] * quiet[rows]
    )
    return Received(probe.lines(sent * all_of_it), *levels)


def _compared(probe: Probe, hand: Hand, rows: Rows, bone: Spectra, rest: Spectra, quiet: Spectra) -> tuple[Array, ...]:
    """The bone's echo, and how it stands over the tissue before it and over all else beside it, in decibels (n,)."""
    world, lines = probe.world, len(hand.wet)
    peak, over_tissue, over_all = np.zeros(lines), np.full(lines, np.inf), np.full(lines, np.inf)
    if not len(rows):
        return peak, over_tissue, over_all
    level, time = probe.envelope(bone)
    peak[rows] = level.max(axis=1)
    depth = hand.depth_mm[rows, None]
    skin = world.forerun.time_s / (1 + world.forerun.faster)
    at = (time - skin) / probe.to_s
    lost = np.exp(nepers(world.attenuation) * world.acquisition.transducer_hz * (at - depth))
    before = np.where((at > FROM_MM) & (at < depth - NEAR_MM), probe.envelope(rest)[0] * lost, 0).max(axis=1)
    beside = np.where(np.abs(at - depth) < NEAR_MM, probe.envelope(quiet)[0], 0).max(axis=1)
    over_tissue[rows], over_all[rows] = (20 * np.log10(peak[rows] / np.maximum(one, 1e-12)) for one in (before, beside))
    return peak, over_tissue, over_all


def _levels(probe: Probe, hand: Hand, received: Received) -> tuple[float, float]:
    """The bone's typical echo, that of the better-aligned half of the lines, and the noise that gives the recording its SNR."""
    world, angle = probe.world, hand.angle_deg
    good = (received.peak > 0) & (hand.kind != "edge") & (hand.wet == 1)
    if good.any():
        good &= angle <= max(float(np.median(angle[good])), 1.0)
        typical = float(np.median(received.peak[good]))
    else:  # as over bone at the drawn depth
        lost = nepers(world.attenuation) * world.depth_mm
        lost += nepers(world.forerun.attenuation) * world.acquisition.forerun_length_mm
        passed = np.abs(probe.pulse) * np.exp(-lost * probe.frequency)
        typical = float(passed.sum()) * 2 / probe.size * SPECKLE_PEAK
    noise = typical / 10 ** (world.snr_db / 20)
    if world.without == "soft":
        middle = int((world.forerun.time_s + probe.to_s * SOFT_MM) * probe.sampling)
        half = int(probe.to_s * probe.sampling)
        shown = received.rf[hand.wet == 1, middle - half : middle + half]
        noise = min(noise, float(np.sqrt(np.mean(shown**2))) / SOFT_OVER)
    return typical, noise


def _convert(probe: Probe, rng: np.random.Generator, received: Received, typical: float, noise: float) -> Array:
    """Noise, main bang, base line, spikes of a neighbouring machine; in codes."""
    world, (lines, samples), sampling = probe.world, received.rf.shape, probe.sampling
    centre, full = world.acquisition.transducer_hz, 2.0 ** (world.bits - 1)
    edges = [0.25 * centre, min(2.2 * centre, 0.45 * sampling)]
    heard = sosfilt(butter(2, edges, "bandpass", fs=sampling, output="sos"), rng.standard_normal((lines, samples + 500)))[:, 500:]
    scale = max(full * world.fill / typical, 1 / noise)  # the noise always moves the converter
    codes = received.rf * scale + heard * (noise * scale / heard.std())
    time = np.arange(samples) / sampling
    decay = rng.uniform(0.12, 0.25) * 1e-6 * (5e6 / centre) ** 0.3
    codes += BANG * full * np.exp(-time / decay) * np.cos(2 * np.pi * centre * time + rng.uniform(0, 2 * np.pi))
    codes += full * (rng.uniform(-0.02, 0.02) + rng.uniform(-0.05, 0.05) * np.exp(-time / rng.uniform(3e-6, 2e-5)))
    if rng.random() < 0.25:
        for row in np.flatnonzero(rng.random(lines) < 0.04):
            at = int(rng.integers(0, samples - 3))
            codes[row, at : at + 2] += rng.choice([-1, 1]) * rng.uniform(0.3, 1.2) * full * np.array([1, -0.4])
    return np.asarray(np.clip(np.rint(codes), -full, full - 1))


def _clipped(probe: Probe, codes: Array, depth_mm: Array) -> Bools:
    """Lines in which the converter's range ends near the bone's echo (n,)."""
    world = probe.world
    skin = world.forerun.time_s
    middle = ((skin + probe.to_s * depth_mm) * probe.sampling).astype(int)
    half = int(1.2 * probe.sampling / world.acquisition.transducer_hz) + int(skin * 0.012 * probe.sampling)
    off = np.arange(codes.shape[1]) - np.clip(middle, 0, codes.shape[1] - 1)[:, None]
    near = (off >= -half) & (off < half)
    return np.asarray((near & (np.abs(codes + 0.5) >= 2.0 ** (world.bits - 1) - 0.6)).any(axis=1))


def _tracked(rng: np.random.Generator, lines: int) -> Bools:
    """Lines with a pose (n,): in some recordings the tracker loses the probe for a moment."""
    seen = np.ones(lines, dtype=bool)
    if rng.random() < 0.25:
        for _ in range(rng.integers(1, 3)):
            first = int(rng.integers(0, lines - 6))
            seen[first : first + int(rng.integers(2, 7))] = False
    return seen


def simulate(rng: np.random.Generator, frames: int, world: World | None = None) -> tuple[Recording, Truth, World]:
    """A recording of about `frames` lines (8 or more), the truth about it, and what it was drawn from."""
    world = world or draw_world(rng)
    probe, hand = Probe(world), draw_hand(rng, world, frames)
    lines = len(hand.place)
    places = draw_places(rng, world, int(hand.place.max()) + 1)
    received = _receive(probe, rng, hand, tissue(probe, rng, places, hand))
    typical, noise = _levels(probe, hand, received)
    codes = _convert(probe, rng, received, typical, noise)
    seen = _tracked(rng, lines)
    poses = draw_poses(rng, places, hand)
    poses[~seen] = np.nan
    recording = Recording(
        lines=codes.astype(np.int16),
        acquisition=world.acquisition,
        probe_to_reference=poses,
        statuses=tuple(np.where(seen, "OK", "OUT_OF_VIEW").tolist()),
        timestamps_s=rng.uniform(0, 100) + np.cumsum(1 / world.rate_hz + rng.normal(0, 0.0005, lines)),
        palpation_points=hand.place,
    )
    bone, ignore = received.peak > 0, hand.kind == "edge"
    with np.errstate(divide="ignore"):
        snr = 20 * np.log10(received.peak / noise)
    truth = Truth(np.where(bone, hand.depth_mm, np.nan), hand.angle_deg, world.speed_m_s, snr)
    must = bone & ~ignore & seen & (truth.tilt_deg <= SQUARE_DEG) & (snr >= CLEAR_DB)
    must &= (received.over_tissue_db >= OVER_TISSUE_DB) & (received.over_all_db >= OVER_ALL_DB)
    must &= (hand.depth_mm >= DEPTH_MM[0]) & (hand.depth_mm <= DEPTH_MM[1]) & ~_clipped(probe, codes, hand.depth_mm)
    return recording, truth, replace(world, must=must, ignore=ignore)
