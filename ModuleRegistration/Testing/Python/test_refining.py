"""What guidance rests on gets better as points arrive, by itself and beside the result."""

from __future__ import annotations

import threading
import time
from concurrent.futures import wait
from types import SimpleNamespace

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import invert_rigid, transform_points
from CranioNavLib.scene_guidance import get_guidance
from CranioNavLib.slicer_files import LabelledPoints
from ModuleRegistrationLib.logic import refining, results
from ModuleRegistrationLib.registration import verdict as verdicts
from ModuleRegistrationLib.registration.problem import RegistrationResult
from touched_patient import TRUTH

MATRICES = {}  # of a stand-in for a method, by the number of points that it is given


class Method:
    """Registers at once, rightly but for what tells how many points it was given."""

    name = "stand-in"

    def __init__(self):
        self.given, self.threads, self.wait = [], [], threading.Event()
        self.wait.set()
        self.refuses = None

    def register(self, problem):
        self.given.append(problem.points.labels)
        self.threads.append(threading.current_thread())
        self.wait.wait(10)
        if self.refuses is not None:
            raise self.refuses
        count = len(problem.points)
        shifted = TRUTH.copy()
        shifted[0, 3] += 1e-3 * count
        MATRICES[count] = shifted
        nothing, all_used = np.zeros(count), np.ones(count, dtype=bool)
        moved = transform_points(shifted, problem.points.positions_mm)
        return RegistrationResult("stand-in", shifted, 0.1, nothing, all_used, 1, "done", moved, 1e-4 * np.eye(6), np.zeros(3))


def touch(patient, count, first=0):
    """The bone points from `first` on, `count` of them, are all that has been taken."""
    scene_data.set_bone_points(patient.all_points.subset(np.arange(first, first + count)))
    settle(patient)


def settle(logic, seconds=60.0):
    """The owner's event loop, until nothing is under way and nothing new is seen."""
    end = time.monotonic() + seconds
    for _ in range(3):
        logic._lookAt_s = 0.0
        logic.poll()
        while logic._underway is not None:
            assert time.monotonic() < end
            time.sleep(0.005)
            logic.poll()


@pytest.fixture
def a_guided_patient(a_patient):
    """Landmarks are registered, the probe is tracked, and no bone point has been taken."""
    a_patient.all_points = scene_data.get_bone_points()
    scene.release("SurfacePoints")
    a_patient.registerLandmarks()
    scene_data.set_pose("ProbeToReference", np.eye(4), "OK", time.monotonic())
    return a_patient


@pytest.fixture
def a_method(a_guided_patient, monkeypatch):
    """In place of the one chosen; every verdict is good unless a test says otherwise."""
    method = Method()
    monkeypatch.setattr(a_guided_patient, "createPlugin", lambda kind, name: method)
    monkeypatch.setattr(verdicts, "judge", lambda *_: verdicts.Verdict("accepted"))
    yield method
    method.wait.set()


def say(monkeypatch, status, *messages):
    monkeypatch.setattr(verdicts, "judge", lambda *_: verdicts.Verdict(status, messages))


def error_mm(matrix):
    """Largest, at the targets."""
    targets = scene_data.get_points("TargetsCT").positions_mm
    return np.linalg.norm(transform_points(matrix @ invert_rigid(TRUTH), targets) - targets, axis=1).max()


def all_but_guidance():
    """Every node of the scene, but the one of guidance and the points that are given, as text."""
    kept = {}
    for index in range(host.scene().GetNumberOfNodes()):
        node = host.scene().GetNthNode(index)
        if node.GetAttribute(scene.ROLE_ATTRIBUTE) not in ("Guidance", "SurfacePoints") and not node.IsA("vtkMRMLStorageNode"):
            kept[node.GetID()] = node.GetMTime()
    return kept


def test_guidance_gets_better_from_six_points_on_and_the_result_stays_as_it_was(a_guided_patient):
    logic = a_guided_patient
    logic.parameters().change(method="cranionav")
    rough, rows = scene_data.get_transform("ReferenceToRas"), results.rows()
    touch(logic, 5)
    assert not get_guidance().refined
    np.testing.assert_array_equal(get_guidance().reference_to_ras, rough)
    touch(logic, 12)
    rests = get_guidance()
    assert rests.refined
    assert rests.remark == ""
    assert rests.points == logic.all_points.labels[:12]
    assert error_mm(rests.reference_to_ras) < 0.5 * error_mm(rough)
    assert np.trace(rests.error[0][3:, 3:]) < 0.5 * np.trace(scene_data.get_motion_error()[0][3:, 3:])
    np.testing.assert_array_equal(scene_data.get_transform("ReferenceToRas"), rough)
    assert (results.status(), results.rows(), logic.registered) == ("landmarks", rows, None)
    assert all(scene.find(role) is None for role in ("RegisteredPoints", "Residuals", "TargetErrors"))


def test_no_other_node_is_touched_and_the_scenes_thread_computes_nothing(a_guided_patient, a_method):
    touch(a_guided_patient, 5)
    before = all_but_guidance()
    touch(a_guided_patient, 6)
    assert get_guidance().refined
    added = [host.scene().GetNodeByID(name) for name in set(all_but_guidance()) - set(before)]
    assert {name: stamp for name, stamp in all_but_guidance().items() if name in before} == before
    assert all(node.IsA("vtkMRMLDisplayNode") for node in added), "of the points"
    assert all(thread is not threading.main_thread() for thread in a_method.threads)


def test_points_taken_back_are_given_up(a_guided_patient, a_method):
    logic, labels = a_guided_patient, a_guided_patient.all_points.labels
    touch(logic, 7)
    assert get_guidance().points == labels[:7]
    touch(logic, 6)
    assert get_guidance().points == labels[:6]
    np.testing.assert_array_equal(get_guidance().reference_to_ras, MATRICES[6])
    touch(logic, 5)
    assert not get_guidance().refined, "five points hold no six degrees of freedom"
    touch(logic, 6)
    scene.release("SurfacePoints")
    settle(logic)
    assert (get_guidance().refined, get_guidance().points) == (False, ())


def test_what_comes_of_a_point_that_was_taken_back_meanwhile_is_dropped(a_guided_patient, a_method):
    logic = a_guided_patient
    a_method.wait.clear()
    scene_data.set_bone_points(logic.all_points.subset(np.arange(7)))
    logic.poll()
    scene_data.set_bone_points(logic.all_points.subset(np.arange(6)))
    seen = []
    a_method.wait.set()
    while logic._underway is not None:
        logic.poll()
        seen.append(get_guidance().points)
    assert set(seen) == {()}
    settle(logic)
    assert get_guidance().points == logic.all_points.labels[:6]


def test_other_landmarks_replace_it(a_guided_patient, a_method):
    logic, labels = a_guided_patient, a_guided_patient.all_points.labels
    touch(logic, 8)
    points = scene_data.get_points("LandmarksPatient")
    away = points.positions_mm + [[1.5, 0, 0], [0, 0, 0], [0, 1.0, 0], [0, 0, 0]]
    scene_data.set_points("LandmarksPatient", LabelledPoints(points.labels, away))
    settle(logic)
    assert not get_guidance().refined, "the registration in force is of the landmarks before"
    assert len(a_method.given) == 1
    logic.registerLandmarks()
    assert not get_guidance().refined
    settle(logic)
    assert get_guidance().points == labels[:8]
    assert len(a_method.given) == 2


def test_a_warned_or_failed_refinement_keeps_the_former_one_and_says_so(a_guided_patient, a_method, monkeypatch, caplog):
    logic, labels = a_guided_patient, a_guided_patient.all_points.labels
    say(monkeypatch, "warning", "ambiguous: another pose fits too")
    touch(logic, 6)
    assert (get_guidance().refined, get_guidance().remark) == (
        False,
        "not refined with 6 points: ambiguous: another pose fits too",
    )
    say(monkeypatch, "accepted", "1 of 7 points contradicts the others")
    touch(logic, 7)
    assert (get_guidance().points, get_guidance().remark) == (labels[:7], "")
    for refuses in (InputError("the points lie on one line"), ZeroDivisionError("division by zero")):
        a_method.refuses = refuses
        touch(logic, len(get_guidance().points) + 1 + isinstance(refuses, ZeroDivisionError))
        assert get_guidance().points == labels[:7]
        assert str(refuses) in get_guidance().remark
        assert "\n" not in get_guidance().remark
    assert "ZeroDivisionError" in caplog.text, "a defect is told to those who mend it"
    touch(logic, 6)
    assert not get_guidance().refined, "the former one rests on a point that was taken back"
    assert get_guidance().remark.startswith("not refined with 6 points: ")


def test_nobody_is_guided_without_a_probe(a_patient, monkeypatch):
    a_patient.registerLandmarks()
    settle(a_patient)
    assert a_patient._worker is None
    assert scene.find("Guidance") is None


def test_a_registration_of_all_points_is_what_guidance_rests_on(a_guided_patient, a_method):
    logic = a_guided_patient
    touch(logic, 8)
    logic.registerSurface().run()
    settle(logic)
    assert (get_guidance().refined, len(get_guidance().points), len(a_method.given)) == (False, 8, 2)
    touch(logic, 9)
    assert (get_guidance().refined, len(get_guidance().points)) == (True, 9)
    assert (results.status(), logic.registered.verdict.status) == ("accepted", "accepted"), "not stale, not another one"
    np.testing.assert_array_equal(scene_data.get_transform("ReferenceToRas"), MATRICES[8])


def test_a_gliding_probe_does_not_keep_the_computer_busy(a_guided_patient, a_method, monkeypatch):
    logic = a_guided_patient
    monkeypatch.setattr(refining, "LOOK_EVERY_S", 0.05)
    clock = time.monotonic() + 10.0  # the module's own, so that a busy machine changes nothing
    monkeypatch.setattr(refining, "time", SimpleNamespace(monotonic=lambda: clock))
    a_method.wait.clear()
    longest = 0.0
    for count in range(6, 40):  # a point with every poll
        scene_data.set_bone_points(logic.all_points.subset(np.arange(count)))
        if a_method.wait.is_set() and logic._underway is not None:
            wait([logic._underway.outcome], timeout=10)
        before = time.monotonic()
        logic.poll()
        longest = max(longest, time.monotonic() - before)
        clock += 0.02
        if count == 20:
            a_method.wait.set()
    assert longest < 0.2, "the views go on"
    assert len(a_method.given) == 2, "the first took 0.3 s of 0.68, so the next waits as long"
