"""Calibrate the bone likelihood on simulated lines of many kinds, and write ModuleUltrasoundLib/echo_weights.py.

    python -m Testing.Studies.calibrate_echo --worlds 1500 --seed 1

Each world (see echo_lines.py) has its own pulse, transducer, forerun, tissue, noise and clutter. A tenth of the worlds is
kept out of the fit and judges it. The same seed gives the same table.
"""

from __future__ import annotations

import argparse
import textwrap
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from ModuleUltrasoundLib.echo_likelihood import Network, probabilities, shared_features
from ModuleUltrasoundLib.echo_search import Found, search_lines
from ModuleUltrasoundLib.measure import stays

from Testing.Studies.echo_lines import simulate

Array = npt.NDArray[np.float64]
RIGHT_MM = 0.5
HIDDEN = (32, 16)
OUTPUT = Path(__file__).parents[2] / "ModuleUltrasound" / "ModuleUltrasoundLib" / "echo_weights.py"


@dataclass(frozen=True, eq=False)
class World:
    """One simulated recording, searched."""

    found: Found
    labels: npt.NDArray[np.int64]  # (n,) index of the right candidate; K: none
    runs: npt.NDArray[np.int64]
    true_mm: Array


def make_world(seed: int) -> World:
    """Simulate and search one recording; the speed of sound is known to a few per cent, as in use."""
    rng = np.random.default_rng(seed)
    frames = int(rng.choice([1, 5, 20, 40, 80], p=[0.15, 0.15, 0.25, 0.3, 0.15]))
    recording, truth, world = simulate(rng, frames, without_bone=float(rng.choice([0.1, 0.3, 0.6])))
    runs = stays(recording)
    assumed = world.speed_m_s if rng.random() < 0.7 else float(rng.uniform(1450, 1630))
    found = search_lines(recording, assumed, (1.4, 20.0), bool(runs.max(initial=0) >= 2))
    true = truth.depth_mm * assumed / world.speed_m_s
    off = np.abs(found.depths_mm - true[:, None])
    off = np.where(np.isfinite(off), off, np.inf)
    # the strongest candidate within the tolerance stands for the bone
    level = np.where(off < RIGHT_MM * 0.8, found.candidates.snrs_db, -np.inf)
    labels = np.where(np.isfinite(level).any(axis=1), level.argmax(axis=1), off.shape[1])
    return World(found, labels, runs, true)


def fit(features: Array, valid: Array, labels: npt.NDArray[np.int64], rng: np.random.Generator, epochs: int) -> Network:
    """Softmax over candidates and "none", by Adam on batches; float32 throughout."""
    sizes = (features.shape[-1], *HIDDEN, 1)
    weights = [(rng.normal(size=(a, b)) / np.sqrt(a)).astype(np.float32) for a, b in zip(sizes[:-1], sizes[1:])]
    biases = [np.zeros(b, dtype=np.float32) for b in sizes[1:]]
    parameters = weights + biases
    first = [np.zeros_like(p) for p in parameters]
    second = [np.zeros_like(p) for p in parameters]
    features = features.astype(np.float32)
    step = 0
    batch = 512
    total = epochs * (len(labels) // batch)
    for _ in range(epochs):
        order = rng.permutation(len(labels))
        for start in range(0, len(order) - batch + 1, batch):
            index = order[start : start + batch]
            gradients = _gradients(weights, biases, features[index], valid[index], labels[index])
            step += 1
            rate = 3e-3 * 0.5 * (1 + np.cos(np.pi * step / total))
            for number, (parameter, gradient) in enumerate(zip(parameters, gradients)):
                if number < len(weights):
                    gradient = gradient + 1e-4 * parameter
                first[number] = 0.9 * first[number] + 0.1 * gradient
                second[number] = 0.999 * second[number] + 0.001 * gradient**2
                scale = np.sqrt(second[number] / (1 - 0.999**step)) + 1e-8
                parameter -= (rate * first[number] / (1 - 0.9**step) / scale).astype(np.float32)
    return Network(tuple((w.astype(float), b.astype(float)) for w, b in zip(weights, biases)))


def _gradients(weights: list[Array], biases: list[Array], x: Array, valid: Array, labels: npt.NDArray[np.int64]) -> list[Array]:
    count, candidates, _ = x.shape
    activations = [x.reshape(count * candidates, -1)]
    for weight, bias in zip(weights[:-1], biases[:-1]):
        activations.append(np.tanh(activations[-1] @ weight + bias))
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
            delta = (delta @ weights[layer].T) * (1 - activations[layer] ** 2)
    return by_weight + by_bias


def shared_of(world: World, single: Network) -> Array:
    """The features of the second stage: the line's own and the recording's."""
    scores = single.scores(world.found.features)
    shared = shared_features(world.found, scores, world.runs)
    return np.concatenate([world.found.features, shared], axis=-1)


def write_weights(networks: dict[str, Network], note: str) -> None:
    """The networks as a Python file of numbers, four digits each."""
    lines = [
        '"""Constants of the bone likelihood. Written by Testing/Studies/calibrate_echo.py; do not edit by hand.',
        "",
        f'{note}\n"""',
        "",
        "# fmt: off",
        "from __future__ import annotations",
    ]
    for name, network in networks.items():
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
    """Simulate, fit both stages, judge them on the worlds kept out, write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--epochs", type=int, default=40)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    seeds = [options.seed * 1_000_000 + index for index in range(options.worlds)]
    with ProcessPoolExecutor(options.jobs) as pool:
        worlds = list(pool.map(make_world, seeds, chunksize=8))
    held = max(len(worlds) // 10, 1)
    rng = np.random.default_rng(options.seed)
    networks: dict[str, Network] = {}
    features = [world.found.features for world in worlds]
    for name in ("SINGLE", "SHARED"):
        if name == "SHARED":
            features = [shared_of(world, networks["SINGLE"]) for world in worlds]
        train = slice(held, None)
        x = np.concatenate(features[train])
        valid = np.concatenate([np.isfinite(world.found.depths_mm) for world in worlds[train]])
        labels = np.concatenate([world.labels for world in worlds[train]])
        networks[name] = fit(x, valid, labels, rng, options.epochs)
        print(name, judge(networks[name], features[:held], worlds[:held]))
    write_weights(networks, f"{options.worlds} simulated recordings, seed {options.seed}, {len(labels)} lines.")


def judge(network: Network, features: list[Array], worlds: list[World]) -> str:
    """How well the held-out worlds are told: log loss, right among the sure, found among the findable."""
    loss, sure, right, bone, none_sure, none = 0.0, 0, 0, 0, 0, 0
    lines = 0
    for one, world in zip(features, worlds):
        chance, rest = probabilities(network.scores(one), np.isfinite(world.found.depths_mm))
        both = np.concatenate([chance, rest[:, None]], axis=1)
        loss -= float(np.log(both[np.arange(len(both)), world.labels] + 1e-9).sum())
        best = chance.argmax(axis=1)
        accepted = chance[np.arange(len(best)), best] > 0.9
        depth = world.found.depths_mm[np.arange(len(best)), best]
        hit = np.abs(depth - world.true_mm) < RIGHT_MM
        has = np.isfinite(world.true_mm)
        sure += int(accepted.sum())
        right += int((accepted & hit).sum())
        bone += int(has.sum())
        none += int((~has).sum())
        none_sure += int((accepted & ~has).sum())
        lines += len(best)
    findable = sum(int((w.labels < w.found.depths_mm.shape[1]).sum()) for w in worlds)
    return (
        f"log loss {loss / lines:.3f}; sure {sure} of {bone} with bone ({findable} findable), right {right / max(sure, 1):.4f}; "
        f"without bone {none}, sure {none_sure}"
    )


if __name__ == "__main__":
    main()
