"""Echoes that may be the bone: the most salient peaks of each line behind the skin, with what speaks for and against them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

from ModuleUltrasoundLib.echo.lean import at_samples, clip, median, without_nan
from ModuleUltrasoundLib.echo.signal_chain import Envelopes, Floats

CANDIDATES = 8  # echoes kept of a line
NOISE_BLOCKS = 10
LOG_RAYLEIGH = 0.058  # mean of the logarithm of Rayleigh noise with unit quadratures: (ln 2 - Euler's constant) / 2
GUARD_CYCLES = 2.5  # half length of a pulse: levels before and after an echo are taken outside of it
FOOT_CYCLES = (1.0, 2.5)  # from an echo's peak to its feet
NEAR_S = 3e-6  # length of the stretches before and after an echo: 2.3 mm
SALIENCE_S = 2.5e-6  # an echo stands out over this much on both sides
DECIBEL = 20 / np.log(10)
TYPICAL_ATTENUATION = 1.0  # dB/cm/MHz; only ranks candidates, soft tissue has 0.3 to 2.6
# How candidates are ranked, chosen so that the bone of both families of simulated lines is among the first
LEVEL_WEIGHT, RISE_WEIGHT, BEFORE_WEIGHT, BEHIND_WEIGHT = (np.float32(x) for x in (1.6, 0.3, 0.2, 0.8))
SALIENCE_GUARD_CYCLES = 2.0
BARRED = np.float32(1e30)
ROWS = 128  # lines worked on at once: the working set stays in the processor's second cache
TILE = 32  # samples whose running sums are one product with a small matrix
_STEPS = np.array([-1, 0, 1])[:, None, None]
_SUM_UP = np.triu(np.ones((TILE, TILE), dtype=np.float32), k=1)


@dataclass(frozen=True, eq=False)
class Candidates:
    """K echoes of each of n lines, most salient first; NaN where a line has fewer."""

    delays_s: Array  # (n, K) after the skin
    amplitudes: Array  # (n, K) envelope
    phases: Array  # (n, K) phase of the RF at the echo's centre, rad
    widths_s: Array  # (n, K) standard deviation of the Gaussian that fits the envelope's top
    frequencies_hz: Array  # (n, K) instantaneous frequency at the centre: attenuation draws it down
    saliences_db: Array  # (n, K) over the mean level around
    before_db: Array  # (n, K) mean level in the stretch just before, over the noise
    after_db: Array  # (n, K) just behind
    before_all_db: Array  # (n, K) from the skin to the echo
    after_all_db: Array  # (n, K) from the echo to the end of the line
    rise_db: Array  # (n, K) the echo over the level at its own front foot
    fall_db: Array  # (n, K) the echo over the level at its own rear foot: a lasting pulse or a lump of echoes falls slowly
    end_db: Array  # (n, K) level of the line's end over its quietest stretch: a receiver may amplify with depth
    half_db: Array  # (n, K) envelope at half the echo's delay, over the echo: strong where a thin film sends sound to and fro
    further_db: Array  # (n, K) the same at one and a half times the delay
    static: Array  # (n, K) 0 to 1: how far it is an echo of the probe, the same at all places
    noise: Array  # (n,) standard deviation of one quadrature

    @property
    def snrs_db(self) -> Array:
        """(n, K) envelope over the noise of one quadrature."""
        return np.asarray(DECIBEL * np.log(np.maximum(self.amplitudes, 1e-9) / self.noise[:, None]))


@dataclass(frozen=True, eq=False)
class Levels:
    """Running sums of a batch's logarithmic envelope, from which mean levels of any stretch follow at once."""

    sums: Floats  # (n, M + 1 or more) of the first 0, 1, ... M samples
    length: int  # M

    def mean(self, first: npt.NDArray[np.int64], last: npt.NDArray[np.int64]) -> Floats:
        """Mean logarithm over [first, last) of each line, indices (..., n); NaN for empty stretches."""
        first, last = clip(first, 0, self.length), clip(last, 0, self.length)
        flat, start = self.sums.reshape(-1), np.arange(0, self.sums.size, self.sums.shape[1])
        total = flat.take(last + start) - flat.take(first + start)
        count = (last - first).astype(np.float32)
        count[count <= 0] = np.nan
        return np.asarray(total / count)


def padded(length: int) -> int:
    """Columns of whole tiles for `length` samples and one more."""
    return (length // TILE + 1) * TILE


def logarithm(magnitude: Floats) -> Floats:
    """Natural logarithm of envelopes (n, M), with columns behind them that fill the last tile."""
    log = np.zeros((len(magnitude), padded(magnitude.shape[1])), dtype=np.float32)
    log[:, : magnitude.shape[1]] = magnitude
    log += np.float32(1e-3)  # a thousandth of a code: far below any converter's noise
    return np.asarray(np.log(log, out=log))


def take_levels(log: Floats, length: int) -> Levels:
    """Levels of envelopes of `length` samples from their `logarithm`."""
    # within tiles by a matrix (line by line: see lean.product), then the tiles before: a third of the time of cumsum
    tiles = log.reshape(len(log), -1, TILE) @ _SUM_UP
    before = np.zeros(tiles.shape[:2], dtype=np.float32)
    np.cumsum(tiles[:, :-1, -1] + log[:, TILE - 1 : -1 : TILE], axis=1, out=before[:, 1:])
    return Levels(tiles.reshape(log.shape) + np.repeat(before, TILE, axis=1), length)


def noise_level(levels: Levels) -> Array:
    """Standard deviation of one quadrature of each line's noise, from its quietest stretch, shape (n,)."""
    edges = np.linspace(0, levels.length, NOISE_BLOCKS + 1).astype(np.int64)[:, None]
    return np.asarray(np.exp(np.fmin.reduce(levels.mean(edges[:-1], edges[1:])).astype(float) - LOG_RAYLEIGH))


def rough_noise(magnitude: Floats) -> Array:
    """As noise_level, but from the envelope itself: a little too high, and cheap."""
    length = magnitude.shape[1]
    block = max(length // NOISE_BLOCKS, 1)
    blocks = length // block
    means = magnitude[:, : blocks * block].reshape(-1, blocks, block) @ np.full(block, 1 / block, dtype=np.float32)
    return np.asarray(means.min(axis=1).astype(float) / np.sqrt(np.pi / 2)) + 1e-6


def refine_peaks(magnitude: Floats, samples: npt.NDArray[np.int64]) -> tuple[Array, Array]:
    """Sub-sample positions (in samples) and heights of peaks, by a parabola through the logarithm; NaN for padding."""
    positions, heights, _ = fit_tops(magnitude, samples)
    return positions, heights


def fit_tops(magnitude: Floats, samples: npt.NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """As refine_peaks, and the standard deviation (samples) of the Gaussian that has each peak's curvature."""
    number = samples.T
    safe = clip(number, 1, magnitude.shape[1] - 2)
    around = at_samples(magnitude, safe + _STEPS)
    left, mid, right = np.log(around.astype(float) + 1e-9)
    curvature = np.minimum(left - 2 * mid + right, -1e-6)
    slope = left - right
    offset = clip(0.5 * slope / curvature, -0.5, 0.5)
    height = np.exp(mid - 0.25 * slope * offset)
    position, width = safe + offset, np.sqrt(-1 / curvature)
    bad = number < 0
    for values in (position, height, width):
        values[bad] = np.nan
    return position.T, height.T, width.T


def salient_peaks(
    log: Floats, levels: Levels, rate_hz: float, rise_db_per_s: float, first: int, last: int, guard_s: float
) -> npt.NDArray[np.int64]:
    """Indices (n, K) of the local maxima in [first, last) that stand out most from what surrounds them; -1 pads.

    Standing out is judged mainly against the level behind, where bone casts its shadow, so that a bone echo far below an
    interface before it is kept; the level itself, raised by the tissue's attenuation, counts too.
    """
    guard = max(int(guard_s * rate_hz), 1)
    length = min(max(int(SALIENCE_S * rate_hz) - guard, 2), levels.length)
    rise = np.arange(1, last - first - 1) * (RISE_WEIGHT * rise_db_per_s / rate_hz / DECIBEL)
    return _highest(_salience(log, levels, first, last, guard, length, rise.astype(np.float32)), first + 1)


def _salience(log: Floats, levels: Levels, first: int, last: int, guard: int, length: int, rise: Floats) -> Floats:
    """How much each local maximum between `first` and `last` stands out, shape (n, last - first - 2); other samples are barred.

    All lines lie behind one another, so that a shift by some samples is a piece of one long row: numpy works on it several
    times as fast as on rows. What runs over from one line into the next lies in margins that are cut off.
    """
    lead, size = guard + length, levels.length
    least, most = first - lead, last + lead
    log, sums = _columns(log, least, most), _columns(levels.sums, least, most)
    width = most - least
    mean = np.zeros_like(sums)  # of [sample, sample + length)
    np.subtract(sums.reshape(-1)[length:], sums.reshape(-1)[:-length], out=mean.reshape(-1)[:-length])
    if least < 0:  # beyond the line's ends the first and last mean repeat
        mean[:, :-least] = mean[:, -least, None]
    if last + guard > size - length:
        mean[:, size - length - least :] = mean[:, size - length - least, None]
    score = log.reshape(-1) * LEVEL_WEIGHT
    mean *= BEHIND_WEIGHT / np.float32(length)
    score[:-guard] -= mean.reshape(-1)[guard:]
    mean *= BEFORE_WEIGHT / BEHIND_WEIGHT
    score[lead:] -= mean.reshape(-1)[:-lead]
    rising = log.reshape(-1)[1:] > log.reshape(-1)[:-1]
    peak = rising[:-1] > rising[1:]
    bar = peak.astype(np.float32)
    bar -= 1
    bar *= BARRED
    score[1:-1] += bar  # a sum: choices that nothing foretells are slow
    score = score.reshape(-1, width)[:, lead + 1 : lead + last - first - 1].copy()
    score += np.tile(rise, (len(score), 1))
    return score


def _columns(values: Floats, first: int, last: int) -> Floats:
    """Columns [first, last) of values (n, M) as an array of their own; 0 beyond the ends."""
    if first >= 0 and last <= values.shape[1]:
        return values[:, first:last].copy()
    columns = np.zeros((len(values), last - first), dtype=np.float32)
    there = values[:, max(first, 0) : max(last, 0)]
    columns[:, max(-first, 0) : max(-first, 0) + there.shape[1]] = there
    return columns


def _highest(score: Floats, first: int) -> npt.NDArray[np.int64]:
    """Columns (n, CANDIDATES), counted from `first`, of the highest scores of each row; -1 pads. `score` is used up."""
    flat, start = score.reshape(-1), np.arange(0, score.size, score.shape[1])
    best = np.empty((CANDIDATES, len(score)), dtype=np.int64)
    heights = np.empty((CANDIDATES, len(score)), dtype=np.float32)
    for rank in range(CANDIDATES):  # a few passes of argmax cost less than sorting every line
        at = score.argmax(axis=1) + start
        best[rank] = at
        heights[rank] = flat[at]
        flat[at] = -np.inf
    best -= start - first
    best[heights < -BARRED / 2] = -1
    return best.T


def find_candidates(
    envelopes: Envelopes, magnitude: Floats, skin_s: Array, window_s: tuple[float, float], transducer_hz: float
) -> Candidates:
    """The most salient echoes within `window_s` (least, most) behind the skin echo of each line.

    The search runs over the window common to all lines of the batch (the skin moves by a few samples only).
    """
    rate, (count, length) = envelopes.rate_hz, magnitude.shape
    skin = median(skin_s) if count else 0.0
    first = max(int((skin + window_s[0]) * rate), 0)
    last = min(int((skin + window_s[1]) * rate) + 1, length)
    rise = TYPICAL_ATTENUATION * transducer_hz * 1e-6 * 154e3  # dB a second of delay: 77 km/s of depth, both ways, per cm
    samples = np.empty((CANDIDATES, count), dtype=np.int64)
    noise, mean = np.empty(count), np.empty((8, CANDIDATES, count), dtype=np.float32)
    for start in range(0, count, ROWS):
        rows = slice(start, start + ROWS)
        log = logarithm(magnitude[rows])
        levels = take_levels(log, length)
        noise[rows] = noise_level(levels)
        if last - first >= 6:
            some = salient_peaks(log, levels, rate, rise, first, last, SALIENCE_GUARD_CYCLES / transducer_hz).T
            samples[:, rows], mean[..., rows] = some, _surroundings(levels, some, rate, transducer_hz, int(skin * rate))
    if last - first < 6:
        return _none(count, noise)
    return _describe(envelopes, magnitude, samples.T, mean, noise, skin_s)


def _describe(
    envelopes: Envelopes, magnitude: Floats, samples: npt.NDArray[np.int64], mean: Floats, noise: Array, skin_s: Array
) -> Candidates:
    """What speaks for and against the echoes at `samples` (n, K), of whose surroundings the `mean` (8, K, n) is known."""
    rate = envelopes.rate_hz
    positions, heights, widths = (values.T for values in fit_tops(magnitude, samples))
    number = samples.T
    back, here, ahead = at_samples(envelopes.values, clip(number + _STEPS, 0, magnitude.shape[1] - 1))
    times = positions / rate
    # the baseband phase hardly changes within a sample; the carrier's phase is that of the refined time
    phases = np.angle(here) + 2 * np.pi * envelopes.carrier_hz * times
    frequencies = envelopes.carrier_hz + np.angle(ahead * back.conj()) * (rate / (4 * np.pi))
    frequencies[number < 0] = np.nan
    height, base = np.log(heights), np.log(noise) + LOG_RAYLEIGH
    over, under = DECIBEL * (height - mean[:3]), DECIBEL * (mean[3:] - base)
    return Candidates(
        delays_s=(times - skin_s).T,
        amplitudes=heights.T,
        phases=phases.T,
        widths_s=(widths / rate).T,
        frequencies_hz=frequencies.T,
        saliences_db=over[0].T,
        rise_db=over[1].T,
        fall_db=over[2].T,
        before_db=under[0].T,
        after_db=under[1].T,
        before_all_db=under[2].T,
        after_all_db=under[3].T,
        end_db=under[4].T,
        half_db=_over(magnitude, skin_s, times, heights, 0.5, rate),
        further_db=_over(magnitude, skin_s, times, heights, 1.5, rate),
        static=np.zeros(samples.shape),
        noise=noise,
    )


def _over(magnitude: Floats, skin_s: Array, times_s: Array, heights: Array, share: float, rate_hz: float) -> Array:
    """Level (n, K) of the envelope at `share` of the delay of echoes at `times_s` (K, n), in dB over their `heights` (K, n)."""
    at = np.rint(without_nan((skin_s + share * (times_s - skin_s)) * rate_hz, -1.0)).astype(np.int64)
    there = at_samples(magnitude, clip(at + _STEPS, 0, magnitude.shape[1] - 1)).max(axis=0)
    return np.asarray((DECIBEL * np.log(np.maximum(there, np.float32(1e-3)) / heights)).T)


def _surroundings(
    levels: Levels, number: npt.NDArray[np.int64], rate_hz: float, transducer_hz: float, skin_sample: int
) -> Floats:
    """Mean logarithm (8, K, n) around the samples `number` (K, n), at the front and the rear foot, just before and behind, in
    all before and all behind, and at the line's end."""
    guard, near, reach = (int(x * rate_hz) for x in (GUARD_CYCLES / transducer_hz, NEAR_S, SALIENCE_S))
    inner, outer = (max(round(x * rate_hz / transducer_hz), 1) for x in FOOT_CYCLES)
    skin = skin_sample + guard
    stretches = np.empty((2, 8, *number.shape), dtype=np.int64)
    first, last = stretches
    for row, least, most in (
        (0, number - reach, number + (reach + 1)),
        (1, number - outer, number - inner),
        (2, number + (inner + 1), number + (outer + 1)),
        (3, np.maximum(number - (guard + near), skin), number - guard),
        (4, number + guard, number + (guard + near)),
        (5, skin, number - guard),
        (6, number + guard, levels.length),
        (7, levels.length - 4 * guard, levels.length),
    ):
        first[row], last[row] = least, most
    return levels.mean(first, last)


def _none(count: int, noise: Array) -> Candidates:
    empty = np.full((count, CANDIDATES), np.nan)
    names = [name for name in Candidates.__dataclass_fields__ if name != "noise"]
    return Candidates(**dict.fromkeys(names, empty), noise=noise)


def concatenate(parts: list[Candidates]) -> Candidates:
    """The candidates of several batches as one."""
    if len(parts) == 1:
        return parts[0]
    names = Candidates.__dataclass_fields__
    return Candidates(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def reorder(candidates: Candidates, order: npt.NDArray[np.int64]) -> Candidates:
    """The candidates of each line in another order, indices (n, K)."""
    at = order.T * len(order) + np.arange(len(order))
    values = {name: getattr(candidates, name) for name in Candidates.__dataclass_fields__}
    return Candidates(**{name: value.T.reshape(-1).take(at).T if value.ndim == 2 else value for name, value in values.items()})
