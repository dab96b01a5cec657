"""Replay of recorded tools: from an .igs.mha recording or a pose table (.csv), in real time, faster, or step by step."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording, read_recording

from ModuleTrackingLib.pose_csv import PoseRow, read_pose_csv
from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, ToolInfo, ToolPose, Tracker, TrackerError

REFERENCE = "Reference"
END_S = 0.05  # a recording at its end answers this slowly, so that whoever polls it does not spin


@dataclass(frozen=True)
class ReplaySettings(Parameters):
    path: Annotated[str, "recording (.igs.mha) or pose table (.csv)"] = ""
    speed: Annotated[float, Limits(0, 1000), "1: as recorded, 2: twice as fast; 0: one frame at every read"] = 1.0
    loop: Annotated[bool, "begin again at the end"] = True


@TRACKERS.register
class ReplayTracker(Tracker):
    """A recording played as if the tracker were there."""

    name = "replay"
    title = "Replay of a recording (.igs.mha or pose table)"
    Settings = ReplaySettings

    def __init__(self, settings: Optional[Parameters] = None) -> None:
        super().__init__(settings)
        self._frames: list[list[PoseRow]] = []
        self._names: list[str] = []
        self._next = 0
        self._rounds = 0
        self._duration_s = self._pause_s = 0.0
        self._begin_s = math.nan

    def open(self) -> None:
        """Read the file.

        Raises
        ------
        InputError
            No path given, or the file is refused.
        """
        if not self.settings.path:
            raise InputError("replay: no recording given; set path to an .igs.mha or .csv file")
        path = Path(self.settings.path)
        if path.suffix.lower() == ".csv":
            self._frames = read_pose_csv(path)
        else:
            self._frames = recorded_frames(read_recording(path, require_probe=False), path)
        self._names = list(dict.fromkeys(row.tool for frame in self._frames for row in frame))
        times = [frame[0].timestamp_s for frame in self._frames]
        self._pause_s = float(np.median(np.diff(times))) if len(times) > 1 else 1.0  # between the last frame and the first again
        self._duration_s = times[-1] - times[0] + self._pause_s

    def start(self) -> None:
        """Begin at the first frame."""
        self._next = self._rounds = 0
        self._begin_s = time.monotonic()

    def read(self, timeout_s: float = 1.0) -> list[ToolPose]:
        """The next frame when it is due; at once with speed 0. Empty for good when the recording is `finished`.

        Raises
        ------
        TrackerError
            It is not open.
        """
        if not self._frames:
            raise TrackerError("replay: not open; open it first")
        if self.finished:
            time.sleep(min(timeout_s, END_S))
            return []
        again = self._next >= len(self._frames)
        frame = self._frames[-1 if again else self._next]
        device_s = math.nan
        if self.settings.speed > 0:
            elapsed_s = frame[0].timestamp_s - self._frames[0][0].timestamp_s
            elapsed_s += self._rounds * self._duration_s + (self._pause_s / 2 if again else 0)
            device_s = elapsed_s / self.settings.speed
            wait_s = self._begin_s + device_s - time.monotonic()
            if wait_s > 0:
                time.sleep(min(wait_s, timeout_s))
            if wait_s > timeout_s:
                return []
        if again:
            # The tools jump back to where they were: a frame without them keeps anybody from interpolating across.
            self._next, self._rounds = 0, self._rounds + 1
            return [self._missing(name, device_s, -1, ("the recording begins again",)) for name in self._names]
        number, self._next = self._next, self._next + 1
        return self._poses(frame, number, device_s)

    def stop(self) -> None:
        """Nothing runs."""

    def close(self) -> None:
        """Let go of the recording."""
        self._frames = []

    @property
    def finished(self) -> bool:
        """Whether a recording that is not looped is at its end."""
        return not self.settings.loop and self._next >= len(self._frames)

    @property
    def tools(self) -> list[ToolInfo]:
        return [ToolInfo(name, detail="recorded") for name in self._names]

    def _poses(self, frame: list[PoseRow], number: int, device_s: float) -> list[ToolPose]:
        now = time.monotonic()
        rows = {row.tool: row for row in frame}
        poses = []
        for name in self._names:
            row = rows.get(name)
            if row is None:
                poses.append(self._missing(name, device_s, number))
            else:
                poses.append(ToolPose(name, row.tool_to_tracker, row.status, now, device_s, number, row.error_mm))
        return poses

    @staticmethod
    def _missing(tool: str, device_s: float, number: int, flags: tuple[str, ...] = ()) -> ToolPose:
        return ToolPose(tool, None, PoseStatus.MISSING, time.monotonic(), device_s, number, flags=flags)


def recorded_frames(recording: Recording, path: Path) -> list[list[PoseRow]]:
    """The tools of a recording, frame by frame.

    `<Tool>ToTracker` streams are taken where there are any. A recording that holds `<Tool>ToReference` only is played with
    the reference base as the tracker's frame: its own pose is then the identity by definition.

    Raises
    ------
    InputError
        The recording holds no tool.
    """
    streams: dict[str, tuple[Array, tuple[str, ...]]] = {
        name: (poses, recording.other_statuses.get(name, ())) for name, poses in recording.other_transforms.items()
    }
    streams["ProbeToReference"] = (recording.probe_to_reference, recording.statuses)
    tools = _tools_of(streams, "ToTracker")
    if not tools:
        tools = _tools_of(streams, "ToReference")
        if tools:
            count = len(recording)
            tools[REFERENCE] = (np.tile(np.eye(4), (count, 1, 1)), ("OK",) * count)
    if not tools:
        raise InputError(f"{path}: holds no tool in the frame Tracker or Reference; record with the tracker on")
    return [
        [_row(float(recording.timestamps_s[index]), tool, poses[index], states[index]) for tool, (poses, states) in tools.items()]
        for index in range(len(recording))
    ]


def _tools_of(streams: dict[str, tuple[Array, tuple[str, ...]]], ending: str) -> dict[str, tuple[Array, tuple[str, ...]]]:
    found = {}
    for name, (poses, statuses) in streams.items():
        valid = np.atleast_1d(np.isfinite(poses).all(axis=(1, 2)))
        if name.endswith(ending) and valid.any():
            states = statuses or tuple("OK" if good else "MISSING" for good in valid)
            found[name[: -len(ending)]] = (poses, states)
    return found


def _row(time_s: float, tool: str, pose: Array, status: str) -> PoseRow:
    if status == "OK" and np.isfinite(pose).all():
        return PoseRow(time_s, tool, PoseStatus.OK, pose, math.nan)
    known = status in PoseStatus.__members__ and status != "OK"
    return PoseRow(time_s, tool, PoseStatus(status) if known else PoseStatus.MISSING, None, math.nan)
