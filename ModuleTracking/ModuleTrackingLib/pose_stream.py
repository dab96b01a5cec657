"""Poses from a tracker's thread to the main thread: bounded, timed, and never stale without saying so."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Callable, Optional

from CranioNavLib.device_stream import READ_S, DeviceStream
from CranioNavLib.rigid import Array

from ModuleTrackingLib.device_clock import ClockReport, DeviceClock
from ModuleTrackingLib.pose_history import LARGEST_GAP_S, PoseHistory
from ModuleTrackingLib.reference_base import REFERENCE, RelativePose, in_reference
from ModuleTrackingLib.tracker import PoseStatus, ToolInfo, ToolPose, Tracker, TrackerError

STALENESS_S = 0.2
QUEUE_FRAMES = 1024  # four seconds at 250 Hz: longer than any redraw blocks the main thread
RATE_WINDOW_S = 1.0


@dataclass(frozen=True)
class StreamState:
    """How the stream is doing, for a person and for the display."""

    connected: bool
    problem: str  # in words: what happened and what to do; empty while connected
    frames: int  # frames taken from the queue so far
    dropped_frames: int  # frames that the queue had no room for
    reconnections: int
    rate_hz: float  # frames a second over the last second
    clock: ClockReport


@dataclass(frozen=True)
class _Event:
    """What the device's thread hands over: a frame, or a change of the connection."""

    poses: tuple[ToolPose, ...] = ()
    connected: bool = True
    problem: str = ""
    error: Optional[BaseException] = None


class PoseStream(DeviceStream):
    """A tracker read in a thread of its own; everything else is for the main thread, after `poll`.

    Poses that leave the stream carry in `host_time_s` the time at which they were taken, on this computer's
    time.monotonic() clock: the device's clock is mapped to it (see DeviceClock).

    Parameters
    ----------
    tracker : Tracker
        It is opened, read and closed in the stream's thread alone, and opened again whenever it fails.
    calibrations : mapping
        Tool name to tool-to-marker transform (4, 4): from the calibrated tool frame to the one that the tracker reports.
    staleness_s : float
        Without news for so long a tool is STALE and has no pose.
    clock : callable
        The host's clock, in s.
    """

    def __init__(
        self,
        tracker: Tracker,
        calibrations: Optional[Mapping[str, Array]] = None,
        staleness_s: float = STALENESS_S,
        largest_gap_s: float = LARGEST_GAP_S,
        queue_frames: int = QUEUE_FRAMES,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(tracker, TrackerError, f"tracker-{tracker.name}")
        self.tracker, self.staleness_s, self.largest_gap_s = tracker, staleness_s, largest_gap_s
        self.calibrations = dict(calibrations or {})
        self.tools: list[ToolInfo] = []
        self._clock = clock
        self._device_clock = DeviceClock()
        self._queue_frames = queue_frames
        self._queue: deque[_Event] = deque()
        self._histories: dict[str, PoseHistory] = {}
        self._arrivals: deque[float] = deque()
        self._frames = self._dropped = self._reconnections = 0
        self._news = threading.Event()
        self.on_news: Callable[[], object] = bool  # called in the device's thread when there is something for `poll`

    # -- the main thread's side -------------------------------------------------------------------------------------

    def wait(self, timeout_s: float) -> bool:
        """Sleep until there is something for `poll` to take over, at most so long; whether there is."""
        return self._news.wait(timeout_s)

    def poll(self) -> list[list[ToolPose]]:
        """Take over what came since the last call: the frames in order, each a pose of every tool.

        Call it from the main thread at every display frame, then ask `current`, `pose_at` and `state`.

        Raises
        ------
        InputError
            The tracker refuses its settings; trying again would not help.
        Exception
            A defect in the tracker's plugin, as it was raised there.
        """
        with self._lock:
            events = list(self._queue)
            self._queue.clear()
            self._news.clear()
        frames: list[list[ToolPose]] = []
        for event in events:
            if event.error is not None:
                self._connected, self._problem = False, str(event.error)
                raise event.error
            if event.connected and not self._connected:
                self._device_clock.restart()
            self._connected, self._problem = event.connected, event.problem
            if not event.connected:
                self._lose_all(event.problem)
            elif event.poses:
                frames.append(self._take(event.poses))
        return frames

    def current(self, tool: str) -> ToolPose:
        """The tool now: its latest pose, or none with the reason (STALE after `staleness_s` without news)."""
        now = self._clock()
        history = self._histories.get(tool)
        latest = history.latest if history is not None else None
        if latest is None:
            return ToolPose(tool, None, PoseStatus.MISSING, now, flags=(self._problem or "not seen yet",))
        age = now - latest.host_time_s
        if age > self.staleness_s:
            return replace(latest, tool_to_tracker=None, status=PoseStatus.STALE, flags=(f"no news for {age:.1f} s",))
        return latest

    def is_live(self, tool: str) -> bool:
        """Whether the tool's latest news is a pose, and young enough to be shown."""
        history = self._histories.get(tool)
        latest = history.latest if history is not None else None
        return latest is not None and latest.usable and self._clock() - latest.host_time_s <= self.staleness_s

    def current_in_reference(self, tool: str) -> RelativePose:
        """The tool now, in the reference base's frame; without a pose when tool or base is lost or stale."""
        latest = self.current(tool)
        base = self.current(REFERENCE)
        if latest.usable and base.usable:
            base = self.pose_at(REFERENCE, latest.host_time_s) if base.host_time_s >= latest.host_time_s else base
            if base.usable and base.host_time_s < latest.host_time_s:  # the base's pose for this time is still to come
                latest = self.pose_at(tool, base.host_time_s)
        return in_reference(latest, replace(base, host_time_s=latest.host_time_s))

    def pose_at(self, tool: str, time_s: float) -> ToolPose:
        """The tool at a time of the host's clock, interpolated; without a pose across gaps and missing frames."""
        history = self._histories.get(tool)
        if history is None:
            return ToolPose(tool, None, PoseStatus.MISSING, time_s, flags=("not seen yet",))
        return history.at(time_s)

    def in_reference_at(self, tool: str, time_s: float) -> RelativePose:
        """The tool in the reference base's frame at a time of the host's clock."""
        return in_reference(self.pose_at(tool, time_s), self.pose_at(REFERENCE, time_s))

    def covers(self, time_s: float, tools: tuple[str, ...] = ()) -> bool:
        """Whether `pose_at` of these tools (default: all) at `time_s` would not change by waiting."""
        names = tools or tuple(self._histories)
        return bool(names) and all(name in self._histories and self._histories[name].covers(time_s) for name in names)

    def rate_hz(self, tool: str) -> float:
        """How often the tool was seen in the last second."""
        history = self._histories.get(tool)
        return history.rate_hz(self._clock()) if history is not None else 0.0

    @property
    def tool_names(self) -> tuple[str, ...]:
        """Tools that have been reported, seen or missing."""
        return tuple(self._histories)

    @property
    def state(self) -> StreamState:
        now = self._clock()
        while self._arrivals and self._arrivals[0] < now - RATE_WINDOW_S:
            self._arrivals.popleft()
        return StreamState(
            connected=self._connected,
            problem=self._problem,
            frames=self._frames,
            dropped_frames=self._dropped,
            reconnections=self._reconnections,
            rate_hz=len(self._arrivals) / RATE_WINDOW_S,
            clock=self._device_clock.report(),
        )

    def _take(self, poses: tuple[ToolPose, ...]) -> list[ToolPose]:
        self._frames += 1
        # One frame, one time: the tools of a frame share the device's clock reading.
        device_s = next((pose.device_time_s for pose in poses if pose.device_time_s == pose.device_time_s), float("nan"))
        arrival_s = min(pose.host_time_s for pose in poses)
        self._arrivals.append(arrival_s)
        common_s = self._device_clock.map(device_s, arrival_s)
        frame = []
        for pose in poses:
            same = pose.device_time_s == device_s or pose.device_time_s != pose.device_time_s
            time_s = common_s if same else common_s + (pose.device_time_s - device_s)
            matrix = pose.tool_to_tracker
            if matrix is not None and pose.tool in self.calibrations:
                matrix = matrix @ self.calibrations[pose.tool]
            taken = ToolPose(
                pose.tool, matrix, pose.status, time_s, pose.device_time_s, pose.frame_number, pose.error_mm, pose.flags
            )
            self._histories.setdefault(pose.tool, PoseHistory(pose.tool, self.largest_gap_s)).add(taken)
            frame.append(taken)
        return frame

    def _lose_all(self, problem: str) -> None:
        now = self._clock()
        for tool, history in self._histories.items():
            history.add(ToolPose(tool, None, PoseStatus.MISSING, now, flags=(problem,)))

    # -- the device thread's side -----------------------------------------------------------------------------------

    def _put(self, event: _Event) -> None:
        with self._lock:
            if len(self._queue) >= self._queue_frames:
                # The oldest frame goes: what is new matters. Changes of the connection are few and are kept.
                oldest = next((index for index, old in enumerate(self._queue) if old.poses), None)
                if oldest is not None:
                    del self._queue[oldest]
                    self._dropped += 1
            self._queue.append(event)
            self._news.set()
        self.on_news()

    def _opened(self, again: bool) -> None:
        self.tools = list(self.tracker.tools)
        self._reconnections += again
        self._put(_Event())

    def _read(self) -> None:
        poses = self.tracker.read(READ_S)
        if poses:
            self._put(_Event(poses=tuple(poses)))

    def _lost(self, problem: str, error: Optional[BaseException] = None) -> None:
        self._put(_Event(connected=False, problem=problem, error=error))
