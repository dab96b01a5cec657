"""A simulated optical tracker: it sees the tools of the simulated session, with noise and with faults on request."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.phantom.session import TOOLS, SimulatedSession
from CranioNavLib.phantom.simulated_device import Head, SimulatedDevice

from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, ToolInfo, ToolPose, Tracker, TrackerError


@dataclass(frozen=True)
class SimulatedTrackerSettings(Parameters):
    rate_hz: Annotated[float, Limits(1, 1000), "frames a second"] = 20.0
    noise: Annotated[float, Limits(0, 100), "scale of the tracking error; 1: a typical passive optical tracker"] = 1.0
    calibrated: Annotated[bool, "report tool tips; otherwise the marker frames, whose tips calibration has to find"] = True
    missing_tools: Annotated[str, "tools that the camera does not see, with commas: Stylus,Sphere"] = ""
    missing_share: Annotated[float, Limits(0, 1), "share of frames in which a tool is lost, each tool by itself"] = 0.0
    fail_after_s: Annotated[Optional[float], Limits(0, 1e6), "the link breaks after this time; not given: never"] = None
    head: Annotated[Head, "head on the table if no session runs yet"] = Head.SAMPLE
    seed: Annotated[int, Limits(0, 2**31), "of the session, if none runs yet, and of lost frames"] = 0


@TRACKERS.register
class SimulatedTracker(SimulatedDevice, Tracker):
    """The tracker of the simulated session (see CranioNavLib.phantom.session)."""

    name = "simulated"
    title = "Simulated optical tracker and patient"
    Settings = SimulatedTrackerSettings
    device, idle, failure = "simulated tracker", "is not tracking", TrackerError

    def __init__(self, settings: Optional[Parameters] = None) -> None:
        super().__init__(settings)
        self._hidden = {name.strip() for name in self.settings.missing_tools.split(",") if name.strip()}
        unknown = self._hidden - set(TOOLS)
        if unknown:
            raise InputError(f"parameter missing_tools: no tool {', '.join(sorted(unknown))}; tools are {', '.join(TOOLS)}")
        self._rng = np.random.default_rng([self.settings.seed, 0x7C])

    def read(self, timeout_s: float = 1.0) -> list[ToolPose]:
        """The next frame, when it is due.

        Raises
        ------
        TrackerError
            It was not started, or the simulated link broke.
        """
        session, begin_s = self._started()
        due = self._await_next(timeout_s)
        return [] if due is None else self._poses(session, due, due - begin_s)

    @property
    def tools(self) -> list[ToolInfo]:
        return [] if self._session is None else [ToolInfo(name, "simulated", f"S-{name}", "simulated") for name in TOOLS]

    def _poses(self, session: SimulatedSession, time_s: float, device_s: float) -> list[ToolPose]:
        seen = session.reported_poses(time_s, self.settings.noise, self.settings.calibrated)
        poses = []
        for name in TOOLS:
            pose = seen[name]
            if name in self._hidden or self._rng.random() < self.settings.missing_share:
                pose = None
            status = PoseStatus.OK if pose is not None else PoseStatus.MISSING
            flags = () if pose is not None else ("not seen by the camera",)
            poses.append(ToolPose(name, pose, status, time_s, device_s, self._number, float("nan"), flags))
        return poses
