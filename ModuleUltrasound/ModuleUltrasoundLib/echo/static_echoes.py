"""Echoes of the probe itself: what stands at the same time, with the same phase, wherever on the head the probe is.

A side wall of the delay line, the end of the damping, the receiver's own ringing: each repeats to a hundredth of a millimetre
from place to place, and bone does not. Whether an echo also lies at about the same depth elsewhere says little, because a scalp
is about as thick everywhere; whether it lies there in phase says much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.rigid import Array

from ModuleUltrasoundLib.echo.lean import at_samples, clip
from ModuleUltrasoundLib.echo.signal_chain import Envelopes

Complexes = npt.NDArray[np.complex64]

LEAST_PLACES = 3
MOST_PLACES, MOST_LINES = 12, 4  # looked at, and of each place
WINDOW_CYCLES = 2.0  # of the transducer's frequency: about a pulse
ALIKE = 0.3  # energy of what a place differs by, over the pattern's own: below, the place shows the pattern
HALF = 0.5  # of an echo is the pattern: it is one of the probe's
STILL_S = 1e-8  # a delay line that moves less needs no alignment


@dataclass(frozen=True, eq=False)
class Pattern:
    """What all places have in common."""

    values: Complexes  # (M,) complex envelope
    shown: Array  # (M,) share of the places that show it
    late: npt.NDArray[np.int64]  # (n,) samples by which each line's copy comes later
    turn: Complexes  # (n,) by which its phase is turned


def common_pattern(envelopes: Envelopes, places: npt.NDArray[np.int64], late_s: Array, transducer_hz: float) -> Pattern | None:
    """The pattern common to the lines of several `places` (n,), consecutive ones numbered alike; None with too few places.

    `late_s` (n,) is by how much each line's copy comes later than in the others.
    """
    starts = np.flatnonzero(np.concatenate([[True], places[1:] != places[:-1]]))
    if len(starts) < LEAST_PLACES:
        return None
    late = np.rint(late_s * envelopes.rate_hz).astype(np.int64)
    turn = np.exp(-2j * np.pi * envelopes.carrier_hz * late_s).astype(np.complex64)
    if np.ptp(late_s) <= STILL_S:
        late, turn = np.zeros_like(late), np.ones_like(turn)
    means = np.stack([_mean(envelopes.values, rows, late, turn) for rows in _some_lines(starts, len(places))])
    typical = np.median(means.real, axis=0) + 1j * np.median(means.imag, axis=0)
    width = max(int(WINDOW_CYCLES * envelopes.rate_hz / transducer_hz), 1)
    own = scipy.ndimage.uniform_filter1d(np.abs(typical) ** 2, width, mode="nearest")
    off = scipy.ndimage.uniform_filter1d(np.abs(means - typical) ** 2, width, axis=1, mode="nearest")
    return Pattern(typical.astype(np.complex64), (off < ALIKE * own).mean(axis=0), late, turn)


def _some_lines(starts: npt.NDArray[np.int64], count: int) -> list[npt.NDArray[np.int64]]:
    """A few lines of each of a few of the places that begin at `starts`: more of them tell little more."""
    stops = np.append(starts[1:], count)
    chosen = np.unique(np.linspace(0, len(starts) - 1, MOST_PLACES).astype(np.int64))
    return [np.unique(np.linspace(starts[k], stops[k] - 1, MOST_LINES).astype(np.int64)) for k in chosen]


def _mean(values: Complexes, rows: npt.NDArray[np.int64], late: npt.NDArray[np.int64], turn: Complexes) -> Complexes:
    """Mean (M,) of some lines, each moved earlier by its own `late`."""
    if not late[rows].any():
        return np.asarray((values[rows] / turn[rows, None]).mean(axis=0))
    index = clip(np.arange(values.shape[1]) + late[rows, None], 0, values.shape[1] - 1)
    return np.asarray((values[rows[:, None], index] / turn[rows, None]).mean(axis=0))


def believed(likeness: Array, amplitudes: Array) -> Array:
    """Likenesses (n, K) as far as they are those of artefacts and not of a scalp that is as thick everywhere.

    An artefact is weaker than what the head sends back: it counts by the share of the lines in which another echo is stronger.
    """
    static = np.where(likeness > HALF, amplitudes, 0.0).max(axis=1, initial=0.0)
    other = np.where(likeness > HALF, 0.0, np.nan_to_num(amplitudes)).max(axis=1, initial=0.0)
    there = static > 0
    share = float((other > static)[there].mean()) if there.any() else 0.0
    return np.where(likeness > HALF, share * likeness, 0.0)


def likeness(envelopes: Envelopes, pattern: Pattern, samples: npt.NDArray[np.int64]) -> Array:
    """How far each echo at `samples` (n, K), negative where there is none, is the pattern: 0 not at all, 1 wholly."""
    number = clip(samples.T, 0, envelopes.values.shape[1] - 1)
    here = at_samples(envelopes.values, number)
    at = clip(number - pattern.late, 0, len(pattern.values) - 1)
    there = pattern.values[at] * pattern.turn
    share = (here * there.conj()).real / np.maximum(np.maximum(np.abs(here), np.abs(there)) ** 2, 1e-12)
    return np.where(samples < 0, 0.0, (clip(share, 0.0, 1.0) * pattern.shown[at]).T)
