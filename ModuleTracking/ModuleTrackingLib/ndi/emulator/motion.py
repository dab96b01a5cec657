"""What the emulated camera sees: tools that move by a script, or poses played from a CSV file in a loop."""

from __future__ import annotations

import bisect
import math
from pathlib import Path
from typing import Optional, Protocol

import numpy as np
from CranioNavLib.errors import InputError

from ModuleTrackingLib.ndi.tracking import RawPose
from ModuleTrackingLib.pose_csv import PoseRow, read_pose_csv


class Motion(Protocol):
    """Tools and where they are."""

    tools: tuple[str, ...]
    rate_hz: float  # frames a second

    def sample(self, time_s: float) -> tuple[int, dict[str, Optional[RawPose]]]:
        """The newest frame at that time since tracking began: its number from 0, and each tool's pose or None."""


class HandMotion:
    """Four tools of a navigated operation, moved as if by hand: smooth, bounded, and the same every time.

    The reference base sways a little about its place; probe, stylus and sphere wander and tilt about theirs.
    """

    def __init__(self, rate_hz: float = 60.0, tools: tuple[str, ...] = ("Reference", "Probe", "Stylus", "Sphere")) -> None:
        if not 1.0 <= rate_hz <= 1000.0:
            raise InputError(f"a tracker has 1 to 1000 frames a second, got {rate_hz:g}")
        self.tools, self.rate_hz = tools, rate_hz

    def sample(self, time_s: float) -> tuple[int, dict[str, Optional[RawPose]]]:
        """See Motion.sample."""
        frame = max(0, math.floor(time_s * self.rate_hz + 1e-6))
        return frame, {tool: self._pose(index, tool, frame / self.rate_hz) for index, tool in enumerate(self.tools)}

    def _pose(self, index: int, tool: str, time_s: float) -> RawPose:
        steady = tool == "Reference"
        reach_mm, tilt_rad = (0.3, 0.002) if steady else (60.0, 0.5)
        phase = 1.7 * index
        swing = [math.sin(speed * time_s + phase + turn) for speed, turn in ((0.61, 0.0), (0.83, 1.0), (1.09, 2.0))]
        half = np.asarray(swing) * tilt_rad / 2 + np.array([0.2, -0.1, 0.3]) * (index + 1) / 2
        angle = float(np.linalg.norm(half))
        vector = half / angle * math.sin(angle) if angle else half
        place = (120.0 * index - 180.0, 40.0 - 25.0 * index, -1100.0 - 30.0 * index)
        x, y, z = (home + reach_mm * swing[(axis + 1) % 3] for axis, home in enumerate(place))
        return RawPose((math.cos(angle), float(vector[0]), float(vector[1]), float(vector[2])), (x, y, z), 0.1 + 0.02 * index)


class ReplayedMotion:
    """Poses from a CSV file, each shown exactly as it stands there until the next one's time, in a loop.

    Rows with one time stamp are one frame. The frame rate is that of the file's median step, so that
    gaps in the file show as jumps of the frame number.
    """

    def __init__(self, path: str | Path) -> None:
        frames = read_pose_csv(path)
        self.tools = tuple(dict.fromkeys(row.tool for frame in frames for row in frame))
        times = [frame[0].timestamp_s for frame in frames]
        steps = np.diff(times)
        self.rate_hz = float(1.0 / np.median(steps)) if len(steps) else 60.0
        self._times = [time - times[0] for time in times]
        nowhere: dict[str, Optional[RawPose]] = dict.fromkeys(self.tools)
        self._frames = [{**nowhere, **{row.tool: _raw(row) for row in frame}} for frame in frames]
        self._numbers = [0]
        for time in self._times[1:]:
            self._numbers.append(max(self._numbers[-1] + 1, round(time * self.rate_hz)))
        self.duration_s = self._times[-1] + 1.0 / self.rate_hz

    def sample(self, time_s: float) -> tuple[int, dict[str, Optional[RawPose]]]:
        """See Motion.sample."""
        loops, within = divmod(max(0.0, time_s), self.duration_s)
        index = bisect.bisect_right(self._times, within + 1e-9) - 1
        return int(loops) * (self._numbers[-1] + 1) + self._numbers[index], self._frames[index]


def _raw(row: PoseRow) -> Optional[RawPose]:
    if row.tool_to_tracker is None or row.quaternion is None:
        return None
    x, y, z = (float(value) for value in row.tool_to_tracker[:3, 3])
    return RawPose(row.quaternion, (x, y, z), row.error_mm if math.isfinite(row.error_mm) else 0.0)
