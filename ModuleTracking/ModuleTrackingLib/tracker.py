"""The tracker plugin kind: what a tracker is asked, and the pose that it answers with."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from enum import Enum
from typing import Optional

from CranioNavLib.device_plugin import DevicePlugin
from CranioNavLib.plugins import PluginKind
from CranioNavLib.rigid import Array


class PoseStatus(str, Enum):
    """Why a tool has a pose, or has none. The words are those of PLUS sequence files."""

    OK = "OK"
    MISSING = "MISSING"
    OUT_OF_VOLUME = "OUT_OF_VOLUME"  # seen, but where the maker promises no accuracy
    INVALID = "INVALID"  # seen, but the device or a check says not to use it
    STALE = "STALE"  # no news for longer than the staleness limit


@dataclass(frozen=True, eq=False)
class ToolPose:
    """One tool in one frame of the tracker. A tool without a trustworthy pose has None, never an old pose."""

    tool: str  # "Probe", "Stylus", "Reference", "Sphere"
    tool_to_tracker: Optional[Array]  # (4, 4), mm; None unless the status is OK or OUT_OF_VOLUME
    status: PoseStatus
    host_time_s: float  # time.monotonic() clock of this computer at arrival
    device_time_s: float = float("nan")  # the tracker's own clock, from its frame number
    frame_number: int = -1
    error_mm: float = float("nan")  # the tracker's own RMS fit error
    flags: tuple[str, ...] = ()  # in words: "partly out of volume", "interference", ...

    @property
    def usable(self) -> bool:
        """Whether navigation may use this pose."""
        return self.status is PoseStatus.OK and self.tool_to_tracker is not None


@dataclass(frozen=True)
class ToolInfo:
    """A tool that a tracker knows."""

    name: str
    part_number: str = ""
    serial_number: str = ""
    detail: str = ""
    definition: str = ""  # fingerprint of the file that says where its markers are, where the host has it


def tool_id(tool: str, tools: list[ToolInfo]) -> str:
    """What tells a tool from another of its name: part and serial number, and a fingerprint of its definition file."""
    info = next((info for info in tools if info.name == tool), ToolInfo(tool))
    return " ".join(text for text in (info.part_number, info.serial_number, info.definition) if text) or tool


class Tracker(DevicePlugin):
    """Base of tracker plugins. `with tracker:` opens, starts and always closes.

    All methods are called from one thread. They raise `TrackerError` for what the device does and
    `InputError` for what the user gave.
    """

    @abstractmethod
    def read(self, timeout_s: float = 1.0) -> list[ToolPose]:
        """The next frame: one ToolPose for every tool, missing ones included; empty if none came in time."""

    @property
    @abstractmethod
    def tools(self) -> list[ToolInfo]:
        """The tools known after `open`."""


class TrackerError(RuntimeError):
    """The tracker failed or was lost; the message says what happened and what to do."""


TRACKERS: PluginKind[Tracker] = PluginKind("tracker", Tracker, folder="ModuleTrackingLib.plugins")  # type: ignore[type-abstract]
