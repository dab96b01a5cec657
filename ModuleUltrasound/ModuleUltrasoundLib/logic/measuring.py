"""The last step: a recording becomes bone points."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Optional

from CranioNavLib import scene_data
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.module_logic import done_or
from CranioNavLib.panel import Progress, Reading, StepStatus, Task
from CranioNavLib.sequence_metafile import read_recording

from ModuleUltrasoundLib.logic.planning import ProtocolStep, count_of

if TYPE_CHECKING:
    from ModuleUltrasoundLib.measurement.speed_of_sound import SpeedEstimate


class MeasureStep(ProtocolStep):
    """SurfacePoints from a file."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.pressed: Optional[SpeedEstimate] = None  # what the recording measured last tells of the speed of sound

    def measureRecording(self) -> Task:
        """Find the bone in every line of `recording_path`; good ones become SurfacePoints."""
        from ModuleUltrasoundLib.measurement.measure import bone_points, measure_lines
        from ModuleUltrasoundLib.measurement.speed_of_sound import estimate_if_pressed

        wanted = self.parameters().read()

        def measure(progress: Progress) -> tuple[BonePoints, int, int, Optional[SpeedEstimate]]:
            progress("reading the recording", 0.05)
            recording = read_recording(wanted.recording_path)
            progress("looking for the bone echo", 0.2)
            measured = measure_lines(recording, wanted.echo_settings())
            pressed = estimate_if_pressed(recording, measured)
            return bone_points(recording, measured), int(measured.accepted.sum()), len(measured), pressed

        def take(found: tuple[BonePoints, int, int, Optional[SpeedEstimate]]) -> str:
            points, accepted, lines, self.pressed = found
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

    def pressedSpeed(self) -> Optional[Reading]:
        """Speed of sound from pressing hard and softly on the same spot; None where nobody did."""
        return None if self.pressed is None else Reading(str(self.pressed))

    def useSpeed(self) -> str:
        """Take the speed of sound from pressing, together with the prior, as the prior of what is measured next."""
        assert self.pressed is not None  # see useSpeedBlocked
        speed, sd = self.pressed.speed_m_s, self.pressed.speed_sd_m_s
        self.parameters().change(speed_of_sound_m_s=round(speed, 1), speed_of_sound_sd_m_s=round(sd, 1))
        self.pressed = None  # it must not count twice
        return f"speed of sound {speed:.0f} ± {sd:.0f} m/s; measure the recording again"

    def useSpeedBlocked(self) -> str:
        """Why there is no speed of sound to take over."""
        return "" if self.pressed is not None else "press hard and softly on one spot while recording, then measure"

    def measureStatus(self) -> StepStatus:
        """Whether there are bone points."""
        return done_or(count_of("SurfacePoints") > 0, self.measureRecordingBlocked() or "measure the recording")
