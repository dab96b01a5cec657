"""Tools from any OpenIGTLink server (PlusServer, 3D Slicer, another CranioNav): TRANSFORM, TDATA, QTDATA, POSITION."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Annotated, Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.openigtlink import IgtlClient
from CranioNavLib.openigtlink.bodies import pose_matrix
from CranioNavLib.openigtlink.messages import Message, Position, Rejected, StartTracking, TrackingData, Transform
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array, check_rigid

from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, ToolInfo, ToolPose, Tracker, TrackerError

REFERENCE = "Reference"
GROUP_S = 0.004  # messages of one tracker frame follow each other at once; at 250 Hz the next frame is 4 ms away
MISSING_AFTER_S = 0.2  # a peer does not send a missing tool: without news for so long it is reported MISSING


@dataclass(frozen=True)
class OpenIGTLinkSettings(Parameters):
    host: Annotated[str, "name or address of the server"] = "127.0.0.1"
    port: Annotated[int, Limits(1, 65535), "TCP port"] = 18944
    frame: Annotated[str, "frame of the poses: the part after To in ProbeToTracker"] = "Tracker"
    request_tdata: Annotated[bool, "ask for tracking data (STT_TDATA); PlusServer sends TDATA only then"] = False
    connect_timeout_s: Annotated[float, Limits(0.1, 60), "longest wait for the server when opening"] = 3.0
    silence_s: Annotated[float, Limits(0.1, 60), "a server heard nothing of for so long counts as lost"] = 2.0


@TRACKERS.register
class OpenIGTLinkTracker(Tracker):
    """Client of an OpenIGTLink server. A message whose checksum is wrong never becomes a pose; it is counted.

    The version 1 protocol has no word for a missing tool: servers just stop sending it. So a tool is left out of `read`
    until 0.2 s have passed without news, then it is reported MISSING. When the frame is `Reference`, the server has
    applied the reference base already, and Reference is reported with the identity for as long as tools arrive.
    """

    name = "openigtlink"
    title = "OpenIGTLink client (PlusServer, 3D Slicer)"
    Settings = OpenIGTLinkSettings

    def __init__(self, settings: Optional[Parameters] = None) -> None:
        super().__init__(settings)
        if not self.settings.frame.isidentifier():
            raise InputError(f"openigtlink: frame is {self.settings.frame!r}; expected a name such as Tracker or Reference")
        self._client: Optional[IgtlClient] = None
        self._seen: dict[str, float] = {}  # tool -> time.monotonic() of its last news, missing included
        self._waiting: list[ToolPose] = []  # of the frame that is not complete yet
        self.refused_poses = 0  # poses that were not rigid

    @property
    def rejected(self) -> int:
        """Messages that were not believed: wrong checksum or a body that does not fit."""
        return self._client.rejected if self._client else 0

    @property
    def crc_errors(self) -> int:
        """Messages whose checksum was wrong."""
        return self._client.crc_errors if self._client else 0

    def open(self) -> None:
        """Connect, and wait for the first tools.

        Raises
        ------
        TrackerError
            Nobody answers.
        """
        settings = self.settings
        greetings = (StartTracking("CranioNav", time.time(), coordinate_name="Tracker"),) if settings.request_tdata else ()
        self._client = IgtlClient(settings.host, settings.port, settings.silence_s, greetings)
        deadline = time.monotonic() + settings.connect_timeout_s
        while not self._seen and time.monotonic() < deadline:
            for message in self._client.receive(0.1):
                self._waiting += self._poses_of(message, time.monotonic())
        if not self._client.connected:
            raise TrackerError(f"OpenIGTLink: {self._client.problem}")

    def start(self) -> None:
        """The server sends by itself."""

    def read(self, timeout_s: float = 1.0) -> list[ToolPose]:
        """The next frame: the tools of one time stamp, and those that have gone missing.

        Raises
        ------
        TrackerError
            The server closed the connection, or is silent; open again.
        """
        client = self._client
        if client is None:
            raise TrackerError("OpenIGTLink: not open")
        deadline = time.monotonic() + timeout_s
        while not self._complete():
            left = deadline - time.monotonic()
            messages = client.receive(max(min(left, GROUP_S if self._waiting else left), 0.0))
            for message in messages:
                self._waiting += self._poses_of(message, client.arrival_s)
            if not client.connected or client.silent:
                raise TrackerError(f"OpenIGTLink: {client.problem}")
            if not messages and (self._waiting or left <= 0):
                break
        return self._take_frame() + self._gone_missing()

    def stop(self) -> None:
        """The server is not asked to stop: others may listen."""

    def close(self) -> None:
        """Disconnect."""
        if self._client is not None:
            self._client.close()
        self._waiting.clear()
        self._seen.clear()

    @property
    def tools(self) -> list[ToolInfo]:
        return [ToolInfo(name, detail=f"{name}To{self.settings.frame}") for name in self._seen]

    def _poses_of(self, message: Message, arrival_s: float) -> list[ToolPose]:
        if isinstance(message, Rejected):
            return []
        if isinstance(message, Transform):
            found = [(message.device, message.matrix)]
        elif isinstance(message, TrackingData):
            found = [
                (tool.name if "To" in tool.name else f"{tool.name}To{self.settings.frame}", tool.matrix) for tool in message.tools
            ]
        elif isinstance(message, Position):
            try:
                found = [(message.device, pose_matrix(message.position_mm, message.quaternion_xyzw))]
            except ValueError:
                self.refused_poses += 1
                return []
        else:
            return []
        status = message.metadata.get("TransformStatus", "OK")
        return [pose for name, matrix in found for pose in self._pose(name, matrix, status, message.time_s, arrival_s)]

    def _pose(self, name: str, matrix: Array, status: str, sent_s: float, arrival_s: float) -> list[ToolPose]:
        ending = f"To{self.settings.frame}"
        if name.endswith(ending) and len(name) > len(ending):
            tool = name[: -len(ending)]
        elif "To" not in name:
            tool = name  # a plain tool name, as many servers send
        else:
            return []  # another frame, not ours to guess
        self._seen[tool] = arrival_s
        device_s = sent_s if sent_s > 0 else math.nan
        if status != "OK":
            known = status in PoseStatus.__members__
            word = PoseStatus(status) if known else PoseStatus.MISSING
            return [ToolPose(tool, None, word, arrival_s, device_s, flags=() if known else (status,))]
        try:
            rigid = check_rigid(matrix, name)
        except InputError as error:
            self.refused_poses += 1
            return [ToolPose(tool, None, PoseStatus.INVALID, arrival_s, device_s, flags=(str(error),))]
        return [ToolPose(tool, rigid, PoseStatus.OK, arrival_s, device_s)]

    def _complete(self) -> bool:
        """Whether all tools that are about have come, or a pose of the next frame has: nothing more to wait for."""
        if not self._waiting:
            return False
        about = {tool for tool, seen_s in self._seen.items() if time.monotonic() - seen_s < MISSING_AFTER_S}
        return self._frame_size() < len(self._waiting) or about <= {pose.tool for pose in self._waiting}

    def _frame_size(self) -> int:
        tools: set[str] = set()
        for index, pose in enumerate(self._waiting):
            first = self._waiting[0].device_time_s
            same = pose.device_time_s == first or (math.isnan(pose.device_time_s) and math.isnan(first))
            if pose.tool in tools or not same:
                return index
            tools.add(pose.tool)
        return len(self._waiting)

    def _take_frame(self) -> list[ToolPose]:
        size = self._frame_size()
        frame, self._waiting = self._waiting[:size], self._waiting[size:]
        if frame and self.settings.frame == REFERENCE and all(pose.tool != REFERENCE for pose in frame):
            frame.append(ToolPose(REFERENCE, np.eye(4), PoseStatus.OK, frame[0].host_time_s, frame[0].device_time_s))
        return frame

    def _gone_missing(self) -> list[ToolPose]:
        now = time.monotonic()
        gone = [tool for tool, seen_s in self._seen.items() if now - seen_s > MISSING_AFTER_S]
        for tool in gone:
            self._seen[tool] = now
        return [ToolPose(tool, None, PoseStatus.MISSING, now, flags=("the server sends no pose of it",)) for tool in gone]
