"""A simulated optical tracker: it sees the tools of the simulated session, with noise and with faults on request."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.phantom.session import TOOLS, SimulatedSession, current_session

from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, ToolInfo, ToolPose, Tracker, TrackerError


class Head(str, Enum):
    """Which head lies on the simulated table, if no session runs yet."""

    SAMPLE = "sample"
    SYNTHETIC = "synthetic"


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
class SimulatedTracker(Tracker):
    """The tracker of the simulated session (see CranioNavLib.phantom.session)."""

    name = "simulated"
    title = "Simulated optical tracker and patient"
    Settings = SimulatedTrackerSettings

    def __init__(self, settings: Optional[Parameters] = None) -> None:
        super().__init__(settings)
        self._hidden = {name.strip() for name in self.settings.missing_tools.split(",") if name.strip()}
        unknown = self._hidden - set(TOOLS)
        if unknown:
            raise InputError(f"parameter missing_tools: no tool {', '.join(sorted(unknown))}; tools are {', '.join(TOOLS)}")
        self._session: Optional[SimulatedSession] = None
        self._rng = np.random.default_rng([self.settings.seed, 0x7C])
        self._begin_s: Optional[float] = None  # not None: tracking
        self._frame = 0

    def open(self) -> None:
        """Join the simulated session.

        Raises
        ------
        InputError
            The sample head is wanted and cannot be had.
        """
        self._session = current_session(self.settings.head.value, self.settings.seed)

    def start(self) -> None:
        """Begin tracking.

        Raises
        ------
        TrackerError
            It is not open.
        """
        if self._session is None:
            raise TrackerError("the simulated tracker is not open; open it first")
        self._begin_s, self._frame = self._session.clock.now(), 0

    def read(self, timeout_s: float = 1.0) -> list[ToolPose]:
        """The next frame, when it is due.

        Raises
        ------
        TrackerError
            It was not started, or the simulated link broke.
        """
        if self._session is None or self._begin_s is None:
            raise TrackerError("the simulated tracker is not tracking; start it first")
        clock, period = self._session.clock, 1 / self.settings.rate_hz
        limit = self.settings.fail_after_s
        if limit is not None and clock.now() - self._begin_s >= limit:
            raise TrackerError("the link to the simulated tracker broke; open it again")
        # frames that nobody fetched in time are gone, as with a real device
        self._frame = max(self._frame + 1, int(np.ceil((clock.now() - self._begin_s) / period - 1e-6)))
        due = self._begin_s + self._frame * period
        if due - clock.now() > timeout_s:
            clock.wait_until(clock.now() + timeout_s)
            self._frame -= 1
            return []
        clock.wait_until(due)
        return self._poses(self._session, due)

    def stop(self) -> None:
        """End tracking."""
        self._begin_s = None

    def close(self) -> None:
        """Leave the session; it goes on for the other simulated device."""
        self._begin_s = self._session = None

    @property
    def tools(self) -> list[ToolInfo]:
        return [] if self._session is None else [ToolInfo(name, "simulated", f"S-{name}", "simulated") for name in TOOLS]

    def _poses(self, session: SimulatedSession, time_s: float) -> list[ToolPose]:
        assert self._begin_s is not None
        seen = session.reported_poses(time_s, self.settings.noise, self.settings.calibrated)
        device_s = time_s - self._begin_s
        poses = []
        for name in TOOLS:
            pose = seen[name]
            if name in self._hidden or self._rng.random() < self.settings.missing_share:
                pose = None
            status = PoseStatus.OK if pose is not None else PoseStatus.MISSING
            flags = () if pose is not None else ("not seen by the camera",)
            poses.append(ToolPose(name, pose, status, time_s, device_s, self._frame, float("nan"), flags))
        return poses
