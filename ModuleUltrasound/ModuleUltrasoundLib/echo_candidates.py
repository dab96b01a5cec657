"""Echoes that may be the bone: the most salient peaks of each line behind the skin, with what speaks for and against them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

from ModuleUltrasoundLib.signal_chain import Envelopes, Floats

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
ROWS = 64  # lines worked on at once: the working set stays in the processor's second cache
TILE = 32  # samples whose running sums are one product with a small matrix
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
    noise: Array  # (n,) standard deviation of one quadrature

    @property
    def snrs_db(self) -> Array:
        """(n, K) envelope over the noise of one quadrature."""
        return np.asarray(DECIBEL * np.log(np.maximum(self.amplitudes, 1e-9) / self.noise[:, None]))


@dataclass(frozen=True, eq=False)
class Levels:
    """Running sums of a batch's logarithmic envelope, from which mean levels of any stretch follow at once."""

    log: Floats  # (n, M) natural logarithm of the envelope
    sums: Floats  # (n, M + 1 or more) of the first 0, 1, ... M samples

    def mean(self, first: npt.NDArray[np.int64], last: npt.NDArray[np.int64]) -> Array:
        """Mean logarithm over [first, last) of each line, indices (n, K); NaN for empty stretches."""
        length, size = self.log.shape[1], self.sums.shape[1]
        first, last = (np.minimum(np.maximum(index, 0), length) for index in (first, last))
        flat, start = self.sums.reshape(-1), np.arange(0, self.sums.size, size)[:, None]
        total = flat.take(last + start) - flat.take(first + start)
        count = last - first
        return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan), dtype=np.float32)

    def means(self, *stretches: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]) -> list[Array]:
        """As mean, for several stretches at once."""
        first, last = (np.concatenate([stretch[k] for stretch in stretches], axis=1) for k in (0, 1))
        mean, width = self.mean(first, last), first.shape[1] // len(stretches)
        return [mean[:, k : k + width] for k in range(0, mean.shape[1], width)]


def take_levels(magnitude: Floats) -> Levels:
    """Logarithmic levels of a batch of envelopes (n, M)."""
    count, length = magnitude.shape
    log = np.zeros((count, (length // TILE + 1) * TILE), dtype=np.float32)
    sums = np.empty_like(log)
    for start in range(0, count, ROWS):
        some = log[start : start + ROWS]
        some[:, :length] = magnitude[start : start + ROWS]
        some += np.float32(1e-3)  # a thousandth of a code: far below any converter's noise
        np.log(some, out=some)
        # within tiles by a matrix, then the tiles before: a third of the time of cumsum
        tiles = (some.reshape(-1, TILE) @ _SUM_UP).reshape(len(some), -1, TILE)
        before = np.zeros(tiles.shape[:2], dtype=np.float32)
        np.cumsum(tiles[:, :-1, -1] + some[:, TILE - 1 : -1 : TILE], axis=1, out=before[:, 1:])
        np.add(tiles.reshape(len(some), -1), np.repeat(before, TILE, axis=1), out=sums[start : start + ROWS])
    return Levels(log[:, :length], sums)


def noise_level(levels: Levels) -> Array:
    """Standard deviation of one quadrature of each line's noise, from its quietest stretch, shape (n,)."""
    length = levels.log.shape[1]
    edges = np.linspace(0, length, NOISE_BLOCKS + 1).astype(np.int64)
    means = (levels.sums[:, edges[1:]] - levels.sums[:, edges[:-1]]) / np.maximum(np.diff(edges), 1)
    return np.asarray(np.exp(means.min(axis=1).astype(float) - LOG_RAYLEIGH))


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
    safe = np.clip(samples, 1, magnitude.shape[1] - 2)
    rows = np.arange(len(magnitude))[:, None]
    left, mid, right = (np.log(magnitude[rows, safe + step].astype(float) + 1e-9) for step in (-1, 0, 1))
    curvature = np.minimum(left - 2 * mid + right, -1e-6)
    offset = np.clip(0.5 * (left - right) / curvature, -0.5, 0.5)
    height = np.exp(mid - 0.25 * (left - right) * offset)
    bad = samples < 0
    return np.where(bad, np.nan, safe + offset), np.where(bad, np.nan, height), np.where(bad, np.nan, np.sqrt(-1 / curvature))


def salient_peaks(
    levels: Levels, rate_hz: float, rise_db_per_s: float, first: int, last: int, guard_s: float
) -> npt.NDArray[np.int64]:
    """Indices (n, K) of the local maxima in [first, last) that stand out most from what surrounds them; -1 pads.

    Standing out is judged mainly against the level behind, where bone casts its shadow, so that a bone echo far below an
    interface before it is kept; the level itself, raised by the tissue's attenuation, counts too.
    """
    guard = max(int(guard_s * rate_hz), 1)
    length = min(max(int(SALIENCE_S * rate_hz) - guard, 2), levels.log.shape[1])
    rise = np.arange(last - first) * (RISE_WEIGHT * rise_db_per_s / rate_hz / DECIBEL)
    samples = np.empty((len(levels.log), CANDIDATES), dtype=np.int64)
    for start in range(0, len(samples), ROWS):
        rows = slice(start, start + ROWS)
        score = _salience(Levels(levels.log[rows], levels.sums[rows]), first, last, guard, length, rise.astype(np.float32))
        samples[rows] = _highest(score)
    return np.asarray(np.where(samples < 0, -1, samples + first + 1))


def _salience(levels: Levels, first: int, last: int, guard: int, length: int, rise: Floats) -> Floats:
    """How much each local maximum between `first` and `last` stands out, shape (n, last - first - 2); other samples are barred.

    All lines lie behind one another, so that a shift by some samples is a piece of one long row: numpy works on it several
    times as fast as on rows. What runs over from one line into the next lies in margins that are cut off.
    """
    lead, size = guard + length, levels.log.shape[1]
    least, most = first - lead, last + lead
    log, sums = _columns(levels.log, least, most), _columns(levels.sums, least, most)
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
    score[1:-1] += (peak.view(np.int8) - np.int8(1)) * BARRED  # a sum: choices that nothing foretells are slow
    score = score.reshape(-1, width)[:, lead + 1 : lead + last - first - 1].copy()
    score += np.tile(rise[1:-1], (len(score), 1))
    return score


def _columns(values: Floats, first: int, last: int) -> Floats:
    """Columns [first, last) of values (n, M) as an array of their own; 0 beyond the ends."""
    if first >= 0 and last <= values.shape[1]:
        return values[:, first:last].copy()
    columns = np.zeros((len(values), last - first), dtype=np.float32)
    there = values[:, max(first, 0) : max(last, 0)]
    columns[:, max(-first, 0) : max(-first, 0) + there.shape[1]] = there
    return columns


def _highest(score: Floats) -> npt.NDArray[np.int64]:
    """Columns (n, CANDIDATES) of the highest scores of each row, -1 where there are no more. `score` is used up."""
    flat, start = score.reshape(-1), np.arange(0, score.size, score.shape[1])
    best = np.empty((CANDIDATES, len(score)), dtype=np.int64)
    heights = np.empty((CANDIDATES, len(score)), dtype=np.float32)
    for rank in range(CANDIDATES):  # a few passes of argmax cost less than sorting every line
        score.argmax(axis=1, out=best[rank])
        at = best[rank] + start
        heights[rank] = flat[at]
        flat[at] = -np.inf
    best[heights < -BARRED / 2] = -1
    return best.T


def find_candidates(
    envelopes: Envelopes,
    magnitude: Floats,
    levels: Levels,
    skin_s: Array,
    window_s: tuple[float, float],
    transducer_hz: float,
) -> Candidates:
    """The most salient echoes within `window_s` (least, most) behind the skin echo of each line.

    The search runs over the window common to all lines of the batch (the skin moves by a few samples only).
    """
    noise = noise_level(levels)
    rate = envelopes.rate_hz
    skin = float(np.median(skin_s)) if len(skin_s) else 0.0
    first = max(int((skin + window_s[0]) * rate), 0)
    last = min(int((skin + window_s[1]) * rate) + 1, magnitude.shape[1])
    if last - first < 6:
        return _none(len(magnitude), noise)
    rise = TYPICAL_ATTENUATION * transducer_hz * 1e-6 * 154e3  # dB a second of delay: 77 km/s of depth, both ways, per cm
    samples = salient_peaks(levels, rate, rise, first, last, SALIENCE_GUARD_CYCLES / transducer_hz)
    positions, heights, widths = fit_tops(magnitude, samples)
    rows = np.arange(len(samples))[:, None]
    complex_values = envelopes.values[rows, np.clip(samples, 0, None)]
    # the baseband phase hardly changes within a sample; the carrier's phase is that of the refined time
    phases = np.angle(complex_values) + 2 * np.pi * envelopes.carrier_hz * (positions / rate)
    ahead, back = (envelopes.values[rows, np.clip(samples + k, 0, magnitude.shape[1] - 1)] for k in (1, -1))
    turn = np.angle(ahead * back.conj())
    guard, near, reach = (int(x * rate) for x in (GUARD_CYCLES / transducer_hz, NEAR_S, SALIENCE_S))
    inner, outer = (max(round(x * rate / transducer_hz), 1) for x in FOOT_CYCLES)
    skin_sample = np.full_like(samples, int(skin * rate) + guard)
    end = np.full_like(samples, magnitude.shape[1])
    around, before, after, before_all, after_all, front, rear, last_level = levels.means(
        (samples - reach, samples + reach + 1),
        (np.maximum(samples - guard - near, skin_sample), samples - guard),
        (samples + guard, samples + guard + near),
        (skin_sample, samples - guard),
        (samples + guard, end),
        (samples - outer, samples - inner),
        (samples + inner + 1, samples + outer + 1),
        (end - guard * 4, end),
    )
    base, height = np.log(noise)[:, None] + LOG_RAYLEIGH, np.log(heights)
    return Candidates(
        delays_s=positions / rate - skin_s[:, None],
        amplitudes=heights,
        phases=phases,
        widths_s=widths / rate,
        frequencies_hz=np.where(samples < 0, np.nan, envelopes.carrier_hz + turn * rate / (4 * np.pi)),
        saliences_db=DECIBEL * (height - around),
        before_db=DECIBEL * (before - base),
        after_db=DECIBEL * (after - base),
        before_all_db=DECIBEL * (before_all - base),
        after_all_db=DECIBEL * (after_all - base),
        rise_db=DECIBEL * (height - front),
        fall_db=DECIBEL * (height - rear),
        end_db=DECIBEL * (last_level - base),
        noise=noise,
    )


def _none(count: int, noise: Array) -> Candidates:
    empty = np.full((count, CANDIDATES), np.nan)
    names = [name for name in Candidates.__dataclass_fields__ if name != "noise"]
    return Candidates(**dict.fromkeys(names, empty), noise=noise)


def concatenate(parts: list[Candidates]) -> Candidates:
    """The candidates of several batches as one."""
    names = Candidates.__dataclass_fields__
    return Candidates(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def reorder(candidates: Candidates, order: npt.NDArray[np.int64]) -> Candidates:
    """The candidates of each line in another order, indices (n, K)."""
    values = {name: getattr(candidates, name) for name in Candidates.__dataclass_fields__}
    return Candidates(
        **{name: np.take_along_axis(value, order, axis=1) if value.ndim == 2 else value for name, value in values.items()}
    )
