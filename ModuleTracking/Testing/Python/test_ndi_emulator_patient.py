"""The emulated camera over the virtual patient: the driver sees what the hand does."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.phantom import make_patient
from CranioNavLib.phantom.session import SimulatedSession, SteppedClock
from CranioNavLib.rigid import invert_rigid, transform_points
from ModuleTrackingLib.ndi.emulator.patient import EACH_S, PatientMotion
from polaris_rig import Rig


@pytest.fixture(scope="module")
def a_patient():
    return make_patient(None, seed=2)


def test_stylus_dwells_on_the_landmarks_one_after_the_other(a_patient):
    clock = SteppedClock()
    rig = Rig(motion=PatientMotion(SimulatedSession(a_patient, seed=2, clock=clock), clock, rate_hz=60.0))
    landmarks = transform_points(a_patient.ras_to_reference, a_patient.landmarks_ras_mm)
    with rig.tracker:
        for landmark in landmarks:
            rig.clock.sleep(EACH_S - 0.5)
            poses = {pose.tool: pose for pose in rig.tracker.read()}
            assert poses["Reference"].usable
            assert not poses["Sphere"].usable
            stylus_to_reference = invert_rigid(poses["Reference"].tool_to_tracker) @ poses["Stylus"].tool_to_tracker
            assert np.linalg.norm(stylus_to_reference[:3, 3] - landmark) < 20.0  # simulated: five SD of finding a landmark
            rig.clock.sleep(0.5)


def test_a_frame_asked_for_twice_is_the_same_and_tracking_may_begin_anew(a_patient):
    clock = SteppedClock()
    motion = PatientMotion(SimulatedSession(a_patient, seed=2, clock=clock), clock, rate_hz=20.0)
    first = motion.sample(3.01)
    assert motion.sample(3.02) is first
    assert motion.sample(3.06)[0] == first[0] + 1
    again = motion.sample(0.0)
    assert again[0] == 0
    assert again[1]["Stylus"] is not None


def test_every_tool_gets_its_turn(a_patient):
    clock = SteppedClock()
    motion = PatientMotion(SimulatedSession(a_patient, seed=2, clock=clock), clock, rate_hz=20.0)
    seen = {tool for turn in range(30) for tool, pose in motion.sample(turn * EACH_S + 3.0)[1].items() if pose is not None}
    assert seen == set(motion.tools)
