"""What is in the probe's way: pins and arms of the head clamp, and the reference base fixed to it."""

from __future__ import annotations

from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.parameters import Limits
from CranioNavLib.rigid import Array, check_points

PROBE_LENGTH_MM = 150.0  # what a probe with the hand takes up outside the head
CLEARANCE_MM = 30.0  # between the probe's axis and a pin: half a hand's width
CLEARANCE_LIMITS = Limits(0, 100)  # a whole hand away there would be no place left on a side of the head that has a pin
PIN_CLEARANCE_MM = 10.0  # between the probe's axis and a pin in the skull: the radii of the probe's body, 7 mm, and of the pin
PIN_LENGTH_MM = 20.0  # of a pin over the bone: what is farther out is not in the place itself, and a hand finds a way round it


def clear_of_clamp(
    feet_mm: Array,
    normals: Array,
    clamp_mm: Optional[npt.ArrayLike],
    clearance_mm: float = CLEARANCE_MM,
    length_mm: float = PROBE_LENGTH_MM,
) -> npt.NDArray[np.bool_]:
    """(N,) whether a probe that stands square on the bone keeps its distance from every point of the clamp.

    Parameters
    ----------
    feet_mm, normals : arrays, shape (N, 3)
        Where it stands, and the outward unit normals along which it is held.
    clamp_mm : array-like, shape (K, 3), or None
        Points on the clamp (pins, arms, reference base), in the same frame.
    clearance_mm : float
        Least distance from the probe's axis.
    length_mm : float
        Of that axis.
    """
    if clamp_mm is None:
        return np.ones(len(feet_mm), dtype=bool)
    away = check_points(clamp_mm, "points on the clamp")[None] - feet_mm[:, None]  # (N, K, 3)
    along = np.clip(np.sum(away * normals[:, None], axis=2), 0.0, length_mm)
    gaps = np.linalg.norm(away - along[:, :, None] * normals[:, None], axis=2)
    return np.asarray(gaps.min(axis=1, initial=np.inf) >= clearance_mm)


def stands_beside_pins(
    feet_mm: Array, normals: Array, clamp_mm: Optional[npt.ArrayLike], clearance_mm: float = CLEARANCE_MM
) -> npt.NDArray[np.bool_]:
    """(N,) whether a probe can be put there at all: no point of the clamp is in the very place, however near it may be."""
    return clear_of_clamp(feet_mm, normals, clamp_mm, min(clearance_mm, PIN_CLEARANCE_MM), PIN_LENGTH_MM)
