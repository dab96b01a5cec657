"""What we track, published over OpenIGTLink for 3D Slicer, PlusServer clients and anybody else."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.openigtlink import IgtlServer
from CranioNavLib.openigtlink.messages import Status, TrackedTool, TrackingData, Transform, a_line_image
from CranioNavLib.rigid import Array, check_rigid

from ModuleTrackingLib.recorder import named_transforms
from ModuleTrackingLib.tracker import ToolPose

OK, NOT_FOUND = 1, 4  # STATUS codes


class Publisher:
    """Puts poses, registrations and A-lines on an IgtlServer.

    A transform without a trustworthy pose is not sent at all: a client cannot tell a repeated old one from a live one.
    STATUS says which are missing, at once when that changes and then as the server's keep-alive.
    """

    def __init__(self, server: IgtlServer) -> None:
        self.server = server
        self._missing: Optional[str] = None

    def publish_poses(self, poses: Mapping[str, ToolPose]) -> None:
        """One frame: `<Tool>ToReference` and `<Tool>ToTracker` of every tool, and TDATA for those who asked.

        Parameters
        ----------
        poses : mapping
            Tool to its pose, all of one time on the time.monotonic() clock (as PoseStream gives them).
        """
        transforms, statuses = named_transforms(poses)
        time_s = unix_time_s(next((pose.host_time_s for pose in poses.values()), time.monotonic()))
        tools = []
        for name, matrix in transforms.items():
            if matrix is not None:
                self.server.publish(Transform(name, time_s, matrix=matrix))
                tools.append(TrackedTool(name, matrix))
        self.server.publish_tracking(TrackingData(self.server.device, time_s, tools=tuple(tools)))
        missing = ", ".join(f"{name} {statuses[name]}" for name, matrix in transforms.items() if matrix is None)
        if missing != self._missing:
            self._missing = missing
            self.server.status = Status(self.server.device, code=NOT_FOUND if missing else OK, text=missing)
            self.server.publish(Status(self.server.device, time_s, code=NOT_FOUND if missing else OK, text=missing))

    def publish_transform(self, name: str, matrix: npt.ArrayLike) -> None:
        """One transform by its name, e.g. `ReferenceToRas` when the registration changed.

        Raises
        ------
        InputError
            The matrix is not rigid, or the name longer than 20 bytes.
        """
        rigid: Array = check_rigid(matrix, name)
        self.server.publish(Transform(name, time.time(), matrix=rigid))

    def publish_line(self, samples: npt.NDArray[np.int16], host_time_s: float, spacing_mm: Optional[float] = None) -> None:
        """One RF line as IMAGE `ALine`, N x 1 x 1, int16; `host_time_s` on the time.monotonic() clock."""
        self.server.publish(a_line_image("ALine", samples, unix_time_s(host_time_s), spacing_mm))


def unix_time_s(host_time_s: float) -> float:
    """A time of the time.monotonic() clock as Unix time."""
    return host_time_s + time.time() - time.monotonic()
