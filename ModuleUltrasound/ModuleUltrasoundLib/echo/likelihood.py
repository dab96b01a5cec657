"""Which echo is the bone: each line judged with the whole recording around it.

What one recording shares speaks in every line: how strong bone echoes and with which polarity, where the neighbouring lines
see it, what repeats at every place and so belongs to the probe. Each judgement sharpens what is known of the others, so it is
done in turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.rigid import Array

from ModuleUltrasoundLib.echo.candidates import DECIBEL
from ModuleUltrasoundLib.echo.lean import median, product, without_nan
from ModuleUltrasoundLib.echo.network import Likelihood, probabilities
from ModuleUltrasoundLib.echo.search import Found

SAME_MM = 0.35  # SD of a hand's tremor along the beam from line to line: how near candidates support each other
BIN_MM = 0.2
REACH = 4  # neighbouring lines on each side
FAR_REACH = 20  # the same, of a long stay or a slow glide
SAME_FAR_MM = 0.6  # the bone's depth wanders over so many
BEHIND_BINS = 5  # an echo so far behind another is another interface
LEAST_AT_PLACE = 0.05  # of the lines from a place: a smaller share is chance
BLUR_STEP = 64  # bins: maps are of many sizes, matrices for them of a few
USUAL_MM = 1.2  # the scalp of a head is about as thick from place to place
SURE = 0.85
# Attenuation of scalp is 0.3 to 2.6 dB/cm/MHz in the literature; their geometric mean is the usual one
LEAST_FADING, USUAL_FADING = 0.3, 0.9  # dB/cm/MHz
FADING_WEIGHT = 30.0  # mm^2: as much as ten lines tell whose depths have a standard deviation of 1.7 mm
LEAST_FOR_SHARED = 3  # lines with a likely bone before anything is learnt from the recording
STRETCH, AROUND = 112, 8  # lines of a glide judged together, and lines on each side that are looked at with them


Real = TypeVar("Real", bound="np.floating[Any]")

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
    "long support",
    "rival long support",
    "presence",
    "elsewhere",
    "elsewhere known",
    "none around",
    "none in all",
    "neighbours",
    "usual depth",
    "clear in all",
    "sure in all",
    "support in all",
    "strength spread",
    "covered",
)


def judge_echoes(found: Found, likelihood: Likelihood, runs: npt.NDArray[np.int64]) -> tuple[Array, Array]:
    """Probability (n, K) of each candidate to be the bone, and the last turn's shared features (n, K, len(SHARED_NAMES)).

    `found` holds the scores of the likelihood's first committee. A long glide is judged stretch by stretch: where the hand was
    tilted for half of the way says nothing about the other half, and the live sweep, which comes in batches, is judged alike.
    """
    count = len(runs)
    if count <= STRETCH + 2 * AROUND or (runs[-1] - runs[0]) * (STRETCH + 2 * AROUND) > count:
        return _judge_together(found, likelihood, runs)
    parts = []
    for first in range(0, count, STRETCH):
        begin, end = max(first - AROUND, 0), min(first + STRETCH + AROUND, count)
        own = slice(first - begin, first - begin + STRETCH if first + STRETCH < count else None)
        parts.append([values[own] for values in _judge_together(found.part(begin, end), likelihood, runs[begin:end])])
    chance, shared = (np.concatenate(values) for values in zip(*parts))
    return chance, shared


def _judge_together(found: Found, likelihood: Likelihood, runs: npt.NDArray[np.int64]) -> tuple[Array, Array]:
    scores, echoes, possible = found.scores, Echoes.of(found.depths_mm, runs), found.possible
    shared = shared_features(found, scores, runs, echoes)
    for turn, committee in enumerate(likelihood.turns[1:]):
        if turn:
            shared = shared_features(found, scores, runs, echoes)
        scores = np.zeros(possible.shape)
        scores[possible] = committee.scores(np.concatenate([found.features[possible], shared[possible]], axis=-1))
    chance, _ = probabilities(scores, found.possible)
    return chance, shared


def shared_features(found: Found, scores: Array, runs: npt.NDArray[np.int64], echoes: Echoes | None = None) -> Array:
    """Features (n, K, len(SHARED_NAMES)) of each candidate from all lines of the recording.

    `scores` (n, K) are the log-odds so far. `runs` (n,) numbers stretches of consecutive frames from one place on the head,
    which may support each other; `echoes` says where echoes are at all (worked out if not given).
    """
    candidates, depth_mm = found.candidates, found.depths_mm
    valid = np.isfinite(depth_mm)
    if not valid.size:
        return np.zeros((*valid.shape, len(SHARED_NAMES)), dtype=np.float32)
    echoes = echoes or Echoes.of(depth_mm, runs)
    chance, none = probabilities(scores, found.possible)
    strength, strength_known, slope = relative_strength(candidates.amplitudes, chance, depth_mm, found.carrier_hz * 1e-6)
    polarity, polarity_known = relative_polarity(candidates.phases - found.forerun_phases[:, None], chance)
    near, far = Neighbours.within(runs, REACH), Neighbours.within(runs, FAR_REACH)
    likely = DepthMap.of(chance, depth_mm)
    support, far_support = likely.mean(near, SAME_MM), likely.mean(far, SAME_FAR_MM)
    best, rows = chance.argmax(axis=1), np.arange(len(chance))
    top = chance[rows, best]
    values = {
        "single": np.clip(scores, -8, 8) / 4,
        "strength": strength,
        "strength known": strength_known,
        "polarity": polarity,
        "polarity known": polarity_known,
        "support": support,
        "has neighbours": (near.number > 0)[:, None],
        "contact": contact(found.forerun.amplitude)[:, None],
        "slope": slope / 3,
        "chance": chance,
        "rival support": _rival(support),
        "long support": far_support,
        "rival long support": _rival(far_support),
        "presence": echoes.presence,
        "elsewhere": echoes.elsewhere,
        "elsewhere known": echoes.elsewhere_known,
        "none around": near.mean(none[:, None]),
        "none in all": none.mean(),
        "neighbours": far.number[:, None] / FAR_REACH,
        "usual depth": likely.mean(None, USUAL_MM),
        "clear in all": top.mean(),
        "sure in all": (top > SURE).mean(),
        "support in all": (top * support[rows, best]).sum() / max(top.sum(), 1e-6),
        "covered": echoes.covered(likely),
        "strength spread": np.sqrt((top * strength[rows, best] ** 2).sum() / max(top.sum(), 1e-6)),
    }
    stacked = np.zeros((*valid.shape, len(SHARED_NAMES)), dtype=np.float32)
    for number, name in enumerate(SHARED_NAMES):
        stacked[..., number] = values[name]
    stacked[~valid] = 0
    stacked[np.isnan(stacked)] = 0
    return np.asarray(stacked)


def _rival(support: Array) -> Array:
    """The best support (n, K) of the other candidates."""
    order = np.sort(support, axis=1)[:, -2:].T
    return np.where(order[-1] == support.T, order[0], order[-1]).T


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The lines [first, last) that each of n lines is compared with, itself left out."""

    first: npt.NDArray[np.int64]
    last: npt.NDArray[np.int64]

    @classmethod
    def within(cls, runs: npt.NDArray[np.int64], reach: int) -> Neighbours:
        """Up to `reach` lines on each side, of the same run."""
        index = np.arange(len(runs))
        start, stop = np.searchsorted(runs, runs), np.searchsorted(runs, runs, side="right")
        return cls(np.maximum(index - reach, start), np.minimum(index + reach + 1, stop))

    @property
    def number(self) -> npt.NDArray[np.int64]:
        """How many (n,)."""
        return self.last - self.first - 1

    def mean(self, values: Array) -> Array:
        """Mean (n, M) over the neighbours of values (n, M); 0 without any."""
        sums = running_sums(values)
        return np.asarray((sums[self.last] - sums[self.first] - values) / np.maximum(self.number, 1)[:, None])


def running_sums(values: npt.NDArray[Real]) -> npt.NDArray[Real]:
    """Sums (n + 1, M) of the first 0, 1, ... n of values (n, M)."""
    sums = np.zeros((len(values) + 1, values.shape[1]), dtype=values.dtype)
    np.cumsum(values, axis=0, out=sums[1:])
    return sums


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Weights of the candidates of n lines, entered at their depths."""

    bins: npt.NDArray[np.int64]  # (K, n) of each candidate; -1: none
    values: npt.NDArray[np.float32]  # (n, M)

    @classmethod
    def of(cls, weight: Array, depth_mm: Array) -> DepthMap:
        """The map of weights (n, K) that belong to depths (n, K)."""
        bins = without_nan(depth_mm.T / BIN_MM, -1.0).astype(np.int64)
        count, size = len(depth_mm), int(bins.max(initial=0)) + 2
        if count < 2:  # nobody to compare with
            return cls(bins, np.zeros((count, size), dtype=np.float32))
        flat = np.bincount(
            (np.where(bins < 0, size - 1, bins) + np.arange(0, count * size, size)).reshape(-1),
            np.where(bins < 0, 0.0, weight.T).reshape(-1),
            count * size,
        )
        return cls(bins, flat.reshape(count, size).astype(np.float32))

    def mean(self, neighbours: Neighbours | None, same_mm: float) -> Array:
        """Mean weight (n, K) that the neighbours (None: all other lines) of each line give to its candidates' depths.

        It counts fully at the very depth, less by a Gaussian of `same_mm`.
        """
        return self.means(same_mm, neighbours)[0]

    def means(self, same_mm: float, *among: Neighbours | None) -> list[Array]:
        """As mean, for several kinds of neighbours."""
        count, size = self.values.shape
        if count < 2:
            return [np.zeros(self.bins.T.shape) for _ in among]
        blurred = product(self.values, _blur(-(-size // BLUR_STEP) * BLUR_STEP, same_mm)[:size, :size])
        flat = blurred[:0] if among == (None,) else running_sums(blurred).reshape(-1)
        column, row = np.maximum(self.bins, 0), np.arange(0, count * size, size)
        own = blurred.reshape(-1).take(column + row)
        means = []
        for neighbours in among:
            if neighbours is None:
                mean = (blurred.sum(axis=0).take(column) - own) / (count - 1)
            else:
                total = flat.take(column + neighbours.last * size) - flat.take(column + neighbours.first * size)
                mean = (total - own) / np.maximum(neighbours.number, 1)
            means.append(np.where(self.bins < 0, 0.0, mean).T)
        return means


@lru_cache(maxsize=16)
def _blur(size: int, same_mm: float) -> npt.NDArray[np.float32]:
    """Matrix (M, M) that spreads a weight by a Gaussian of height 1, cut off at two standard deviations."""
    sigma = same_mm / BIN_MM
    kernel = scipy.ndimage.gaussian_filter1d(np.eye(size), sigma, axis=1, mode="constant", truncate=2.0)
    return np.asarray(kernel * (np.sqrt(2 * np.pi) * sigma), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Echoes:
    """Where echoes are at all, whatever they may be; what also shows at other places is an artefact of the probe."""

    presence: Array  # (n, K) share of the neighbours with an echo at this depth
    elsewhere: Array  # (n, K) share of the lines from other places with one
    elsewhere_known: Array  # (n, 1) 0 to 1: enough of them
    at_place: Array  # (n, K) share of the other lines from the same place with an echo at this depth
    here: DepthMap
    place: Neighbours

    @classmethod
    def of(cls, depth_mm: Array, runs: npt.NDArray[np.int64]) -> Echoes:
        """Of candidates at depths (n, K), NaN where there is none, in lines of `runs` (n,)."""
        here = DepthMap.of(np.isfinite(depth_mm).astype(float), depth_mm)
        own = Neighbours.within(runs, len(runs))
        all_others = max(len(runs) - 1, 0)
        others = (all_others - own.number)[:, None]
        near, of_own, of_all = here.means(SAME_MM, Neighbours.within(runs, REACH), own, None)
        elsewhere = of_all * all_others - of_own * own.number[:, None]
        return cls(
            near,
            np.clip(elsewhere / np.maximum(others, 1), 0, 2),
            np.minimum(others / 10, 1),
            of_own,
            here,
            own,
        )

    def covered(self, likely: DepthMap) -> Array:
        """Of the lines from the same place that show an echo at a candidate's depth, the share (n, K) with the bone behind it.

        Nothing is seen behind bone: what goes on over a hole in the skull is a layer of the scalp. `likely` maps where the
        bone is.
        """
        deeper = np.zeros_like(likely.values)
        deeper[:, :-BEHIND_BINS] = np.cumsum(likely.values[:, ::-1], axis=1)[:, -BEHIND_BINS - 1 :: -1]
        behind = DepthMap(likely.bins, self.here.values * deeper).mean(self.place, SAME_MM)
        return behind / (self.at_place + LEAST_AT_PLACE)


def relative_strength(amplitudes: Array, chance: Array, depth_mm: Array, carrier_mhz: float) -> tuple[Array, float, float]:
    """Level of each candidate (n, K) over what a bone of its depth shows in this recording, in units of 15 dB.

    The bone's level falls with depth by the tissue's attenuation: a straight line through the likely bones of all lines,
    its slope shrunk to that of usual tissue and never less than that of the clearest. So a layer at half the depth of the bone
    elsewhere is weak for a bone there, even if it is as strong. Also how far the line is known (0 to 1), and its slope (dB/mm).
    """
    level = DECIBEL * np.log(np.maximum(amplitudes, 1e-9))
    best = chance.argmax(axis=1)
    rows = np.arange(len(chance))
    weight = np.where(chance[rows, best] > 0.5, chance[rows, best], 0.0)
    if (weight > 0).sum() < LEAST_FOR_SHARED:
        return np.zeros(level.shape), 0.0, 0.0
    y, x = np.nan_to_num(level[rows, best]), np.nan_to_num(depth_mm[rows, best])
    usual, least = (-0.2 * one * carrier_mhz for one in (USUAL_FADING, LEAST_FADING))  # dB/mm of depth, there and back
    slope, middle_x, middle_y = 0.0, 0.0, 0.0
    for _ in range(3):
        total = weight.sum() + 1e-9
        middle_x, middle_y = float((weight * x).sum() / total), float((weight * y).sum() / total)
        spread = (weight * (x - middle_x) ** 2).sum()
        along = (weight * (x - middle_x) * (y - middle_y)).sum()
        slope = float(np.clip((along + FADING_WEIGHT * usual) / (spread + FADING_WEIGHT), -5.0, least))
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


def contact(amplitude: Array) -> Array:
    """The forerun echo's level over its median in the recording, in units of 10 dB: it is strongest in air."""
    seen = amplitude > 0
    if seen.sum() < LEAST_FOR_SHARED:
        return np.zeros(len(amplitude))
    middle = median(amplitude[seen])
    return np.where(seen, np.clip(DECIBEL * np.log(np.where(seen, amplitude, middle) / middle) / 10, -3, 3), 0.0)
