"""Recording all tools and A-lines into .igs.mha, frame by frame, as they come."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import Callable, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Acquisition, RecordingWriter

from ModuleTrackingLib.pose_stream import PoseStream
from ModuleTrackingLib.reference_base import REFERENCE, in_reference
from ModuleTrackingLib.tracker import PoseStatus, ToolPose, tool_id

PROBE = "Probe"
LONGEST_WAIT_S = 0.08  # a line waits so long for the pose after it; a killed process loses no more than the lines waiting
# Words of ours that PLUS does not know, in its own words.
PLUS_WORDS = {PoseStatus.STALE: "MISSING"}


@dataclass(frozen=True)
class RecorderState:
    """What has been recorded so far."""

    frames: int
    seconds: float
    without_probe: int  # frames that have no probe pose
    path: Path


@dataclass(frozen=True, eq=False)
class _Line:
    samples: Optional[npt.NDArray[np.int16]]  # None: a frame of poses only
    time_s: float
    palpation_point: int


class SessionRecorder:
    """Writes a pose stream, and A-lines if there are any, to a recording on disk.

    With A-lines, a frame is one line with every tool interpolated at its transmit pulse. Without, a frame is one frame of
    the tracker. Every frame holds `<Tool>ToTracker` and, where a reference base is tracked, `<Tool>ToReference`. The probe
    is always named, so that a frame without its pose says so.

    Parameters
    ----------
    path : path
        The .igs.mha file to be.
    stream : PoseStream
        Polled by its owner; this only reads what has been polled.
    acquisition, samples
        How the A-lines are taken and how long they are; None and 0 for poses only.
    clock : callable
        The host's clock, in s, that lines and poses are timed by.
    """

    def __init__(
        self,
        path: str | Path,
        stream: PoseStream,
        acquisition: Optional[Acquisition] = None,
        samples: int = 0,
        fields: Optional[Mapping[str, str]] = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._stream, self._clock, self._samples = stream, clock, samples
        self._start_s = clock()
        started = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        ids = {f"{info.name}ToolId": tool_id(info.name, stream.tools) for info in stream.tools if info.name.isidentifier()}
        ids = {name: text for name, text in ids.items() if (name + text).isascii() and text.isprintable()}
        header = {"CranioNavTimeZero": f"start of recording, {started}", **ids, **(fields or {})}
        self._writer = RecordingWriter(path, samples, acquisition, header)
        self._lines: deque[_Line] = deque()
        self._last_s = 0.0
        self._without_probe = 0

    @property
    def state(self) -> RecorderState:
        return RecorderState(self._writer.count, self._last_s, self._without_probe, self._writer.path)

    def add_frames(self, frames: list[list[ToolPose]]) -> None:
        """Tracker frames as `PoseStream.poll` gave them. In a recording with A-lines they only serve its lines."""
        if not self._samples:
            # Trackers that report their tools one by one give frames of one tool: the others are interpolated.
            self._lines += [_Line(None, frame[0].host_time_s, -1) for frame in frames]
        self.flush()

    def add_line(self, samples: npt.NDArray[np.int16], host_time_s: float, palpation_point: int = -1) -> None:
        """An RF line and the time of its transmit pulse on the host's clock."""
        if samples.shape != (self._samples,):
            raise InputError(f"expected an RF line of {self._samples} samples, got {samples.shape}; start a new recording")
        # A copy: a driver may reuse its buffer while the line waits for its pose.
        self._lines.append(_Line(np.array(samples, dtype=np.int16), host_time_s, palpation_point))
        self.flush()

    def flush(self, everything: bool = False) -> None:
        """Write the lines whose poses are known, or that have waited long enough."""
        while self._lines:
            line = self._lines[0]
            waited_s = self._clock() - line.time_s
            if not everything and waited_s < LONGEST_WAIT_S and not self._stream.covers(line.time_s):
                return
            self._lines.popleft()
            poses = {name: self._stream.pose_at(name, line.time_s) for name in self._stream.tool_names}
            self._append(line.time_s, poses, line.samples, line.palpation_point)

    def close(self) -> None:
        """Write what waits and finish the file; may be called twice."""
        self.flush(everything=True)
        self._writer.close()

    def __enter__(self) -> SessionRecorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _append(self, time_s: float, poses: Mapping[str, ToolPose], line: Optional[npt.NDArray[np.int16]], point: int) -> None:
        transforms, statuses = named_transforms(poses)
        self._without_probe += transforms.get("ProbeToReference") is None
        # Time runs forward in a file; poses that the clock's mapping moved back by a hair keep the time before.
        self._last_s = max(self._last_s, time_s - self._start_s)
        self._writer.append(self._last_s, transforms, statuses, line, point)


def named_transforms(poses: Mapping[str, ToolPose]) -> tuple[dict[str, Optional[Array]], dict[str, str]]:
    """Transforms and statuses of one frame by their names in PLUS: `ProbeToReference` first, then all others.

    Parameters
    ----------
    poses : mapping
        Tool to its pose; all of one time.
    """
    transforms: dict[str, Optional[Array]] = {}
    statuses: dict[str, str] = {}
    time_s = next((pose.host_time_s for pose in poses.values()), math.nan)
    base = poses.get(REFERENCE, ToolPose(REFERENCE, None, PoseStatus.MISSING, time_s))
    probe = poses.get(PROBE, ToolPose(PROBE, None, PoseStatus.MISSING, time_s))
    for tool, pose in {PROBE: probe, **poses}.items():
        if tool != REFERENCE:
            relative = in_reference(pose, base)
            transforms[f"{tool}ToReference"] = relative.tool_to_reference
            statuses[f"{tool}ToReference"] = _word(relative.status)
    for tool, pose in poses.items():
        transforms[f"{tool}ToTracker"] = pose.tool_to_tracker if pose.usable else None
        statuses[f"{tool}ToTracker"] = _word(pose.status)
    return transforms, statuses


def _word(status: PoseStatus) -> str:
    return PLUS_WORDS.get(status, status.value)
