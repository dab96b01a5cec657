"""Whether the reference base still sits on its clamp, told while tracking: on demand, or when the stylus rests in its divot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array

from ModuleTrackingLib.reference_base import (
    FEWEST_SAMPLES,
    CheckPoint,
    CheckResult,
    check_reference_base,
    store_check_point,
)

NEAR_MM = 5.0  # a stylus that rests so near to the check point is taken to be in the divot
RESTING_MM = 0.5  # RMS scatter of a tip in a divot: the tracker's 0.25 mm, with room for a hand
FILE = "reference-check-point.json"


class BaseWatch:
    """Keeps the check point, and what touching it again told.

    Parameters
    ----------
    folder : str
        Where the check point is saved and found again; "": nowhere.
    """

    def __init__(self, folder: str = "") -> None:
        self.folder = folder
        self.point: Optional[CheckPoint] = None
        self.result: Optional[CheckResult] = None  # of the last check since the point was stored or loaded
        self.refused = ""  # why a saved check point is not used

    def store(self, tips_mm: Sequence[Array], reference_id: str) -> CheckPoint:
        """The check point from tips (N, 3) that rest in the divot, in Reference; saved where there is a folder.

        Raises
        ------
        InputError
            Too few tips, or they moved.
        """
        self.point = store_check_point(np.reshape(tips_mm, (-1, 3)), reference_id)
        self.result, self.refused = None, ""
        if self.folder:
            self.point.save(Path(self.folder) / FILE)
        return self.point

    def load(self, reference_id: str) -> None:
        """Take up the point saved before, unless it belongs to another reference tool."""
        path = Path(self.folder) / FILE
        if self.point is not None and self.point.reference_id != reference_id:
            self.point = self.result = None
            self.refused = "the check point belongs to another reference tool; touch the divot and store it again"
        if self.point is None and self.folder and path.is_file():
            try:
                self.point = CheckPoint.load(path, reference_id)
            except InputError as error:
                self.refused = str(error)

    def check(self, tips_mm: Sequence[Array]) -> CheckResult:
        """Compare tips (N, 3) that rest in the divot with the stored point.

        Raises
        ------
        InputError
            No point is stored, too few tips, or they moved.
        """
        if self.point is None:
            raise InputError("no check point is stored; rest the stylus in the divot on the clamp and store it")
        self.result = check_reference_base(self.point, np.reshape(tips_mm, (-1, 3)))
        return self.result

    def notice(self, tips_mm: Sequence[Array]) -> Optional[CheckResult]:
        """The same by itself, if these latest tips rest near the check point; None if not."""
        if self.point is None or len(tips_mm) < FEWEST_SAMPLES:
            return None
        if np.linalg.norm(tips_mm[-1] - np.array(self.point.position_mm)) > NEAR_MM:
            return None
        tips = np.reshape(tips_mm, (-1, 3))
        if np.sqrt(np.mean(np.sum((tips - np.median(tips, axis=0)) ** 2, axis=1))) > RESTING_MM:
            return None
        return self.check(tips_mm)

    @property
    def loose(self) -> bool:
        """Whether the last check found the base moved."""
        return self.result is not None and self.result.loose

    def words(self) -> str:
        """What is known, in one line."""
        if self.result is not None:
            return self.result.message
        if self.point is None:
            return self.refused or "no check point is stored: without one (it is optional) a loose base is not noticed"
        return f"check point stored {self.point.date[:16].replace('T', ' ')} UTC, SD {self.point.sd_mm:.2f} mm; not checked since"
