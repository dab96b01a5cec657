"""Tracking replies as tool poses: which may be used, and why the others may not."""

from __future__ import annotations

import math
from typing import Optional

import numpy as np
from CranioNavLib.rigid import Array

from ModuleTrackingLib.ndi import words
from ModuleTrackingLib.ndi.session import Tool
from ModuleTrackingLib.ndi.tracking import HandleData, HandleState, RawPose, TrackingReply
from ModuleTrackingLib.tracker import PoseStatus, ToolPose

QUATERNION_TOLERANCE = 5e-3  # TX carries four decimals; anything farther from length 1 is no rotation
FARTHEST_MM = 20_000.0  # no measuring volume reaches that far


def tool_poses(
    reply: TrackingReply, tools: tuple[Tool, ...], count: int, device_time_s: float, host_time_s: float, alert: str = ""
) -> list[ToolPose]:
    """One ToolPose for every tool of the set-up; handles that nobody set up are left out.

    Parameters
    ----------
    count : int
        Frame number of the newest handle, unwrapped.
    device_time_s : float
        The device's own clock at that frame.
    host_time_s : float
        Monotonic time at which the reply was whole.
    alert : str
        Words about the whole device that every pose has to carry.
    """
    entries = {entry.handle: entry for entry in reply.handles}
    common = words.flags_in_words(reply.system_status, words.SYSTEM_FLAGS) + ((alert,) if alert else ())
    barred = bool(reply.system_status & words.SYSTEM_BARS_USE)
    newest = count % 2**32
    poses = []
    for tool in tools:
        status, matrix, error_mm, flags = _judge(entries.get(tool.handle), newest)
        if barred and matrix is not None:
            status, matrix = PoseStatus.INVALID, None
        poses.append(
            ToolPose(tool.name, matrix, status, host_time_s, device_time_s, count, error_mm, tuple(dict.fromkeys(flags + common)))
        )
    return poses


def missing_poses(tools: tuple[Tool, ...], host_time_s: float, *flags: str) -> list[ToolPose]:
    """Every tool missing, and why."""
    return [ToolPose(tool.name, None, PoseStatus.MISSING, host_time_s, flags=flags) for tool in tools]


def _judge(entry: Optional[HandleData], newest_frame: int) -> tuple[PoseStatus, Optional[Array], float, tuple[str, ...]]:
    """Status, pose, error and flags of one handle."""
    none = float("nan")
    if entry is None:
        return PoseStatus.MISSING, None, none, ("not reported by the tracker",)
    if entry.state is HandleState.DISABLED:
        return PoseStatus.MISSING, None, none, ("disabled",)
    if entry.state is HandleState.UNOCCUPIED:
        return PoseStatus.MISSING, None, none, ("unplugged",)
    port, info = entry.port_status or 0, entry.tool_info or 0
    flags = words.flags_in_words(port, words.PORT_FLAGS) + words.flags_in_words(info, words.TOOL_FLAGS)
    if entry.pose is None:
        return PoseStatus.MISSING, None, none, flags
    if entry.frame != newest_frame:
        return PoseStatus.MISSING, None, none, (*flags, "not measured in this frame")
    problem = _problem(entry.pose)
    if problem or port & words.PORT_BARS_USE or info & words.TOOL_BARS_USE or not port & words.ENABLED:
        return PoseStatus.INVALID, None, none, (*flags, *((problem,) if problem else ()))
    outside = port & (words.OUT_OF_VOLUME | words.PARTLY_OUT)
    return PoseStatus.OUT_OF_VOLUME if outside else PoseStatus.OK, _matrix(entry.pose), entry.pose.error_mm, flags


def _problem(pose: RawPose) -> str:
    """Why these numbers are no pose; empty if they are one."""
    if abs(math.sqrt(sum(value * value for value in pose.quaternion)) - 1.0) > QUATERNION_TOLERANCE:
        return "not a rotation"
    if max(abs(value) for value in pose.translation_mm) > FARTHEST_MM:
        return "impossibly far away"
    return "impossible error" if pose.error_mm < 0.0 else ""


def _matrix(pose: RawPose) -> Array:
    """The 4x4 transform of a pose; the quaternion is brought to length 1 first."""
    q0, qx, qy, qz = pose.quaternion
    scale = 2.0 / (q0 * q0 + qx * qx + qy * qy + qz * qz)
    x, y, z = pose.translation_mm
    return np.array(
        (
            (1 - scale * (qy * qy + qz * qz), scale * (qx * qy - q0 * qz), scale * (qx * qz + q0 * qy), x),
            (scale * (qx * qy + q0 * qz), 1 - scale * (qx * qx + qz * qz), scale * (qy * qz - q0 * qx), y),
            (scale * (qx * qz - q0 * qy), scale * (qy * qz + q0 * qx), 1 - scale * (qx * qx + qy * qy), z),
            (0.0, 0.0, 0.0, 1.0),
        )
    )
