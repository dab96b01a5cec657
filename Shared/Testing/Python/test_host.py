"""The host: one real MRML scene in a plain Python, quiet, in one thread, shared with whoever brings another."""

from __future__ import annotations

import subprocess
import sys
import threading

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.errors import InputError

CLASSES = (
    "MarkupsFiducial MarkupsJsonStorage MarkupsFiducialStorage Model ModelStorage ScalarVolume VolumeArchetypeStorage "
    "Segmentation SegmentationStorage LinearTransform TransformStorage Table TableStorage PlotChart PlotSeries Sequence "
    "SequenceStorage SequenceBrowser Text TextStorage ScriptedModule SubjectHierarchy"
).split()


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)


@pytest.fixture
def an_empty_scene():
    host.scene().Clear(False)
    yield host.scene()
    host.scene().Clear(False)


@pytest.mark.parametrize("name", CLASSES)
def test_every_kind_of_node_is_usable(name):
    assert host.scene().CreateNodeByClass(f"vtkMRML{name}Node") is not None


def test_the_scene_is_slicers():
    assert host.slicer.mrmlScene is host.scene()
    assert host.scene() is host.scene()


def test_importing_the_host_makes_no_scene_and_says_nothing():
    done = run("import sys, CranioNavLib.host; assert 'slicer' not in sys.modules and 'vtk' not in sys.modules")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_booting_saving_and_refusing_say_nothing_on_the_console(tmp_path):
    (tmp_path / "broken.tfm").write_text("nonsense")
    done = run(
        "from CranioNavLib import host, scene\n"
        "from CranioNavLib.slicer_files import save_scene, load_scene, read_transform\n"
        "for role in scene.ROLES: scene.find_or_create(role)\n"
        f"save_scene(r'{tmp_path}/s.mrb'); load_scene(r'{tmp_path}/s.mrb')\n"
        f"try: read_transform(r'{tmp_path}/broken.tfm')\n"
        "except ValueError: pass\n"
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_scene_from_elsewhere_becomes_the_hosts_and_knows_all_nodes(an_empty_scene):
    slicer, before = host.slicer_package(), host.scene()
    other = slicer.vtkMRMLScene()
    try:
        assert host.adopt_scene(other) is host.scene() is slicer.mrmlScene is other
        scene_data.set_transform("ReferenceToRas", np.eye(4))
        assert other.GetNumberOfNodesByClass("vtkMRMLLinearTransformNode") == 1
        assert before.GetNumberOfNodesByClass("vtkMRMLLinearTransformNode") == 0
        assert other.CreateNodeByClass("vtkMRMLSequenceBrowserNode") is not None
    finally:
        host.adopt_scene(before)


def test_the_web_workstations_scene_can_be_adopted():
    done = run(
        "from trame_slicer.core import SlicerApp\n"
        "from CranioNavLib import host, scene\n"
        "app = SlicerApp()\n"
        "host.adopt_scene(app.scene, app.app_logic)\n"
        "import slicer\n"
        "assert slicer.mrmlScene is app.scene is host.scene()\n"
        "for role in scene.ROLES: scene.find_or_create(role)\n"
        "assert app.scene.GetNumberOfNodesByClass('vtkMRMLMarkupsFiducialNode') >= 7\n"
    )
    assert done.returncode == 0, done.stderr


def test_a_node_write_from_another_thread_is_refused(an_empty_scene):
    caught = []

    def write() -> None:
        try:
            scene_data.set_transform("ProbeToReference", np.eye(4))
        except RuntimeError as error:
            caught.append(str(error))

    thread = threading.Thread(target=write, name="tracker")
    thread.start()
    thread.join()
    assert len(caught) == 1
    assert "'tracker'" in caught[0]
    assert "queue" in caught[0]
    assert scene.find("ProbeToReference") is None


def test_quiet_keeps_what_mrml_says(tmp_path):
    slicer = host.slicer
    storage, node = slicer.vtkMRMLMarkupsJsonStorageNode(), slicer.vtkMRMLMarkupsFiducialNode()
    storage.SetFileName(str(tmp_path / "none.mrk.json"))
    with host.quiet() as said:
        assert not storage.ReadData(node)
    assert "none.mrk.json" in said.GetOutput()


def test_missing_packages_outside_the_application_are_named(monkeypatch):
    monkeypatch.setattr(host, "PACKAGES", {"scipy": "scipy", "no_such_thing": "no-such-thing"})
    assert host.missing_packages() == ["no-such-thing"]
    with pytest.raises(InputError, match="pip install no-such-thing"):
        host.install_missing_packages()


class _FakeUtil:
    def __init__(self, answer: bool) -> None:
        self.answer, self.installed = answer, []

    def confirmOkCancelDisplay(self, text, windowTitle=""):
        self.asked = text
        return self.answer

    def pip_install(self, packages):
        self.installed.append(packages)


@pytest.mark.parametrize("answer", [True, False])
def test_inside_the_application_packages_are_installed_only_when_the_user_agrees(monkeypatch, answer):
    import slicer

    util = _FakeUtil(answer)
    monkeypatch.setattr(host, "PACKAGES", {"no_such_thing": "no-such-thing"})
    monkeypatch.setattr(slicer, "app", object(), raising=False)
    monkeypatch.setattr(slicer, "util", util)
    if answer:
        host.install_missing_packages()
        assert util.installed == ["no-such-thing"]
    else:
        with pytest.raises(InputError, match="no-such-thing"):
            host.install_missing_packages()
        assert util.installed == []
    assert "no-such-thing" in util.asked


def test_inside_the_application_its_scene_and_base_classes_are_used(monkeypatch):
    import types

    import slicer

    theirs = types.ModuleType("slicer.ScriptedLoadableModule")
    for name in host.BASE_CLASSES:
        setattr(theirs, name, type(name, (), {}))
    their_scene = object()
    monkeypatch.setattr(slicer, "app", object(), raising=False)
    monkeypatch.setattr(slicer, "mrmlScene", their_scene)
    monkeypatch.setitem(sys.modules, "slicer.ScriptedLoadableModule", theirs)
    assert host.scene() is their_scene
    assert host.slicer.mrmlScene is their_scene
    for name in host.BASE_CLASSES:
        assert getattr(host, name) is getattr(theirs, name)


def test_a_module_works_in_a_plain_console_as_in_slicers():
    done = run(
        "import ModuleRegistration\n"
        "from ModuleRegistration import ModuleRegistrationLogic\n"
        "logic = ModuleRegistrationLogic()\n"
        "import slicer\n"
        "assert logic.getParameterNode().GetScene() is slicer.mrmlScene\n"
        "assert logic.getParameterNode() is ModuleRegistrationLogic().getParameterNode()\n"
        "module = ModuleRegistration.ModuleRegistration(None)\n"
        "import pathlib\n"
        "assert pathlib.Path(module.resourcePath('Icons/ModuleRegistration.png')).is_file()\n"
        "assert 'Landmarks' in module.parent.helpText\n"
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
