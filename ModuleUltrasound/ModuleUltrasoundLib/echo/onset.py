"""The pulse's own delay: from the time an echo arrives to the peak of its envelope.

With a forerun echo in the line the question does not arise: both echoes share the pulse, and their distance is free of it.
Without one, depth counts from the transmit pulse, and a peak picked on a pulse that rises at the arrival is late by half a
cycle to two cycles (0.1 to 0.4 mm). A main bang that shows the very pulse of the echoes tells how much. Else the shape of the
pulse does, in part: a damped oscillation rises faster than it decays, and has its origin near its onset. Many a pulse looks
symmetric that is not: each stage of transducer, receiver and tissue rounds it. It may count from its middle, as in many
simulators, or from the firing, as a device does that knows nothing of its transducer's delay: half of that delay is taken
then, so that either way at most half is left wrong. What is wrong in it is common to all points of the recording (an offset
of depth that registration can estimate), so it is not part of their covariances.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

from ModuleUltrasoundLib.echo.signal_chain import BAND_WIDTH
from ModuleUltrasoundLib.echo.timing import BEFORE, BEHIND, LEAST_LINES, Pulse

SMEAR_CYCLES = 2.3548 / (2 * np.pi * BAND_WIDTH)  # standard deviation in time of the band-pass
GAMMA_SHAPES = (1.0, 1.5, 2.0, 3.0, 4.0)  # of t^(k-1) exp(-t/theta): abrupt onset to slow build-up
GAMMA_SCALES = tuple(np.geomspace(0.1, 2.5, 18))  # theta, cycles
WIDTHS = tuple(np.geomspace(0.4, 2.5, 30))  # standard deviation of a symmetric pulse, cycles
# Nothing in a recording tells whether its zero is the firing or the peak of what was fired. Two thirds of a damped pulse's delay:
# of at most 0.4 mm a third is left wrong if it is the firing, two thirds if it is the peak
COUNTED = 2 / 3
COUNTED_IF_SYMMETRIC = 1 / 2  # nor whether such a pulse is late at all
RISE, LONGEST_RISE = 3**0.5, 1.6  # peak of t^3 exp(-t/theta) behind its onset, in standard deviations about the peak; cycles
CLEAR = 0.45  # residual of the causal shape over that of the symmetric one: below, the pulse is causal
UNDECIDED = 0.8  # above, symmetric; between them the delay fades
GOOD_FIT = 0.06  # largest RMS residual of a shape that explains the pulse
RISEN = 0.35  # of the bang's height: its first sample must lie below, or its rise was before time zero
BANG_FIT = 0.08  # largest RMS difference of bang and echo, of their heights
BANG_CYCLES = (0.5, 3.5)  # where the bang's peak may lie


@lru_cache(maxsize=8)
def _shapes(step_cycles: float) -> tuple[Array, Array, Array]:
    """Causal shapes (S, W), their peaks' delays (S,) in cycles, and symmetric shapes (T, W); sampled as a Pulse."""
    fine = 1 / 32
    t = np.arange(-8, 24, fine)
    kernel = np.exp(-0.5 * (np.arange(-4 * SMEAR_CYCLES, 4 * SMEAR_CYCLES + fine / 2, fine) / SMEAR_CYCLES) ** 2)
    u = np.arange(-BEFORE, BEHIND + 1) * step_cycles
    causal, delays = [], []
    for shape in GAMMA_SHAPES:
        for scale in GAMMA_SCALES:
            rise = np.where(t > 0, np.clip(t, 1e-9, None) ** (shape - 1) * np.exp(-t / scale), 0.0)
            smooth = np.convolve(rise, kernel, mode="same")
            peak = int(smooth.argmax())
            causal.append(np.interp(u, t - t[peak], smooth / smooth[peak]))
            delays.append(t[peak])
    symmetric = [np.exp(-0.5 * (u / width) ** 2) for width in WIDTHS]
    return np.array(causal), np.array(delays), np.array(symmetric)


def delay_from_shape(pulse: Pulse, transducer_hz: float) -> float:
    """What is counted of the delay (s) of the peak behind the onset, by the shape of the pulse; 0 while it is not known."""
    if pulse.lines < LEAST_LINES:
        return 0.0
    magnitude = np.abs(pulse.values)
    magnitude = magnitude / magnitude[BEFORE]
    weight = np.clip(magnitude / 0.15, 0.1, 1.0)  # the feet hold other echoes and noise
    causal, delays, symmetric = _shapes(round(transducer_hz / pulse.rate_hz, 6))
    rms = [np.sqrt((weight * (shapes - magnitude) ** 2).sum(axis=1) / weight.sum()) for shapes in (causal, symmetric)]
    best = int(rms[0].argmin())
    ratio = rms[0][best] / max(float(rms[1].min()), 1e-6)
    share = float(np.clip((UNDECIDED - ratio) / (UNDECIDED - CLEAR), 0, 1)) if rms[0][best] < GOOD_FIT else 0.0
    near = rms[0] < 1.3 * rms[0][best] + 0.003  # shapes that explain it about as well: their mean delay
    damped = COUNTED * max(float(delays[near].mean()), 0.0)
    symmetric = COUNTED_IF_SYMMETRIC * min(RISE * WIDTHS[int(rms[1].argmin())], LONGEST_RISE)
    return float((share * damped + (1 - share) * symmetric) / transducer_hz)


def delay_from_bang(bang: npt.NDArray[np.complex128], pulse: Pulse, transducer_hz: float) -> float:
    """Time (s) of the main bang's peak if the bang shows the whole pulse of the echoes, else NaN.

    `bang` is the mean complex envelope of the lines' first samples, from time zero.
    """
    magnitude, shape = np.abs(bang), np.abs(pulse.values)
    cycle = pulse.rate_hz / transducer_hz
    first, last = int(np.ceil(BANG_CYCLES[0] * cycle)), min(int(BANG_CYCLES[1] * cycle), len(magnitude) - BEFORE)
    if pulse.lines < LEAST_LINES or last <= first:
        return float("nan")
    peak = int(magnitude[: last + 2].argmax())
    if not first <= peak <= last or magnitude[0] > RISEN * magnitude[peak]:
        return float("nan")
    left, right = min(peak, BEFORE), min(BEFORE, BEHIND)
    there = magnitude[peak - left : peak + right + 1] / magnitude[peak]
    here = shape[BEFORE - left : BEFORE + right + 1] / shape[BEFORE]
    here = here[: len(there)]
    if np.sqrt(np.mean((there - here) ** 2)) > BANG_FIT:
        return float("nan")
    a, b, c = (float(np.log(magnitude[peak + k] + 1e-9)) for k in (-1, 0, 1))
    return (peak + 0.5 * (a - c) / min(a - 2 * b + c, -1e-9)) / pulse.rate_hz


def pulse_delay(bang: npt.NDArray[np.complex128], pulse: Pulse, transducer_hz: float) -> float:
    """Delay (s) of an echo's peak behind its arrival, for lines without a forerun echo."""
    seen = delay_from_bang(bang, pulse, transducer_hz)
    return seen if np.isfinite(seen) else delay_from_shape(pulse, transducer_hz)
