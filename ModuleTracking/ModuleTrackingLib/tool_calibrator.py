"""Calibration while tracking: poses of one tool are collected for some seconds, the result is kept, saved and loaded."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Optional, Union

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, invert_rigid, rigid

from ModuleTrackingLib.calibration import (
    PivotCalibration,
    SpinCalibration,
    ToolCalibration,
    ToolGeometry,
    calibrate_pivot,
    calibrate_spin,
    load_calibration,
    save_calibration,
    tool_to_marker,
)
from ModuleTrackingLib.tracker import ToolInfo, tool_id


class Kind(str, Enum):
    """What is done with the tool."""

    PIVOT = "pivot"  # tilted to all sides with its tip in a divot: where the tip is
    SPIN = "spin"  # rolled about itself with its tip in a divot: where its axis points


@dataclass
class _Run:
    """A calibration under way."""

    kind: Kind
    tool: str
    until_s: float
    poses: list[Array] = field(default_factory=list)  # marker to Reference


class ToolCalibrator:
    """Calibrates one tool at a time and knows all that have been calibrated.

    Parameters
    ----------
    folder : str
        Where results are saved and found again; "": nowhere.
    """

    def __init__(self, folder: str = "") -> None:
        self.folder = folder
        self.found: dict[str, ToolCalibration] = {}
        self.failure = ""  # why the last poses, or a saved calibration, were refused
        self._run: Optional[_Run] = None

    @property
    def busy(self) -> str:
        """Name of the tool that is being calibrated; "" if none is."""
        return self._run.tool if self._run is not None else ""

    @property
    def kind(self) -> Optional[Kind]:
        """What is being done; None: nothing."""
        return self._run.kind if self._run is not None else None

    @property
    def poses(self) -> list[Array]:
        """Marker to Reference, as collected so far."""
        return self._run.poses if self._run is not None else []

    def begin(self, kind: Kind, tool: str, until_s: float) -> None:
        """Collect poses of a tool up to that time of the host's clock. To pivot it anew forgets its calibration.

        Raises
        ------
        InputError
            A tool is to be spun whose tip is not known.
        """
        if kind is Kind.SPIN and tool not in self.found:
            raise InputError(f"pivot the {tool.lower()} first: its axis is taken through its tip")
        self.failure = ""
        if kind is Kind.PIVOT:
            self.found.pop(tool, None)
        self._run = _Run(kind, tool, until_s)

    def cancel(self) -> None:
        """Forget the poses collected."""
        self._run = None

    def add(self, tool: str, tool_to_reference: Array) -> None:
        """A pose of a tool, calibrated as `tool_to_marker` says."""
        if self._run is not None and self._run.tool == tool:
            known = self.found.get(tool)
            pose = tool_to_reference if known is None else tool_to_reference @ invert_rigid(known.tool_to_marker)
            self._run.poses.append(pose)

    def finish(self, now_s: float, geometry: ToolGeometry) -> Optional[ToolCalibration]:
        """The new calibration once the time is over; None before, and when the poses are refused (see `failure`)."""
        if self._run is None or now_s < self._run.until_s:
            return None
        run, self._run = self._run, None
        try:
            result = self._calibrate(run, np.reshape(run.poses, (-1, 4, 4)), geometry)
            if self.folder:
                save_calibration(self._path(run.tool), result)
        except InputError as error:
            self.failure = str(error)
            return None
        self.found[run.tool] = result
        return result

    def load(self, tool: str, geometry: ToolGeometry) -> Optional[ToolCalibration]:
        """The calibration of this very tool, from memory or from the folder; one of another geometry is refused.

        What is refused is forgotten, and `failure` says why.
        """
        known = self.found.get(tool)
        if known is not None:
            difference = known.geometry.difference(geometry)
            if difference:
                del self.found[tool]
                self.failure = f"the {tool.lower()}'s calibration does not fit: {difference}; calibrate it again"
        elif self.folder and self._path(tool).is_file():
            try:
                self.found[tool] = load_calibration(self._path(tool), tool, geometry)
            except InputError as error:
                self.failure = str(error)
        return self.found.get(tool)

    def tool_to_marker(self, tool: str) -> Optional[Array]:
        """The calibrated tool's frame in its marker's; None where it is not calibrated."""
        return self.found[tool].tool_to_marker if tool in self.found else None

    def words(self, tool: str) -> str:
        """What is known of a tool; "" if nothing."""
        found = self.found.get(tool)
        if found is None:
            return ""
        words = f"found by {found.method}, SD {found.error_mm:.2f} mm in the worst direction"
        return f"{words}, {found.date[:10]}" if found.date else words

    def _calibrate(self, run: _Run, poses: Array, geometry: ToolGeometry) -> ToolCalibration:
        if run.kind is Kind.PIVOT:
            return _of(run.tool, geometry, calibrate_pivot(poses, np.random.default_rng(0)))
        before = self.found[run.tool]
        spun = calibrate_spin(poses, before.tool_to_marker[:3, 3])
        return _of(run.tool, geometry, spun, before)

    def _path(self, tool: str) -> Path:
        return Path(self.folder) / f"{tool.lower()}.calibration.json"


def geometry_of(tool: str, tools: list[ToolInfo]) -> ToolGeometry:
    """What tells this tool from another."""
    return ToolGeometry.of(tool_id(tool, tools))


def _of(
    tool: str,
    geometry: ToolGeometry,
    result: Union[PivotCalibration, SpinCalibration],
    before: Optional[ToolCalibration] = None,
) -> ToolCalibration:
    from datetime import datetime, timezone

    date = datetime.now(timezone.utc).isoformat(timespec="seconds")
    if isinstance(result, PivotCalibration):
        at_tip = rigid(np.eye(3), result.tip_in_marker_mm)  # the marker's axes, with the origin at the tip
        used = int(result.used.sum())
        return ToolCalibration(tool, geometry, at_tip, result.covariance_mm2, result.rms_mm, "pivot", used, date)
    assert before is not None
    frame = tool_to_marker(before.tool_to_marker[:3, 3], result.axis_in_marker)
    covariance = np.zeros((5, 5))
    covariance[:3, :3] = before.covariance[:3, :3]
    covariance[3:, 3:] = np.eye(2) * np.radians(result.sd_deg) ** 2
    return ToolCalibration(tool, geometry, frame, covariance, before.rms_mm, "pivot and spin", before.samples, date)
