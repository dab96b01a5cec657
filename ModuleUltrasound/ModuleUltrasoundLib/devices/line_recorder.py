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
        self._writer = RecordingWriter(path, len(first.samples), acquisition)

    @property
    def lines(self) -> int:
        """How many are written."""
        return self._writer.count

    def add(self, item: PosedLine) -> None:
        """Write a line; where it has no pose its status tells why."""
        if item.line.host_time_s <= self.start_s and self.lines:
            return
        pose = item.pose
        self._writer.append(
            max(0.0, item.line.host_time_s - self.start_s),
            {"ProbeToReference": pose.tool_to_tracker if pose.usable else None},
            {"ProbeToReference": "OK" if pose.usable else status_word(pose.status)},
            item.line.samples,
            item.palpation_point,
        )
        if pose.usable:
            self.points.add(item.palpation_point)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()
