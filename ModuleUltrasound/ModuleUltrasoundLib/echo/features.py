"""What the physics of a bone echo says about each candidate, as numbers of order one.

Bone under soft tissue is the first strong specular interface, and it casts a shadow: the tissue's own echoes end with it.
Behind it come the inner table and reverberations, before it weaker interfaces (galea, fat and muscle). The forerun's
echoes repeat at whole multiples of its time. The electronic noise is the same everywhere.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

from ModuleUltrasoundLib.echo.candidates import DECIBEL, Candidates
from ModuleUltrasoundLib.echo.forerun import MULTIPLES, Forerun
from ModuleUltrasoundLib.echo.signal_chain import Floats

FAR_MM = 12.0  # stands for "there is none" in distances between echoes
FAR_DB = 40.0
APART_MM = 0.3  # nearer echoes are one
CLEAR_DB = 34.0  # over the noise: an echo that is clearer still is no other kind of echo
MULTIPLE_EARLY_CYCLES = 1.6  # a multiple carries the pulse's delay once, its prediction from the first echo twice
MULTIPLE_TOLERANCE_S = 2e-7
REPEATED = 0.5  # of the likeness of a place to that of a multiple: beyond, an echo there is not compared with others
REVERBERATION_TOLERANCE_S = 2.5e-7

UNITS = {  # what each number is counted in, so that all are of order one
    "snr": 20, "salience": 10, "before": 10, "after": 10, "before all": 10, "after all": 10, "drop": 10, "drop all": 10,
    "stronger before": 15, "its distance": 5, "stronger behind": 15, "its distance behind": 5, "depth": 8, "loss": 50,
    "multiple": 1, "multiple share": 15, "forerun": 30, "has forerun": 1, "reverberation": 15, "width": 1,
    "rank before": 3, "rank behind": 3, "line snr": 20, "next best": 15, "frequency": 0.2, "frequency against before": 0.2,
    "frequency against behind": 0.2, "rise": 15, "fall": 15, "end of line": 15, "own reverberation": 15, "static": 0.5,
    "half": 15, "further": 15,
}  # fmt: skip
NAMES = tuple(UNITS)
_DIVISORS = np.array(list(UNITS.values()), dtype=np.float32)[:, None, None]


def line_features(
    candidates: Candidates, forerun: Forerun, nominal_skin_s: float, transducer_hz: float, speed_m_s: float
) -> Array:
    """Features (n, K, len(NAMES)) of each candidate from its own line alone; NaN candidates give finite numbers.

    Inside, the lines are the last axis: numpy's inner loops then run over many lines instead of a few candidates.
    """
    valid = ~np.isnan(candidates.amplitudes.T)
    delays, amplitudes, frequencies, widths, saliences, rise, fall, end, static, half, further, *stretches = _numbers(candidates)
    level = DECIBEL * np.log(np.maximum(amplitudes, np.float32(1e-9)))
    snr = np.where(valid, level - (DECIBEL * np.log(candidates.noise)).astype(np.float32), np.float32(-FAR_DB))
    depth = delays * np.float32(500 * speed_m_s)
    frequency = np.where(valid, frequencies / np.float32(transducer_hz) - np.float32(0.92), np.float32(0))
    before, after, before_all, after_all = np.minimum(np.maximum(stretches, np.float32(-5)), np.float32(60))
    over = _over_forerun(level, forerun)
    multiple = _multiples(delays, forerun, nominal_skin_s, transducer_hz, valid)
    real = valid & (multiple < REPEATED)  # the forerun's own repetitions say nothing about the tissue's echoes
    pair = snr - snr[:, None]  # [one, other, line]: how much stronger the other is
    gap = depth - depth[:, None]
    sides = np.stack([gap < -APART_MM, gap > APART_MM])  # [before or behind, one, other, line]
    sides &= real & valid[:, None]
    stronger, far, lower = _strongest(pair, depth, frequency, sides)
    rank = (sides & (pair > -8)).sum(axis=2, dtype=np.float32)
    reverberation, own = _reverberations(delays, pair, sides[0])
    strongest = np.where(real, snr, np.float32(-FAR_DB)).max(axis=0, initial=-FAR_DB)
    features = (
        np.minimum(snr, CLEAR_DB), saliences, before, after, before_all, after_all, before - after, before_all - after_all,
        stronger[0], far[0], stronger[1], far[1], depth, depth * np.float32(transducer_hz * 1e-6),
        multiple, over * multiple, over, forerun.amplitude > 0, reverberation, widths * np.float32(transducer_hz),
        rank[0], rank[1], np.minimum(strongest, CLEAR_DB), strongest - snr,
        frequency, lower[0], lower[1], rise, fall, end, own, static, half, further,
    )  # fmt: skip
    stacked = np.empty((len(NAMES), *snr.shape), dtype=np.float32)
    for row, feature in zip(stacked, features):
        row[...] = feature
    stacked /= _DIVISORS
    stacked *= valid.astype(np.float32)
    np.minimum(np.maximum(stacked, -4, out=stacked), 4, out=stacked)
    return np.ascontiguousarray(stacked.T)


def _numbers(candidates: Candidates) -> Floats:
    """What the features are made of, each (K, n); 0 where there is no candidate or the stretch is empty."""
    names = (
        "delays_s", "amplitudes", "frequencies_hz", "widths_s", "saliences_db", "rise_db", "fall_db", "end_db", "static",
        "half_db", "further_db",
        "before_db", "after_db", "before_all_db", "after_all_db",
    )  # fmt: skip
    numbers = np.empty((len(names), *candidates.amplitudes.T.shape), dtype=np.float32)
    for row, name in zip(numbers, names):
        row[...] = getattr(candidates, name).T
    numbers[np.isnan(numbers)] = 0
    return numbers


def _over_forerun(level: Floats, forerun: Forerun) -> Floats:
    """Level of each candidate (K, n) over the forerun's echo, dB; 0 without one."""
    face = (DECIBEL * np.log(np.maximum(forerun.amplitude, 1e-9))).astype(np.float32)
    return np.asarray(np.where(forerun.amplitude > 0, level - face, np.float32(0)))


def _strongest(pair: Floats, depth: Floats, frequency: Floats, where: npt.NDArray[np.bool_]) -> tuple[Floats, Floats, Floats]:
    """Of the strongest of those `where` is (sides, K, K, n): how much stronger (dB) it is, how far (mm) away it lies, and how
    much lower than its frequency each echo's own is, all (sides, K, n)."""
    masked = np.where(where, pair, np.float32(-FAR_DB))
    best = masked.max(axis=2)
    weaker = (masked != best[:, :, None]).view(np.uint8)
    count, lines = depth.shape
    # the first of the strongest: argmax over an axis that is not the last one would copy everything
    which = (weaker * np.uint8(count) + np.arange(count, dtype=np.uint8)[:, None]).min(axis=2, initial=count - 1)
    at = which * np.int64(lines) + np.arange(lines)
    some = where.any(axis=2)
    far = np.where(some, np.minimum(np.abs(depth.reshape(-1).take(at) - depth), FAR_MM), np.float32(FAR_MM))
    lower = np.where(some, frequency - frequency.reshape(-1).take(at), np.float32(0))
    return np.minimum(np.maximum(best, -FAR_DB), FAR_DB), far, lower


def _multiples(
    delays: Floats, forerun: Forerun, nominal_skin_s: float, transducer_hz: float, valid: npt.NDArray[np.bool_]
) -> Floats:
    """How much a candidate (K, n) lies where the forerun's echo repeats, 0 to 1."""
    if nominal_skin_s <= 0:
        return np.zeros(delays.shape, dtype=np.float32)
    times = np.arange(1, MULTIPLES, dtype=np.float32)[:, None, None]
    expected = times * forerun.skin_s.astype(np.float32)
    early = times * np.float32(MULTIPLE_EARLY_CYCLES / transducer_hz)
    jump = forerun.jump_s.astype(np.float32)
    off = np.minimum(*(np.maximum(late, -late - early).min(axis=0) for late in (delays - expected, delays - jump - expected)))
    off = np.maximum(off, 0) / np.float32(MULTIPLE_TOLERANCE_S)
    return np.asarray(np.exp(-(off**2)) * valid)


def _reverberations(delays: Floats, pair: Floats, before: npt.NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """How much stronger (dB) an earlier echo is of which this one would be the first reverberation under the skin, and how
    near in strength the echo comes that would be this one's: bone under a flat skin has one."""
    late, early, line = np.nonzero(before & (np.abs(delays[:, None] - 2 * delays) < REVERBERATION_TOLERANCE_S))  # seldom any
    stronger = pair[late, early, line]
    source, own = np.zeros_like(delays), np.zeros_like(delays)
    np.maximum.at(source, (late, line), np.minimum(stronger, FAR_DB))
    np.maximum.at(own, (early, line), np.minimum(FAR_DB - stronger, FAR_DB))
    return source, own
