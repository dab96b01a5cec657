"""Palpation by the module's logic on the real scene: points taken, asked for next, taken back, swept; guidance."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
from CranioNavLib import scene, scene_data
from CranioNavLib.panel import Level, StepState
from CranioNavLib.rigid import invert_rigid, rigid_from_vector, transform_points
from CranioNavLib.sequence_metafile import read_recording
from CranioNavLib.slicer_files import LabelledPoints
from echo_logic import DEPTH_MM, on_point, run_for
from ModuleUltrasoundLib import panel_description as module_panel
from ModuleUltrasoundLib.palpation.next_point import rms_tre_mm
from ModuleUltrasoundLib.palpation.palpation import PalpationLine


def test_resting_on_a_point_takes_it_and_asks_for_the_next(a_recording_logic, tmp_path):
    logic = a_recording_logic
    first, label = logic.protocolPoints()[0][0], logic.protocolPoints()[2][0]
    end = time.monotonic() + 60
    while logic.currentIndex() == 0 and time.monotonic() < end:
        run_for(logic, 0.2, on_point(logic, 0))
    assert logic.currentIndex() == 1
    taken = scene_data.get_bone_points()
    assert taken.labels == (label,)
    assert np.linalg.norm(taken.positions_mm[0] - first) < 0.5
    assert taken.has_beam.all()
    assert "1 of 18" in logic.dwell().text
    asked_s = time.monotonic() - logic.recorder.start_s  # a line that comes while undoing counts for either
    assert logic.undoPoint() == f"{label} taken back"
    assert logic.currentIndex() == 0
    assert scene.find("SurfacePoints") is None
    run_for(logic, 0.4, on_point(logic, 0))
    for killed in (True, False):
        if not killed:
            logic.closeRecording()
        recording = read_recording(tmp_path / "r.igs.mha")
        before = recording.timestamps_s < asked_s
        assert not any(status == "OK" for status, early in zip(recording.statuses, before) if early), "of the point taken back"
        assert any(status == "OK" for status, early in zip(recording.statuses, before) if not early)


def test_lines_of_a_probe_that_still_rests_on_a_taken_point_are_not_the_next_points(a_recording_logic, tmp_path):
    logic, end = a_recording_logic, time.monotonic() + 15
    while logic.currentIndex() == 0 and time.monotonic() < end:
        run_for(logic, 0.2, on_point(logic, 0))
    run_for(logic, 0.6, on_point(logic, 0))  # it rests on
    run_for(logic, 0.6, on_point(logic, 1))
    logic.closeRecording()
    recording = read_recording(tmp_path / "r.igs.mha")
    places = recording.probe_to_reference[:, :3, 3]
    for number in (0, 1):
        stood = np.linalg.norm(places - on_point(logic, number)[:3, 3], axis=1) < 1.0
        assert stood.any()
        assert set(recording.palpation_points[stood].tolist()) == {number}


def test_lines_that_wait_while_another_point_is_asked_for_stay_with_the_one_they_were_taken_at(a_recording_logic, tmp_path):
    logic = a_recording_logic
    time.sleep(0.3)  # a redraw: lines wait in the queue
    logic.nextPoint()
    pressed_s = time.monotonic() - logic.recorder.start_s
    run_for(logic, 0.4, on_point(logic, 1))
    logic.closeRecording()
    recording = read_recording(tmp_path / "r.igs.mha")
    assert recording.palpation_points.tolist() == (recording.timestamps_s >= pressed_s).astype(int).tolist()
    assert (recording.palpation_points == 0).sum() > 10


def lines_on(logic, index, start_s):
    """Measured lines of a probe that rests on a point for 0.6 s, twenty a second."""
    positions, normals, _ = logic.protocolPoints()
    moments = start_s + np.arange(13) / 20
    return [PalpationLine(t, True, 0.95, "", positions[index], np.eye(3), -normals[index], DEPTH_MM) for t in moments]


@pytest.mark.parametrize("press", ["nextPoint", "undoPoint", "none: the point was taken"])
def test_lines_that_wait_to_be_measured_are_not_the_point_that_is_asked_for_now(a_recording_logic, press):
    logic, now_s = a_recording_logic, time.monotonic()
    logic.palpation.aim(0, asked_s=now_s - 9)
    if press != "nextPoint":
        logic.takePoints(lines_on(logic, 0, now_s - 3))
        assert len(logic.taken()) == 1
    if hasattr(logic, press):
        getattr(logic, press)()
    asked, before = logic.currentIndex(), logic.taken()
    logic.takePoints(lines_on(logic, asked, now_s - 1))
    assert logic.taken() == before
    logic.takePoints(lines_on(logic, asked, time.monotonic()))
    assert logic.taken() == [*before, logic.protocolPoints()[2][asked]]


def know_the_error(logic):
    """The registration in force turns loosely about the left-right axis, and is sure of all else."""
    scene_data.set_motion_error(np.diag([0.05, 0.002, 0.002, 0.3, 0.3, 0.3]) ** 2, np.zeros(3), None)
    logic.closeRecording()
    run_for(logic, 0.3, on_point(logic, 0))
    logic.startRecording()


def test_the_point_that_shrinks_the_error_most_is_asked_for_first(a_recording_logic):
    logic = a_recording_logic
    know_the_error(logic)
    positions, normals, _ = logic.protocolPoints()
    arms = np.abs(np.cross(positions, normals)[:, 0])  # of a turn about the left-right axis
    assert arms[logic.currentIndex()] > 0.9 * arms.max()
    before, after = map(float, logic.brings().text.split(" → "))
    assert after < before
    first = logic.currentIndex()
    logic.nextPoint()
    assert logic.currentIndex() != first
    asked = {first, logic.currentIndex()}
    for _ in range(16):
        logic.nextPoint()
        asked.add(logic.currentIndex())
    assert asked == set(range(18))  # each once, before one that was left out is asked for again


def test_points_that_the_registration_was_made_of_are_not_counted_in_once_more(a_recording_logic):
    logic, (positions, _, labels) = a_recording_logic, a_recording_logic.protocolPoints()
    know_the_error(logic)
    first = logic.currentIndex()
    logic.takePoints(lines_on(logic, first, time.monotonic()))
    assert logic.taken() == [labels[first]]
    in_force = float(rms_tre_mm(np.diag([0.05, 0.002, 0.002, 0.3, 0.3, 0.3]) ** 2, np.zeros(3), positions))
    assert float(logic.brings().text.split(" → ")[0]) < in_force - 0.1
    scene_data.set_points("RegisteredPoints", LabelledPoints((labels[first],), positions[[first]]))
    logic.askNext()
    assert float(logic.brings().text.split(" → ")[0]) == pytest.approx(in_force, abs=0.06)


def test_points_that_the_table_hides_are_asked_for_last(a_recording_logic):
    logic = a_recording_logic
    logic.parameters().change(patient_lies=module_panel.PatientLies.LEFT)
    know_the_error(logic)
    normals, order = logic.protocolPoints()[1], [logic.currentIndex()]
    for _ in range(17):
        logic.nextPoint()
        order.append(logic.currentIndex())
    hidden = (normals @ [-1.0, 0, 0] >= np.cos(np.radians(50)))[order]
    assert hidden.any()
    assert not hidden[: (~hidden).sum()].any()


def test_a_point_where_the_reference_base_stands_is_asked_for_last(a_recording_logic):
    logic = a_recording_logic
    know_the_error(logic)
    first = logic.currentIndex()
    positions, normals, _ = logic.protocolPoints()
    base = np.eye(4)
    base[:3, 3] = positions[first] + 60 * normals[first]  # in the way of a probe on that point
    scene_data.set_transform("ReferenceToRas", base)
    logic.beginAsking()
    assert logic.currentIndex() != first


def test_a_point_beside_a_pin_of_the_clamp_is_asked_for_last_and_planned_elsewhere(a_recording_logic):
    logic = a_recording_logic
    know_the_error(logic)
    first, positions = logic.currentIndex(), logic.protocolPoints()[0]
    assert logic.clampPins().text.startswith("no pins known")
    reference_to_ras = rigid_from_vector([0.4, -0.2, 1.1], [20.0, 300.0, -40.0])
    pins = transform_points(invert_rigid(reference_to_ras), positions[first : first + 1])
    scene_data.set_points("ClampPins", LabelledPoints(("C1",), pins))
    scene_data.set_transform("ReferenceToRas", reference_to_ras)
    assert logic.clampPins().text.startswith("1 pin and the reference base; the probe keeps 30 mm away; ")
    logic.beginAsking()
    assert logic.currentIndex() != first
    logic.planProtocol()
    assert np.linalg.norm(logic.protocolPoints()[0] - positions[first], axis=1).min() >= 30.0


def test_pins_touched_before_there_is_a_registration_wait_for_it(a_logic, a_head):
    scene_data.set_surface("OuterTable", a_head)
    a_logic.planProtocol()
    free = a_logic.protocolPoints()[0]
    scene_data.set_points("ClampPins", LabelledPoints(("C1", "C2"), free[:2]))
    assert a_logic.clampPins().level is Level.WARNING
    assert a_logic.clampPins().text.startswith("2 pins; ")
    a_logic.planProtocol()
    np.testing.assert_array_equal(a_logic.protocolPoints()[0], free)


def test_a_gliding_probe_leaves_points_on_its_way_and_asks_for_none(a_recording_logic, tmp_path):
    logic = a_recording_logic
    logic.closeRecording()
    logic.parameters().change(palpate_by=module_panel.PalpateBy.SWEEP, recording_path=str(tmp_path / "sweep.igs.mha"))
    logic.startRecording()
    assert logic.currentPoint() is None
    start = on_point(logic, 0)
    for step in range(60):  # 16 mm along the probe's own x, slower than a sweep may be
        pose = start.copy()
        pose[:3, 3] += 0.27 * step * start[:3, 0]
        run_for(logic, 0.03, pose)
    told = len(logic.sweep) + sum(logic.sweep.refused.values())  # every line is a point, or it is said why not
    assert 0 <= logic.recorder.lines - told <= 1 + 0.2 / 0.01  # but those of the last fifth of a second
    assert logic.guidance() is not None  # where it is, it only has to stand upright
    assert logic.palpationStatus().state is StepState.ATTENTION
    assert "points of the sweep" in logic.dwell().text
    logic._guide = SimpleNamespace(instruction="hold still", on_target=True, aligned=True)
    assert logic.guidance().text == "glide on"
    logic.showSweep()
    along = np.sort(scene_data.get_bone_points().positions_mm @ start[:3, 0])
    assert np.diff(along).min() > 1.8  # one every 2 mm at most, and fewer where the machine was busy
    assert len(along) >= 3
    logic.closeRecording()
    assert set(read_recording(tmp_path / "sweep.igs.mha").palpation_points.tolist()) == {-1}


def test_a_probe_far_from_the_point_takes_nothing_and_is_told_so(a_recording_logic):
    logic = a_recording_logic
    run_for(logic, 1.5, on_point(logic, 9))
    assert logic.currentIndex() == 0
    assert "away from the target" in logic.dwell().text
    assert logic.guidance().level is Level.WARNING


def test_guidance_tells_the_tilt_under_the_registration(a_recording_logic):
    logic = a_recording_logic
    logic.closeRecording()  # guidance needs no recording, and without one no point is taken
    logic.goTo(5)
    run_for(logic, 0.6, on_point(logic, 5))
    assert float(logic.tilt().text) < 2.0
    assert logic.guidance().level is Level.GOOD
    assert logic.bullsEye().startswith("<svg")
    assert logic.aLine().startswith("<svg")
    run_for(logic, 0.6, on_point(logic, 5, tilt_deg=12.0))
    assert float(logic.tilt().text) == pytest.approx(12.0, abs=1.5)
    assert logic.guidance().level is Level.WARNING


def test_without_a_registration_there_is_no_guidance(a_recording_logic):
    scene.find("ReferenceToRas").RemoveAttribute(scene.STATUS_ATTRIBUTE)
    run_for(a_recording_logic, 0.6, on_point(a_recording_logic, 0))
    assert a_recording_logic.guidance() is None
    assert a_recording_logic.bullsEye() is None
    assert a_recording_logic.tilt() is None
