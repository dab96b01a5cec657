"""The forerun (delay line): its echo found in each line, which is the line's own zero of tissue depth.

Taking the time from the forerun's echo of the same line removes the delay line's temperature drift, trigger jitter
and the pulse's own delay, because both echoes share the pulse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Acquisition

from ModuleUltrasoundLib.echo.candidates import fit_tops
from ModuleUltrasoundLib.echo.lean import at_samples, clip, median
from ModuleUltrasoundLib.echo.signal_chain import Envelopes
from ModuleUltrasoundLib.echo.timing import shift_columns

SEARCH = 0.04  # of the nominal time: temperature changes the delay line's speed by 1 to 3 %, and its length is machined
SEARCH_S = 4e-7  # on top: the pulse's own delay
LIKELY = 0.015  # SD of the same: a delay line warmed by 10 degrees; a film or layer behind the face may echo more than it
LEAST_SNR = 6.0  # envelope peak over the noise of one quadrature
SAME_S = 1e-7  # lines of one recording show the face this near to each other
LEAST_SHARE = 0.4  # of a batch's lines must show it
CLEAR, LEAST_CLEAR = 10.0, 3  # or so many show it this far over what is behind: in air, where all sound comes back from the face
LEAST_AGREEING = 0.8  # of those that show it so clearly
DRIFT = 0.02  # of the nominal time: how far a delay line moves within a recording
CONTRAST = 6.0  # of the echo over the mean level behind it; speckle seldom reaches 4
CONTRAST_EXPECTED = 3.0  # the same where the header says that the echo should be
BEHIND_S = 3e-6
NEIGHBOURS = 15  # lines on each side over which the delay line's temperature is taken as constant: under a second
MEDIAN_TO_SD = 1.4826
MULTIPLES = 4
PULSE_CYCLES = 3.0  # half length of the pulse that is subtracted at a multiple
LEAST_LINES = 6  # lines of a batch from which the strength of a multiple can be learnt
LEAST_COHERENCE = 0.6  # of its strength over the lines: the multiple repeats in phase, tissue does not


@dataclass(frozen=True, eq=False)
class Forerun:
    """Where the tissue starts in each line."""

    skin_s: Array  # (n,) time of the skin: the centre of the forerun's echo, or the nominal time
    amplitude: Array  # (n,) envelope of the forerun's echo; 0 where none was found
    found: npt.NDArray[np.bool_]  # (n,) the echo was seen in this line
    measured: npt.NDArray[np.bool_]  # (n,) the time comes from this line's echo or its neighbours', not from the header
    sd_s: Array  # (n,) of the skin's time, as far as noise makes it uncertain
    jump_s: Array  # (n,) by which the whole line comes late, where a clear face stands elsewhere than in the other lines; else 0
    face: Array  # (n,) highest envelope where the face should be, of whatever it is an echo; 0 without a forerun


def nominal_skin_s(acquisition: Acquisition) -> float:
    """Two-way time through the forerun as the header states it; 0 without a forerun."""
    if acquisition.forerun_length_mm <= 0:
        return 0.0
    return 2e-3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s


def find_forerun(envelopes: Envelopes, magnitude: npt.NDArray[np.float32], noise: Array, acquisition: Acquisition) -> Forerun:
    """The echo of the forerun's face in each line.

    An echo is believed if it stands out of what follows (tissue begins there, and its speckle must not be taken for the face)
    and lies where the other lines of the batch show it. Lines in which it is too weak get the others' median; if most lines
    lack it, a few that show it very clearly (in air) will do; without them all get the nominal time.
    """
    nominal = nominal_skin_s(acquisition)
    count, length = magnitude.shape
    false = np.zeros(count, dtype=bool)
    none = np.zeros(count)
    nothing = Forerun(np.full(count, nominal), none, false, false, none, none, none)
    rate = envelopes.rate_hz
    first = max(int((nominal * (1 - SEARCH) - SEARCH_S / 2) * rate), 1)
    last = min(int((nominal * (1 + SEARCH) + SEARCH_S) * rate) + 1, length - 1)
    if nominal == 0.0 or last - first < 3:
        return nothing
    off = np.arange(first, last) / rate - nominal
    off = np.maximum(np.maximum(-off, off - 1.5 / acquisition.transducer_hz), 0.0)  # the pulse's own delay is no error
    prior = np.exp(-0.5 * (off / (LIKELY * nominal)) ** 2).astype(np.float32)
    window = magnitude[:, first:last]
    peak = (window >= magnitude[:, first - 1 : last - 1]) & (window >= magnitude[:, first + 1 : last + 1])
    samples = (peak * window * prior).argmax(axis=1)[:, None] + first
    positions, heights, widths = (values[:, 0] for values in fit_tops(magnitude, samples))
    guard = int(PULSE_CYCLES / acquisition.transducer_hz * rate)
    index = np.minimum(samples[:, 0] + (guard + np.arange(0, int(BEHIND_S * rate), 2))[:, None], length - 1)
    behind = np.exp(np.log(at_samples(magnitude, index) + 1e-3).mean(axis=0))
    nothing = replace(nothing, face=heights)
    times = positions / rate
    expected = (times > nominal - 0.3 / acquisition.transducer_hz) & (times < nominal + 1.5 / acquisition.transducer_hz)
    inside = (samples[:, 0] > first) & (samples[:, 0] < last - 1)
    found = inside & (heights > LEAST_SNR * noise) & (heights > np.where(expected, CONTRAST_EXPECTED, CONTRAST) * behind)
    if not found.any():
        return nothing
    seen, clear = found, found & (heights > CLEAR * behind)
    found = found & (np.abs(times - median(times[found])) < SAME_S)
    if found.sum() < LEAST_SHARE * count:
        found = _agreeing(times, clear, nominal)
    if not found.any():
        return nothing
    middle = median(times[found])
    sd = np.where(found, widths / rate * noise / np.maximum(heights, 1e-9), SAME_S / 2)
    jump = np.where(seen & ~found, times - middle, 0.0)
    return Forerun(np.where(found, times, middle), np.where(found, heights, 0.0), found, ~false, sd, jump, heights)


def _agreeing(times: Array, clear: npt.NDArray[np.bool_], nominal_s: float) -> npt.NDArray[np.bool_]:
    """The `clear` lines (n,) if they show one face, whose time (s) at most drifts; none if they are few or differ."""
    seen = np.flatnonzero(clear)
    if len(seen) < LEAST_CLEAR:
        return np.zeros_like(clear)
    typical = scipy.ndimage.median_filter(times[seen], size=2 * LEAST_CLEAR - 1, mode="nearest")
    near = np.abs(times[seen] - typical) < SAME_S
    agreeing = np.zeros_like(clear)
    if near.sum() < max(LEAST_CLEAR, LEAST_AGREEING * len(seen)) or np.ptp(typical) > SAME_S + DRIFT * nominal_s:
        return agreeing
    if np.abs(np.diff(typical)).max() < SAME_S:
        agreeing[seen[near]] = True
    return agreeing


def steady(forerun: Forerun) -> Forerun:
    """The skin's times freed of the echo's noise, over a whole recording.

    The delay line warms slowly, so neighbouring lines share its time; what jitters beyond the echo's noise (the trigger) is
    the line's own and is kept. Each time is drawn to its neighbours' mean by the share that noise has in the scatter.
    """
    seen = np.flatnonzero(forerun.found)
    if not len(seen):
        return forerun
    missing = np.flatnonzero(forerun.measured & ~forerun.found)
    times_s, sd_s = forerun.skin_s.copy(), forerun.sd_s.copy()
    if len(seen) >= LEAST_LINES:
        times_s[seen], sd_s[seen] = _freed_of_noise(forerun.skin_s[seen], forerun.sd_s[seen] ** 2)
    times_s[missing] = np.interp(missing, seen, times_s[seen])
    return replace(forerun, skin_s=times_s, sd_s=sd_s)


def _freed_of_noise(times: Array, variance: Array) -> tuple[Array, Array]:
    """Times (m,) drawn to their neighbours' means, and their standard deviations."""
    weight = 1 / variance
    mean = _running(weight * times, NEIGHBOURS) / _running(weight, NEIGHBOURS)
    noise = median(variance)
    scatter = (MEDIAN_TO_SD * median(np.abs(times - mean))) ** 2
    own = max(scatter - noise, 0.0) / max(scatter, noise)  # share of the scatter that is not noise
    drawn = mean + own * (times - mean)
    rest = own**2 * variance + (1 - own) ** 2 / _running(weight, NEIGHBOURS)
    return np.asarray(drawn), np.asarray(np.sqrt(rest))


def _running(values: Array, reach: int) -> Array:
    """Sums over `reach` values on each side, fewer at the ends."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    return np.asarray(sums[np.minimum(index + reach + 1, len(values))] - sums[np.maximum(index - reach, 0)])


def suppress_multiples(
    envelopes: Envelopes, magnitude: npt.NDArray[np.float32], forerun: Forerun, acquisition: Acquisition
) -> None:
    """Take the forerun's reverberations out of `envelopes` and `magnitude` (in place), where these can be predicted.

    Multiple number m lies at m times the first echo's time and has its shape. Its complex strength relative to the first
    echo is the median over the batch's lines; it is subtracted only if the lines agree on it in phase, so that an echo of
    tissue that happens to lie there in one line stays. Only for lines from several places on the head.
    """
    rate, carrier = envelopes.rate_hz, envelopes.carrier_hz
    half = int(PULSE_CYCLES / acquisition.transducer_hz * rate)
    lines = np.flatnonzero(forerun.found)
    if len(lines) < LEAST_LINES:
        return
    window = np.arange(-half, half + 1)[:, None]  # the lines are the last axis: numpy's inner loops are longer so
    first = np.rint(forerun.skin_s[lines] * rate).astype(np.int64)
    reach = int(SEARCH_S * rate)
    if first.min() < half:
        return
    size = envelopes.values.shape[1]
    rows = lines * size
    pulse = envelopes.values.take(rows + first + window)
    # free of trigger jitter
    late = rate * _running(forerun.skin_s[lines], NEIGHBOURS) / _running(np.ones(len(lines)), NEIGHBOURS)
    for number in range(2, MULTIPLES + 1):
        # the first echo's centre stands at the nominal time plus the pulse's delay, which the multiple carries once only
        lag = np.rint(late * (number - 1)).astype(np.int64)
        rounded = late * (number - 1) - lag
        if (first + lag).max() + half + 1 >= size:
            break
        lag += _best_shift(envelopes.values, lines, first + lag, pulse, reach)
        place = rows + first + lag + window
        turn = np.exp(-2j * np.pi * carrier * (lag + rounded) / rate).astype(np.complex64)  # of the carrier's phase
        there = envelopes.values.take(place) / turn
        moved = shift_columns(pulse, -_offset(there, pulse, rounded))
        strength = _share(there, moved)
        typical = complex(median(strength.real), median(strength.imag))
        coherence = np.abs(np.mean(strength / (np.abs(strength) + 1e-12)))
        if coherence < LEAST_COHERENCE or abs(typical) > 1:
            continue
        cleaned = (there - np.complex64(typical) * moved) * turn
        np.put(envelopes.values, place, cleaned)
        np.put(magnitude, place, np.abs(cleaned))


def _share(there: npt.NDArray[np.complex64], pulse: npt.NDArray[np.complex64]) -> npt.NDArray[np.complex64]:
    """How much of each `pulse` (W, n) there is in each window (W, n), shape (n,)."""
    return np.asarray((there * pulse.conj()).sum(axis=0) / (np.abs(pulse) ** 2).sum(axis=0))


def _offset(there: npt.NDArray[np.complex64], pulse: npt.NDArray[np.complex64], rounded: Array) -> Array:
    """How many samples (n,) the pulse (W, n) stands behind the middle of each line's window, less than one: what is common to
    all lines (the pulse's own delay) and what each line's place was `rounded` by."""
    slope = np.gradient(pulse, axis=0)
    each = _share(there, pulse)
    typical = complex(median(each.real), median(each.imag)) or 1.0
    rest = there / np.complex64(typical) - pulse
    steps = -(slope.conj() * rest).sum(axis=0).real / np.maximum((np.abs(slope) ** 2).sum(axis=0), 1e-12)
    return clip(median(steps - rounded) + rounded, -1.0, 1.0)


def _best_shift(
    values: npt.NDArray[np.complex64],
    lines: npt.NDArray[np.int64],
    starts: npt.NDArray[np.int64],
    pulse: npt.NDArray[np.complex64],
    reach: int,
) -> int:
    """The shift (samples, at most 0) common to all lines at which the pulse (W, n) fits best; it takes up the pulse's delay."""
    shifts = range(-reach, 1)
    some = slice(None, None, max(len(starts) // 32, 1))  # the shift is the pulse's: a few lines tell it
    size = len(pulse)
    wide = np.arange(-(size // 2) - reach, size // 2 + 1)[:, None]
    there = values[lines[some], np.minimum(np.maximum(starts[some] + wide, 0), values.shape[1] - 1)]
    few = pulse[:, some].conj()
    scores = [np.abs((there[reach + s : reach + s + size] * few).sum(axis=0)).mean() for s in shifts]
    return int(shifts[int(np.argmax(scores))])
