"""An OpenIGTLink server fed by the pose stream: what we track, and the registration, for 3D Slicer and others."""

from __future__ import annotations

import time
from typing import Callable, Optional

import numpy as np
from CranioNavLib.openigtlink import IgtlServer
from CranioNavLib.rigid import Array

from ModuleTrackingLib.publisher import Publisher
from ModuleTrackingLib.tracker import ToolPose

REPEAT_S = 1.0  # a transform that does not change is said again: clients come at any time


class Sharing:
    """Server and publisher together; `close` ends both.

    Parameters
    ----------
    port : int
        0 takes a free one.
    host : str
        Loopback unless others are to see what is tracked: OpenIGTLink asks nobody who he is.

    Raises
    ------
    InputError
        The port is in use, or the host is none of this computer.
    """

    def __init__(self, port: int, host: str = "127.0.0.1", clock: Callable[[], float] = time.monotonic) -> None:
        self.server = IgtlServer(port, host)
        self.server.open()
        self.publisher = Publisher(self.server)
        self._clock = clock
        self._said: dict[str, tuple[float, Array]] = {}

    @property
    def address(self) -> str:
        """Where clients find it."""
        return f"{self.server.host}:{self.server.port}"

    def add_frames(self, frames: list[list[ToolPose]]) -> None:
        """Tracker frames as `PoseStream.poll` gave them."""
        for frame in frames:
            self.publisher.publish_poses({pose.tool: pose for pose in frame})

    def add_transform(self, name: str, matrix: Optional[Array]) -> None:
        """A transform that seldom changes, such as ReferenceToRas; None: there is none now."""
        if matrix is None:
            self._said.pop(name, None)
            return
        now = self._clock()
        said_s, said = self._said.get(name, (-np.inf, None))
        if now - said_s >= REPEAT_S or said is None or not np.array_equal(said, matrix):
            self._said[name] = now, matrix
            self.publisher.publish_transform(name, matrix)

    def words(self) -> str:
        """How it is doing, in one line."""
        clients = self.server.clients
        dropped = sum(client.dropped for client in clients)
        many = "1 client" if len(clients) == 1 else f"{len(clients)} clients"
        return f"{many} at {self.address}" + (f", {dropped} messages dropped for slow ones" if dropped else "")

    def close(self) -> None:
        """Say good-bye to all clients; may be called twice."""
        self.server.close()
