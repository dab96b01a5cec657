"""A simulated optical tracker: it sees the tools of the simulated session, with noise and with faults on request."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.phantom.hand_round import go_round
from CranioNavLib.phantom.session import TOOLS, SimulatedSession
from CranioNavLib.phantom.simulated_device import Head, SimulatedDevice

from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, ToolInfo, ToolPose, Tracker, TrackerError


class Hand(str, Enum):
    """Who moves the tools."""

    TOLD = "told"  # whoever drives the session; until then all lie out of view
    ROUND = "round"  # they go round on the head by themselves


@dataclass(frozen=True)
class SimulatedTrackerSettings(Parameters):
    rate_hz: Annotated[float, Limits(1, 1000), "frames a second; an NDI Vicra gives 20, a Spectra 60"] = 60.0
    noise: Annotated[float, Limits(0, 100), "scale of the tracking error; 1: a typical passive optical tracker"] = 1.0
    calibrated: Annotated[bool, "report tool tips; otherwise the marker frames, whose tips calibration has to find"] = True
    missing_tools: Annotated[str, "tools that the camera does not see, with commas: Stylus,Sphere"] = ""
    missing_share: Annotated[float, Limits(0, 1), "share of frames in which a tool is lost, each tool by itself"] = 0.0
    fail_after_s: Annotated[Optional[float], Limits(0, 1e6), "the link breaks after this time; not given: never"] = None
    hand: Annotated[Hand, "told: the tools move as the session says; round: from place to place by themselves"] = Hand.TOLD
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

    def start(self) -> None:
        """Begin to measure, and to move the tools if nobody else does."""
        super().start()
        session = self._joined()
        if self.settings.hand is Hand.ROUND and not session.playing:
            go_round(session)

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
        origin = "tip" if self.settings.calibrated else "marker"  # a calibration of the one must not be used for the other
        return [] if self._session is None else [ToolInfo(name, "simulated", f"S-{name}", "simulated", origin) for name in TOOLS]

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
