"""The plan keeps clear of pins and reference base, also of those that become known later; points that were taken stay."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib import scene, scene_data
from CranioNavLib.panel import Level
from CranioNavLib.panel_model import PanelModel
from CranioNavLib.rigid import invert_rigid, rigid_from_vector, transform_points
from CranioNavLib.slicer_files import LabelledPoints, load_scene, save_scene
from CranioNavLib.surface import Surface
from ModuleUltrasoundLib.palpation.clamp import CLEARANCE_LIMITS, CLEARANCE_MM, clear_of_clamp
from ModuleUltrasoundLib.panel_description import PANEL, UltrasoundParameters

TURNED = rigid_from_vector([0.4, -0.2, 1.1], [0.0, 0.0, 0.0])


@pytest.fixture
def a_planned_logic(a_logic, a_head):
    scene_data.set_surface("OuterTable", a_head)
    a_logic.planProtocol()
    return a_logic


def register_with_base_at(place_ras_mm, status="landmarks"):
    """The registration says that the reference base stands there."""
    reference_to_ras = TURNED.copy()
    reference_to_ras[:3, 3] = place_ras_mm
    scene_data.set_transform("ReferenceToRas", reference_to_ras).SetAttribute(scene.STATUS_ATTRIBUTE, status)


def over_point(logic, index, height_mm=60.0):
    """Where a probe on that point would be held."""
    positions, normals, _ = logic.protocolPoints()
    return positions[index] + height_mm * normals[index]


def clear(logic, place, clearance_mm=CLEARANCE_MM):
    positions, normals, _ = logic.protocolPoints()
    return clear_of_clamp(positions, normals, place[None], clearance_mm)


def test_points_are_planned_away_from_the_reference_base(a_planned_logic):
    base = over_point(a_planned_logic, 7)
    register_with_base_at(base)
    a_planned_logic.planProtocol()
    assert clear(a_planned_logic, base).all()
    assert "reference base" in a_planned_logic.clampPins().text


def test_a_base_that_becomes_known_after_planning_moves_the_points_that_it_is_in_the_way_of(a_planned_logic):
    base = over_point(a_planned_logic, 7)
    register_with_base_at(base)
    assert not clear(a_planned_logic, base).all()
    a_planned_logic.poll()
    assert clear(a_planned_logic, base).all()
    assert "planned anew" in a_planned_logic.clampPins().text
    assert a_planned_logic.currentIndex() == 0


def test_a_base_that_is_in_nobodys_way_moves_no_point(a_planned_logic):
    before = a_planned_logic.protocolPoints()[0]
    register_with_base_at([0.0, 0.0, -250.0])
    a_planned_logic.poll()
    np.testing.assert_array_equal(a_planned_logic.protocolPoints()[0], before)
    assert "anew" not in a_planned_logic.clampPins().text


def test_points_that_were_taken_are_not_moved_by_a_base_that_becomes_known(a_planned_logic):
    before = a_planned_logic.protocolPoints()[0]
    base = over_point(a_planned_logic, 7)
    scene_data.set_points("SurfacePoints", LabelledPoints(("S1",), before[:1]))
    register_with_base_at(base)
    a_planned_logic.poll()
    np.testing.assert_array_equal(a_planned_logic.protocolPoints()[0], before)
    shown = a_planned_logic.clampPins()
    assert shown.level is Level.WARNING
    assert f"{(~clear(a_planned_logic, base)).sum()} point" in shown.text


def test_points_are_not_moved_while_they_are_palpated(a_recording_logic):
    before, base = a_recording_logic.protocolPoints()[0], over_point(a_recording_logic, 7)
    register_with_base_at(base)
    a_recording_logic.poll()
    np.testing.assert_array_equal(a_recording_logic.protocolPoints()[0], before)
    assert a_recording_logic.clampPins().level is Level.WARNING
    assert "stop the recording" in a_recording_logic.planProtocolBlocked()
    a_recording_logic.closeRecording()
    a_recording_logic.poll()
    assert clear(a_recording_logic, base).all(), "nothing was palpated: now they are"


def test_a_pin_touched_after_planning_moves_the_points_near_it(a_planned_logic):
    register_with_base_at([0.0, 0.0, -250.0])
    a_planned_logic.poll()
    pin = a_planned_logic.protocolPoints()[0][2]
    to_reference = invert_rigid(scene_data.get_transform("ReferenceToRas"))
    scene_data.set_points("ClampPins", LabelledPoints(("C1",), transform_points(to_reference, pin[None])))
    a_planned_logic.poll()
    assert clear(a_planned_logic, pin).all()


def test_where_no_free_place_is_left_all_points_are_planned_and_those_in_the_way_are_named(a_planned_logic):
    labels, base = a_planned_logic.protocolPoints()[2], over_point(a_planned_logic, 7)
    a_planned_logic.parameters().change(clamp_clearance_mm=100.0)
    register_with_base_at(base)
    a_planned_logic.poll()
    assert a_planned_logic.protocolPoints()[2] == labels
    near = [label for label, free in zip(labels, clear(a_planned_logic, base, 100.0)) if not free]
    assert 0 < len(near) < 18
    said = a_planned_logic.clampPins()
    assert said.level is Level.WARNING
    stands = "1 point stands" if len(near) == 1 else f"{len(near)} points stand"
    assert f"{stands} nearer" in said.text
    assert "no free place within reach" in said.text
    assert "asked for last" in said.text
    assert "\n" not in said.text
    before = a_planned_logic.protocolPoints()[0]
    scene_data.set_points("SurfacePoints", LabelledPoints(("S1",), before[:1]))
    register_with_base_at(over_point(a_planned_logic, 3))
    a_planned_logic.poll()
    np.testing.assert_array_equal(a_planned_logic.protocolPoints()[0], before)


def test_the_message_of_planning_counts_all_points_and_says_which_stand_near_and_why(a_planned_logic):
    base = over_point(a_planned_logic, 7)
    a_planned_logic.parameters().change(clamp_clearance_mm=100.0)
    register_with_base_at(base)
    said = a_planned_logic.planProtocol()
    assert said.startswith("18 points; ")
    near = next(
        label for label, free in zip(a_planned_logic.protocolPoints()[2], clear(a_planned_logic, base, 100.0)) if not free
    )
    assert near in said
    assert "asked for last" in said


def test_a_point_that_a_pin_takes_the_only_place_of_is_named_in_the_panel(a_logic, a_head):
    scene_data.set_surface("OuterTable", a_head)
    a_logic.planProtocol()
    cheek = a_logic.protocolPoints()[0][16]
    far = np.linalg.norm(a_head.vertices_mm[a_head.triangles].mean(axis=1) - cheek, axis=1)
    scene_data.set_surface("OuterTable", Surface(a_head.vertices_mm, a_head.triangles[(far < 9.0) | (far > 60.0)]))
    assert a_logic.planProtocol().startswith("18 points")
    register_with_base_at([0.0, 0.0, -250.0])
    to_reference = invert_rigid(scene_data.get_transform("ReferenceToRas"))
    scene_data.set_points(
        "ClampPins", LabelledPoints(("C1",), transform_points(to_reference, over_point(a_logic, 16, 6.0)[None]))
    )
    a_logic.poll()
    assert len(a_logic.protocolPoints()[2]) == 17
    said = a_logic.clampPins()
    assert said.level is Level.WARNING
    assert "no place to stand for Periorbital 3 (no even bone, or a pin in it)" in said.text


def test_the_distance_is_a_setting_with_limits_and_a_default(a_planned_logic, tmp_path):
    info = next(one for one in UltrasoundParameters.describe() if one.name == "clamp_clearance_mm")
    assert (info.default, info.limits, info.unit) == (30.0, CLEARANCE_LIMITS, "mm")
    model = PanelModel(PANEL, a_planned_logic)
    field = next(item for item in PANEL.items() if getattr(item, "name", "") == "clamp_clearance_mm")
    assert not model.change(field, CLEARANCE_LIMITS.high + 1)
    assert "expected" in model.errors[field.name]
    assert model.change(field, 42.5)
    save_scene(tmp_path / "s.mrb")
    load_scene(tmp_path / "s.mrb")
    assert a_planned_logic.parameters().read().clamp_clearance_mm == 42.5


def test_points_keep_the_distance_that_is_set_and_follow_when_it_changes(a_planned_logic):
    base = over_point(a_planned_logic, 7)
    a_planned_logic.parameters().change(clamp_clearance_mm=45.0)
    register_with_base_at(base)
    a_planned_logic.poll()
    assert clear(a_planned_logic, base, 45.0).all()
    assert "45 mm" in a_planned_logic.clampPins().text
    far = a_planned_logic.protocolPoints()[0]
    a_planned_logic.parameters().change(clamp_clearance_mm=10.0)
    a_planned_logic.poll()
    assert np.linalg.norm(a_planned_logic.protocolPoints()[0] - far, axis=1).max() > 1.0, "nearer is good now"


def test_a_point_is_out_of_reach_by_the_distance_that_is_set(a_recording_logic):
    plan = a_recording_logic._plan()
    side = np.cross(plan.normals[3], [0.0, 0.0, 1.0])
    register_with_base_at(over_point(a_recording_logic, 3) + 40.0 * side / np.linalg.norm(side))
    assert a_recording_logic._within_reach(plan)[3]
    a_recording_logic.parameters().change(clamp_clearance_mm=41.0)
    assert not a_recording_logic._within_reach(plan)[3]
