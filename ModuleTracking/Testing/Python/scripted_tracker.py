"""A tracker that says what a test tells it to."""

from __future__ import annotations

import queue
import time
from typing import Callable, Union

import numpy as np
from CranioNavLib.rigid import rigid
from ModuleTrackingLib.tracker import PoseStatus, ToolInfo, ToolPose, Tracker
from scipy.spatial.transform import Rotation

Step = Union[list[ToolPose], BaseException, Callable[[], list[ToolPose]]]


def a_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rigid(Rotation.random(random_state=seed).as_matrix(), rng.normal(0, 200, 3))


def ok(tool: str, matrix: np.ndarray, time_s: float, device_s: float = float("nan"), error_mm: float = 0.1) -> ToolPose:
    return ToolPose(tool, matrix, PoseStatus.OK, time_s, device_s, error_mm=error_mm)


def missing(tool: str, time_s: float) -> ToolPose:
    return ToolPose(tool, None, PoseStatus.MISSING, time_s)


class ScriptedTracker(Tracker):
    """`put` gives it frames, or exceptions to raise from read; `fail_open` is raised by open while it is set."""

    name = "scripted"

    def __init__(self) -> None:
        super().__init__()
        self.script: queue.Queue[Step] = queue.Queue()
        self.fail_open: BaseException | None = None
        self.opened = self.closed = 0

    def put(self, step: Step) -> None:
        self.script.put(step)

    def open(self) -> None:
        self.opened += 1
        if self.fail_open is not None:
            raise self.fail_open

    def start(self) -> None:
        pass

    def read(self, timeout_s: float = 1.0) -> list[ToolPose]:
        try:
            step = self.script.get(timeout=min(timeout_s, 0.02))
        except queue.Empty:
            return []
        if isinstance(step, BaseException):
            raise step
        return step() if callable(step) else step

    def stop(self) -> None:
        pass

    def close(self) -> None:
        self.closed += 1

    @property
    def tools(self) -> list[ToolInfo]:
        return [ToolInfo("Probe"), ToolInfo("Reference")]


def wait_until(condition: Callable[[], object], timeout_s: float = 10.0) -> None:
    """Go on when the condition holds; fail when it does not in time."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.002)
