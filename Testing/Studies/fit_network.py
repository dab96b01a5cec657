"""Fit of the networks that score echoes: softmax over a line's candidates and "none", by Adam, float32 throughout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from ModuleUltrasoundLib.echo.network import Network

Floats = npt.NDArray[np.float32]

HIDDEN = (64, 32)
SHIFT = 0.1  # SD of what is added to a recording's features, anew in each epoch: another simulator, or a patient, is a bit off
BATCH = 512
NONE_WEIGHT = 3.0  # of a line without bone over one with it: a false point misleads, a missed one is asked for again
RATE, DECAY = 3e-3, 0.01


@dataclass(frozen=True, eq=False)
class Lines:
    """Labelled lines of many recordings."""

    features: Floats  # (n, K, D)
    valid: npt.NDArray[np.bool_]  # (n, K)
    labels: npt.NDArray[np.int64]  # (n,) index of the right candidate; K: none
    recording: npt.NDArray[np.int64]  # (n,)


def joined(parts: list[Lines]) -> Lines:
    """Several sets as one; their recordings are counted on."""
    before = np.cumsum([0] + [int(part.recording.max(initial=-1)) + 1 for part in parts])
    return Lines(
        np.concatenate([part.features for part in parts]),
        np.concatenate([part.valid for part in parts]),
        np.concatenate([part.labels for part in parts]),
        np.concatenate([part.recording + start for part, start in zip(parts, before)]),
    )


def fit(lines: Lines, rng: np.random.Generator, epochs: int) -> Network:
    """The network that gives the right candidates the highest probability."""
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
            rate = RATE * 0.5 * (1 + np.cos(np.pi * step / total))
            for number, (parameter, gradient) in enumerate(zip(parameters, gradients)):
                first[number] = 0.9 * first[number] + 0.1 * gradient
                second[number] = 0.999 * second[number] + 0.001 * gradient**2
                move = first[number] / (1 - 0.9**step) / (np.sqrt(second[number] / (1 - 0.999**step)) + 1e-8)
                decay = DECAY * parameter if number < len(weights) else 0.0
                parameter -= (rate * (move + decay)).astype(np.float32)
    return Network(tuple((_rounded(w), _rounded(b)) for w, b in zip(weights, biases)))


def _rounded(values: Floats) -> Floats:
    """As they will stand in the table."""
    return np.vectorize(lambda value: np.float32(f"{value:.4g}"), otypes=[np.float32])(values)


def _gradients(
    weights: list[Floats], biases: list[Floats], x: Floats, valid: npt.NDArray[np.bool_], labels: npt.NDArray[np.int64]
) -> list[Floats]:
    """Of the mean log loss, by every weight and bias."""
    count, candidates, _ = x.shape
    activations = [x.reshape(count * candidates, -1)]
    for matrix, bias in zip(weights[:-1], biases[:-1]):
        activations.append(np.maximum(activations[-1] @ matrix + bias, 0))
    scores = (activations[-1] @ weights[-1] + biases[-1]).reshape(count, candidates)
    scores = np.concatenate([np.where(valid, scores, -1e9), np.zeros((count, 1), dtype=np.float32)], axis=1)
    chance = np.exp(scores - scores.max(axis=1, keepdims=True))
    chance /= chance.sum(axis=1, keepdims=True)
    chance[np.arange(count), labels] -= 1
    chance *= np.where(labels == candidates, NONE_WEIGHT, 1.0).astype(np.float32)[:, None]
    delta = (np.where(valid, chance[:, :-1], 0) / count).reshape(-1, 1).astype(np.float32)
    by_weight: list[Floats] = []
    by_bias: list[Floats] = []
    for layer in range(len(weights) - 1, -1, -1):
        by_weight.insert(0, activations[layer].T @ delta)
        by_bias.insert(0, delta.sum(axis=0))
        if layer:
            delta = (delta @ weights[layer].T) * (activations[layer] > 0)
    return by_weight + by_bias
