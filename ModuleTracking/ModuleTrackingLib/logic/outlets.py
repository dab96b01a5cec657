"""The last two steps: what is tracked, shared with other programs over OpenIGTLink and recorded into a file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Optional

from CranioNavLib import scene, scene_data
from CranioNavLib.panel import Level, Reading

from ModuleTrackingLib.logic.tools import ToolsStep
from ModuleTrackingLib.recorder import SessionRecorder
from ModuleTrackingLib.tracker import ToolPose

if TYPE_CHECKING:
    from ModuleTrackingLib.sharing import Sharing


class OutletSteps(ToolsStep):
    """Sharing and recording."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self._recorder: Optional[SessionRecorder] = None
        self._sharing: Optional[Sharing] = None

    def handOn(self, frames: list[list[ToolPose]]) -> None:
        """Frames to the file and to those who listen."""
        if self._recorder is not None:
            self._recorder.add_frames(frames)
        if self._sharing is not None:
            self._sharing.add_frames(frames)
            node = scene.find("ReferenceToRas")
            registered = node is not None and bool(node.GetAttribute(scene.STATUS_ATTRIBUTE))
            self._sharing.add_transform("ReferenceToRas", scene_data.get_transform("ReferenceToRas") if registered else None)

    # Sharing

    def startSharing(self) -> str:
        """Serve what is tracked over OpenIGTLink, on this computer only. Returns a message."""
        from ModuleTrackingLib.sharing import Sharing

        self._sharing = Sharing(self.parameters().read().share_port)
        return f"OpenIGTLink at {self._sharing.address}"

    def startSharingBlocked(self) -> str:
        """Why nothing can be shared now."""
        return self.notConnected() or ("already shared" if self._sharing is not None else "")

    def stopSharing(self) -> None:
        """Close the server."""
        if self._sharing is not None:
            self._sharing.close()
            self._sharing = None

    def stopSharingBlocked(self) -> str:
        """Why there is no server to close."""
        return "" if self._sharing is not None else "not shared"

    def sharing(self) -> Optional[Reading]:
        """Who listens."""
        return Reading(self._sharing.words(), Level.GOOD) if self._sharing is not None else None

    # Recording

    def startRecording(self) -> str:
        """Record all tools into `recording_path`. Returns a message."""
        path = self.parameters().read().recording_path
        self._recorder = SessionRecorder(path, self.running)
        return f"recording into {path}"

    def startRecordingBlocked(self) -> str:
        """Why nothing can be recorded now."""
        if self._recorder is not None:
            return "already recording"
        return self.notConnected() or ("" if self.parameters().read().recording_path else "choose a file first")

    def stopRecording(self) -> str:
        """Finish the recording. Returns a message."""
        if self._recorder is None:
            return ""
        recorder, self._recorder = self._recorder, None
        recorder.close()
        return f"{recorder.state.frames} frames in {recorder.state.path}"

    def stopRecordingBlocked(self) -> str:
        """Why there is no recording to stop."""
        return "" if self._recorder is not None else "not recording"

    def recording(self) -> Optional[Reading]:
        """What has been recorded so far."""
        if self._recorder is None:
            return None
        state = self._recorder.state
        return Reading(f"{state.frames} frames, {state.seconds:.1f} s, {state.without_probe} without the probe")
