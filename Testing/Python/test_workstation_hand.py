"""The simulated hand does what the page asks for: it rests on points, and glides while a sweep is recorded."""

from __future__ import annotations

import time

import numpy as np
import pytest
from CranioNavLib import host, scene_data
from CranioNavLib.panel import StepState
from CranioNavLib.phantom import make_patient
from CranioNavLib.phantom.session import PROBE, SimulatedSession, SteppedClock, use_session
from CranioNavLib.slicer_files import LabelledPoints

from Workstation.web import simulated_hand
from Workstation.web.simulated_hand import SimulatedHandLogic


@pytest.fixture
def a_session():
    host.scene().Clear(False)
    session = SimulatedSession(make_patient(None, 4), 1, SteppedClock())
    use_session(session)
    yield session
    use_session(None)
    host.scene().Clear(False)


@pytest.mark.slow
def test_the_hand_glides_to_and_fro_while_a_sweep_is_recorded_and_no_longer(a_session, monkeypatch):
    bone, recording = a_session.patient.bone, [True]
    high = np.argsort(-bone.vertices_mm[:, 2])[:: len(bone.vertices_mm) // 40][:3]
    node = scene_data.set_points("ProtocolPoints", LabelledPoints(("1", "2", "3"), bone.vertices_mm[high]))
    for axis, name in enumerate(("Normal_R", "Normal_A", "Normal_S")):
        scene_data.add_measurement(node, name, bone.vertex_normals[high, axis])
    hand = SimulatedHandLogic(lambda: None, lambda: 0 if recording[0] else None, lambda: recording[0], lambda volume: None)
    assert "glide" in hand.palpationHandStatus().text
    assert "to and fro" in hand.palpateAll().run()
    assert hand.palpationHandStatus().state is StepState.DONE
    first = a_session.tool_to_reference(PROBE, 5.0)
    hand.poll()
    np.testing.assert_array_equal(a_session.tool_to_reference(PROBE, 5.0), first)
    now = time.monotonic()
    monkeypatch.setattr(simulated_hand.time, "monotonic", lambda: now + 1000.0)
    hand.poll()  # that way is behind: another one
    assert not np.array_equal(a_session.tool_to_reference(PROBE, 5.0), first)
    recording[0] = False
    hand.poll()
    assert a_session.tool_to_reference(PROBE, 5.0) is None


def test_without_a_registration_the_hand_is_asked_for_no_targets(monkeypatch):
    host.scene().Clear(False)
    monkeypatch.setattr(simulated_hand, "running_simulation", lambda: object())
    hand = SimulatedHandLogic(lambda: None, lambda: None, lambda: False, lambda volume: None)
    for registered, state in ((False, StepState.DONE), (True, StepState.TODO)):
        if registered:
            scene_data.set_transform("ReferenceToRas", np.eye(4)).SetAttribute("CranioNav.Status", "accepted")
        assert hand.targetHandStatus().state is state
        assert hand.tourHandStatus().state is state
    host.scene().Clear(False)
