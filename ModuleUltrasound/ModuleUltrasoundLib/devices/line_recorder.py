"""Lines with the probe's pose, written to a file as they come."""

from __future__ import annotations

from CranioNavLib.sequence_metafile import Acquisition, RecordingWriter

from ModuleUltrasoundLib.devices.device import RfLine
from ModuleUltrasoundLib.devices.line_stream import PosedLine, status_word


class LineRecorder:
    """A recording that grows line by line; times count from `first`.

    Parameters
    ----------
    path : str
        The .igs.mha file.
    first : RfLine
        The last line before the recording; later ones are its content, and as long.
    acquisition : Acquisition
        How the lines are taken.
    """

    def __init__(self, path: str, first: RfLine, acquisition: Acquisition) -> None:
        self.start_s = first.host_time_s
        self.points: set[int] = set()  # of the protocol, with a pose
        self._frames: dict[int, list[int]] = {}  # of each point
        self._taken_back: dict[int, float] = {}  # when a point was
        self._writer = RecordingWriter(path, len(first.samples), acquisition)

    @property
    def lines(self) -> int:
        """How many are written."""
        return self._writer.count

    def add(self, item: PosedLine) -> None:
        """Write a line; where it has no pose its status tells why."""
        if item.line.host_time_s <= self.start_s and self.lines:
            return
        pose, point = item.pose, item.palpation_point
        late = item.line.host_time_s < self._taken_back.get(point, 0.0)  # it was on its way when the point was taken back
        if not late:
            self._frames.setdefault(point, []).append(self.lines)
        self._writer.append(
            max(0.0, item.line.host_time_s - self.start_s),
            {"ProbeToReference": pose.tool_to_tracker if pose.usable else None},
            {"ProbeToReference": "OK" if pose.usable else status_word(pose.status)},
            item.line.samples,
            point,
            late,
        )
        if pose.usable:
            self.points.add(point)

    def take_back(self, point: int, host_time_s: float) -> None:
        """The lines of a point up to now are none of it: they stay in the file, marked as invalid at once, for a killed
        process to leave them so."""
        self._taken_back[point] = host_time_s
        self.points.discard(point)
        self._writer.mark_invalid(self._frames.pop(point, ()))

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()
