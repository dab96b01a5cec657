"""The step of the reference base: whether it still sits where it sat, told by touching a divot on its clamp again."""

from __future__ import annotations

from typing import Any, Optional

from CranioNavLib.panel import Level, Reading, StepState, StepStatus

from ModuleTrackingLib.base_watch import BaseWatch
from ModuleTrackingLib.logic.calibrating import CalibrationStep
from ModuleTrackingLib.panel_description import Tool
from ModuleTrackingLib.tool_calibrator import geometry_of

CHECK_S, CHECK_FRAMES = 0.5, 150  # a stylus that rests so long in the divot checks the base by itself; so many poses of it


class BaseStep(CalibrationStep):
    """The check point on the head clamp."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.base = BaseWatch()

    def storeCheckPoint(self) -> str:
        """Keep where the stylus rests now, in the divot on the clamp. Returns a message."""
        self.base.folder = self.parameters().read().calibration_folder
        self.base.store(self.restingTips(Tool.STYLUS.value), self._referenceId())
        return self.base.words()

    def storeCheckPointBlocked(self) -> str:
        """Why the divot cannot be stored now."""
        return self.notConnected() or self.calibrating()

    def checkBase(self) -> str:
        """Compare the divot with the stored place. Returns a message."""
        return self.base.check(self.restingTips(Tool.STYLUS.value)).message

    def checkBaseBlocked(self) -> str:
        """Why the base cannot be checked now."""
        return self.storeCheckPointBlocked() or ("" if self.base.point is not None else "store the check point first")

    def loadCheckPoint(self) -> None:
        """Once the tracker has told its tools: take up the point that is saved, unless it is of another reference tool."""
        self.base.folder = self.parameters().read().calibration_folder
        self.base.load(self._referenceId())

    def watchBase(self) -> None:
        """A stylus that rests in the divot checks the base by itself."""
        tips = self.tips.get(Tool.STYLUS.value)
        if self.base.point is not None and tips and not self.calibrator.busy:
            since = tips[-1][0] - CHECK_S
            if tips[0][0] <= since:
                self.base.notice([pose[:3, 3] for time_s, pose in tips[-CHECK_FRAMES:] if time_s > since])

    def _referenceId(self) -> str:
        return geometry_of("Reference", self.running.tools).tool_id

    def referenceTool(self) -> Optional[Reading]:
        """The reference base."""
        if self.stream is not None and self.base.loose:
            return Reading(self.base.words(), Level.BAD)
        return super().referenceTool()

    def baseCheck(self) -> Reading:
        """Whether the reference base still sits where it sat."""
        checked = Level.GOOD if self.base.result is not None else Level.PLAIN
        return Reading(self.base.words(), Level.BAD if self.base.loose else checked)

    def baseStatus(self) -> StepStatus:
        """Whether the base is known to be loose; a check point is worth its minute, but no step waits for it."""
        wrong = self.base.loose or bool(self.base.refused and self.base.point is None)
        return StepStatus(StepState.ATTENTION if wrong else StepState.DONE, self.base.words())
