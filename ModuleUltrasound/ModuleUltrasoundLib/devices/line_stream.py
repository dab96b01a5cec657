"""RF lines from a device's thread to the main thread, each with the probe's pose at its transmit pulse."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Callable, Optional

import numpy as np
from CranioNavLib.device_stream import READ_S, DeviceStream
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Acquisition, Recording
from ModuleTrackingLib.pose_history import PoseHistory
from ModuleTrackingLib.tracker import PoseStatus, ToolPose

from ModuleUltrasoundLib.devices.device import AModeDevice, DeviceError, RfLine

QUEUE_LINES = 2048  # ten seconds at 200 lines a second: longer than any redraw blocks the main thread
LONGEST_WAIT_S = 0.3  # a line waits so long for the pose after it: longer than redraws keep the poses from being taken over


@dataclass(frozen=True)
class LineStreamState:
    """How the device is doing."""

    connected: bool
    problem: str  # in words; empty while connected
    lines: int  # lines taken over so far
    dropped_lines: int  # lines that the queue had no room for


@dataclass(frozen=True, eq=False)
class PosedLine:
    """One line and where the probe was when it was sent."""

    line: RfLine
    pose: ToolPose  # ProbeToReference at the transmit pulse; its status says why there is none
    palpation_point: int


class LineStream(DeviceStream):
    """An A-mode device read in a thread of its own; `poll`, on the main thread, takes the lines over.

    A device that fails is opened again. What it refuses (InputError) ends the stream and is raised by `poll`.
    """

    def __init__(self, device: AModeDevice, queue_lines: int = QUEUE_LINES) -> None:
        super().__init__(device, DeviceError, f"amode-{device.name}")
        self.device, self.acquisition = device, Acquisition(0.0, 0.0)  # the real one is known once connected
        self._queue: deque[RfLine] = deque()
        self._queue_lines = queue_lines
        self._error: Optional[BaseException] = None
        self._lines = self._dropped = 0

    def poll(self) -> list[RfLine]:
        """The lines that came since the last call, in order.

        Raises
        ------
        InputError
            The device refuses its settings.
        Exception
            A defect in the device's plugin, as it was raised there.
        """
        with self._lock:
            lines, error = list(self._queue), self._error
            self._queue.clear()
            self._error = None
        self._lines += len(lines)
        if error is not None:
            raise error
        return lines

    @property
    def state(self) -> LineStreamState:
        """How the device is doing now."""
        with self._lock:
            return LineStreamState(self._connected, self._problem, self._lines, self._dropped)

    def _opened(self, again: bool) -> None:
        self.acquisition = self.device.acquisition
        self._say(True, "")

    def _read(self) -> None:
        line = self.device.read(READ_S)
        if line is not None:
            self._put(line)

    def _lost(self, problem: str, error: Optional[BaseException] = None) -> None:
        self._say(False, problem, error)

    def _say(self, connected: bool, problem: str, error: Optional[BaseException] = None) -> None:
        with self._lock:
            self._connected, self._problem, self._error = connected, problem, error

    def _put(self, line: RfLine) -> None:
        with self._lock:
            if len(self._queue) >= self._queue_lines:
                self._queue.popleft()  # the oldest goes: what is new matters
                self._dropped += 1
            self._queue.append(line)


class LinePoser:
    """Gives each line the probe's pose at its transmit pulse; a line waits a moment for the pose after it.

    Feed it with `add_pose` and `add_line`, from one thread; take what is ready with `ready`.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._history = PoseHistory("Probe")
        self._waiting: deque[tuple[RfLine, int]] = deque()
        self._clock = clock

    def add_pose(self, probe_to_reference: Optional[Array], status: str, host_time_s: float) -> None:
        """ProbeToReference (4, 4) taken at `host_time_s`, or None with the status that says why."""
        known = status if status in PoseStatus.__members__ else PoseStatus.INVALID.value
        self._history.add(ToolPose("Probe", probe_to_reference, PoseStatus(known), host_time_s))

    def add_line(self, line: RfLine, palpation_point: int = -1) -> None:
        """A line, and which point of the protocol the user was on."""
        self._waiting.append((line, palpation_point))

    def ready(self, everything: bool = False) -> list[PosedLine]:
        """Lines whose pose will not change by waiting, in order."""
        posed = []
        while self._waiting:
            line, point = self._waiting[0]
            waited_s = self._clock() - line.host_time_s
            if not everything and waited_s < LONGEST_WAIT_S and not self._history.covers(line.host_time_s):
                break
            self._waiting.popleft()
            posed.append(PosedLine(line, self._history.at(line.host_time_s), point))
        return posed


def recording_of(posed: Sequence[PosedLine], acquisition: Acquisition) -> Recording:
    """Posed lines as a recording in memory, for `measure_lines`. Times count from the first line.

    Raises
    ------
    InputError
        No lines, or lines of different lengths.
    """
    if not posed:
        raise InputError("no lines have been taken yet; hold the probe on the head")
    if len({len(item.line.samples) for item in posed}) > 1:
        raise InputError("the device changed the length of its lines while it was read; connect again and take them anew")
    nowhere = np.full((4, 4), np.nan)
    matrices = [item.pose.tool_to_tracker if item.pose.usable else None for item in posed]
    return Recording(
        lines=np.stack([item.line.samples for item in posed]),
        acquisition=acquisition,
        probe_to_reference=np.stack([nowhere if matrix is None else matrix for matrix in matrices]),
        statuses=tuple("OK" if item.pose.usable else status_word(item.pose.status) for item in posed),
        timestamps_s=np.array([item.line.host_time_s - posed[0].line.host_time_s for item in posed]),
        palpation_points=np.array([item.palpation_point for item in posed], dtype=np.int64),
    )


def status_word(status: PoseStatus) -> str:
    """Why a line has no pose, as recordings say it."""
    return "MISSING" if status in (PoseStatus.STALE, PoseStatus.OK) else status.value
