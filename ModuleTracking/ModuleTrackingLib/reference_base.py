"""Everything in the frame of the reference base on the head clamp, and whether that base still sits where it sat."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.files import write_text
from CranioNavLib.rigid import Array, check_points, invert_rigid

from ModuleTrackingLib.tracker import PoseStatus, ToolPose

REFERENCE = "Reference"
SAME_TIME_S = 1e-3  # poses of one tracker frame; apart by more, a moving head would shift the tool
FEWEST_SAMPLES = 10
LARGEST_SPREAD_MM = 1.0  # a tip resting in a divot scatters by the tracker's 0.25 mm; more means that it moved
LOOSE_MM = 1.0  # default tolerance: four times the tracker's RMS error, two times that of a calibrated tip


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A tool in the reference base's frame; without a matrix wherever tool or base was not trustworthy."""

    tool: str
    tool_to_reference: Optional[Array]  # (4, 4) mm
    status: PoseStatus
    host_time_s: float
    error_mm: float = math.nan  # larger of the tracker's own fit errors of tool and base
    reason: str = ""  # why there is no pose

    @property
    def usable(self) -> bool:
        return self.status is PoseStatus.OK and self.tool_to_reference is not None


def in_reference(tool: ToolPose, reference: ToolPose) -> RelativePose:
    """ToolToReference = inverse(ReferenceToTracker) @ ToolToTracker, of poses taken at the same time.

    Raises
    ------
    ValueError
        The two were taken more than 1 ms apart; interpolate one of them first.
    """
    apart = abs(tool.host_time_s - reference.host_time_s)
    if apart > SAME_TIME_S:
        raise ValueError(f"{tool.tool} and {reference.tool} were taken {apart * 1e3:.1f} ms apart; interpolate one first")
    for pose in (tool, reference):
        if not pose.usable or pose.tool_to_tracker is None:
            status = pose.status if pose.status is not PoseStatus.OK else PoseStatus.MISSING
            reason = ", ".join(pose.flags) or status.value
            return RelativePose(tool.tool, None, status, tool.host_time_s, reason=f"{pose.tool}: {reason}")
    assert tool.tool_to_tracker is not None
    assert reference.tool_to_tracker is not None
    matrix = invert_rigid(reference.tool_to_tracker) @ tool.tool_to_tracker
    error = float(np.fmax(tool.error_mm, reference.error_mm))
    return RelativePose(tool.tool, matrix, PoseStatus.OK, tool.host_time_s, error)


@dataclass(frozen=True)
class CheckPoint:
    """Where the stylus tip rests in the divot on the clamp, in Reference; stored once the base is tightened."""

    position_mm: tuple[float, float, float]
    sd_mm: float  # per-axis scatter of the samples it was made from
    reference_id: str = ""  # serial number or file of the reference tool
    date: str = ""

    def save(self, path: str | Path) -> None:
        """Write as JSON."""
        write_text(path, json.dumps(asdict(self), indent=2) + "\n")

    @classmethod
    def load(cls, path: str | Path, reference_id: str = "") -> CheckPoint:
        """Read from JSON.

        Raises
        ------
        InputError
            Missing or damaged file, or it belongs to another reference tool than `reference_id`.
        """
        try:
            values = json.loads(Path(path).read_text(encoding="utf-8"))
            position = check_points([values["position_mm"]], "check point")[0]
            point = cls(
                (float(position[0]), float(position[1]), float(position[2])),
                float(values["sd_mm"]),
                str(values["reference_id"]),
                str(values["date"]),
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path}: not a check point of the reference base ({error}); touch the divot and store it again"
            ) from None
        if reference_id and point.reference_id and point.reference_id != reference_id:
            raise InputError(
                f"{path}: belongs to reference tool {point.reference_id!r}, not {reference_id!r}; touch the divot and store anew"
            )
        return point


@dataclass(frozen=True)
class CheckResult:
    """What touching the divot again told."""

    distance_mm: float
    tolerance_mm: float
    loose: bool
    message: str


def store_check_point(tips_reference_mm: npt.ArrayLike, reference_id: str = "") -> CheckPoint:
    """The check point from tip positions (N, 3) in Reference while the stylus rests in the divot.

    Raises
    ------
    InputError
        Fewer than 10 samples, or they scatter by more than 1 mm: the tip moved.
    """
    mean, sd = _resting_tip(tips_reference_mm)
    date = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return CheckPoint((float(mean[0]), float(mean[1]), float(mean[2])), sd, reference_id, date)


def check_reference_base(point: CheckPoint, tips_reference_mm: npt.ArrayLike, tolerance_mm: float = LOOSE_MM) -> CheckResult:
    """Whether the reference base still sits where it sat, by touching the divot again.

    Only the divot is checked: a base that turned about the divot itself would pass. Put the divot far from the base.

    Raises
    ------
    InputError
        Fewer than 10 samples, or the tip moved.
    """
    mean, _ = _resting_tip(tips_reference_mm)
    distance = float(np.linalg.norm(mean - np.array(point.position_mm)))
    loose = distance > tolerance_mm
    message = (
        f"the reference base has moved by {distance:.1f} mm on its clamp; tighten it and register again"
        if loose
        else f"the reference base sits firmly ({distance:.1f} mm from its check point)"
    )
    return CheckResult(distance, tolerance_mm, loose, message)


def _resting_tip(tips_mm: npt.ArrayLike) -> tuple[Array, float]:
    tips = check_points(tips_mm, "tip positions", at_least=FEWEST_SAMPLES)
    centre = np.median(tips, axis=0)
    sd = float(np.sqrt(np.mean((tips - centre) ** 2)))
    if sd > LARGEST_SPREAD_MM:
        raise InputError(f"the tip moved while it was in the divot (scatter {sd:.1f} mm); hold it still and touch again")
    return centre, sd


def stale(pose: RelativePose, reason: str) -> RelativePose:
    """The same tool without its pose, because no news came for too long."""
    return replace(pose, tool_to_reference=None, status=PoseStatus.STALE, reason=reason)
