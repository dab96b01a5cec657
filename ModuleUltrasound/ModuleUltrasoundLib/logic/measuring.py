"""The last step: a recording becomes bone points."""

from __future__ import annotations

from pathlib import Path
from typing import Optional

from CranioNavLib import scene_data
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.module_logic import done_or
from CranioNavLib.panel import Progress, Reading, StepStatus, Task
from CranioNavLib.sequence_metafile import read_recording

from ModuleUltrasoundLib.logic.planning import ProtocolStep, count_of


class MeasureStep(ProtocolStep):
    """SurfacePoints from a file."""

    def measureRecording(self) -> Task:
        """Find the bone in every line of `recording_path`; good ones become SurfacePoints."""
        from ModuleUltrasoundLib.measure import bone_points, measure_lines

        wanted = self.parameters().read()

        def measure(progress: Progress) -> tuple[BonePoints, int, int]:
            progress("reading the recording", 0.05)
            recording = read_recording(wanted.recording_path)
            progress("looking for the bone echo", 0.2)
            measured = measure_lines(recording, wanted.echo_settings())
            return bone_points(recording, measured), int(measured.accepted.sum()), len(measured)

        def take(found: tuple[BonePoints, int, int]) -> str:
            points, accepted, lines = found
            scene_data.set_bone_points(points)
            return f"{len(points)} bone points from {accepted} of {lines} lines"

        return Task("Measure recording", measure, take)

    def measureRecordingBlocked(self) -> str:
        """Why nothing can be measured now."""
        path = self.parameters().read().recording_path
        return ("" if Path(path).is_file() else "nothing is recorded yet") if path else "choose a recording first"

    def pointCount(self) -> Optional[Reading]:
        """How many bone points there are."""
        count = count_of("SurfacePoints")
        return Reading(str(count)) if count else None

    def measureStatus(self) -> StepStatus:
        """Whether there are bone points."""
        return done_or(count_of("SurfacePoints") > 0, self.measureRecordingBlocked() or "measure the recording")
