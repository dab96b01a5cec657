"""One description, two faces: the web renderer draws all that a panel names, and its clicks do what Qt's do."""

from __future__ import annotations

import os
import uuid
from typing import Any

import numpy as np
import pytest
from CranioNavLib import host, scene_data
from CranioNavLib.panel import Action, ListField, NodeField, Picture, ReadOut
from CranioNavLib.panel_model import PanelModel
from CranioNavLib.slicer_files import LabelledPoints

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
pytest.importorskip("PySide6.QtWidgets", exc_type=ImportError)

from Workstation.web.panel_view import PanelView

MODULES = ("ModuleTracking", "ModuleUltrasound", "ModuleRegistration")


@pytest.fixture
def an_empty_scene():
    host.scene().Clear(False)
    yield host.scene()
    host.scene().Clear(False)


def drawn_in_the_web(name: str) -> tuple[PanelView, str]:
    """A module's panel on a server of its own, and the page's template."""
    from trame.app import get_server
    from trame.ui.vuetify3 import VAppLayout

    module = __import__(name)
    server = get_server(f"panel-{uuid.uuid4()}", client_type="vue3")
    view = PanelView(server, PanelModel(module.PANEL, getattr(module, f"{name}Logic")()), "panel")
    with VAppLayout(server) as layout:
        for step in module.PANEL.steps:
            view.draw(step)
    return view, layout.html


def drawn_by_qt(name: str) -> Any:
    """The same panel drawn by Qt."""
    from CranioNavLib import panel_qt_widgets
    from CranioNavLib.panel_qt import PanelWidget

    qt, module = panel_qt_widgets.toolkit(), __import__(name)
    app = qt.QApplication.instance() or qt.QApplication([])
    parent = qt.QWidget()
    drawn = PanelWidget(PanelModel(module.PANEL, getattr(module, f"{name}Logic")()), qt.QVBoxLayout(parent))
    drawn.kept = (app, parent)
    return drawn


def click(view: PanelView, action: str) -> None:
    """What the page sends when a button is pressed."""
    view.server.controller.trigger_fn("panel_run")(action)


def touch_landmarks() -> None:
    planned = np.array([[0.0, 90, 0], [50, 60, 10], [-50, 60, 12], [0, 80, -40]])
    scene_data.set_points("LandmarksCT", LabelledPoints(("a", "b", "c", "d"), planned))
    scene_data.set_points("LandmarksPatient", LabelledPoints(("a", "b", "c", "d"), planned + (5.0, 6.0, 7.0)))


def test_a_button_for_what_rarely_goes_wrong_is_shown_only_then(an_empty_scene):
    view, page = drawn_in_the_web("ModuleRegistration")
    drawn = drawn_by_qt("ModuleRegistration")
    touch_landmarks()
    for wrong in (False, True):
        if wrong:
            touched = scene_data.get_points("LandmarksPatient")
            moved = touched.positions_mm + np.eye(4)[:, :1] * 80.0
            scene_data.set_points("LandmarksPatient", LabelledPoints(touched.labels, moved))
        view.refresh()
        drawn.refresh()
        assert bool(view.server.state.panel["blocked"]["dropMisfit"]) != wrong
        assert drawn.buttons["dropMisfit"].isHidden() != wrong
        assert not drawn.buttons["verify"].isHidden(), "others are grey"
    assert """v-show="!panel.blocked['dropMisfit']\"""" in page.replace("&#x27;", "'")


@pytest.mark.parametrize("name", MODULES)
def test_everything_described_is_drawn(an_empty_scene, name):
    view, page = drawn_in_the_web(name)
    for item in view.model.panel.items():
        if isinstance(item, Action):
            assert f'data-action="{item.name}"' in page
        elif isinstance(item, ReadOut):
            assert f'data-reading="{item.name}"' in page
        elif isinstance(item, NodeField):
            assert f"panel.nodes['{item.role}']" in page
        elif isinstance(item, Picture):
            assert (f'data-picture="{item.name}"' in page) is item.on_page
        elif isinstance(item, ListField):
            assert f'data-list="{item.name}"' in page
        else:
            assert f'data-field="{item.name}"' in page


def test_a_click_in_the_browser_does_what_a_click_in_qt_does(an_empty_scene):
    found = []
    for press in (
        lambda: click(drawn_in_the_web("ModuleRegistration")[0], "registerLandmarks"),
        lambda: drawn_by_qt("ModuleRegistration").buttons["registerLandmarks"].click(),
    ):
        an_empty_scene.Clear(False)
        touch_landmarks()
        press()
        found.append((scene_data.get_transform("ReferenceToRas"), scene_data.get_table("Results")))
    np.testing.assert_allclose(found[0][0][:3, 3], [-5, -6, -7], atol=1e-9)
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert found[0][1] == found[1][1]


def test_an_edit_in_the_browser_reaches_the_scene(an_empty_scene):
    view, _ = drawn_in_the_web("ModuleRegistration")
    view.server.controller.trigger_fn("panel_change")("marker_diameter_mm", "6.5")
    assert view.model.logic.parameters().read().marker_diameter_mm == 6.5
    assert view.server.state.panel["fields"]["marker_diameter_mm"] == 6.5


def test_a_refused_edit_is_said_at_its_field_and_changes_nothing(an_empty_scene):
    view, _ = drawn_in_the_web("ModuleRegistration")
    view.server.controller.trigger_fn("panel_change")("marker_diameter_mm", "600")
    assert view.server.state.panel["errors"]["marker_diameter_mm"] == "600.0; expected 1 to 20 mm; 4.0 is kept"
    assert view.model.logic.parameters().read().marker_diameter_mm == 4.0


def test_a_number_that_is_none_is_refused_in_words_and_one_that_need_not_be_given_can_be_emptied(an_empty_scene):
    view, _ = drawn_in_the_web("ModuleTracking")
    change = view.server.controller.trigger_fn("panel_setting")
    field = next(item for item in view.model.panel.items() if getattr(item, "kind", "") == "tracker")
    for value, kept, said in (("5", 5.0, None), ("abc", 5.0, "expected a number, got 'abc'; 5.0 is kept"), ("", None, None)):
        change(field.name, "fail_after_s", value)
        assert view.model.settings(field).read().fail_after_s == kept
        assert view.server.state.panel["errors"].get(f"{field.name}.fail_after_s") == said


def test_a_button_is_grey_again_once_what_was_typed_beside_it_has_come(an_empty_scene):
    view, _ = drawn_in_the_web("ModuleTracking")
    view.server.state.typed = "panel.sharing"
    view.server.controller.trigger_fn("panel_change")("share_port", "18945")
    assert view.server.state.typed == ""


def test_a_blocked_action_says_why(an_empty_scene):
    view, _ = drawn_in_the_web("ModuleRegistration")
    click(view, "registerLandmarks")
    assert "still missing" in view.server.state.panel["blocked"]["registerLandmarks"]
    assert "still missing" in view.server.state.panel["message"]["text"]


def test_a_point_added_to_a_list_is_saved(an_empty_scene, tmp_path):
    from CranioNavLib import scene
    from CranioNavLib.slicer_files import add_points, read_points
    from CranioNavLib.volume import Volume

    from Workstation.web.session_folder import SessionFolder

    session = SessionFolder(tmp_path, list)
    scene_data.set_volume("CT", Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing"))
    touch_landmarks()
    session.save("landmarks")
    add_points(scene.find("LandmarksPatient"), LabelledPoints(("e",), np.array([[1.0, 2, 3]])))
    session.save("landmarks")
    assert read_points(tmp_path / "landmarks-patient.mrk.json").labels == ("a", "b", "c", "d", "e")
    scene.release("LandmarksPatient")
    session.save("landmarks")
    assert not (tmp_path / "landmarks-patient.mrk.json").exists()


def test_a_button_with_a_shortcut_names_its_key_in_the_browser(an_empty_scene):
    _, page = drawn_in_the_web("ModuleTracking")
    assert 'data-shortcut="Space"' in page
    assert 'data-shortcut="Ctrl+Z"' in page
    assert "(Space)" in page


def test_a_button_that_waits_for_a_typed_path_can_be_pressed_while_it_is_typed(an_empty_scene):
    _, page = drawn_in_the_web("ModuleRegistration")
    assert """!!panel.blocked['loadCt'] && typed !== 'panel.ct'""" in page
    assert """typed = 'panel.ct'""" in page


def test_good_news_of_what_is_to_be_done_goes_once_it_is_done(an_empty_scene):
    from CranioNavLib.panel import StepState, StepStatus

    view, _ = drawn_in_the_web("ModuleRegistration")
    state, logic = view.server.state, view.model.logic
    logic.addLandmark, logic.addLandmarkBlocked = lambda: "click on it", lambda: ""
    click(view, "addLandmark")
    assert state.panel["message"]["text"] == "click on it"
    logic.planStatus = lambda: StepStatus(StepState.DONE)
    view.refresh()
    assert state.panel["message"]["text"] == ""
    click(view, "addLandmark")
    assert state.panel["message"]["text"] == "click on it", "said when it was done already"
