"""Sub-sample time of flight of the chosen echoes, by a matched filter on envelope and phase, with its deviation.

The pulse is learnt from the recording itself. Each echo is then fitted with it, `y(u) = a w(u - tau)`: the envelope gives
`tau` without ambiguity, the phase of `a` gives it more finely but only up to whole cycles, and what the fit leaves over
gives the deviation of both (Walker and Trahey, IEEE Trans UFFC 42:301, 1995, for the bound that this attains).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

from ModuleUltrasoundLib.echo.lean import clip

Complexes = npt.NDArray[np.complex64]

BEFORE, BEHIND = 10, 16  # samples of an echo's window before and behind its peak (4 a cycle of the transducer)
CORE = 5  # samples on each side of the peak that are fitted: what follows or comes before may be another interface
MARGIN = 4  # samples beyond the core that the interpolation reaches
BLOCK = 512  # lines fitted at once: they stay in the processor's cache, and their matrix products on one thread
LEAST_LINES = 5  # echoes from which a pulse is learnt; below, a Gaussian of the typical width stands in
SURE = 0.9  # probability of an echo that may teach the pulse
STEADY = 0.8  # mean resultant length of the phases from which on the phase is trusted
SAFE_CYCLES = 0.17  # the envelope must be surer than this, so that the phase's whole cycles are known
TYPICAL_BANDWIDTH = 0.6


@dataclass(frozen=True, eq=False)
class Pulse:
    """The complex envelope of an echo of this recording, its peak at sample BEFORE, of height 1 and phase 0."""

    values: Array  # complex (BEFORE + 1 + BEHIND,)
    rate_hz: float
    lines: int  # echoes it was learnt from; 0: assumed
    phase: float  # common phase of the bone echoes, rad (see `relative phases` of fit_echoes)
    phase_sd: float  # their spread; infinite when they do not agree


@dataclass(frozen=True, eq=False)
class Timing:
    """Correction of each echo's time, and its deviation. Not a number where there is no echo."""

    shift_s: Array  # (n,) to be added to the time of the envelope's peak
    sd_s: Array  # (n,) from what the fit leaves over
    misfit: Array  # (n,) residual energy over the echo's energy: 0 for a clean copy of the pulse


def shift_windows(windows: Complexes, offset: Array) -> Complexes:
    """Windows (n, W) moved earlier by `offset` (n,) samples, |offset| < 2, by cubic interpolation; the ends repeat."""
    return shift_columns(np.ascontiguousarray(windows.T), offset).T


def shift_columns(windows: Complexes, offset: Array) -> Complexes:
    """As shift_windows for windows (W, n): with many of them numpy's inner loops are longer so."""
    whole = np.floor(offset)
    part = (offset - whole).astype(np.float32)
    length, count = windows.shape
    index = clip(whole.astype(np.int64) + np.arange(-1, length + 2)[:, None], 0, length - 1)
    near = windows.reshape(-1).take(index * count + np.arange(count))
    a, b, c, d = near[:-3], near[1:-2], near[2:-1], near[3:]
    moved = (0.5 * part) * ((c - a) + part * ((2 * a - 5 * b + 4 * c - d) + part * (3 * (b - c) + d - a)))
    moved += b
    return np.asarray(moved, dtype=np.complex64)


def learn_pulse(windows: Complexes, offset: Array, chance: Array, rate_hz: float, transducer_hz: float) -> Pulse:
    """The pulse common to the sure echoes: their median after alignment in time, height and phase."""
    sure: npt.NDArray[np.int64] = np.asarray(np.flatnonzero(chance > SURE), dtype=np.int64)
    if len(sure) < LEAST_LINES:
        u = np.arange(-BEFORE, BEHIND + 1) / rate_hz
        sigma = np.sqrt(2 * np.log(2)) / (np.pi * TYPICAL_BANDWIDTH * transducer_hz)
        return Pulse(np.exp(-0.25 * (u / sigma) ** 2).astype(complex), rate_hz, 0, 0.0, np.inf)
    some = sure[:: max(len(sure) // 512, 1)]
    aligned = shift_windows(windows[some], offset[some])
    aligned = aligned / aligned[:, BEFORE : BEFORE + 1]
    ordered = np.sort(np.concatenate([aligned.real.T, aligned.imag.T]), axis=1)  # sort is faster than median on short rows
    middle = (ordered[:, (len(some) - 1) // 2] + ordered[:, len(some) // 2]) / 2
    return Pulse(middle[: aligned.shape[1]] + 1j * middle[aligned.shape[1] :], rate_hz, len(sure), 0.0, np.inf)


def fit_echoes(windows: Complexes, offset: Array, pulse: Pulse) -> tuple[Array, Array, Array, Array, Array]:
    """Least-squares fit of the pulse to each echo.

    Returns the remaining shift of the envelope (samples), its deviation (samples), the phase at the shifted peak (rad), its
    deviation (rad), and the misfit; each of shape (n,).
    """
    w = pulse.values[BEFORE - CORE : BEFORE + CORE + 1].astype(np.complex64)
    slope = (pulse.values[BEFORE - CORE + 1 : BEFORE + CORE + 2] - pulse.values[BEFORE - CORE - 1 : BEFORE + CORE]) / 2
    slope = slope.astype(np.complex64)
    windows = np.ascontiguousarray(windows[:, BEFORE - CORE - MARGIN : BEFORE + CORE + 1 + MARGIN].T)
    core = slice(MARGIN, MARGIN + 2 * CORE + 1)
    shift: Array = np.zeros(windows.shape[1])
    own, mixed, other = complex(np.vdot(w, w)), complex(np.vdot(w, slope)), complex(np.vdot(slope, slope))
    inverse = np.array([[other, -mixed], [-mixed.conjugate(), own]]) / (own * other - abs(mixed) ** 2)
    both = np.stack([w.conj(), slope.conj()])
    # einsum stays on this thread; a matrix product of complex numbers would be spread over several, however small it is
    for _ in range(2):
        y = shift_columns(windows, clip(offset + shift, -1.5, 1.5))[core]
        amplitude, along = np.einsum("ji,in->jn", inverse @ both, y)
        amplitude[amplitude == 0] = 1
        shift = clip(shift + clip(-(along / amplitude).real, -0.5, 0.5), -1.0, 1.0)
    y = shift_columns(windows, clip(offset + shift, -1.5, 1.5))[core]
    amplitude = np.einsum("i,in->n", both[0], y) / own.real
    rest = (np.abs(y - amplitude * w[:, None]) ** 2).sum(axis=0)
    # neighbouring samples of the band-passed noise are alike: about half of them count (4 samples a cycle, 2 independent)
    quadrature = rest / (2 * max(CORE - 1, 1))
    power = np.maximum(np.abs(amplitude) ** 2, 1e-12)
    correlated = 2.0
    shift_sd = np.sqrt(correlated * quadrature / power * inverse[1, 1].real)
    phase_sd = np.sqrt(correlated * quadrature / power / np.vdot(w, w).real)
    misfit = rest / np.maximum((np.abs(y) ** 2).sum(axis=0), 1e-12)
    phase = np.asarray(np.angle(amplitude), dtype=np.float64)
    return np.asarray(shift), shift_sd, phase, phase_sd, misfit


def common_phase(phases: Array, chance: Array) -> tuple[float, float]:
    """Mean phase of the sure echoes and its spread (rad); the spread is infinite when they do not agree."""
    sure = chance > SURE
    if sure.sum() < LEAST_LINES:
        return 0.0, np.inf
    mean = np.exp(1j * phases[sure]).mean()
    length = float(np.abs(mean))
    return float(np.angle(mean)), float(np.sqrt(-2 * np.log(length))) if length > STEADY else np.inf


def time_echoes(
    windows: Complexes, peaks_s: Array, references: Array, chance: Array, rate_hz: float, carrier_hz: float, transducer_hz: float
) -> tuple[Timing, Pulse]:
    """Time correction of each line's echo, whose window (n, W) starts BEFORE samples before the sample nearest to its peak.

    `peaks_s` is the time of the envelope's peak, `references` (n,) the phase of the line's forerun echo (0: none).
    """
    good = np.isfinite(peaks_s)
    times = np.where(good, peaks_s, 0.0)
    offset = times * rate_hz - np.rint(times * rate_hz)
    pulse = learn_pulse(windows, offset, np.where(good, chance, 0.0), rate_hz, transducer_hz)
    pieces = [slice(start, start + BLOCK) for start in range(0, max(len(windows), 1), BLOCK)]
    shift, sd, phase, phase_sd, misfit = np.concatenate([fit_echoes(windows[k], offset[k], pulse) for k in pieces], axis=1)
    absolute = phase + 2 * np.pi * carrier_hz * (times + shift / rate_hz) - references
    middle, spread = common_phase(absolute, np.where(good, chance, 0.0))
    per_cycle = rate_hz / carrier_hz  # samples a cycle
    if np.isfinite(spread):
        # a time too late by tau shows a phase too large by 2 pi f tau
        fine = -np.angle(np.exp(1j * (absolute - middle))) / (2 * np.pi) * per_cycle
        fine_sd = np.hypot(phase_sd, spread) / (2 * np.pi) * per_cycle
        share = np.where(sd < SAFE_CYCLES * per_cycle, sd**2 / (sd**2 + fine_sd**2), 0.0)
        shift = shift + share * fine
        sd = np.where(share > 0, np.sqrt(sd**2 * fine_sd**2 / (sd**2 + fine_sd**2)), sd)
    timing = Timing(np.where(good, shift / rate_hz, np.nan), np.where(good, sd / rate_hz, np.nan), np.where(good, misfit, np.nan))
    return timing, Pulse(pulse.values, rate_hz, pulse.lines, middle, spread)
