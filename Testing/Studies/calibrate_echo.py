"""Calibrate the bone likelihood on simulated lines of many kinds, and write ModuleUltrasoundLib/echo/weights.json.

    python -m Testing.Studies.calibrate_echo --worlds 4400 --seed 30 [--cache DIR]

The recordings come from families of simulated lines that share no model (Testing/Studies/simulators). Four are drawn to be hard,
one is a water bath, where there is bone and nothing else, one is as a textbook has it, in one the probe meets no bone at all,
and seventeen go as a palpation session does: the hand comes down, searches the perpendicular, holds, lifts. Each recording has
its own pulse, transducer, forerun, tissue, noise and clutter. A tenth of the recordings is kept out of the fit; they judge it.
On those of them that are as in use, and on families that nothing is fitted to (UNSEEN), the stated quality is mapped to the
share of depths that were right. The same seed gives the same table; the one in the repository says in its note what it was
fitted to.
"""

from __future__ import annotations

import argparse
import pickle
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Recording
from ModuleUltrasoundLib.echo.likelihood import shared_features
from ModuleUltrasoundLib.echo.network import (
    DOUBTFUL,
    WEIGHTS,
    Calibration,
    Committee,
    Likelihood,
    probabilities,
    write_likelihood,
)
from ModuleUltrasoundLib.echo.search import Found, search_lines
from ModuleUltrasoundLib.measurement.measure import DEFAULT_SETTINGS, EchoSettings, measure_lines, places_of, stays
from ModuleUltrasoundLib.measurement.quality import TOLERANCE_MM

from Testing.Studies.fit_network import Lines, fit, joined
from Testing.Studies.simulators import bench_lines, echo_lines, tissue_lines
from Testing.Studies.simulators.families import HARD, OFF_BONE, SESSIONS, TEXTBOOK, UNSEEN

Array = npt.NDArray[np.float64]
# Recordings of each family, of the number asked for
FAMILIES = (
    dict.fromkeys(HARD, 0.75)
    | {"bare_lines": 0.75, "session_lines": 1.0}
    | dict.fromkeys(sorted(SESSIONS.keys() - {"session_lines"}), 0.5)
    | dict.fromkeys(TEXTBOOK, 0.5)
    | dict.fromkeys(OFF_BONE, 0.15)
)
AS_IN_USE = SESSIONS | TEXTBOOK | OFF_BONE | UNSEEN  # what the quality is calibrated on
MEMBERS = 3  # networks of a turn: one alone is better or worse by chance (lines without bone accepted: 0.5 to 0.9 %)
TURNS = 2  # a line by itself, then with the recording around it; a third adds little and costs a tenth of the time
LABEL_MM = 0.4  # a candidate this near to the bone stands for it
LATE_CYCLES = 1.2  # without a forerun echo the peak of a pulse that rises at its arrival comes later; corrected afterwards
LINES_EACH = 24  # of a recording, for the fit: further ones say little new
HELD_OUT = 10  # every tenth recording
LEAST_LINES = 12  # of a recording that calibrates the quality: with fewer there is no recording around a line
KNOTS = 14  # of the map of the quality
FEW = 20  # lines of a family in a bin: fewer say little
FILE = 400  # recordings a file of the cache


@dataclass(frozen=True, eq=False)
class Simulated:
    """One simulated recording and the truth about it."""

    family: str
    recording: Recording
    true_mm: Array  # (n,) NaN: no bone
    tilt_deg: Array
    snr_db: Array
    speed_m_s: float
    assumed_m_s: float  # known to a few per cent, as in use


@dataclass(frozen=True, eq=False)
class World:
    """A simulated recording, searched."""

    found: Found
    labels: npt.NDArray[np.int64]  # (n,) index of the right candidate; K: none
    runs: npt.NDArray[np.int64]


def simulate_world(family: str, seed: int) -> Simulated:
    """One recording of a family; the same for the same seed."""
    rng = np.random.default_rng(seed)
    frames = int(rng.choice([1, 4, 12, 24, 40], p=[0.1, 0.15, 0.25, 0.3, 0.2]))
    if family == "echo_lines":
        recording, truth, _ = echo_lines.simulate(rng, frames, without_bone=float(rng.choice([0.1, 0.3, 0.6])))
    elif family == "tissue_lines":
        recording, truth, _ = tissue_lines.simulate(rng, frames)
    elif family == "bare_lines":
        recording, truth, _ = bench_lines.simulate(rng, frames * 3 // 2, bench_lines.draw_bare(rng))
    elif family in SESSIONS:
        recording, truth, _ = SESSIONS[family].simulate(rng, max(frames, 8) * 3 // 2)
    else:
        recording, truth, _ = (HARD | TEXTBOOK | OFF_BONE | UNSEEN)[family].simulate(rng, frames * 3 // 2)
    assumed = truth.speed_m_s if rng.random() < 0.8 else float(rng.uniform(1450, 1630))
    return Simulated(family, recording, truth.depth_mm, truth.tilt_deg, truth.snr_db, truth.speed_m_s, assumed)


def search_world(one: Simulated) -> World:
    """Search a recording and label its candidates: the strongest near the bone stands for it."""
    runs = stays(one.recording)
    limits = (DEFAULT_SETTINGS.least_depth_mm, DEFAULT_SETTINGS.most_depth_mm)
    found = search_lines(one.recording, one.assumed_m_s, limits, places_of(one.recording, runs))
    off = found.depths_mm - one.true_mm[:, None] * one.assumed_m_s / one.speed_m_s
    late = LATE_CYCLES / one.recording.acquisition.transducer_hz * 500 * one.assumed_m_s
    late_mm = np.where(found.forerun.measured, 0.0, late)[:, None]
    near = found.possible & (off > -LABEL_MM) & (off < LABEL_MM + late_mm)
    level = np.where(near, found.candidates.snrs_db, -np.inf)
    found = replace(found, windows=found.windows[:, :0], features=found.features.astype(np.float32))  # what is not used
    return World(found, np.where(near.any(axis=1), level.argmax(axis=1), off.shape[1]), runs)


def family_of(family: str, first: int, count: int, cache: Path | None, jobs: int) -> Iterator[Simulated]:
    """`count` recordings of a family, simulated or read from files that an earlier call has left."""
    for start in range(first, first + count, FILE):
        size = min(FILE, first + count - start)
        path = None if cache is None else cache / f"{family}-{start}-{size}.pickle"
        if path is not None and path.is_file():
            with path.open("rb") as file:
                for _ in range(size):
                    yield pickle.load(file)
            continue
        with ProcessPoolExecutor(jobs) as pool:
            found = list(pool.map(partial(simulate_world, family), range(start, start + size), chunksize=8))
        if path is not None:
            with path.open("wb") as file:
                for one in found:
                    pickle.dump(one, file)
        yield from found


def lines_of(worlds: list[World], features: list[Array], rng: np.random.Generator) -> Lines:
    """At most LINES_EACH lines of each recording as one set."""
    some = [rng.permutation(len(world.labels))[:LINES_EACH] for world in worlds]
    return Lines(
        np.concatenate([one[index] for one, index in zip(features, some)]).astype(np.float32),
        np.concatenate([world.found.possible[index] for world, index in zip(worlds, some)]),
        np.concatenate([world.labels[index] for world, index in zip(worlds, some)]),
        np.repeat(np.arange(len(worlds)), [len(index) for index in some]),
    )


def seen_by(world: World, turns: list[Committee]) -> Array:
    """The features of the next turn after `turns`: the line's own and the recording's."""
    scores = turns[0].scores(world.found.features)
    for committee in turns[1:]:
        scores = committee.scores(_with_shared(world, scores))
    return _with_shared(world, scores)


def _with_shared(world: World, scores: Array) -> Array:
    return np.concatenate([world.found.features, shared_features(world.found, scores, world.runs)], axis=-1)


def fit_turns(worlds: list[World], rng: np.random.Generator, epochs: int, jobs: int) -> tuple[Committee, ...]:
    """The committees, each fitted to what the ones before it say of recordings they have not seen, as it will be in use."""
    halves = [worlds[0::2], worlds[1::2]]
    blind: list[list[Committee]] = [[], []]  # of each half, fitted to the other half alone
    turns: list[Committee] = []
    for turn in range(TURNS):
        lines = []
        for half, fitted in zip(halves, blind):
            features = [seen_by(world, fitted) if turn else world.found.features for world in half]
            lines.append(lines_of(half, features, rng))
        sets = [joined(lines)] * MEMBERS + (lines if turn + 1 < TURNS else [])
        with ThreadPoolExecutor(jobs) as pool:
            fitted_to = list(pool.map(partial(fit, epochs=epochs), sets, rng.spawn(len(sets))))
        turns.append(Committee(tuple(fitted_to[:MEMBERS])))
        for half_blind, network in zip(reversed(blind), fitted_to[MEMBERS:]):
            half_blind.append(Committee((network,)))
        print(f"turn {turn + 1} fitted to {sum(len(part.labels) for part in lines)} lines", flush=True)
    return tuple(turns)


def calibrate_quality(held: list[Simulated], turns: tuple[Committee, ...]) -> Calibration:
    """What the committees' quality means: a monotone map to the share of depths within the tolerance, and the doubtful's share.

    A new simulator, or a patient, is one more family: what is expected of it is the mean over the families of their shares,
    however many lines each has in a bin. Short recordings are left out, and so are families that do not go as a session does:
    the lines they were drawn to be hard with say nothing of how often a line in use is right.
    """
    straight = Calibration(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    stated: dict[str, list[Array]] = {}
    right: dict[str, list[Array]] = {}
    for one in held:
        if len(one.true_mm) < LEAST_LINES or one.family not in AS_IN_USE:
            continue
        settings = EchoSettings(speed_of_sound_m_s=one.speed_m_s)
        found = measure_lines(one.recording, settings, Likelihood(turns, straight))
        stated.setdefault(one.family, []).append(found.qualities)
        right.setdefault(one.family, []).append(np.abs(np.nan_to_num(found.depths_mm - one.true_mm, nan=np.inf)) < TOLERANCE_MM)
    lines = [(np.concatenate(stated[family]), np.concatenate(right[family])) for family in sorted(stated)]
    middles, shares, some = typical_shares(lines, np.array([0.0, *np.linspace(0.05, 0.95, KNOTS - 3), 0.98, 0.995, 1 + 1e-9]))
    fine = Calibration(*monotone(middles[some], shares[some]))
    mapped = [(fine.probability(one), of_one) for one, of_one in lines]
    _, levels, _ = typical_shares(mapped, np.array([0.0, *DOUBTFUL, 1 + 1e-9]))
    return replace(fine, doubtful=float(levels[1]))


def typical_shares(lines: list[tuple[Array, Array]], edges: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Mean stated (b,), mean over the families of the share that was right (b,), and whether there is any line (b,).

    `lines` holds (stated, right) of each family; the bins lie between `edges` (b + 1,).
    """
    sums = np.zeros((len(lines), 3, len(edges) - 1))  # lines, stated, right
    for row, (stated, right) in enumerate(lines):
        which = np.digitize(stated, edges) - 1
        sums[row] = [np.bincount(which, values, len(edges) - 1) for values in (np.ones(len(stated)), stated, right)]
    print("lines, stated, right of each family", *np.round(sums / np.maximum(sums[:, :1], 1e-9), 3)[:, 1:], sep="\n")
    pooled = sums.sum(axis=0)
    typical = pooled[2] / np.maximum(pooled[0], 1e-9)
    shares = (sums[:, 2] + FEW * typical) / (sums[:, 0] + FEW)  # a few lines say little of a family
    return pooled[1] / np.maximum(pooled[0], 1e-9), shares.mean(axis=0), pooled[0] > 0


def monotone(stated: Array, right: Array) -> tuple[Array, Array]:
    """Knots of a linear interpolation through (stated, right) from 0 to 1; neighbours that fall are pooled."""
    sums: list[list[float]] = []  # number, stated, right
    for pair in zip(stated, right):
        sums.append([1.0, float(pair[0]), float(pair[1])])
        while len(sums) > 1 and sums[-2][2] / sums[-2][0] >= sums[-1][2] / sums[-1][0]:
            last = sums.pop()
            sums[-1] = [a + b for a, b in zip(sums[-1], last)]
    knots = [0.0] + [s / n for n, s, _ in sums]
    values = [0.0] + [r / n for n, _, r in sums]
    return np.array([*knots, 1.0]), np.array([*values, max(values[-1], min(1.0, values[-1] + 1 - knots[-1]))])


def main() -> None:
    """Simulate, fit both turns, judge them on the recordings kept out, write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=4400, help="recordings of each family")
    parser.add_argument("--seed", type=int, default=30)
    parser.add_argument("--epochs", type=int, default=12)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=None, help="folder that keeps the simulated recordings")
    options = parser.parse_args()
    worlds: list[World] = []
    held: list[Simulated] = []
    tests: list[World] = []
    for family, share in FAMILIES.items():
        recordings = family_of(family, options.seed * 1_000_000, int(share * options.worlds), options.cache, options.jobs)
        for number, one in enumerate(recordings):
            searched = search_world(one)
            if number % HELD_OUT:
                worlds.append(searched)
            else:
                held.append(one)
                tests.append(searched)
    rng = np.random.default_rng(options.seed)
    turns = fit_turns(worlds, rng, options.epochs, options.jobs)
    for turn in range(TURNS):
        judge(turn, turns[: turn + 1], held, tests)
    count = options.worlds // HELD_OUT
    unseen = [one for name in UNSEEN for one in family_of(name, options.seed * 1_000_000, count, options.cache, options.jobs)]
    quality = calibrate_quality(held + unseen, turns)
    print("quality", quality.stated, quality.right, quality.doubtful, sep="\n")
    counts = ", ".join(f"{int(share * options.worlds)} {family}" for family, share in FAMILIES.items())
    note = f"simulated recordings, seed {options.seed}: {counts}"
    write_likelihood(WEIGHTS, Likelihood(turns, quality), note)


def judge(turn: int, turns: tuple[Committee, ...], held: list[Simulated], tests: list[World]) -> None:
    """Print how well the recordings kept out are told: log loss, right among the sure, sure among the tellable."""
    for family in FAMILIES:
        loss, lines, sure, right, easy, easy_sure, none, none_sure = 0.0, 0, 0, 0, 0, 0, 0, 0
        for one, world in zip(held, tests):
            if one.family != family:
                continue
            features = seen_by(world, list(turns[:turn])) if turn else world.found.features
            chance, rest = probabilities(turns[turn].scores(features), world.found.possible)
            both = np.concatenate([chance, rest[:, None]], axis=1)
            rows = np.arange(len(both))
            loss -= float(np.log(both[rows, world.labels] + 1e-9).sum())
            best = chance.argmax(axis=1)
            accepted = chance[rows, best] > 0.9
            bone = np.isfinite(one.true_mm)
            tellable = bone & (one.tilt_deg < 3) & (one.snr_db > 12)
            lines += len(both)
            sure, right = sure + int(accepted.sum()), right + int((accepted & (best == world.labels)).sum())
            easy, easy_sure = easy + int(tellable.sum()), easy_sure + int((accepted & tellable).sum())
            none, none_sure = none + int((~bone).sum()), none_sure + int((accepted & ~bone).sum())
        print(
            f"turn {turn + 1} {family}: log loss {loss / lines:.3f}; sure {sure}, right {right / max(sure, 1):.4f}; of the "
            f"tellable sure {easy_sure / max(easy, 1):.3f}; of {none} without bone sure {none_sure}",
            flush=True,
        )


if __name__ == "__main__":
    main()
