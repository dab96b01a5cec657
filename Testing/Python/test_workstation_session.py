"""A session that is killed at any step goes on exactly where it was."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np
import pytest
from CranioNavLib import host, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.files import set_aside
from CranioNavLib.panel import StepState
from CranioNavLib.panel_model import PanelModel
from CranioNavLib.slicer_files import LabelledPoints
from CranioNavLib.volume import Volume

from Workstation.web.session_folder import SessionFolder

SAME = ("ModuleRegistration", "ModuleUltrasound", "Session")  # panels whose read-outs and states must be as before
OF_A_CONNECTION = ("connection", "probePose", "depth", "quality", "guidance")


class Workstation:
    """The logics on one scene, as the page has them."""

    def __init__(self, folder: Any) -> None:
        from Workstation.web.application import _modules

        host.scene().Clear(False)
        self.logics: dict[str, Any] = {}
        self.models: dict[str, PanelModel] = {}
        self.step = "ct"
        self.session = SessionFolder(folder, lambda: [logic.parameters().node for logic in self.logics.values()])
        for panel, logic in _modules(self.session, self.logics, self.go_to):
            self.logics[panel.module] = logic
            self.models[panel.module] = PanelModel(panel, logic)
        self.logics["ModuleUltrasound"].parameters().change(recording_path=self.session.recording_path)

    def go_to(self, step: str) -> None:
        self.step = step

    def action(self, module: str, name: str) -> Any:
        return next(one for one in self.models[module].panel.actions() if one.name == name)

    def do(self, module: str, action: str) -> str:
        model = self.models[module]
        assert model.run(self.action(module, action)), model.message.text
        return model.message.text

    def keep(self) -> None:
        volume = self.session.ct_to_write()
        if volume is not None:
            self.session.write_ct(volume)
        self.session.save(self.step)

    def seen(self) -> dict[str, Any]:
        """What the panels show of the work, devices left out."""
        from Workstation.web.panel_state import panel_state

        found = {}
        for name in SAME:
            state = panel_state(self.models[name])
            readings = {key: value for key, value in state["readings"].items() if key not in OF_A_CONNECTION}
            steps = {key: value for key, value in state["status"].items() if key not in ("device", "palpation")}
            found[name] = {"readings": readings, "status": steps, "fields": state["fields"]}
        return found


@pytest.fixture
def a_recorded_patient(tmp_path, monkeypatch):
    """A simulated patient on the synthetic head, with a recording of his palpation."""
    monkeypatch.setenv("CRANIONAV_SIMULATED_HEAD", "synthetic")
    from Workstation.demo_case import make_case

    return make_case(None, seed=0, folder=tmp_path / "recorded")


@pytest.mark.slow
def test_a_session_killed_at_any_step_goes_on_exactly_where_it_was(a_recorded_patient, tmp_path):
    import shutil

    from CranioNavLib.case import read_case

    folder, case = tmp_path / "session", read_case(a_recorded_patient)
    pins = LabelledPoints(("C1",), case.landmarks_patient.positions_mm[1:2])

    def palpate(one: Workstation) -> None:
        shutil.copy(a_recorded_patient / "palpation.igs.mha", folder / "palpation.igs.mha")
        one.do("ModuleUltrasound", "measureRecording")

    steps = [
        ("ct", lambda one: one.do("SimulatedHand", "layPatient")),
        ("bone", lambda one: one.do("ModuleRegistration", "segmentBone")),
        ("landmarks", lambda one: scene_data.set_points("LandmarksPatient", case.landmarks_patient)),
        ("landmarks", lambda one: one.do("ModuleRegistration", "registerLandmarks")),
        ("landmarks", lambda one: scene_data.set_points("ClampPins", pins)),
        ("ultrasound", lambda one: (one.do("ModuleUltrasound", "planProtocol"), one.do("ModuleUltrasound", "nextPoint"))),
        ("ultrasound", palpate),
        ("ultrasound", lambda one: one.do("ModuleRegistration", "registerSurface")),
        ("verification", lambda one: (one.do("SimulatedHand", "measureTargets"), one.do("ModuleRegistration", "verify"))),
    ]
    running = Workstation(folder)
    for step, work in steps:
        running.step = step
        work(running)
        running.keep()
        expected = running.seen()
        running = Workstation(folder)
        assert "the session goes on" in running.do("Session", "resumeSession")
        assert running.step == step
        assert running.seen() == expected
    assert scene_data.get_points("RegisteredPoints").labels


def test_the_plan_comes_back_as_it_was_under_whatever_registration(tmp_path):
    from CranioNavLib import scene

    running = Workstation(tmp_path)
    scene_data.set_volume("CT", Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing"))
    node = scene_data.set_points("ProtocolPoints", LabelledPoints(("a", "b", "c"), 60.0 * np.eye(3)))
    for axis, name in enumerate(("Normal_R", "Normal_A", "Normal_S")):
        scene_data.add_measurement(node, name, np.eye(3)[:, axis])
    running.logics["ModuleUltrasound"].goTo(2)
    running.keep()
    host.scene().Clear(False)
    scene_data.set_transform("ReferenceToRas", np.diag([-1.0, -1.0, 1.0, 1.0])).SetAttribute(scene.STATUS_ATTRIBUTE, "accepted")
    state = running.session.read_state(tmp_path)
    assert running.session.restore_plan(state)
    positions, normals, labels = running.logics["ModuleUltrasound"].protocolPoints()
    assert labels == ("a", "b", "c")
    np.testing.assert_array_equal(positions, 60.0 * np.eye(3))
    np.testing.assert_array_equal(normals, np.eye(3))
    assert state["asked_for"] == 2
    assert not running.session.restore_plan({"planned": True}), "a session from before"


def test_a_session_that_goes_on_can_be_killed_at_once(tmp_path):
    """Its CT is the folder's own: it is not written again, which would take the state away until that is done."""
    began = Workstation(tmp_path)
    scene_data.set_volume("CT", Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing"))
    began.keep()
    host.scene().Clear(False)
    again = Workstation(tmp_path)
    volume = Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing")
    again.logics["Session"]._bring_back(tmp_path, again.session.read_state(tmp_path), {}, volume, None, None, None)
    assert again.session.ct_to_write() is None
    assert (tmp_path / "session.json").is_file()


def test_a_report_that_differs_from_the_screen_says_why(tmp_path):
    from CranioNavLib import scene
    from CranioNavLib.panel import Level

    running = Workstation(tmp_path / "session")
    report, ultrasound = running.logics["Session"], running.logics["ModuleUltrasound"].parameters()
    node = scene_data.set_transform("ReferenceToRas", np.eye(4))
    node.SetAttribute(scene.STATUS_ATTRIBUTE, "accepted")
    assert report._report_written(0.01) == "written; the registration from the files is the one on the screen"
    unexplained = report._report_written(0.4)
    assert (unexplained.level, "0.40 mm" in unexplained.text) == (Level.WARNING, True)
    assert "no setting explains it" in unexplained.text
    ultrasound.change(speed_of_sound_m_s=1600.0)
    running.logics["ModuleRegistration"].pluginSettings("segmentation", "threshold").change(threshold_hu=400.0)
    said = report._report_written(0.4).text
    assert "speed of sound is 1600.0 m/s (usual 15" in said
    assert "400.0 HU" in said
    assert said.count("(usual") == 2, "those that differ, and no others"
    node.SetAttribute(scene.STATUS_ATTRIBUTE, "landmarks")
    assert "by landmarks alone" in report._report_written(4.0).text


def test_an_earlier_recording_is_set_aside_under_a_number(tmp_path):
    path = tmp_path / "palpation.igs.mha"
    assert set_aside(path) is None
    for number in (1, 2):
        path.write_text(str(number))
        assert set_aside(path) == tmp_path / f"palpation-{number}.igs.mha"
    assert (tmp_path / "palpation-1.igs.mha").read_text() == "1"
    assert not path.exists()


def test_a_session_that_was_moved_finds_its_own_files(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    there.mkdir()
    (there / "palpation.igs.mha").write_text("")
    running = Workstation(here)
    running.session.correct_paths(there)
    assert running.logics["ModuleUltrasound"].parameters().read().recording_path == str(there / "palpation.igs.mha")


def test_a_damaged_session_is_refused_and_nothing_is_changed(tmp_path):
    folder = tmp_path / "session"
    folder.mkdir()
    (folder / "session.json").write_text("{")
    running = Workstation(folder)
    model = running.models["Session"]
    assert not model.run(next(one for one in model.panel.actions() if one.name == "resumeSession"))
    assert "cannot be read" in model.message.text
    assert running.logics["ModuleRegistration"].ctStatus().text == "load the head CT"


def test_what_was_verified_is_kept(tmp_path):
    running = Workstation(tmp_path)
    scene_data.set_volume("CT", Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing"))
    scene_data.set_transform("ReferenceToRas", np.eye(4)).SetAttribute("CranioNav.Status", "accepted")
    scene_data.set_table("TargetErrors", {"target": ["a"], "TRE (mm)": [1.5]})
    scene_data.set_points("RegisteredPoints", LabelledPoints(("p",), np.array([[1.0, 2, 3]])))
    running.keep()
    state = json.loads((tmp_path / "session.json").read_text())
    assert state["tables"]["TargetErrors"] == {"target": ["a"], "TRE (mm)": [1.5]}
    assert state["registered_points"] == {"labels": ["p"], "positions_mm": [[1.0, 2.0, 3.0]]}


def test_a_second_ct_takes_the_place_of_the_first_in_the_folder(tmp_path):
    import SimpleITK

    running = Workstation(tmp_path)
    volumes = [Volume(np.full((4, 5, 6), value, np.int16), np.eye(4), "CT") for value in (1, 2, 3)]
    running.logics["ModuleRegistration"].takeCt(volumes[0])
    running.keep()
    assert (tmp_path / "session.json").is_file()
    pending = []
    for volume in volumes[1:]:
        running.logics["ModuleRegistration"].takeCt(volume)
        pending.append(running.session.ct_to_write())
        running.session.save("ct")
    for volume in reversed(pending):  # two workers: the last that ends need not be the last that began
        running.session.write_ct(volume)
        assert not (tmp_path / "session.json").exists(), "a state beside a CT that it is not of"
    assert SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(tmp_path / "ct.nrrd")).max() == 3
    running.keep()
    assert (tmp_path / "session.json").is_file()


def test_a_ct_that_could_not_be_written_is_offered_again_and_nothing_counts_as_saved(tmp_path):
    (tmp_path / "session").write_text("a file where the folder should be")
    running = Workstation(tmp_path / "session")
    scene_data.set_volume("CT", Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing"))
    with pytest.raises(InputError, match="cannot write into"):
        running.keep()
    running.session.save("ct")
    assert not running.session.is_saved
    (tmp_path / "session").unlink()
    running.keep()
    assert running.session.is_saved
    assert (tmp_path / "session" / "session.json").is_file()


@pytest.mark.parametrize("goes_on", [False, True])
def test_of_a_session_that_is_not_gone_on_with_nothing_is_taken_for_the_next_patient(tmp_path, goes_on):
    for name in ("session.json", "landmarks-patient.mrk.json", "targets-patient.mrk.json", "palpation.igs.mha"):
        (tmp_path / name).write_text("of the one before")
    running = Workstation(tmp_path)
    running.session.goes_on = goes_on
    scene_data.set_volume("CT", Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing"))
    running.keep()
    for name in ("landmarks-patient", "targets-patient", "palpation"):
        kept = sorted(path.name for path in tmp_path.glob(f"{name}*"))
        assert [one.startswith(f"{name}-1.") for one in kept] == [not goes_on], kept
    assert json.loads((tmp_path / "session.json").read_text())["step"] == "ct"


def test_of_a_patient_laid_on_the_table_before_nothing_stays(tmp_path):
    from types import SimpleNamespace

    from CranioNavLib import scene
    from CranioNavLib.phantom.session import use_session

    running = Workstation(tmp_path)
    hand = running.logics["SimulatedHand"]
    places = np.array([[0.0, 90, 0], [50, 60, 10], [-50, 60, 12]])
    laid = SimpleNamespace(landmark_labels=("a", "b", "c"), landmarks_ras_mm=places, markers_ras_mm=places)
    volume = Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing")
    hand._take(SimpleNamespace(patient=laid), volume, "one")
    for role in ("LandmarksPatient", "SurfacePoints", "TargetsPatient", "ClampPins", "ProtocolPoints", "RegisteredPoints"):
        scene_data.set_points(role, LabelledPoints(("a", "b", "c"), places))
    scene_data.set_transform("ReferenceToRas", np.diag([-1.0, -1.0, 1.0, 1.0])).SetAttribute("CranioNav.Status", "accepted")
    scene_data.set_table("Results", {"quantity": ["verdict"], "value": ["accepted"]})
    (tmp_path / "palpation.igs.mha").write_text("of the one before")
    hand._take(SimpleNamespace(patient=laid), volume, "another")
    use_session(None)
    touched = ("LandmarksPatient", "SurfacePoints", "TargetsPatient", "ClampPins")
    for role in (*touched, "ProtocolPoints", "RegisteredPoints", "Results"):
        assert scene.find(role) is None, role
    assert running.logics["Navigation"].navigationStatus().state is StepState.TODO
    assert running.models["ModuleUltrasound"].blocked(running.action("ModuleUltrasound", "measureRecording"))
    assert (tmp_path / "palpation-1.igs.mha").is_file(), "set aside, not lost"


def test_a_report_of_another_registration_is_none_of_this_one_after_a_restart_either(tmp_path):
    running = Workstation(tmp_path)
    scene_data.set_volume("CT", Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing"))
    node = scene_data.set_transform("ReferenceToRas", np.eye(4))
    node.SetAttribute("CranioNav.Status", "accepted")
    running.logics["Session"]._report_written(0.0)
    for turned, state in ((np.eye(4), StepState.DONE), (np.diag([-1.0, -1.0, 1.0, 1.0]), StepState.ATTENTION)):
        scene_data.set_transform("ReferenceToRas", turned)
        running.keep()
        again = Workstation(tmp_path)
        again.session.restore_registration(again.session.read_state(tmp_path))
        assert again.logics["Session"].reportStatus().state is state
        running = again
        scene_data.set_volume("CT", Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing"))


def test_a_report_that_is_cancelled_is_written_no_further(tmp_path):
    from CranioNavLib.panel import Cancelled, Progress

    from Workstation.web.session_panel import _run_until_cancelled

    late = "import time, pathlib; time.sleep(1.5); pathlib.Path('late').touch()"
    progress = Progress(lambda text, share: progress.cancel())
    with pytest.raises(Cancelled):
        _run_until_cancelled([sys.executable, "-c", late], tmp_path, progress)
    time.sleep(2)
    assert not (tmp_path / "late").exists()
    with pytest.raises(InputError, match="no such case"):
        _run_until_cancelled([sys.executable, "-c", "raise SystemExit('no such case')"], tmp_path, Progress())
