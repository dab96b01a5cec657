"""The tracker step: every tool's pose in the scene for as long as it is live, and what the panel says of it."""

from __future__ import annotations

from typing import Any, Optional

from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.module_logic import DeviceInScene
from CranioNavLib.panel import Level, Reading, StepStatus
from CranioNavLib.rigid import Array

from ModuleTrackingLib.panel_description import Tool, TrackingParameters
from ModuleTrackingLib.pose_stream import PoseStream
from ModuleTrackingLib.tracker import PoseStatus, ToolPose, TrackerError

TIP_HISTORY = 4096  # tip positions kept a tool: half a minute at 120 Hz
LEVELS = {PoseStatus.OK: Level.GOOD, PoseStatus.OUT_OF_VOLUME: Level.WARNING}


class ToolsStep(DeviceInScene[TrackingParameters, PoseStream]):
    """Tools in the scene; what every other step stands on."""

    parameterClass = TrackingParameters
    sessionRole = "TrackingSession"
    refusals = (TrackerError,)
    deviceWord = "tracker"

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.tips: dict[str, list[tuple[float, Array]]] = {}  # tool -> (time in s, ToolToReference) of the last frames

    def takeFrames(self) -> list[list[ToolPose]]:
        """The tracker's frames since the last call.

        Raises
        ------
        InputError
            The tracker refuses its settings; it is let go of.
        """
        try:
            return self.running.poll()
        except InputError as error:
            self.running.stop()
            self.stream, self.failure = None, str(error)
            raise

    def writeFrames(self, frames: list[list[ToolPose]]) -> list[tuple[str, Array]]:
        """Frames into the scene, each node written once, with the newest of them: nobody would see the others.

        Returns what was seen of the tools in all frames: ToolToReference (4, 4), by name, in order.
        """
        newest: dict[str, tuple[ToolPose, Array | None, PoseStatus]] = {}  # tool -> pose, ToolToReference, its status
        base, seen = None, []
        for pose in (pose for frame in frames for pose in frame):
            if pose.tool == "Reference" and pose.usable and pose.tool_to_tracker is not None:
                base = pose.tool_to_tracker
            if f"{pose.tool}ToReference" not in scene.ROLES:
                continue
            relative = self.running.in_reference_at(pose.tool, pose.host_time_s)
            matrix = relative.tool_to_reference if relative.usable else None
            newest[pose.tool] = pose, matrix, relative.status
            if matrix is not None:
                tips = self.tips.setdefault(pose.tool, [])
                tips.append((pose.host_time_s, matrix))
                del tips[:-TIP_HISTORY]
                seen.append((pose.tool, matrix))
        if base is not None:
            scene_data.set_transform("ReferenceToTracker", base)
        for tool, (pose, matrix, status) in newest.items():
            scene_data.set_pose(f"{tool}ToReference", matrix, status.value, pose.host_time_s)
        self._writeStale()
        return seen

    def _writeStale(self) -> None:
        """Tools without news lose their pose in the scene, too, even if others or old frames go on coming."""
        base = self.running.is_live("Reference")
        for tool in (tool.value for tool in Tool):
            if (base and self.running.is_live(tool)) or tool not in self.running.tool_names:
                continue
            current = self.running.current_in_reference(tool)
            if not current.usable and scene_data.get_pose(f"{tool}ToReference").status != current.status.value:
                scene_data.set_pose(f"{tool}ToReference", None, current.status.value, current.host_time_s)

    def loseTools(self) -> None:
        """Stop tracking; every tool is missing from now on."""
        if self.stream is not None:
            self.stream.stop()
            self.stream = None
            for name in Tool:
                scene_data.set_pose(f"{name.value}ToReference", None, PoseStatus.MISSING.value, 0.0)
        self.tips.clear()

    def restingTips(self, tool: str) -> list[Array]:
        """The tool's tips (3,) of the last `rest_s`, in Reference.

        Raises
        ------
        InputError
            The tool has no pose now.
        """
        current = self.running.current_in_reference(tool)
        if not current.usable:
            raise InputError(f"the {tool.lower()} has no pose ({current.reason}); show it to the camera and read the point again")
        since = current.host_time_s - self.parameters().read().rest_s
        return [pose[:3, 3] for taken, pose in self.tips.get(tool, []) if taken > since]

    def connection(self) -> Reading:
        """Connected and at which rate, or why not."""
        if self.stream is None:
            return self.whyNoConnection()
        state = self.stream.state
        if not state.connected:
            return Reading(state.problem, Level.WARNING)
        return Reading(f"{state.rate_hz:.0f} frames a second", Level.GOOD)

    def referenceTool(self) -> Optional[Reading]:
        """The reference base."""
        if self.stream is None:
            return None
        pose = self.stream.current("Reference")
        return Reading(", ".join(pose.flags) or pose.status.value, LEVELS.get(pose.status, Level.BAD))

    def probeTool(self) -> Optional[Reading]:
        """The probe."""
        return self._seen("Probe")

    def stylusTool(self) -> Optional[Reading]:
        """The stylus."""
        return self._seen("Stylus")

    def sphereTool(self) -> Optional[Reading]:
        """The sphere tool."""
        return self._seen("Sphere")

    def _seen(self, tool: str) -> Optional[Reading]:
        if self.stream is None:
            return None
        pose = self.stream.current_in_reference(tool)
        lost = Level.BAD if self.tips.get(tool) else Level.PLAIN  # one that has not been shown yet is not lost
        return Reading(pose.reason or pose.status.value, LEVELS.get(pose.status, lost))

    def trackerStatus(self) -> StepStatus:
        """Whether poses arrive."""
        return self.statusOfDevice()
