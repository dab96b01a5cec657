"""The palpation step: lines are recorded, and points taken on which the probe rests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Optional

import numpy as np
from CranioNavLib import scene, scene_data
from CranioNavLib.module_logic import done_or
from CranioNavLib.panel import Level, Reading, StepState, StepStatus, Task
from CranioNavLib.rigid import Array, invert_rigid, transform_points
from CranioNavLib.scene_guidance import get_guidance
from CranioNavLib.sequence_metafile import put_aside

from ModuleUltrasoundLib.devices.line_stream import PosedLine
from ModuleUltrasoundLib.logic.measuring import MeasureStep
from ModuleUltrasoundLib.logic.planning import count_of
from ModuleUltrasoundLib.logic.sweeping import SweepStep
from ModuleUltrasoundLib.panel_description import PalpateBy

if TYPE_CHECKING:
    from ModuleUltrasoundLib.devices.line_recorder import LineRecorder
    from ModuleUltrasoundLib.palpation.palpation import Palpation, PalpationLine, PalpationStatus

LEFT_MM = 10.0  # a resting probe wanders by 1 to 3 mm; the next point is centimetres away
ENOUGH = 200  # points of a sweep after which stopping is suggested


class PalpationStep(SweepStep, MeasureStep):
    """Recording, and SurfacePoints as they are taken."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.recorder: Optional[LineRecorder] = None
        self._palpated: Optional[PalpationStatus] = None  # its last status
        self._guidedBy = b""  # the registration that the last lines were taken under
        self._rests: Optional[tuple[int, Array]] = None  # the point just taken, and where the probe stood then (Reference)
        self._restsUntil = np.inf  # it was taken back: from then on the probe is where it is asked to be

    def goTo(self, index: int) -> None:
        """Ask for a point; where it is expected on the patient follows from the registration, once there is one."""
        super().goTo(index)
        if self.palpation is not None and index >= 0 and scene.find("ProtocolPoints") is not None:
            self.palpation.aim(index, self._expectedAt(index), self._changes[-1][0])

    def _expectedAt(self, index: int) -> Optional[Array]:
        """(3,) Reference; None without a registration."""
        rests = get_guidance()
        if rests is None:
            return None
        target = np.array(scene.find_or_create("ProtocolPoints").GetNthControlPointPosition(index))[None]
        expected: Array = transform_points(invert_rigid(rests.reference_to_ras), target)[0]
        return expected

    def _followGuidance(self) -> None:
        """Where guidance rests on another registration than at the last lines, the point asked for is expected elsewhere."""
        rests, index = get_guidance(), self.currentIndex()
        now = rests.reference_to_ras.tobytes() if rests is not None else b""
        if now == self._guidedBy:
            return
        self._guidedBy = now
        if self.palpation is not None and self.palpation.target == index:
            self.palpation.expect(self._expectedAt(index))
            self.weighAnew()

    def disconnect(self) -> None:
        """Let go of the device; a recording under way is finished."""
        if self.recorder is not None:
            self.closeRecording()
        super().disconnect()
        self.palpation = None

    # Recording

    def startRecording(self) -> str:
        """Record every line with its pose into `recording_path`; points are taken where the probe rests, or as it glides."""
        from ModuleUltrasoundLib.devices.line_recorder import LineRecorder
        from ModuleUltrasoundLib.palpation.palpation import Palpation, Sweep

        path = self.parameters().read().recording_path
        earlier = put_aside(path)
        assert self.latest is not None  # see startRecordingBlocked
        self.recorder = LineRecorder(path, self.latest.line, self.running.acquisition)
        self.measureAnew()
        if self.parameters().read().palpate_by is PalpateBy.SWEEP:
            self.sweep = Sweep()
        elif count_of("ProtocolPoints"):
            self.palpation = Palpation(scene_data.get_points("ProtocolPoints").labels)
            self.beginAsking()
        return f"recording into {path}" + (f"; the one before is kept as {earlier.name}" if earlier is not None else "")

    def startRecordingBlocked(self) -> str:
        """Why nothing can be recorded now."""
        if self.recorder is not None:
            return "already recording"
        if self.latest is None:
            return self.notConnected() or "no line has come yet"
        return "" if self.parameters().read().recording_path else "choose a file first"

    def record(self, posed: list[PosedLine]) -> None:
        """Lines into the file, while there is a recording; a probe still on the point just taken is not on the next."""
        if self.recorder is None:
            return
        for item in posed:
            if self._rests is not None and item.pose.usable:
                away_mm = float(np.linalg.norm(_origin(item) - self._rests[1]))
                self._rests = self._rests if away_mm < LEFT_MM and item.line.host_time_s < self._restsUntil else None
            if self._rests is not None and item.palpation_point >= 0:
                item = replace(item, palpation_point=self._rests[0])
            self.recorder.add(item)

    def stopRecording(self) -> Task:
        """Finish the file and measure it."""
        self.closeRecording()
        return self.measureRecording()

    def stopRecordingBlocked(self) -> str:
        """Why there is no recording to stop."""
        return "" if self.recorder is not None else "not recording"

    def closeRecording(self) -> None:
        """Write what waits for its pose and finish the file; no more points are taken."""
        if self.recorder is not None:
            self.record(self.poser.ready(everything=True) if self.poser is not None else [])
            self.recorder.close()
        self.recorder = self.palpation = self.sweep = self._palpated = self._rests = None

    def measureRecordingBlocked(self) -> str:
        """Why nothing can be measured now."""
        return "stop the recording first" if self.recorder is not None else super().measureRecordingBlocked()

    # Points

    def takePoints(self, lines: list[PalpationLine]) -> None:
        """A point on which the probe has rested long enough is taken, and the next one is asked for; a sweep goes on."""
        if self.sweep is not None:
            self.sweepOver(lines)
        if self.palpation is None:
            return
        self._followGuidance()
        new = False
        for line in lines:
            self._palpated = self.palpation.add(line)
            if self._palpated.new_point is not None:
                new = True
                point = self._palpated.new_point
                tip_mm = self.running.acquisition.forerun_length_mm + point.line.depth_mm
                self._rests, self._restsUntil = (point.target, point.line.position_mm - tip_mm * point.line.beam), np.inf
                self.askNext()
        if new:
            self._showTaken(self.palpation)

    def _showTaken(self, palpation: Palpation) -> None:
        """The points taken so far as SurfacePoints; measuring the whole recording replaces them at the end."""
        from ModuleUltrasoundLib.palpation.palpation import to_bone_points

        taken, wanted = palpation.taken, self.parameters().read()
        if not taken:
            scene.release("SurfacePoints")
            return
        lines, labels = [point.line for point in taken], [point.label for point in taken]
        scene_data.set_bone_points(to_bone_points(lines, labels, wanted.speed_of_sound_m_s, wanted.speed_of_sound_sd_m_s))

    def undoPoint(self) -> Optional[str]:
        """Take back the last point, in the recording too, and return to it. Returns a message."""
        point = self.palpation.undo() if self.palpation is not None else None
        if point is None or self.palpation is None:
            return None
        self.goTo(point.target)
        self._restsUntil = self._changes[-1][0]
        self._showTaken(self.palpation)
        if self.recorder is not None:
            self.recorder.take_back(point.target, self._changes[-1][0])
        return f"{point.label} taken back"

    def undoPointBlocked(self) -> str:
        """Why there is no point to take back."""
        return "" if self.taken() else "no point has been taken in this recording"

    def taken(self) -> list[str]:
        """Labels of the points taken in this recording."""
        return [point.label for point in self.palpation.taken] if self.palpation is not None else []

    # What the panel shows

    def dwell(self) -> Optional[Reading]:
        """How many points are taken, and what the present one still lacks."""
        if self._palpated is None:
            return self.swept()
        done = f"{self._palpated.taken} of {self._palpated.total} points; rested {self._palpated.dwell:.0%} of the time needed"
        return Reading("; ".join(filter(None, [done, self._palpated.reason])))

    def currentPoint(self) -> Optional[Reading]:
        """The point to palpate now; None once they are measured."""
        if self.recorder is None and count_of("SurfacePoints"):
            return None
        done = self.palpation is not None and len(self.taken()) >= count_of("ProtocolPoints")
        return Reading("all are taken", Level.GOOD) if done else super().currentPoint()

    def recorded(self) -> Optional[Reading]:
        """How much has been recorded."""
        if self.recorder is None:
            return None
        return Reading(f"{self.recorder.lines} lines" + (f" at {len(self.recorder.points)} points" if self.sweep is None else ""))

    def palpationStatus(self) -> StepStatus:
        """Whether something is being or has been recorded."""
        if self.sweep is not None:
            message = "glide over the skull, then stop the recording"
            return StepStatus(StepState.ATTENTION, message, "stopRecording" if len(self.sweep) >= ENOUGH else "")
        if self.recorder is not None:
            taken, planned = len(self.taken()), count_of("ProtocolPoints")
            if taken < planned:
                return StepStatus(StepState.ATTENTION, f"recording: {taken} of {planned} points are taken")
            return StepStatus(StepState.ATTENTION, "all points are taken: stop the recording", "stopRecording")
        done = Path(self.parameters().read().recording_path).is_file()
        return done_or(done, self.startRecordingBlocked() or "record")


def _origin(item: PosedLine) -> Array:
    """(3,) where a line's probe stood, Reference."""
    pose = item.pose.tool_to_tracker
    assert pose is not None  # or it is not usable
    return np.asarray(pose[:3, 3], dtype=float)
