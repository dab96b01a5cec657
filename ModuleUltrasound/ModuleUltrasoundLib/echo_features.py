"""What the physics of a bone echo says about each candidate, as numbers of order one.

Bone under soft tissue is the first strong specular interface, and it casts a shadow: the tissue's own echoes end with it.
Behind it come the inner table and reverberations, before it weaker interfaces (galea, fat and muscle). The forerun's
echoes repeat at whole multiples of its time. The electronic noise is the same everywhere.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

from ModuleUltrasoundLib.echo_candidates import DECIBEL, Candidates
from ModuleUltrasoundLib.signal_chain import Floats
from ModuleUltrasoundLib.signal_forerun import MULTIPLES, Forerun

FAR_MM = 12.0  # stands for "there is none" in distances between echoes
FAR_DB = 40.0
CLEAR_DB = 34.0  # over the noise: an echo that is clearer still is no other kind of echo
MULTIPLE_EARLY_CYCLES = 1.6  # a multiple carries the pulse's delay once, its prediction from the first echo twice
MULTIPLE_TOLERANCE_S = 2e-7
REPEATED = 0.5  # of the likeness of a place to that of a multiple: beyond, an echo there is not compared with others
REVERBERATION_TOLERANCE_S = 2.5e-7

NAMES = (
    "snr", "salience", "before", "after", "before all", "after all", "drop", "drop all", "stronger before", "its distance",
    "stronger behind", "its distance behind", "depth", "loss", "multiple", "multiple share", "forerun", "has forerun",
    "reverberation", "width", "rank before", "rank behind", "line snr", "next best",
    "frequency", "frequency against before", "frequency against behind", "rise", "fall", "end of line", "own reverberation",
)  # fmt: skip


def line_features(
    candidates: Candidates, forerun: Forerun, nominal_skin_s: float, transducer_hz: float, speed_m_s: float
) -> Array:
    """Features (n, K, len(NAMES)) of each candidate from its own line alone; NaN candidates give finite numbers."""
    snr = candidates.snrs_db.astype(np.float32)
    valid = np.isfinite(snr)
    depth = np.where(valid, candidates.delays_s * 500 * speed_m_s, 0.0).astype(np.float32)
    snr = np.where(valid, snr, np.float32(-FAR_DB))
    pair = snr[:, None, :] - snr[:, :, None]  # [line, one, other]: how much stronger the other is
    gap = depth[:, None, :] - depth[:, :, None]
    multiple, share = _multiples(candidates, forerun, nominal_skin_s, transducer_hz, valid)
    real = valid & (multiple < REPEATED)  # the forerun's own repetitions say nothing about the tissue's echoes
    both = real[:, None, :] & valid[:, :, None]
    before, behind = both & (gap < -0.3), both & (gap > 0.3)
    best_before, far_before, which_before = _strongest(pair, gap, before)
    best_behind, far_behind, which_behind = _strongest(pair, gap, behind)
    rows = np.arange(len(snr))[:, None]
    frequency = np.where(valid, candidates.frequencies_hz / transducer_hz - 0.92, 0.0)
    lower = [
        np.where(where.any(axis=2), frequency - frequency[rows, which], 0.0)
        for where, which in ((before, which_before), (behind, which_behind))
    ]
    reverberation, own = _reverberations(candidates, pair, before)
    seen = forerun.amplitude[:, None] > 0
    over_forerun = np.where(
        seen, DECIBEL * np.log(np.maximum(candidates.amplitudes, 1e-9) / np.maximum(forerun.amplitude[:, None], 1e-9)), 0.0
    )
    megahertz = transducer_hz * 1e-6
    stretches = np.stack([candidates.before_db, candidates.after_db, candidates.before_all_db, candidates.after_all_db])
    levels = np.clip(np.nan_to_num(stretches, nan=0.0), -5, 60)
    strongest = np.where(real, snr, np.float32(-FAR_DB)).max(axis=1, keepdims=True, initial=-FAR_DB)
    clear = np.minimum(snr, CLEAR_DB)
    features = [
        clear / 20, candidates.saliences_db / 10, levels[0] / 10, levels[1] / 10, levels[2] / 10, levels[3] / 10,
        (levels[0] - levels[1]) / 10, (levels[2] - levels[3]) / 10, best_before / 15, far_before / 5,
        best_behind / 15, far_behind / 5, depth / 8, depth * megahertz / 50, multiple, share / 15, over_forerun / 30,
        np.broadcast_to(seen, snr.shape).astype(float), reverberation / 15, candidates.widths_s * transducer_hz,
        (before & (pair > -8)).sum(axis=2) / 3.0, (behind & (pair > -8)).sum(axis=2) / 3.0,
        np.broadcast_to(np.minimum(strongest, CLEAR_DB), snr.shape) / 20, (strongest - snr) / 15,
        frequency * 5, lower[0] * 5, lower[1] * 5, candidates.rise_db / 15, candidates.fall_db / 15,
        candidates.end_db / 15, own / 15,
    ]  # fmt: skip
    stacked = np.zeros((*snr.shape, len(NAMES)), dtype=np.float32)
    for number, feature in enumerate(features):
        stacked[..., number] = feature
    stacked[~valid] = 0
    np.nan_to_num(stacked, copy=False)
    return np.asarray(np.clip(stacked, -4, 4, out=stacked))


def _strongest(pair: Floats, gap: Floats, where: Array) -> tuple[Array, Array, npt.NDArray[np.int64]]:
    """How much stronger (dB) the strongest echo of those `where` is, how far (mm) away it lies, and which it is."""
    masked = np.where(where, pair, np.float32(-FAR_DB))
    which = masked.argmax(axis=2)
    rows, columns = np.arange(len(pair))[:, None], np.arange(pair.shape[1])
    best = masked[rows, columns, which]
    far = np.where(where.any(axis=2), np.minimum(np.abs(gap[rows, columns, which]), FAR_MM), FAR_MM)
    return np.clip(best, -FAR_DB, FAR_DB), far, which


def _multiples(
    candidates: Candidates, forerun: Forerun, nominal_skin_s: float, transducer_hz: float, valid: Array
) -> tuple[Array, Array]:
    """Whether a candidate lies where the forerun's echo repeats, and its strength over the forerun's echo there (dB)."""
    place = np.zeros(valid.shape)
    share = np.zeros(valid.shape)
    if nominal_skin_s <= 0:
        return place, share
    for number in range(2, MULTIPLES + 1):
        late = candidates.delays_s - (number - 1) * forerun.skin_s[:, None]
        off = np.maximum(late, -late - (number - 1) * MULTIPLE_EARLY_CYCLES / transducer_hz) / MULTIPLE_TOLERANCE_S
        off = np.maximum(np.nan_to_num(off, nan=9.0), 0.0)
        place = np.maximum(place, np.where(valid, np.exp(-(off**2)), 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        over = DECIBEL * np.log(candidates.amplitudes / forerun.amplitude[:, None])
    share = np.where(valid & np.isfinite(over), over, 0.0) * place
    return place, share


def _reverberations(candidates: Candidates, pair: Floats, before: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
    """How much stronger (dB) an earlier echo is of which this one would be the first reverberation under the skin, and how
    near in strength the echo comes that would be this one's: bone under a flat skin has one."""
    delays = np.nan_to_num(candidates.delays_s)
    off = np.abs(delays[:, :, None] - 2 * delays[:, None, :])
    hit = before & (off < REVERBERATION_TOLERANCE_S)
    earlier = np.where(hit, np.clip(pair, 0, FAR_DB), 0.0).max(axis=2)
    return earlier, np.where(hit, np.clip(FAR_DB - pair, 0, FAR_DB), 0.0).max(axis=1)
