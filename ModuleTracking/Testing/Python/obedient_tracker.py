"""A tracker that does exactly what a test says, for the tracking module's logic; and its event loop."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from CranioNavLib import scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Parameters
from CranioNavLib.rigid import rigid, rigid_from_vector
from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, ToolInfo, ToolPose, Tracker, TrackerError

BASE = rigid_from_vector([0.2, -0.1, 0.4], [30, -40, 1500])  # ReferenceToTracker
TIP = np.array([1.0, -2.0, 120.0])  # of the stylus, in its marker's frame
DIVOT = np.array([40.0, 25.0, 10.0])  # in Reference


class Script:
    """What the scripted tracker sees; shared by test and plugin."""

    refuse = ""
    broken = False
    silent: tuple = ()  # tools that the tracker says nothing of, not even that they are missing
    tools: dict = {}  # tool -> ToolToReference, or a function of the frame's number  # noqa: RUF012


@TRACKERS.register
class ObedientTracker(Tracker):
    name = "scripted"
    title = "Scripted"

    @dataclass(frozen=True)
    class Settings(Parameters):
        pass

    def open(self):
        if Script.refuse:
            raise InputError(Script.refuse)
        self.frame = 0

    def start(self):
        pass

    def stop(self):
        pass

    def close(self):
        pass

    @property
    def tools(self):
        return [ToolInfo(name) for name in ("Reference", "Stylus", "Probe")]

    def read(self, timeout_s=1.0):
        time.sleep(0.004)
        if Script.broken:
            raise TrackerError("the cable fell out; plug it in")
        self.frame += 1
        now = time.monotonic()
        poses = [ToolPose("Reference", BASE, PoseStatus.OK, now, frame_number=self.frame)]
        if "Reference" in Script.silent:
            return []
        for name in {"Stylus", "Probe"}.difference(Script.silent):
            pose = Script.tools.get(name)
            pose = pose(self.frame) if callable(pose) else pose
            status = PoseStatus.OK if pose is not None else PoseStatus.MISSING
            poses.append(ToolPose(name, None if pose is None else BASE @ pose, status, now, frame_number=self.frame))
        return poses


def pivoting(frame):
    """The stylus' marker while its tip rests in the divot."""
    turn = rigid_from_vector([0.5 * np.sin(frame / 7), 0.5 * np.sin(frame / 11), 0.3 * np.sin(frame / 5)], np.zeros(3))
    return rigid(np.eye(3), DIVOT) @ turn @ rigid(np.eye(3), -TIP)


def still(place):
    """The stylus' marker while its tip rests there, a little differently in every frame."""
    return lambda frame: rigid(np.eye(3), np.asarray(place) - TIP + 0.01 * np.sin([frame, 2 * frame, 3 * frame]))


def run_until(logic, done, limit_s=10.0):
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        logic.poll()
        if done():
            return
        time.sleep(0.005)
    raise AssertionError("waited in vain")


def seen(tool="Stylus"):
    return lambda: scene_data.get_pose(f"{tool}ToReference").matrix is not None


def run_for(logic, seconds):
    end = time.monotonic() + seconds
    run_until(logic, lambda: time.monotonic() > end)


def read_point(logic):
    """Read the resting tip as a user does: try again while it is refused."""
    for _ in range(40):
        run_for(logic, 0.25)
        try:
            return logic.digitise()
        except InputError:
            continue
    return logic.digitise()
