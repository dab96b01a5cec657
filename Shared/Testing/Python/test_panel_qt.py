"""The Qt renderer, under PySide6 without a screen: every panel is drawn, and what the user does reaches the scene."""

from __future__ import annotations

import os
import time
from types import SimpleNamespace

import numpy as np
import pytest

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
pytest.importorskip("PySide6.QtWidgets", exc_type=ImportError)

from CranioNavLib import host, panel_qt_widgets, scene, scene_data
from CranioNavLib.host import ScriptedLoadableModuleWidget
from CranioNavLib.panel import Action, ListField, NodeField, Picture, ReadOut, StepState
from CranioNavLib.panel_model import PanelModel
from CranioNavLib.panel_qt import PanelWidget
from CranioNavLib.slicer_files import LabelledPoints

MODULES = ("ModuleTracking", "ModuleUltrasound", "ModuleRegistration")


@pytest.fixture(scope="module")
def qt():
    toolkit = panel_qt_widgets.toolkit()
    app = toolkit.QApplication.instance() or toolkit.QApplication([])
    yield toolkit
    app.processEvents()


@pytest.fixture
def an_empty_scene():
    host.scene().Clear(False)
    yield host.scene()
    host.scene().Clear(False)


def module(name):
    loaded = __import__(name)
    return SimpleNamespace(panel=loaded.PANEL, logic=getattr(loaded, f"{name}Logic"), widget=getattr(loaded, f"{name}Widget"))


@pytest.fixture(params=MODULES)
def a_drawn_panel(request, qt, an_empty_scene):
    found = module(request.param)
    parent = qt.QWidget()
    drawn = PanelWidget(PanelModel(found.panel, found.logic()), qt.QVBoxLayout(parent))
    drawn.parent = parent
    yield drawn
    drawn.close()


@pytest.fixture
def a_registration_panel(qt, an_empty_scene):
    found = module("ModuleRegistration")
    parent = qt.QWidget()
    drawn = PanelWidget(PanelModel(found.panel, found.logic()), qt.QVBoxLayout(parent))
    drawn.parent = parent
    yield drawn
    drawn.close()


@pytest.mark.parametrize("name", MODULES)
def test_each_modules_description_names_only_what_its_logic_has(name):
    found = module(name)
    PanelModel(found.panel, found.logic())


def test_everything_described_is_drawn(a_drawn_panel):
    panel = a_drawn_panel.model.panel
    assert list(a_drawn_panel.sections) == [step.name for step in panel.steps]
    for item in panel.items():
        if isinstance(item, Action):
            assert a_drawn_panel.buttons[item.name].text() == item.label
        elif isinstance(item, ReadOut):
            assert a_drawn_panel.readings[item.name].text()
        elif isinstance(item, NodeField):
            assert a_drawn_panel.choosers[item.role].widget.count() >= 1
        elif isinstance(item, Picture):
            assert a_drawn_panel.pictures[item.name].widget.accessibleName() == item.label
        elif isinstance(item, ListField):
            assert a_drawn_panel.lists[item.name].widget.count() == len(a_drawn_panel.model.entries(item))
        else:
            assert item.name in a_drawn_panel.editors or item.name in a_drawn_panel.choosers


def test_buttons_that_cannot_be_used_are_grey_and_say_why(a_drawn_panel):
    for action in a_drawn_panel.model.panel.actions():
        button, reason = a_drawn_panel.buttons[action.name], a_drawn_panel.model.blocked(action)
        assert button.isEnabled() == (not reason)
        assert button.toolTip() == (reason or action.help)


def test_an_edit_in_a_number_field_reaches_the_scene_and_back(a_registration_panel):
    editor = a_registration_panel.editors["landmark_fle_mm"]
    editor.input.setValue(2.25)
    assert a_registration_panel.model.logic.parameters().read().landmark_fle_mm == 2.25
    a_registration_panel.model.logic.parameters().change(landmark_fle_mm=1.5)
    a_registration_panel.refresh()
    assert editor.value() == 1.5
    assert editor.input.suffix() == " mm"
    assert (editor.input.minimum(), editor.input.maximum()) == (0.05, 20)


def test_choosing_a_plugin_shows_its_settings_and_their_edits_reach_the_scene(qt, an_empty_scene):
    found = module("ModuleTracking")
    parent = qt.QWidget()
    drawn = PanelWidget(PanelModel(found.panel, found.logic()), qt.QVBoxLayout(parent))
    combo = drawn.choosers["tracker"]
    combo.setCurrentIndex(combo.findText("replay"))
    assert drawn.model.logic.parameters().read().tracker == "replay"
    assert "tracker.loop" in drawn.editors
    assert "tracker.seed" not in drawn.editors
    combo.setCurrentIndex(combo.findText("simulated"))
    drawn.editors["tracker.rate_hz"].input.setValue(33.0)
    assert drawn.model.logic.pluginSettings("tracker", "simulated").read().rate_hz == 33.0
    optional = drawn.editors["tracker.fail_after_s"]
    assert optional.value() is None
    assert not optional.input.isEnabled()
    optional._switch.setChecked(True)
    assert drawn.model.logic.pluginSettings("tracker", "simulated").read().fail_after_s is not None
    drawn.close()


def test_a_click_registers_landmarks_as_a_call_of_the_logic_does(a_registration_panel):
    planned = np.array([[0.0, 80, 0], [-60, 40, 10], [60, 42, 10], [0, 70, -50]])
    labels = ("a", "b", "c", "d")
    scene_data.set_points("LandmarksCT", LabelledPoints(labels, planned))
    scene_data.set_points("LandmarksPatient", LabelledPoints(labels, planned + [5.0, 6.0, 7.0]))
    a_registration_panel.refresh()
    a_registration_panel.buttons["registerLandmarks"].click()
    clicked = scene_data.get_transform("ReferenceToRas")
    np.testing.assert_allclose(clicked[:3, 3], [-5, -6, -7], atol=1e-9)
    assert "4 landmark pairs" in a_registration_panel._message.text()
    assert a_registration_panel.readings["fre"].text() == "0.0 mm"
    assert a_registration_panel.sections["landmarks"].title.startswith("✓")
    scene.release("ReferenceToRas")
    a_registration_panel.model.logic.registerLandmarks()
    np.testing.assert_array_equal(scene_data.get_transform("ReferenceToRas"), clicked)


def test_choosing_in_a_list_reaches_the_scene_and_the_logic_hears_of_it(a_registration_panel):
    from CranioNavLib.volume import Volume

    scene_data.set_volume("CT", Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing"))
    shown = a_registration_panel.lists["landmark"].widget
    shown.setCurrentRow(1)
    shown.itemClicked.emit(shown.currentItem())
    logic = a_registration_panel.model.logic
    assert logic.parameters().read().landmark == "Left frontozygomatic"
    assert logic.planned.active() == "Left frontozygomatic"
    assert "click on it" in a_registration_panel.model.message.text


def test_a_drawing_given_as_svg_is_shown(qt):
    drawing = panel_qt_widgets.Drawing("A square")
    drawing.show('<svg xmlns="http://www.w3.org/2000/svg" width="40" height="30"><rect width="40" height="30" fill="red"/></svg>')
    assert (drawing.widget.pixmap().width(), drawing.widget.pixmap().height()) == (40, 30)
    drawing.show(None)
    assert not drawing.widget.isVisible()


def test_a_refusal_is_shown_in_words(a_registration_panel):
    points = LabelledPoints(("a", "b", "c"), np.array([[0.0, 0, 0], [50, 0, 0], [100, 0, 0]]))
    scene_data.set_points("LandmarksCT", points)
    scene_data.set_points("LandmarksPatient", points)
    a_registration_panel.refresh()
    a_registration_panel.buttons["registerLandmarks"].click()
    assert a_registration_panel._message.text().startswith("✗ ")
    assert "line" in a_registration_panel._message.text()
    assert a_registration_panel.model.logic.landmarkStatus().state is StepState.TODO


def test_another_node_can_be_chosen_for_a_role(a_registration_panel, an_empty_scene):
    scene.find_or_create("TargetsCT")
    mine = an_empty_scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "mine")
    a_registration_panel.refresh()
    combo = a_registration_panel.choosers["TargetsCT"].widget
    combo.setCurrentIndex(combo.findText("mine"))
    assert scene.find("TargetsCT") is mine


def test_long_work_leaves_the_window_alive_and_ends_in_the_scene(qt, a_registration_panel, tmp_path):
    a_registration_panel.model.logic.parameters().change(ct_path=str(tmp_path / "none.nrrd"))
    assert not a_registration_panel.buttons["loadCt"].isEnabled()
    a_registration_panel.tick()
    a_registration_panel.buttons["loadCt"].click()
    assert a_registration_panel.model.busy is not None
    assert not a_registration_panel.buttons["loadCt"].isEnabled()
    assert not a_registration_panel._progress_row.isHidden()
    deadline = time.monotonic() + 20
    while a_registration_panel.model.busy is not None and time.monotonic() < deadline:
        qt.QApplication.processEvents()
        time.sleep(0.01)
    assert a_registration_panel.model.busy is None
    assert "no CT at" in a_registration_panel._message.text()
    assert a_registration_panel._progress_row.isHidden()


@pytest.mark.parametrize("name", MODULES)
def test_each_modules_widget_sets_up_enters_exits_and_cleans_up(qt, an_empty_scene, name):
    widget = module(name).widget()
    assert isinstance(widget, ScriptedLoadableModuleWidget)
    widget.setup()
    widget.enter()
    qt.QApplication.processEvents()
    assert widget.layout.count() > len(widget.panel.sections)
    widget.exit()
    widget.cleanup()


# Inside the application: its own widgets, asked for in the way PythonQt understands


class FakeWidget:
    """Records what a Qt widget of the application is told."""

    def __init__(self, *_):
        self.told, self.connected, self.properties = [], {}, {}

    def __getattr__(self, name):
        if name.startswith("_") or name in ("in_application",):
            raise AttributeError(name)
        return lambda *arguments: self.told.append((name, arguments))

    def setProperty(self, name, value):
        self.properties[name] = value

    def connect(self, signal, slot):
        self.connected[signal] = slot


def test_inside_the_application_slicers_own_widgets_are_used(monkeypatch, an_empty_scene):
    import sys

    import slicer

    monkeypatch.setattr(slicer, "app", object(), raising=False)
    monkeypatch.setattr(slicer, "qMRMLNodeComboBox", FakeWidget, raising=False)
    monkeypatch.setitem(sys.modules, "qt", SimpleNamespace(QVBoxLayout=FakeWidget, QTimer=FakeWidget))
    monkeypatch.setitem(sys.modules, "ctk", SimpleNamespace(ctkCollapsibleButton=FakeWidget))
    monkeypatch.setattr(slicer, "mrmlScene", an_empty_scene)
    panel_qt_widgets.toolkit.cache_clear()
    try:
        chosen = []
        chooser = panel_qt_widgets.NodeChooser("vtkMRMLModelNode", chosen.append)
        assert chooser.widget.nodeTypes == ["vtkMRMLModelNode"]
        assert not chooser.widget.addEnabled
        assert ("setMRMLScene", (an_empty_scene,)) in chooser.widget.told
        node = an_empty_scene.AddNewNodeByClass("vtkMRMLModelNode", "m")
        chooser.widget.connected["currentNodeChanged(vtkMRMLNode*)"](node)
        assert chosen == [node]
        section = panel_qt_widgets.Section("Title")
        section.set_title("✓ Title")
        section.set_collapsed(True)
        assert section.widget.properties == {"text": "✓ Title", "collapsed": True}
    finally:
        panel_qt_widgets.toolkit.cache_clear()
