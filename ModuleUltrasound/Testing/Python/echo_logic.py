"""A device that hears one echo, and the module's logic with it: what the tests of the logic stand on."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Parameters
from CranioNavLib.rigid import rigid, rigid_from_vector
from CranioNavLib.sequence_metafile import Acquisition
from CranioNavLib.surface import Surface
from ModuleUltrasoundLib.devices.device import AMODE_DEVICES, AModeDevice, RfLine

import ModuleUltrasound as module

RATE_HZ, CARRIER_HZ, SPEED_M_S = 50e6, 5e6, 1540.0
DEPTH_MM = 6.0
POSE = rigid(np.diag([1.0, -1.0, -1.0]), [5.0, 6.0, 50.0])  # the beam points down


def echo_line(depth_mm, rng):
    """Transmit pulse, skin at 1 mm, bone at `depth_mm` below the transducer, noise: no forerun."""
    times = np.arange(1500) / RATE_HZ
    samples = rng.normal(0, 20, len(times))
    for mm, amplitude, seconds in ((0.0, 20000, 2e-7), (depth_mm, 8000, 2.5e-7)):
        late = times - 2e-3 * mm / SPEED_M_S
        samples += amplitude * np.exp(-((late / seconds) ** 2)) * np.cos(2 * np.pi * CARRIER_HZ * late)
    return np.clip(samples, -32768, 32767).astype(np.int16)


@AMODE_DEVICES.register
class EchoDevice(AModeDevice):
    name = "one-echo"
    title = "One echo"

    @dataclass(frozen=True)
    class Settings(Parameters):
        pass

    refuse = ""

    def open(self):
        if EchoDevice.refuse:
            raise InputError(EchoDevice.refuse)
        self.rng = np.random.default_rng(0)

    def start(self):
        pass

    def stop(self):
        pass

    def close(self):
        pass

    @property
    def acquisition(self):
        return Acquisition(RATE_HZ, CARRIER_HZ)

    def read(self, timeout_s=1.0):
        time.sleep(0.01)
        return RfLine(echo_line(DEPTH_MM, self.rng), time.monotonic())


@pytest.fixture
def a_logic():
    host.scene().Clear(False)
    EchoDevice.refuse = ""
    logic = module.ModuleUltrasoundLogic()
    logic.parameters().change(device="one-echo")
    yield logic
    logic.disconnect()
    host.scene().Clear(False)


@pytest.fixture(scope="module")
def a_head():
    """An egg of a head's size, finely meshed, in RAS."""
    import vtk

    source = vtk.vtkSphereSource()
    source.SetThetaResolution(160)
    source.SetPhiResolution(120)
    source.SetRadius(1.0)
    source.Update()
    egg = Surface.from_polydata(source.GetOutput())
    return Surface(egg.vertices_mm * [72.0, 92.0, 85.0], egg.triangles)


def run_for(logic, seconds, pose=POSE, status="OK"):
    """The event loop; a tracker goes on at 20 poses a second however long a poll takes."""
    told_s = time.monotonic()
    end = told_s + seconds
    while (now := time.monotonic()) < end:
        for moment_s in (*np.arange(told_s + 0.05, now, 0.05), now):
            scene_data.set_pose("ProbeToReference", pose, status, float(moment_s))
        told_s = now
        logic.poll()
        time.sleep(0.01)


def on_point(logic, index, tilt_deg=0.0):
    """ProbeToReference with the bone 6 mm below the face, square to it or tilted about the bone point."""
    positions, normals, _ = logic.protocolPoints()
    beam = -normals[index]
    across = np.cross(beam, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across)
    straight = rigid(np.column_stack([across, np.cross(beam, across), beam]), positions[index])
    turned = straight @ rigid_from_vector([np.radians(tilt_deg), 0, 0], np.zeros(3))
    return turned @ rigid(np.eye(3), [0, 0, -DEPTH_MM])


@pytest.fixture
def a_recording_logic(a_logic, a_head, tmp_path):
    """Recording with a planned protocol, registered: Reference is RAS."""
    scene_data.set_surface("OuterTable", a_head)
    a_logic.planProtocol()
    scene_data.set_transform("ReferenceToRas", np.eye(4)).SetAttribute(scene.STATUS_ATTRIBUTE, "landmarks")
    a_logic.parameters().change(recording_path=str(tmp_path / "r.igs.mha"))
    a_logic.connect()
    run_for(a_logic, 0.3, on_point(a_logic, 0))
    a_logic.startRecording()
    return a_logic
