"""One point from a tip that rests on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, check_points

FEWEST_SAMPLES = 5
LARGEST_SPREAD_MM = 1.0  # a resting tip scatters by the tracker's 0.25 mm; more means that it slid


@dataclass(frozen=True, eq=False)
class RestingTip:
    """Where a tip rested."""

    position_mm: Array  # (3,)
    spread_mm: float  # RMS distance of the samples from their median: the hand and the tracker, not the tip's error
    samples: int


def rest_of_tip(positions_mm: npt.ArrayLike, largest_spread_mm: float = LARGEST_SPREAD_MM) -> RestingTip:
    """The median of tip positions (N, 3) taken while the tip was held still.

    Raises
    ------
    InputError
        Fewer than 5 samples, or they scatter by more than `largest_spread_mm`: the tip moved.
    """
    positions = check_points(positions_mm, "tip positions", at_least=FEWEST_SAMPLES)
    middle: Array = np.median(positions, axis=0)
    spread = float(np.sqrt(np.mean(np.sum((positions - middle) ** 2, axis=1))))
    if spread > largest_spread_mm:
        raise InputError(f"the tip moved by {spread:.1f} mm (RMS) while it was read; hold it still and read the point again")
    return RestingTip(middle, spread, len(positions))
