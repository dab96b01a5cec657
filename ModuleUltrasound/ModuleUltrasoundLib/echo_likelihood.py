"""Which echo is the bone: probabilities of all candidates of a line, and of none of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array
from scipy.ndimage import gaussian_filter1d

from ModuleUltrasoundLib.echo_candidates import DECIBEL, Candidates
from ModuleUltrasoundLib.echo_search import Found

SAME_MM = 0.35  # SD of a hand's tremor along the beam from line to line: how near candidates support each other
BIN_MM = 0.2
REACH = 4  # neighbouring lines on each side
ROWS = 256  # lines whose scores are worked out at once: the layers stay in the processor's cache
LEAST_FOR_SHARED = 3  # lines with a likely bone before anything is learnt from the recording


Table = tuple[tuple[tuple[tuple[float, ...], ...], tuple[float, ...]], ...]


@dataclass(frozen=True, eq=False)
class Network:
    """A small perceptron that turns a candidate's features into its log-odds against "no bone"."""

    layers: tuple[tuple[Array, Array], ...]  # weights (in, out) and biases (out,)

    @classmethod
    def from_table(cls, table: Table) -> Network:
        """The network whose numbers stand in a table (see echo_weights.py)."""
        return cls(tuple((np.array(weights, dtype=np.float32), np.array(biases, dtype=np.float32)) for weights, biases in table))

    def scores(self, features: Array) -> Array:
        """Log-odds (n, K) of features (n, K, D)."""
        values = np.empty(features.shape[:-1], dtype=float)
        for start in range(0, len(features), ROWS):
            x = np.asarray(features[start : start + ROWS], dtype=np.float32)
            for weights, biases in self.layers[:-1]:
                x = np.asarray(x @ weights, dtype=np.float32)
                x += biases
                np.maximum(x, 0, out=x)  # cheaper than a smooth kink, and as good
            weights, biases = self.layers[-1]
            values[start : start + ROWS] = (x @ weights + biases)[..., 0]
        return values


def probabilities(scores: Array, valid: Array) -> tuple[Array, Array]:
    """Softmax over the candidates and "none": probability of each candidate (n, K), and of none (n,)."""
    scores = np.where(valid, scores, -np.inf)
    top = np.maximum(scores.max(axis=1, initial=0.0), 0.0)[:, None]
    weight = np.exp(scores - top)
    none = np.exp(-top)
    total = weight.sum(axis=1, keepdims=True) + none
    return weight / total, (none / total)[:, 0]


SHARED_NAMES = (
    "single",
    "strength",
    "strength known",
    "polarity",
    "polarity known",
    "support",
    "has neighbours",
    "contact",
    "slope",
    "chance",
    "rival support",
)


def shared_features(found: Found, scores: Array, runs: npt.NDArray[np.int64]) -> Array:
    """Features (n, K, len(SHARED_NAMES)) of each candidate from all lines of the recording.

    `runs` (n,) numbers stretches of consecutive frames from one place on the head, which may support each other.
    """
    candidates, depth_mm = found.candidates, found.depths_mm
    valid = np.isfinite(depth_mm)
    chance, _ = probabilities(scores, valid)
    strength, strength_known, slope = relative_strength(candidates, chance, depth_mm)
    polarity, polarity_known = relative_polarity(candidates.phases - found.forerun_phases[:, None], chance)
    support, neighbours = neighbour_support(chance, depth_mm, runs)
    order = np.sort(support, axis=1)
    rival = np.where(support == order[:, -1:], order[:, -2:-1], order[:, -1:])
    features = [
        np.clip(scores, -8, 8) / 4,
        strength,
        np.full(scores.shape, strength_known),
        polarity,
        np.full(scores.shape, polarity_known),
        support,
        np.broadcast_to(neighbours[:, None], scores.shape),
        np.broadcast_to(contact(found.forerun.amplitude)[:, None], scores.shape),
        np.full(scores.shape, slope / 3),
        chance,
        rival,
    ]
    return np.nan_to_num(np.stack([np.where(valid, feature, 0.0) for feature in features], axis=-1))


def relative_strength(candidates: Candidates, chance: Array, depth_mm: Array) -> tuple[Array, float, float]:
    """Level of each candidate over what a bone of its depth shows in this recording, in units of 15 dB.

    The bone's level falls with depth by the tissue's attenuation: a straight line through the likely bones of all lines,
    its slope shrunk to none. Also how far the line is known (0 to 1), and its slope (dB/mm).
    """
    level = DECIBEL * np.log(np.maximum(candidates.amplitudes, 1e-9))
    best = chance.argmax(axis=1)
    rows = np.arange(len(chance))
    weight = np.where(chance[rows, best] > 0.5, chance[rows, best], 0.0)
    if (weight > 0).sum() < LEAST_FOR_SHARED:
        return np.zeros(level.shape), 0.0, 0.0
    y, x = np.nan_to_num(level[rows, best]), np.nan_to_num(depth_mm[rows, best])
    slope, middle_x, middle_y = 0.0, 0.0, 0.0
    for _ in range(3):
        total = weight.sum() + 1e-9
        middle_x, middle_y = float((weight * x).sum() / total), float((weight * y).sum() / total)
        spread = (weight * (x - middle_x) ** 2).sum()
        slope = float(np.clip((weight * (x - middle_x) * (y - middle_y)).sum() / (spread + 30.0), -5.0, 0.0))
        off = y - middle_y - slope * (x - middle_x)
        # tilted lines are weak: the upper part counts, so weak ones lose weight faster
        weight = np.where(chance[rows, best] > 0.5, chance[rows, best], 0.0) / (1 + (np.where(off < 0, off / 6, off / 12)) ** 2)
    expected = middle_y + slope * (depth_mm - middle_x)
    known = float(min(weight.sum() / 10, 1.0))
    return np.clip((level - expected) / 15, -3, 3) * known, known, slope * known


def relative_polarity(phases: Array, chance: Array) -> tuple[Array, float]:
    """Cosine of each candidate's phase against the bone echoes' common phase, faded if they share none."""
    best = chance.argmax(axis=1)
    rows = np.arange(len(chance))
    weight = np.where(chance[rows, best] > 0.5, chance[rows, best], 0.0)
    if (weight > 0).sum() < LEAST_FOR_SHARED:
        return np.zeros(phases.shape), 0.0
    mean = (weight * np.exp(1j * np.nan_to_num(phases[rows, best]))).sum() / weight.sum()
    length = float(np.abs(mean))
    known = max(0.0, (length - 0.3) / 0.7) * float(min(weight.sum() / 10, 1.0))
    return np.cos(phases - np.angle(mean)) * known, known


def neighbour_support(chance: Array, depth_mm: Array, runs: npt.NDArray[np.int64]) -> tuple[Array, Array]:
    """Mean chance (n, K) that the neighbouring lines give to the same depth, and whether a line has neighbours (n,)."""
    count = len(chance)
    rows = np.arange(count)
    if count < 2:
        return np.zeros(chance.shape), np.zeros(count)
    bins = np.nan_to_num(depth_mm / BIN_MM, nan=-1.0).astype(np.int64)
    size = int(bins.max(initial=0)) + 2
    spread = np.zeros((count, size), dtype=np.float32)
    for rank in range(chance.shape[1]):  # one after the other, because two candidates may share a bin
        spread[rows, bins[:, rank]] += np.where(bins[:, rank] >= 0, chance[:, rank], 0)
    spread[:, -1] = 0
    spread = gaussian_filter1d(spread, SAME_MM / BIN_MM, axis=1, mode="constant", truncate=2.0)
    spread *= np.sqrt(2 * np.pi) * SAME_MM / BIN_MM  # a neighbour at the very depth counts fully
    support = np.zeros_like(spread)
    number = np.zeros(count)
    for step in range(1, min(REACH, count - 1) + 1):
        same = (runs[step:] == runs[:-step]).astype(np.float32)
        support[step:] += spread[:-step] * same[:, None]
        support[:-step] += spread[step:] * same[:, None]
        number[step:] += same
        number[:-step] += same
    taken = np.take_along_axis(support, np.clip(bins, 0, None), axis=1) / np.maximum(number, 1)[:, None]
    return np.where(bins >= 0, taken, 0.0), (number > 0).astype(float)


def contact(amplitude: Array) -> Array:
    """The forerun echo's level over its median in the recording, in units of 10 dB: it is strongest in air."""
    seen = amplitude > 0
    if seen.sum() < LEAST_FOR_SHARED:
        return np.zeros(len(amplitude))
    middle = float(np.median(amplitude[seen]))
    return np.where(seen, np.clip(DECIBEL * np.log(np.where(seen, amplitude, middle) / middle) / 10, -3, 3), 0.0)
