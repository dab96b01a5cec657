"""The calibration step: a tool pivoted or rolled, its tip and axis found, known again when its tracker comes back."""

from __future__ import annotations

import time
from typing import Any, Optional

import numpy as np
from CranioNavLib import scene, scene_data
from CranioNavLib.module_logic import done_or, todo
from CranioNavLib.panel import Level, Reading, StepState, StepStatus
from CranioNavLib.rigid import Array, invert_rigid

from ModuleTrackingLib.calibration.coverage import TiltCoverage, draw_coverage, tilt_coverage
from ModuleTrackingLib.logic.tools import ToolsStep
from ModuleTrackingLib.panel_description import Tool
from ModuleTrackingLib.tool_calibrator import Kind, ToolCalibrator, geometry_of

MOST_SHOWN = 300  # poses of a pivoting tool that its drawing is made of


class CalibrationStep(ToolsStep):
    """Tools' tips and axes."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.calibrator = ToolCalibrator()

    def startPivot(self) -> str:
        """Collect poses of the chosen tool, tilted to all sides, for `pivot_s`; `poll` then calibrates its tip."""
        self._calibrate(Kind.PIVOT)
        return f"poses of the {self._tool().lower()} are collected for {self.parameters().read().pivot_s:.0f} s"

    def startPivotBlocked(self) -> str:
        """Why no tool can be calibrated now."""
        return self.notConnected() or self.calibrating()

    def startSpin(self) -> str:
        """Collect poses of the chosen tool, rolled about itself, for `pivot_s`; `poll` then finds its axis."""
        self._calibrate(Kind.SPIN)
        return f"roll the {self._tool().lower()} for {self.parameters().read().pivot_s:.0f} s"

    def startSpinBlocked(self) -> str:
        """Why no axis can be found now."""
        known = "" if self._tool() in self.calibrator.found else "pivot the tool first"
        return self.notConnected() or self.calibrating() or known

    def cancelPivot(self) -> None:
        """Forget the poses collected."""
        self.calibrator.cancel()

    def cancelPivotBlocked(self) -> str:
        """Why there is nothing to cancel."""
        return "" if self.calibrator.busy else "no tool is being calibrated"

    def calibrating(self) -> str:
        """Why points must wait; "" if no tool is being calibrated."""
        return "a tool is being calibrated" if self.calibrator.busy else ""

    def loadCalibrations(self) -> None:
        """Once the tracker has told its tools: take up what is saved of them, and drop what is of others."""
        self._useFolder()
        for tool in (tool.value for tool in Tool):
            self.calibrator.load(tool, geometry_of(tool, self.running.tools))
            self._useCalibration(tool)

    def collectPoses(self, written: list[tuple[str, Array]]) -> None:
        """What was seen of the tools, for a calibration under way."""
        for tool, matrix in written:
            self.calibrator.add(tool, matrix)

    def finishCalibration(self) -> None:
        """A calibration under way is made once its time is over."""
        tool = self.calibrator.busy
        if tool and self.calibrator.finish(time.monotonic(), geometry_of(tool, self.running.tools)) is not None:
            self._useCalibration(tool)

    def _tool(self) -> str:
        return str(self.parameters().read().tool.value)

    def _calibrate(self, kind: Kind) -> None:
        self._useFolder()
        self.calibrator.begin(kind, self._tool(), time.monotonic() + self.parameters().read().pivot_s)
        self._useCalibration(self._tool())

    def _useFolder(self) -> None:
        self.calibrator.folder = self.parameters().read().calibration_folder

    def _useCalibration(self, tool: str) -> None:
        """What is known of a tool, into the stream; tips of before are no longer comparable."""
        known, before = self.calibrator.tool_to_marker(tool), self.running.calibrations.get(tool)
        if known is before:
            return
        if known is None:
            del self.running.calibrations[tool]
        else:
            self.running.calibrations[tool] = known
        self.tips.pop(tool, None)

    # What the panel shows

    def pivotProgress(self) -> Optional[Reading]:
        """How many poses have been collected, or why they were refused."""
        if self.calibrator.busy:
            return Reading(f"{len(self.calibrator.poses)} poses")
        return Reading(self.calibrator.failure, Level.BAD) if self.calibrator.failure else None

    def pivotAdvice(self) -> Optional[Reading]:
        """To which side the tool has to be tilted further, while it is being pivoted."""
        found = self._tiltCoverage()
        if found is None:
            return None
        return Reading(found.advice or "every side is covered", Level.WARNING if found.advice else Level.GOOD)

    def pivotCone(self) -> Optional[str]:
        """A drawing of the sides to which the tool has been tilted; None while it is not being pivoted."""
        found = self._tiltCoverage()
        return draw_coverage(found) if found is not None else None

    def _tiltCoverage(self) -> Optional[TiltCoverage]:
        if self.calibrator.kind is not Kind.PIVOT:
            return None
        camera: Array = np.zeros(3)
        if scene.find("ReferenceToTracker") is not None:
            camera = invert_rigid(scene_data.get_transform("ReferenceToTracker"))[:3, 3]
        poses = self.calibrator.poses
        return tilt_coverage(poses[:: -(1 + len(poses) // MOST_SHOWN)][::-1], camera) if poses else None  # the last stays

    def calibration(self) -> Optional[Reading]:
        """The calibration of the chosen tool."""
        words = self.calibrator.words(self._tool())
        return Reading(words, Level.GOOD) if words else None

    def calibrationStatus(self) -> StepStatus:
        """Whether the chosen tool is calibrated."""
        if self.calibrator.failure and self.stream is not None:
            return StepStatus(StepState.ATTENTION, self.calibrator.failure)
        tool = self._tool().lower()
        if self.calibrator.busy:
            return todo(f"go on tilting the {tool} to all sides" if self.calibrator.poses else f"show the {tool} to the camera")
        return done_or(self._tool() in self.calibrator.found, f"press Pivot, and pivot the {tool} while its poses are collected")
