"""Points placed by click, moved, taken out and brought back, on a real scene."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.point_editor import PLACED_BY_CLICK, PointEditor
from CranioNavLib.slicer_files import LabelledPoints


@pytest.fixture
def an_editor():
    host.scene().Clear(False)
    yield PointEditor("LandmarksCT", ("a", "b", "c"), lambda place: "too far" if np.abs(place).max() > 100 else "")
    host.scene().Clear(False)


def click(position) -> None:
    """What Slicer's place mode does: a point is added, then it gets its place."""
    node = host.scene().GetFirstNodeByName(PLACED_BY_CLICK)
    node.AddControlPoint(*position)


def places() -> dict[str, list[float]]:
    points = scene_data.get_points("LandmarksCT")
    return {label: place.tolist() for label, place in zip(points.labels, points.positions_mm)}


def interaction():
    return host.scene().GetNodeByID("vtkMRMLInteractionNodeSingleton")


def test_a_click_places_the_chosen_point_and_asks_for_the_next(an_editor):
    an_editor.place("b")
    assert interaction().GetCurrentInteractionMode() == interaction().Place
    click((1.0, 2, 3))
    assert places() == {"b": [1, 2, 3]}
    assert an_editor.active() == "c"
    click((4.0, 5, 6))
    assert an_editor.active() == "a"


def test_the_mouse_is_given_back_when_all_points_are_placed(an_editor):
    an_editor.place("a")
    for number in range(3):
        click((number, 0, 0))
    assert len(places()) == 3
    assert an_editor.active() == ""
    assert interaction().GetCurrentInteractionMode() == interaction().ViewTransform


def test_a_point_placed_again_moves_and_only_it(an_editor):
    scene_data.set_points("LandmarksCT", LabelledPoints(("a", "b", "c"), np.eye(3)))
    an_editor.place("b")
    click((7.0, 8, 9))
    assert places() == {"a": [1, 0, 0], "b": [7, 8, 9], "c": [0, 0, 1]}


def test_a_click_off_the_head_is_refused_and_asked_again(an_editor):
    an_editor.place("a")
    click((500.0, 0, 0))
    assert scene.find("LandmarksCT") is None
    assert "too far" in an_editor.said
    assert an_editor.active() == "a"
    click((5.0, 0, 0))
    assert places() == {"a": [5, 0, 0]}
    assert an_editor.said == ""


def test_each_change_is_undone_in_turn(an_editor):
    an_editor.put("a", (1, 1, 1))
    an_editor.put("a", (2, 2, 2))
    an_editor.remove("a")
    an_editor.undo()
    assert places() == {"a": [2, 2, 2]}
    an_editor.undo()
    assert places() == {"a": [1, 1, 1]}
    an_editor.undo()
    assert scene.find("LandmarksCT").GetNumberOfControlPoints() == 0
    assert not an_editor.can_undo()


def test_a_point_dragged_in_a_view_can_be_brought_back(an_editor):
    node = scene_data.set_points("LandmarksCT", LabelledPoints(("a",), np.array([[1.0, 2, 3]])))
    an_editor.place("a")
    node.InvokeEvent(type(node).PointStartInteractionEvent)
    node.SetNthControlPointPosition(0, 9.0, 9, 9)
    an_editor.undo()
    assert places() == {"a": [1, 2, 3]}


def test_another_mode_of_the_mouse_ends_placing(an_editor):
    an_editor.place("a")
    interaction().SetCurrentInteractionMode(interaction().ViewTransform)
    assert an_editor.active() == ""
    click((1.0, 2, 3))
    assert scene.find("LandmarksCT") is None


def test_further_points_get_names_of_their_own(an_editor):
    first = an_editor.add()
    an_editor.put(first, (1, 1, 1))
    second = an_editor.add()
    assert first != second
    assert [one.name for one in an_editor.entries()] == ["a", "b", "c", first, second]


def test_a_point_without_a_place_cannot_be_taken_out(an_editor):
    with pytest.raises(InputError, match="has no place"):
        an_editor.remove("a")


def test_the_hidden_list_of_clicks_is_not_saved_with_the_scene(an_editor):
    an_editor.place("a")
    assert not host.scene().GetFirstNodeByName(PLACED_BY_CLICK).GetSaveWithScene()
