"""The hand is led by what guidance rests on: the registration in force, or its refinement with the points taken so far."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
from CranioNavLib import scene, scene_data
from CranioNavLib.panel import Level
from CranioNavLib.rigid import invert_rigid, rigid_from_vector, transform_points
from CranioNavLib.scene_guidance import set_refinement, set_remark
from CranioNavLib.sequence_metafile import Acquisition
from echo_logic import on_point
from ModuleUltrasoundLib.palpation.palpation import Palpation, PalpationLine

BETTER = rigid_from_vector([np.radians(8.0), 0, 0], [0.0, 0.0, 6.0])
LOOSE = np.diag([0.05, 0.002, 0.002, 0.3, 0.3, 0.3]) ** 2


@pytest.fixture
def a_guided_logic(a_logic, a_head):
    """Palpating without a device: a planned protocol, registered by landmarks; Reference is RAS."""
    scene_data.set_surface("OuterTable", a_head)
    a_logic.planProtocol()
    scene_data.set_transform("ReferenceToRas", np.eye(4)).SetAttribute(scene.STATUS_ATTRIBUTE, "landmarks")
    scene_data.set_motion_error(LOOSE, np.zeros(3), 9.0)
    a_logic.stream = SimpleNamespace(acquisition=Acquisition(50e6, 5e6), stop=lambda: None)
    a_logic.palpation = Palpation(scene_data.get_points("ProtocolPoints").labels)
    a_logic.beginAsking()
    yield a_logic
    a_logic.palpation = None


def a_line(position, moment_s):
    return PalpationLine(moment_s, True, 0.95, "", np.asarray(position), np.eye(3), np.array([0.0, 0.0, -1.0]), 6.0)


def test_tilt_and_place_are_told_under_the_refinement(a_guided_logic):
    logic, index = a_guided_logic, a_guided_logic.currentIndex()
    scene_data.set_pose("ProbeToReference", invert_rigid(BETTER) @ on_point(logic, index), "OK", time.monotonic())
    logic.steer()
    assert logic.guide().distance_mm > 4.0
    set_refinement(BETTER, 0.01 * LOOSE, np.zeros(3), None, ("a",))
    logic.steer()
    assert logic.guide().distance_mm < 0.5
    assert logic.guide().angle_deg < 1.0
    assert logic.guide().angle_sd_deg < 0.5
    scene.find("ReferenceToRas").RemoveAttribute(scene.STATUS_ATTRIBUTE)
    logic.steer()
    assert logic.guide() is None


def test_a_better_registration_leaves_the_point_and_moves_where_it_is_expected(a_guided_logic):
    logic, asked = a_guided_logic, a_guided_logic.currentIndex()
    there = logic.protocolPoints()[0][asked]
    away = there + 17.0 * np.array([1.0, 0.0, 0.0])
    moved = rigid_from_vector(np.zeros(3), there - away)  # under it the same place is 17 mm off
    logic.takePoints([a_line(away, time.monotonic())])
    assert "away from the target" in logic.dwell().text
    before = logic.brings().text
    set_refinement(moved, 0.04 * LOOSE, np.zeros(3), None, ())
    begun = time.monotonic()
    logic.takePoints([a_line(away, begun + k / 20) for k in range(4)])
    assert logic.currentIndex() == asked
    assert logic.brings().text != before
    np.testing.assert_allclose(transform_points(moved, away[None])[0], there, atol=1e-9)
    slightly = rigid_from_vector([0, 0, 1e-4], np.zeros(3)) @ moved
    set_refinement(slightly, 0.03 * LOOSE, np.zeros(3), None, ())
    logic.takePoints([a_line(away, begun + k / 20) for k in range(4, 12)])
    assert logic.taken() == [logic.protocolPoints()[2][asked]], "the dwell went on"


def test_points_that_guidance_rests_on_are_not_counted_in_once_more(a_guided_logic):
    logic, asked = a_guided_logic, a_guided_logic.currentIndex()
    label = logic.protocolPoints()[2][asked]
    logic.takePoints([a_line(logic.protocolPoints()[0][asked], time.monotonic() + k / 20) for k in range(13)])
    counted_in = float(logic.brings().text.split(" → ")[0])
    set_refinement(rigid_from_vector([0, 0, 1e-4], np.zeros(3)), LOOSE, np.zeros(3), None, (label,))
    logic.takePoints([a_line([0.0, 0.0, 0.0], time.monotonic() + 1)])
    assert float(logic.brings().text.split(" → ")[0]) > counted_in + 0.1


def test_it_is_said_what_guidance_rests_on(a_guided_logic):
    logic = a_guided_logic
    rough = logic.restsOn()
    assert rough.text.startswith("landmarks; error to expect ")
    assert rough.text.endswith(" mm (RMS at the targets)")
    assert rough.level is Level.PLAIN
    set_refinement(BETTER, 0.01 * LOOSE, np.zeros(3), None, ("a", "b", "c"))
    assert logic.restsOn().text.startswith("landmarks and 3 points; error to expect ")
    assert float(logic.restsOn().text.split()[7]) < 0.2 * float(rough.text.split()[4])
    set_remark("not refined with 4 points: ambiguous")
    assert logic.restsOn().text.endswith("; not refined with 4 points: ambiguous")
    assert logic.restsOn().level is Level.WARNING
    scene.find("ReferenceToRas").RemoveAttribute(scene.STATUS_ATTRIBUTE)
    assert logic.restsOn() is None
