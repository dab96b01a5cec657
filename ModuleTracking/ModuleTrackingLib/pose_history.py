"""The recent poses of one tool, and its pose at any time between them."""

from __future__ import annotations

import bisect
import math
from dataclasses import replace

import numpy as np
import scipy
from CranioNavLib.rigid import Array

from ModuleTrackingLib.tracker import PoseStatus, ToolPose

HISTORY_S = 10.0
LARGEST_GAP_S = 0.1  # six frames of a 60 Hz tracker: a hand moves some 20 mm in it, and not on a line


class PoseHistory:
    """Poses of one tool in order of time; missing ones are kept, too, because nothing may be interpolated across them."""

    def __init__(self, tool: str, largest_gap_s: float = LARGEST_GAP_S, history_s: float = HISTORY_S) -> None:
        self.tool, self.largest_gap_s, self.history_s = tool, largest_gap_s, history_s
        self.out_of_order = 0  # poses not later than the one before; they are left out
        self._times: list[float] = []
        self._poses: list[ToolPose] = []

    def add(self, pose: ToolPose) -> None:
        """Add a pose whose `host_time_s` is the time it was taken."""
        if self._times and pose.host_time_s <= self._times[-1]:
            self.out_of_order += 1
            return
        self._times.append(pose.host_time_s)
        self._poses.append(pose)
        oldest = pose.host_time_s - self.history_s
        if self._times[0] < oldest - self.history_s:  # cut now and then, not at every pose
            keep = bisect.bisect_left(self._times, oldest)
            del self._times[:keep], self._poses[:keep]

    def __len__(self) -> int:
        return len(self._times)

    @property
    def latest(self) -> ToolPose | None:
        return self._poses[-1] if self._poses else None

    def rate_hz(self, now_s: float, window_s: float = 1.0) -> float:
        """Poses a second over the last `window_s`, missing ones left out."""
        first = bisect.bisect_left(self._times, now_s - window_s)
        return sum(pose.usable for pose in self._poses[first:]) / window_s

    def covers(self, time_s: float) -> bool:
        """Whether a pose at or after `time_s` is known, so that waiting longer would change nothing."""
        return bool(self._times) and self._times[-1] >= time_s

    def at(self, time_s: float) -> ToolPose:
        """The pose at `time_s` (host clock): spherical interpolation of the rotation, linear of the origin.

        Returns
        -------
        ToolPose
            Status OK with a pose; or without one, and `flags` says why: before the first or after the last pose, a gap
            longer than `largest_gap_s`, or a neighbour that is not OK.
        """
        after = bisect.bisect_left(self._times, time_s)
        if after < len(self._times) and self._times[after] == time_s:
            return self._poses[after]
        if after == 0:
            return self._refused(time_s, PoseStatus.MISSING, "no pose so early")
        if after == len(self._times):
            return self._refused(time_s, PoseStatus.STALE, "no pose so late yet")
        before, behind = self._poses[after - 1], self._poses[after]
        for neighbour in (before, behind):
            if not neighbour.usable:
                status = neighbour.status if neighbour.status is not PoseStatus.OK else PoseStatus.MISSING
                return self._refused(time_s, status, f"next to a pose that is {status.value}")
        gap = behind.host_time_s - before.host_time_s
        if gap > self.largest_gap_s:
            return self._refused(time_s, PoseStatus.STALE, f"in a gap of {gap * 1e3:.0f} ms")
        assert before.tool_to_tracker is not None
        assert behind.tool_to_tracker is not None
        share = (time_s - before.host_time_s) / gap
        return replace(
            before if share < 0.5 else behind,
            tool_to_tracker=interpolate(before.tool_to_tracker, behind.tool_to_tracker, share),
            host_time_s=time_s,
            device_time_s=(1 - share) * before.device_time_s + share * behind.device_time_s,
            error_mm=float(np.fmax(before.error_mm, behind.error_mm)),
            frame_number=-1,
        )

    def _refused(self, time_s: float, status: PoseStatus, reason: str) -> ToolPose:
        return ToolPose(self.tool, None, status, time_s, flags=(reason,))


def interpolate(a: Array, b: Array, share: float) -> Array:
    """The rigid transform at `share` (0: a, 1: b) of the way: rotation at constant speed about one axis, origin on a line."""
    turn = a[:3, :3].T @ b[:3, :3]
    sines = np.array((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])) / 2  # axis times sin(angle)
    sine, cosine = math.sqrt(float(sines @ sines)), (float(turn.trace()) - 1) / 2
    if cosine < 0.5:  # far apart: rare, and the axis needs more care
        start = scipy.spatial.transform.Rotation.from_matrix(a[:3, :3])
        rotation = (
            start
            * scipy.spatial.transform.Rotation.from_rotvec(share * scipy.spatial.transform.Rotation.from_matrix(turn).as_rotvec())
        ).as_matrix()
    else:
        part = share * math.atan2(sine, cosine)
        x, y, z = sines / max(sine, 1e-300)
        across = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
        rotation = a[:3, :3] @ (np.eye(3) + math.sin(part) * across + (1 - math.cos(part)) * (across @ across))
    between = np.eye(4)
    between[:3, :3] = rotation
    between[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return between
