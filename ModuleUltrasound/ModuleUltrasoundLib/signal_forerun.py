"""The forerun (delay line): its echo found in each line, which is the line's own zero of tissue depth.

Taking the time from the forerun's echo of the same line removes the delay line's temperature drift, trigger jitter
and the pulse's own delay, because both echoes share the pulse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Acquisition

from ModuleUltrasoundLib.echo_candidates import refine_peaks
from ModuleUltrasoundLib.signal_chain import Envelopes

SEARCH = 0.04  # of the nominal time: temperature changes the delay line's speed by 1 to 3 %, and its length is machined
SEARCH_S = 4e-7  # on top: the pulse's own delay
LEAST_SNR = 6.0  # envelope peak over the noise of one quadrature
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


def nominal_skin_s(acquisition: Acquisition) -> float:
    """Two-way time through the forerun as the header states it; 0 without a forerun."""
    if acquisition.forerun_length_mm <= 0:
        return 0.0
    return 2e-3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s


def find_forerun(envelopes: Envelopes, magnitude: npt.NDArray[np.float32], noise: Array, acquisition: Acquisition) -> Forerun:
    """The echo of the forerun's face in each line; where it is too weak, the median of the other lines' times."""
    nominal = nominal_skin_s(acquisition)
    count, length = magnitude.shape
    nothing = Forerun(np.full(count, nominal), np.zeros(count), np.zeros(count, dtype=bool))
    rate = envelopes.rate_hz
    first = max(int((nominal * (1 - SEARCH) - SEARCH_S) * rate), 1)
    last = min(int((nominal * (1 + SEARCH) + SEARCH_S) * rate) + 1, length - 1)
    if nominal == 0.0 or last - first < 3:
        return nothing
    samples = magnitude[:, first:last].argmax(axis=1)[:, None] + first
    positions, heights = (values[:, 0] for values in refine_peaks(magnitude, samples))
    inside = (samples[:, 0] > first) & (samples[:, 0] < last - 1)
    found = inside & (heights > LEAST_SNR * noise)
    if not found.any():
        return nothing
    times = positions / rate
    middle = float(np.median(times[found]))
    found &= np.abs(times - middle) < SEARCH_S
    return Forerun(np.where(found, times, middle), np.where(found, heights, 0.0), found)


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
    window = np.arange(-half, half + 1)
    first = np.rint(forerun.skin_s[lines] * rate).astype(np.int64)
    rows, values = lines[:, None], envelopes.values
    reach = int(SEARCH_S * rate)
    if first.min() < half:
        return
    pulse = values[rows, first[:, None] + window]
    power = (np.abs(pulse) ** 2).sum(axis=1)
    for number in range(2, MULTIPLES + 1):
        # the first echo's centre stands at the nominal time plus the pulse's delay, which the multiple carries once only
        lag = np.rint(forerun.skin_s[lines] * (number - 1) * rate).astype(np.int64)
        if (first + lag).max() + half + 1 >= envelopes.values.shape[1]:
            break
        lag += _best_shift(values, rows, first + lag, pulse, window, reach)
        place = (first + lag)[:, None] + window
        turn = np.exp(-2j * np.pi * carrier * lag / rate)  # the carrier's phase between the two places
        strength = (values[rows, place] * pulse.conj()).sum(axis=1) / power / turn
        typical = complex(np.median(strength.real), np.median(strength.imag))
        coherence = np.abs(np.mean(strength / (np.abs(strength) + 1e-12)))
        if coherence < LEAST_COHERENCE or abs(typical) > 1:
            continue
        cleaned = values[rows, place] - (typical * turn).astype(np.complex64)[:, None] * pulse
        values[rows, place] = cleaned
        magnitude[rows, place] = np.abs(cleaned)


def _best_shift(
    values: npt.NDArray[np.complex64],
    rows: npt.NDArray[np.int64],
    starts: npt.NDArray[np.int64],
    pulse: npt.NDArray[np.complex64],
    window: npt.NDArray[np.int64],
    reach: int,
) -> int:
    """The shift (samples, at most 0) common to all lines at which the pulse fits best; it takes up the pulse's delay."""
    shifts = range(-reach, 1)
    some = slice(None, None, max(len(starts) // 32, 1))  # the shift is the pulse's: a few lines tell it
    wide = np.arange(window[0] - reach, window[-1] + 1)
    there = values[rows[some], np.clip(starts[some, None] + wide, 0, values.shape[1] - 1)]
    size = len(window)
    scores = [np.abs((there[:, reach + s : reach + s + size] * pulse[some].conj()).sum(axis=1)).mean() for s in shifts]
    return int(shifts[int(np.argmax(scores))])
