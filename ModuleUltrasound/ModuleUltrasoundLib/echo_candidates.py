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
    sums: Floats  # (n, M + 1)

    def mean(self, first: npt.NDArray[np.int64], last: npt.NDArray[np.int64]) -> Array:
        """Mean logarithm over [first, last) of each line, indices (n, K); NaN for empty stretches."""
        length = self.log.shape[1]
        first, last = np.clip(first, 0, length), np.clip(last, 0, length)
        rows = np.arange(len(self.sums))[:, None]
        total = self.sums[rows, last] - self.sums[rows, first]
        return np.asarray(np.where(last > first, total / np.maximum(last - first, 1), np.nan), dtype=np.float32)

    def means(self, *stretches: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]) -> list[Array]:
        """As mean, for several stretches at once."""
        first, last = (np.concatenate([stretch[k] for stretch in stretches], axis=1) for k in (0, 1))
        return np.split(self.mean(first, last), len(stretches), axis=1)


def take_levels(magnitude: Floats) -> Levels:
    """Logarithmic levels of a batch of envelopes (n, M)."""
    log = np.log(magnitude + np.float32(1e-3))  # a thousandth of a code: far below any converter's noise
    sums = np.zeros((len(log), log.shape[1] + 1), dtype=np.float32)
    np.cumsum(log, axis=1, out=sums[:, 1:])
    return Levels(log, sums)


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
    parts = [magnitude[:, k * block : (k + 1) * block] @ np.full(block, 1 / block, dtype=np.float32) for k in range(blocks)]
    means = np.stack(parts, axis=1)
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
    start = max(first - guard - length, 0)  # sums before it and behind `stop` are not asked for
    stop = min(last + guard + length, levels.log.shape[1])
    running = levels.sums[:, start + length : stop + 1] - levels.sums[:, start : stop + 1 - length]
    running *= np.float32(1 / length)
    rise = (np.arange(1, last - first - 1) * (RISE_WEIGHT * rise_db_per_s / rate_hz / DECIBEL)).astype(np.float32)
    here = levels.log[:, first + 1 : last - 1]
    score = LEVEL_WEIGHT * here + rise
    score -= BEFORE_WEIGHT * _stretch(running, first + 1 - guard - length - start, last - 1 - guard - length - start)
    score -= BEHIND_WEIGHT * _stretch(running, first + 1 + guard - start, last - 1 + guard - start)
    lower = (here <= levels.log[:, first : last - 2]) | (here < levels.log[:, first + 2 : last])
    np.copyto(score, np.float32(-np.inf), where=lower)
    samples = np.full((len(score), CANDIDATES), -1, dtype=np.int64)
    rows = np.arange(len(score))
    for rank in range(CANDIDATES):  # a few passes of argmax cost less than sorting every line
        best = score.argmax(axis=1)
        samples[:, rank] = np.where(np.isfinite(score[rows, best]), best + first + 1, -1)
        score[rows, best] = -np.inf
    return samples


def _stretch(values: Floats, start: int, stop: int) -> Floats:
    """Columns [start, stop) of values (n, M); beyond the ends the first and last column repeat."""
    inside = values[:, max(start, 0) : max(stop, 0)]
    if start >= 0 and stop <= values.shape[1]:
        return inside
    return np.asarray(values[:, np.clip(np.arange(start, stop), 0, values.shape[1] - 1)])


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
