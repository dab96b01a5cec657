"""A Polaris driver wired to an emulated device in the same process, with a clock that jumps."""

from __future__ import annotations

import math

import numpy as np
from ModuleTrackingLib.ndi.emulator.device import EmulatedPolaris, Model
from ModuleTrackingLib.ndi.emulator.loopback import JumpingClock, LoopbackPort
from ModuleTrackingLib.ndi.emulator.station import Station, make_faults
from ModuleTrackingLib.ndi.tracking import RawPose
from ModuleTrackingLib.plugins.polaris import PolarisTracker
from scipy.spatial.transform import Rotation

TOOLS = ("Reference", "Probe", "Stylus", "Sphere")


class CountingMotion:
    """Every pose tells which frame and tool it belongs to, so that a wrong or mixed-up one is found out."""

    def __init__(self, tools: tuple[str, ...] = TOOLS, rate_hz: float = 60.0) -> None:
        self.tools, self.rate_hz = tools, rate_hz

    def sample(self, time_s: float):
        number = max(0, math.floor(time_s * self.rate_hz + 1e-6))
        return number, {tool: self.pose(number, index) for index, tool in enumerate(self.tools)}

    @staticmethod
    def pose(number: int, index: int) -> RawPose:
        x, y, z, w = Rotation.from_rotvec([0.001 * (number % 3000), 0.3 * index, 0.2]).as_quat()
        place = (float(number % 1000), 100.0 * index + 50.0, -1000.0 - number // 1000 % 1000)
        return RawPose((float(w), float(x), float(y), float(z)), place, 0.1)


class Rig:
    """The driver, the device and the cable between them."""

    def __init__(self, faults=(), model=None, motion=None, has_break=True, paced=True, seed=0, **settings) -> None:
        self.clock = JumpingClock()
        self.motion = motion or CountingMotion()
        self.station = Station(EmulatedPolaris(self.motion, make_faults(list(faults), seed), model or Model()), paced)
        self.adapter_present = True
        self.has_break = has_break
        self.ports = 0
        self.states: list[tuple[float, str, str]] = []
        self.tracker = PolarisTracker(PolarisTracker.Settings.from_strings({"port": "rig", **settings}))
        self.tracker.clock, self.tracker.open_port = self.clock, self._open_port
        self.tracker.on_state = lambda state, message: self.states.append((self.clock.now(), state.value, message))

    @property
    def device(self) -> EmulatedPolaris:
        return self.station.device

    def _open_port(self, url: str) -> LoopbackPort:
        self.ports += 1
        return LoopbackPort(self.station, self.clock, lambda: self.adapter_present, self.has_break)

    def newest(self) -> int:
        """The device's frame of this moment, counted from TSTART."""
        return self.motion.sample(self.clock.now() - self.device._tracking_since_s)[0]

    def check(self, poses, tolerance_mm=1e-3, frames_old=3) -> int:
        """How many poses are usable; each must be the right tool's, of one frame, and of now."""
        usable = [pose for pose in poses if pose.tool_to_tracker is not None]
        numbers = set()
        for pose in usable:
            x, _, z = pose.tool_to_tracker[:3, 3]
            number = round(x) + 1000 * round(-1000.0 - z)
            index = self.motion.tools.index(pose.tool)
            truth = CountingMotion.pose(number, index)
            turn = Rotation.from_quat([*truth.quaternion[1:], truth.quaternion[0]]).as_matrix()
            assert np.abs(pose.tool_to_tracker[:3, 3] - truth.translation_mm).max() < tolerance_mm
            assert np.abs(pose.tool_to_tracker[:3, :3] - turn).max() < 2e-4
            assert np.allclose(pose.tool_to_tracker[3], (0, 0, 0, 1))
            numbers.add(number)
        assert len(numbers) <= 1
        for number in numbers:
            assert 0 <= self.newest() - number <= frames_old
        return len([pose for pose in usable if pose.usable])
