"""Calibrate the bone likelihood on simulated lines of many kinds, and write ModuleUltrasoundLib/echo_weights.py.

    python -m Testing.Studies.calibrate_echo --worlds 2400 --seed 30 [--cache DIR]

Half of the recordings come from each of two families of simulated lines (echo_lines.py and tissue_lines.py), which share no
model; each recording has its own pulse, transducer, forerun, tissue, noise and clutter. A tenth of the recordings is kept out
of the fit; they judge it, and on them the stated quality is mapped to the share of depths that were right. The same seed
gives the same table.
"""

from __future__ import annotations

import argparse
import pickle
import textwrap
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Recording
from ModuleUltrasoundLib.echo_likelihood import Network, probabilities, shared_features
from ModuleUltrasoundLib.echo_search import Found, search_lines
from ModuleUltrasoundLib.measure import EchoSettings, Likelihood, measure_lines, stays
from ModuleUltrasoundLib.quality import TOLERANCE_MM

from Testing.Studies import echo_lines, tissue_lines

Array = npt.NDArray[np.float64]
FAMILIES = ("echo_lines", "tissue_lines")
LABEL_MM = 0.4  # a candidate this near to the bone stands for it
LATE_CYCLES = 1.2  # without a forerun echo the peak of a pulse that rises at its arrival comes later; corrected afterwards
HIDDEN = (64, 32)
SHIFT = 0.1  # SD of what is added to a recording's features, anew in each epoch: another simulator, or a patient, is a bit off
BATCH = 512
HELD_OUT = 10  # every tenth recording
LEAST_LINES, LEAST_BONE = 12, 0.25  # lines, and share of them with bone, of a recording that calibrates the quality
KNOTS = 14  # of the map of the quality
OUTPUT = Path(__file__).parents[2] / "ModuleUltrasound" / "ModuleUltrasoundLib" / "echo_weights.py"


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
    else:
        recording, truth, _ = tissue_lines.simulate(rng, frames)  # type: ignore[assignment]
    assumed = truth.speed_m_s if rng.random() < 0.8 else float(rng.uniform(1450, 1630))
    return Simulated(family, recording, truth.depth_mm, truth.tilt_deg, truth.snr_db, truth.speed_m_s, assumed)


def search_world(one: Simulated) -> World:
    """Search a recording and label its candidates: the strongest near the bone stands for it."""
    runs = stays(one.recording)
    found = search_lines(one.recording, one.assumed_m_s, (1.4, 20.0), bool(runs.max(initial=0) >= 2))
    off = found.depths_mm - one.true_mm[:, None] * one.assumed_m_s / one.speed_m_s
    late = LATE_CYCLES / one.recording.acquisition.transducer_hz * 500 * one.assumed_m_s
    late_mm = np.where(found.forerun.measured, 0.0, late)[:, None]
    near = np.isfinite(off) & (off > -LABEL_MM) & (off < LABEL_MM + late_mm)
    level = np.where(near, found.candidates.snrs_db, -np.inf)
    return World(found, np.where(near.any(axis=1), level.argmax(axis=1), off.shape[1]), runs)


def family_of(family: str, seeds: list[int], cache: Path | None, jobs: int) -> Iterator[Simulated]:
    """The recordings of a family, simulated or read from a file that an earlier call has left."""
    path = None if cache is None else cache / f"{family}-{seeds[0]}-{len(seeds)}.pickle"
    if path is not None and path.is_file():
        with path.open("rb") as file:
            for _ in seeds:
                yield pickle.load(file)
        return
    with ProcessPoolExecutor(jobs) as pool:
        found = list(pool.map(partial(simulate_world, family), seeds, chunksize=8))
    if path is not None:
        with path.open("wb") as file:
            for one in found:
                pickle.dump(one, file)
    yield from found


@dataclass(frozen=True, eq=False)
class Lines:
    """Labelled lines of many recordings."""

    features: npt.NDArray[np.float32]  # (n, K, D)
    valid: npt.NDArray[np.bool_]  # (n, K)
    labels: npt.NDArray[np.int64]  # (n,)
    recording: npt.NDArray[np.int64]  # (n,)


def lines_of(worlds: list[World], features: list[Array]) -> Lines:
    """The lines of some recordings as one set."""
    counts = [len(world.labels) for world in worlds]
    return Lines(
        np.concatenate(features).astype(np.float32),
        np.concatenate([np.isfinite(world.found.depths_mm) for world in worlds]),
        np.concatenate([world.labels for world in worlds]),
        np.repeat(np.arange(len(worlds)), counts),
    )


def fit(lines: Lines, rng: np.random.Generator, epochs: int) -> Network:
    """Softmax over candidates and "none", by Adam on batches; float32 throughout."""
    sizes = (lines.features.shape[-1], *HIDDEN, 1)
    weights = [(rng.normal(size=(a, b)) * np.sqrt((1 if b == 1 else 2) / a)).astype(np.float32) for a, b in zip(sizes, sizes[1:])]
    biases = [np.zeros(b, dtype=np.float32) for b in sizes[1:]]
    parameters = weights + biases
    first = [np.zeros_like(p) for p in parameters]
    second = [np.zeros_like(p) for p in parameters]
    count, step = len(lines.labels), 0
    total = epochs * (count // BATCH)
    for _ in range(epochs):
        order = rng.permutation(count)
        shift = SHIFT * rng.standard_normal((int(lines.recording.max()) + 1, sizes[0]), dtype=np.float32)
        for start in range(0, count - BATCH + 1, BATCH):
            index = order[start : start + BATCH]
            features = lines.features[index] + shift[lines.recording[index], None, :]
            gradients = _gradients(weights, biases, features, lines.valid[index], lines.labels[index])
            step += 1
            rate = 3e-3 * 0.5 * (1 + np.cos(np.pi * step / total))
            for number, (parameter, gradient) in enumerate(zip(parameters, gradients)):
                first[number] = 0.9 * first[number] + 0.1 * gradient
                second[number] = 0.999 * second[number] + 0.001 * gradient**2
                move = first[number] / (1 - 0.9**step) / (np.sqrt(second[number] / (1 - 0.999**step)) + 1e-8)
                decay = 0.01 * parameter if number < len(weights) else 0.0
                parameter -= (rate * (move + decay)).astype(np.float32)
    return Network(tuple((_rounded(w), _rounded(b)) for w, b in zip(weights, biases)))


def _rounded(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """As they will stand in the table."""
    return np.vectorize(lambda value: np.float32(f"{value:.4g}"), otypes=[np.float32])(values)


def _gradients(
    weights: list[Array],
    biases: list[Array],
    x: npt.NDArray[np.float32],
    valid: npt.NDArray[np.bool_],
    labels: npt.NDArray[np.int64],
) -> list[Array]:
    count, candidates, _ = x.shape
    activations = [x.reshape(count * candidates, -1)]
    for matrix, bias in zip(weights[:-1], biases[:-1]):
        activations.append(np.maximum(activations[-1] @ matrix + bias, 0))
    scores = (activations[-1] @ weights[-1] + biases[-1]).reshape(count, candidates)
    scores = np.concatenate([np.where(valid, scores, -1e9), np.zeros((count, 1), dtype=np.float32)], axis=1)
    chance = np.exp(scores - scores.max(axis=1, keepdims=True))
    chance /= chance.sum(axis=1, keepdims=True)
    chance[np.arange(count), labels] -= 1
    delta = (np.where(valid, chance[:, :-1], 0) / count).reshape(-1, 1).astype(np.float32)
    by_weight: list[Array] = []
    by_bias: list[Array] = []
    for layer in range(len(weights) - 1, -1, -1):
        by_weight.insert(0, activations[layer].T @ delta)
        by_bias.insert(0, delta.sum(axis=0))
        if layer:
            delta = (delta @ weights[layer].T) * (activations[layer] > 0)
    return by_weight + by_bias


def shared_of(world: World, single: Network) -> Array:
    """The features of the second stage: the line's own and the recording's."""
    shared = shared_features(world.found, single.scores(world.found.features), world.runs)
    return np.concatenate([world.found.features, shared], axis=-1)


def calibrate_quality(held: list[Simulated], likelihood: Likelihood) -> tuple[Array, Array]:
    """Knots of the monotone map from the likelihood's quality to the share of depths within the tolerance.

    The families count alike. A recording in which hardly a line shows bone is left out: nothing tells a lone interface from
    bone there, and nobody navigates by it. So are short ones.
    """
    held = [one for one in held if len(one.true_mm) >= LEAST_LINES and np.isfinite(one.true_mm).mean() >= LEAST_BONE]
    quality, right, weight = [], [], []
    for one in held:
        found = measure_lines(one.recording, EchoSettings(speed_of_sound_m_s=one.speed_m_s), likelihood)
        error = np.abs(found.depths_mm - one.true_mm)
        quality.append(found.qualities)
        right.append(np.where(np.isfinite(error), error, np.inf) < TOLERANCE_MM)
        weight.append(np.full(len(error), 1 / sum(len(other.true_mm) for other in held if other.family == one.family)))
    return pool_adjacent(np.concatenate(quality), np.concatenate(right).astype(float), np.concatenate(weight))


def pool_adjacent(stated: Array, right: Array, weight: Array) -> tuple[Array, Array]:
    """Monotone steps through (stated, right), as knots for a linear interpolation from 0 to 1."""
    edges = np.concatenate([[0.0], np.linspace(0.05, 0.95, KNOTS - 3), [0.98, 0.995, 1.0 + 1e-9]])
    sums: list[list[float]] = []  # weight, stated, right
    for low, high in zip(edges, edges[1:]):
        inside = (stated >= low) & (stated < high)
        if not inside.any():
            continue
        sums.append([float(x[inside].sum()) for x in (weight, weight * stated, weight * right)])
        while len(sums) > 1 and sums[-2][2] / sums[-2][0] >= sums[-1][2] / sums[-1][0]:
            last = sums.pop()
            sums[-1] = [a + b for a, b in zip(sums[-1], last)]
    knots = [0.0] + [s / w for w, s, _ in sums]
    values = [0.0] + [r / w for w, _, r in sums]
    return np.array([*knots, 1.0]), np.array([*values, max(values[-1], min(1.0, values[-1] + 1 - knots[-1]))])


def write_weights(likelihood: Likelihood, note: str) -> None:
    """The likelihood as a Python file of numbers, four digits each."""
    lines = [
        '"""Constants of the bone likelihood. Written by Testing/Studies/calibrate_echo.py; do not edit by hand.',
        "",
        f'{note}\n"""',
        "",
        "# fmt: off",
        "from __future__ import annotations",
        "",
        "QUALITY = (",
        *_row(likelihood.quality[0]),
        *_row(likelihood.quality[1]),
        ")",
    ]
    for name, network in (("SINGLE", likelihood.single), ("SHARED", likelihood.both)):
        lines += ["", f"{name} = ("]
        for weight, bias in network.layers:
            rows = [_row(row) for row in weight]
            lines += ["(", "(", *(line for row in rows for line in row), "),", *_row(bias), "),"]
        lines.append(")")
    OUTPUT.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _row(values: Array) -> list[str]:
    """One tuple of numbers, wrapped."""
    return textwrap.wrap("(" + ", ".join(f"{value:.4g}" for value in values) + ",),", 125)


def main() -> None:
    """Simulate, fit both stages, judge them on the recordings kept out, write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=2400, help="recordings of each family")
    parser.add_argument("--seed", type=int, default=30)
    parser.add_argument("--epochs", type=int, default=25)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=None, help="folder that keeps the simulated recordings")
    options = parser.parse_args()
    seeds = [options.seed * 1_000_000 + index for index in range(options.worlds)]
    worlds: list[World] = []
    held: list[Simulated] = []
    tests: list[World] = []
    for family in FAMILIES:
        for number, one in enumerate(family_of(family, seeds, options.cache, options.jobs)):
            searched = search_world(one)
            if number % HELD_OUT:
                worlds.append(searched)
            else:
                held.append(one)
                tests.append(searched)
    rng = np.random.default_rng(options.seed)
    single = fit(lines_of(worlds, [world.found.features for world in worlds]), rng, options.epochs)
    judge("SINGLE", single, held, tests, [world.found.features for world in tests])
    # the second stage learns from scores of recordings that the first has not seen, as it will meet them in use
    halves = [worlds[0::2], worlds[1::2]]
    judges = [fit(lines_of(half, [world.found.features for world in half]), rng, options.epochs) for half in halves]
    lines = lines_of(halves[0] + halves[1], [shared_of(world, judges[1 - k]) for k in (0, 1) for world in halves[k]])
    both = fit(lines, rng, options.epochs)
    judge("SHARED", both, held, tests, [shared_of(world, single) for world in tests])
    likelihood = Likelihood(single, both, (np.array([0.0, 1.0]), np.array([0.0, 1.0])))
    likelihood = Likelihood(single, both, calibrate_quality(held, likelihood))
    print("quality", *likelihood.quality, sep="\n")
    note = f"{options.worlds} simulated recordings of each family, seed {options.seed}, {len(lines.labels)} lines."
    write_weights(likelihood, note)


def judge(name: str, network: Network, held: list[Simulated], tests: list[World], features: list[Array]) -> None:
    """Print how well the recordings kept out are told: log loss, right among the sure, sure among the tellable."""
    for family in FAMILIES:
        loss, lines, sure, right, easy, easy_sure, none, none_sure = 0.0, 0, 0, 0, 0, 0, 0, 0
        for one, world, own in zip(held, tests, features):
            if one.family != family:
                continue
            chance, rest = probabilities(network.scores(own), np.isfinite(world.found.depths_mm))
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
            f"{name} {family}: log loss {loss / lines:.3f}; sure {sure}, right {right / max(sure, 1):.4f}; of the tellable sure "
            f"{easy_sure / max(easy, 1):.3f}; of {none} without bone sure {none_sure}",
            flush=True,
        )


if __name__ == "__main__":
    main()
