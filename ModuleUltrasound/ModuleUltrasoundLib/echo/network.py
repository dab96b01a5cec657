"""The small networks that score echoes, and the numbers that were learnt for them (weights.json)."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

WEIGHTS = Path(__file__).with_name("weights.json")  # written by Testing/Studies/calibrate_echo.py
ROWS = 48  # candidates in one matrix product: OpenBLAS spreads larger ones over threads (see lean.ONE_THREAD)
BLOCKS = 32  # products made in one call: the layers stay in the processor's cache
DOUBTFUL = (0.1, 0.9)  # beyond, a line is nearly excluded or nearly sure, in every tissue

Weights = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Network:
    """A small perceptron that turns a candidate's features into its log-odds against "no bone"."""

    layers: tuple[tuple[Weights, Weights], ...]  # weights (in, out) and biases (out,)

    def scores_of_blocks(self, blocks: Weights) -> Array:
        """Log-odds (b, ROWS) of features (b, ROWS, D)."""
        values = np.empty(blocks.shape[:2])
        for start in range(0, len(blocks), BLOCKS):
            x = blocks[start : start + BLOCKS]
            for weights, biases in self.layers[:-1]:
                x = np.matmul(x, weights)
                x += biases
                np.maximum(x, 0, out=x)  # cheaper than a smooth kink, and as good
            weights, biases = self.layers[-1]
            values[start : start + BLOCKS] = (x @ weights + biases)[..., 0]
        return values


@dataclass(frozen=True, eq=False)
class Committee:
    """Networks fitted to the same lines from other beginnings; they score a candidate by their mean.

    Where a tissue is like none they were fitted to, each is off its own way, and the mean less than any of them.
    """

    members: tuple[Network, ...]

    def scores(self, features: npt.NDArray[np.floating[Any]]) -> Array:
        """Log-odds (...) of features (..., D)."""
        rows = features.reshape(-1, features.shape[-1])
        blocks = np.zeros((-(-len(rows) // ROWS), ROWS, rows.shape[1]), dtype=np.float32)
        blocks.reshape(-1, rows.shape[1])[: len(rows)] = rows
        mean = sum(member.scores_of_blocks(blocks) for member in self.members) / len(self.members)
        return np.asarray(mean).reshape(-1)[: len(rows)].reshape(features.shape[:-1])


def probabilities(scores: Array, valid: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
    """Softmax over the candidates and "none": probability of each candidate (n, K), and of none (n,)."""
    scores = np.where(valid, scores, -np.inf)
    top = np.maximum(scores.max(axis=1, initial=0.0), 0.0)[:, None]
    weight = np.exp(scores - top)
    none = np.exp(-top)
    total = weight.sum(axis=1, keepdims=True) + none
    return weight / total, (none / total)[:, 0]


@dataclass(frozen=True, eq=False)
class Calibration:
    """From a quality as the networks state it to the probability that the depth is right.

    What is neither nearly sure nor nearly excluded is told by one number. How many of such lines are right is known over many
    tissues, but in any one of them it is off by 0.1 to 0.3, upwards or downwards, wherever in that range the networks saw the
    line: a finer figure would claim what nobody knows.
    """

    stated: Array  # (k,) knots
    right: Array  # (k,) the share that was right
    doubtful: float = math.nan  # the share that was right of all lines within DOUBTFUL; NaN: no such range

    def probability(self, stated: Array) -> Array:
        """Of qualities (n,) before calibration."""
        fine = np.interp(stated, self.stated, self.right)
        if math.isnan(self.doubtful):
            return np.asarray(fine)
        return np.where((fine > DOUBTFUL[0]) & (fine < DOUBTFUL[1]), self.doubtful, fine)


@dataclass(frozen=True, eq=False)
class Likelihood:
    """What was learnt about bone echoes.

    The first committee judges a line by itself; each further one judges it again with the recording around it, as the
    committee before it sees that recording.
    """

    turns: tuple[Committee, ...]
    quality: Calibration


def read_likelihood(path: Path) -> Likelihood:
    """The likelihood that `write_likelihood` has written."""
    table = json.loads(path.read_text(encoding="utf-8"))
    turns = tuple(Committee(tuple(map(_network, members))) for members in table["turns"])
    quality = table["quality"]
    return Likelihood(turns, Calibration(np.array(quality["stated"]), np.array(quality["right"]), quality["doubtful"]))


def _network(layers: list[dict[str, Any]]) -> Network:
    return Network(
        tuple((np.array(one["weights"], dtype=np.float32), np.array(one["biases"], dtype=np.float32)) for one in layers)
    )


def write_likelihood(path: Path, likelihood: Likelihood, note: str) -> None:
    """The likelihood as JSON, a row of numbers a line, four digits each."""
    turns = ",\n".join("[\n" + ",\n".join(map(_layers, turn.members)) + "]" for turn in likelihood.turns)
    stated, right = _row(likelihood.quality.stated), _row(likelihood.quality.right)
    quality = f'{{"stated": {stated},\n"right": {right},\n"doubtful": {likelihood.quality.doubtful:.4g}}}'
    path.write_text(f'{{"note": {json.dumps(note)},\n"quality": {quality},\n"turns": [\n{turns}]}}\n', encoding="utf-8")


def _layers(network: Network) -> str:
    parts = (f'{{"weights": [\n{_lines(weights)}],\n"biases": {_row(biases)}}}' for weights, biases in network.layers)
    return "[\n" + ",\n".join(parts) + "]"


def _lines(weights: Weights) -> str:
    return ",\n".join(map(_row, weights))


def _row(values: npt.NDArray[np.floating[Any]]) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"


@lru_cache(maxsize=1)
def learnt() -> Likelihood:
    """The likelihood that was calibrated on simulated lines."""
    return read_likelihood(WEIGHTS)
