"""Echoes that may be the bone: the highest peaks of each line's envelope behind the skin, with what speaks for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

from ModuleUltrasoundLib.signal_chain import Envelopes, Floats

CANDIDATES = 8  # echoes kept of a line
RAYLEIGH_MEDIAN = 1.1774  # median of the envelope of noise, in standard deviations of one quadrature
NOISE_BLOCKS = 8


@dataclass(frozen=True, eq=False)
class Candidates:
    """K echoes of each of n lines, strongest first; NaN where a line has fewer."""

    delays_s: Array  # (n, K) after the skin
    amplitudes: Array  # (n, K) envelope
    samples: npt.NDArray[np.int64]  # (n, K) index of the peak
    noise: Array  # (n,) standard deviation of one quadrature


def noise_level(magnitude: Floats) -> Array:
    """Standard deviation of one quadrature of the noise of each line, from its quietest stretch, shape (n,)."""
    count, length = magnitude.shape
    block = max(length // NOISE_BLOCKS, 1)
    blocks = magnitude[:, : block * (length // block)].reshape(count, -1, block)[:, 1:]
    quiet = np.median(blocks, axis=2).min(axis=1)
    return np.asarray(quiet / RAYLEIGH_MEDIAN, dtype=float) + 1e-6


def find_peaks(magnitude: Floats, weights: Floats, first: int, last: int) -> npt.NDArray[np.int64]:
    """Indices of the K highest local maxima of `magnitude * weights` in [first, last), shape (n, K); -1 pads."""
    part = magnitude[:, first:last] * weights[first:last]
    inner = part[:, 1:-1]
    peak = (inner > part[:, :-2]) & (inner >= part[:, 2:])
    score = np.where(peak, inner, 0)
    keep = min(CANDIDATES, score.shape[1])
    top = np.argpartition(-score, keep - 1, axis=1)[:, :keep]
    heights = np.take_along_axis(score, top, axis=1)
    order = np.argsort(-heights, axis=1)
    top = np.take_along_axis(top, order, axis=1)
    heights = np.take_along_axis(heights, order, axis=1)
    return np.where(heights > 0, top + first + 1, -1)


def refine_peaks(magnitude: Floats, samples: npt.NDArray[np.int64]) -> tuple[Array, Array]:
    """Sub-sample positions (in samples) and heights of peaks, by a parabola through the logarithm; NaN for padding."""
    safe = np.clip(samples, 1, magnitude.shape[1] - 2)
    left, mid, right = (np.log(np.take_along_axis(magnitude, safe + step, axis=1).astype(float) + 1e-9) for step in (-1, 0, 1))
    curvature = left - 2 * mid + right
    offset = np.where(curvature < -1e-9, 0.5 * (left - right) / np.minimum(curvature, -1e-9), 0.0)
    offset = np.clip(offset, -0.5, 0.5)
    height = np.exp(mid - 0.25 * (left - right) * offset)
    bad = samples < 0
    return np.where(bad, np.nan, safe + offset), np.where(bad, np.nan, height)


def find_candidates(envelopes: Envelopes, skin_s: Array, least_s: float, most_s: float, gain_db_per_s: float) -> Candidates:
    """The strongest echoes `least_s` to `most_s` behind the skin echo of each line.

    The search runs over the window common to all lines of the batch (the skin moves by a few samples only).
    """
    magnitude = np.abs(envelopes.values)
    rate = envelopes.rate_hz
    noise = noise_level(magnitude)
    time = np.arange(magnitude.shape[1]) / rate - float(np.median(skin_s))
    weights = (10 ** (gain_db_per_s * np.clip(time, 0, most_s) / 20)).astype(np.float32)
    first = max(int((np.median(skin_s) + least_s) * rate), 0)
    last = min(int((np.median(skin_s) + most_s) * rate) + 1, magnitude.shape[1])
    if last - first < 4:
        empty = np.full((len(magnitude), 1), np.nan)
        return Candidates(empty, empty, np.full(empty.shape, -1), noise)
    samples = find_peaks(magnitude, weights, first, last)
    positions, heights = refine_peaks(magnitude, samples)
    return Candidates(positions / rate - skin_s[:, None], heights, samples, noise)
