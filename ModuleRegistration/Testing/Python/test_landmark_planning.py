"""Planning landmarks in the CT: placed, doubted, moved, exchanged, taken back."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib import scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.panel import StepState
from CranioNavLib.rigid import rigid_from_vector, transform_points
from CranioNavLib.slicer_files import LabelledPoints
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.logic.planning import off_the_head
from touched_patient import LABELS, LANDMARKS


@pytest.fixture
def a_ball_in_air(a_logic):
    """A CT of a ball of tissue, 60 mm in radius about (5, -10, 20), in a rotated grid of uneven voxels."""
    ijk_to_ras = rigid_from_vector([0.2, 0.1, -0.3], [0, 0, 0]) @ np.diag([1.0, 1.5, 2.0, 1.0])
    ijk_to_ras[:3, 3] = (5, -10, 20) - ijk_to_ras[:3, :3] @ (80, 50, 40)
    k, j, i = np.mgrid[:80, :100, :160]
    places = transform_points(ijk_to_ras, np.stack([i, j, k], axis=-1).reshape(-1, 3)).reshape(*i.shape, 3)
    inside = np.linalg.norm(places - (5, -10, 20), axis=-1) < 60
    a_logic.takeCt(Volume(np.where(inside, 40, -1000).astype(np.int16), ijk_to_ras, "ball"))
    return a_logic


@pytest.mark.parametrize(
    ("place", "refused"),
    [((5, -10, 20), False), ((5, 49, 20), False), ((5, 53, 20), False), ((5, 60, 20), True), ((5, 500, 20), True)],
)
def test_a_landmark_lies_on_the_head_or_in_it(a_ball_in_air, place, refused):
    assert ("missed the head" in off_the_head(place)) == refused


def test_landmarks_are_planned_without_a_mouse_and_each_step_is_taken_back(a_ball_in_air, monkeypatch):
    from CranioNavLib import slice_views

    logic = a_ball_in_air
    first = logic.planStatus()
    assert (first.state, first.action) == (StepState.TODO, "suggestLandmarks")
    for number in range(3):
        monkeypatch.setattr(slice_views, "crossing", lambda number=number: np.array([5.0, 10 * number, 20]))
        logic.placeHere()
    planned = scene_data.get_points("LandmarksCT")
    assert planned.labels == tuple(one.name for one in logic.landmarks())[:3]
    np.testing.assert_allclose(planned.positions_mm[:, 1], [0, 10, 20])
    assert logic.planStatus().state is StepState.DONE
    monkeypatch.setattr(logic.planned, "active", lambda: planned.labels[0])
    logic.planned.said = "the click missed the head"
    assert logic.planStatus().state is StepState.ATTENTION, "placed before, but the click since did nothing"
    monkeypatch.undo()
    logic.undoLandmark()
    assert len(scene_data.get_points("LandmarksCT")) == 2
    assert "place 1 more" in logic.planStatus().text
    logic.parameters().change(landmark=planned.labels[0])
    logic.removeLandmark()
    assert scene_data.get_points("LandmarksCT").labels == planned.labels[1:2]
    monkeypatch.setattr(slice_views, "crossing", lambda: np.array([5.0, 300, 20]))
    with pytest.raises(InputError, match="missed the head"):
        logic.placeHere()


def test_a_landmark_in_the_head_needs_attention_and_is_moved_to_the_bone(a_patient, a_skull):
    on_bone = a_skull.closest(LANDMARKS).points_mm
    inside = np.where(np.arange(4)[:, None] == 1, 0.5, 1.0) * on_bone
    scene_data.set_points("LandmarksCT", LabelledPoints(LABELS, inside))
    status, entry = a_patient.planStatus(), a_patient.landmarks()[-3]
    assert (status.state, status.action) == (StepState.ATTENTION, "moveToSurface")
    assert "Left lies 3" in status.text, "which, and how far"
    assert (entry.name, entry.doubtful, "off skin and bone" in entry.note) == ("Left", True, True)
    a_patient.moveToSurface()
    assert a_patient.planStatus().state is StepState.DONE
    assert a_patient.moveToSurfaceBlocked()
    moved = scene_data.get_points("LandmarksCT").positions_mm
    assert a_skull.closest(moved[1:2]).distances_mm < 0.1
    a_patient.undoLandmark()
    np.testing.assert_allclose(scene_data.get_points("LandmarksCT").positions_mm, inside)
    scene_data.set_points("TargetsCT", LabelledPoints(("Sphere 1",), inside[1:2]))
    assert a_patient.planStatus().state is StepState.DONE, "a marker that the CT shows stands where it stands"


def test_left_and_right_exchanged_need_attention_and_are_exchanged_back(a_patient, a_skull):
    on_bone = a_skull.closest(LANDMARKS).points_mm
    scene_data.set_points("LandmarksCT", LabelledPoints(LABELS, on_bone[[0, 2, 1, 3]]))
    status = a_patient.planStatus()
    assert (status.state, status.action, "Left and Right" in status.text) == (StepState.ATTENTION, "exchangeSides", True)
    assert [one.name for one in a_patient.landmarks() if one.doubtful] == ["Left", "Right"]
    a_patient.exchangeSides()
    np.testing.assert_allclose(scene_data.get_points("LandmarksCT").positions_mm, on_bone, atol=1e-6)
    assert a_patient.planStatus().state is StepState.DONE
    assert a_patient.exchangeSidesBlocked()
    a_patient.planned.put("Right", on_bone[1] * (0.99, 1, 1))
    a_patient.planned.remove("Left")
    assert "Right lies on the other side" in a_patient.planStatus().text


def test_a_further_landmark_waits_for_its_click_until_told_otherwise(a_ball_in_air):
    logic = a_ball_in_air
    assert "Landmark 5" in logic.addLandmark()
    assert "Landmark 5" in logic.placing().text
    logic.stopPlacing()
    assert logic.placing() is None
    assert logic.stopPlacingBlocked()
