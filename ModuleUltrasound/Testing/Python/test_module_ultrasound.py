"""The ultrasound module's logic on the real scene: protocol, live lines, recording, bone points."""

from __future__ import annotations

import time
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.panel import Level, StepState
from CranioNavLib.parameters import Parameters
from CranioNavLib.rigid import invert_rigid, rigid, rigid_from_vector, transform_points
from CranioNavLib.sequence_metafile import Acquisition, Recording, read_recording
from CranioNavLib.slicer_files import LabelledPoints, load_scene, save_scene
from CranioNavLib.surface import Surface
from ModuleUltrasoundLib import panel_description as module_panel
from ModuleUltrasoundLib.devices.device import AMODE_DEVICES, AModeDevice, RfLine
from ModuleUltrasoundLib.emulators.amode_serial import SerialPulser
from ModuleUltrasoundLib.emulators.faults import Faults
from ModuleUltrasoundLib.emulators.line_source import RecordedLines
from ModuleUltrasoundLib.emulators.server import served
from ModuleUltrasoundLib.palpation.next_point import rms_tre_mm
from ModuleUltrasoundLib.palpation.palpation import PalpationLine

import ModuleUltrasound as module

RATE_HZ, CARRIER_HZ, SPEED_M_S = 50e6, 5e6, 1540.0
DEPTH_MM = 6.0
POSE = rigid(np.diag([1.0, -1.0, -1.0]), [5.0, 6.0, 50.0])  # the beam points down


def echo_line(depth_mm, rng):
    """Transmit pulse, skin at 1 mm, bone at `depth_mm` below the transducer, noise: no forerun."""
    times = np.arange(1500) / RATE_HZ
    samples = rng.normal(0, 20, len(times))
    for mm, amplitude, seconds in ((0.0, 20000, 2e-7), (depth_mm, 8000, 2.5e-7)):
        late = times - 2e-3 * mm / SPEED_M_S
        samples += amplitude * np.exp(-((late / seconds) ** 2)) * np.cos(2 * np.pi * CARRIER_HZ * late)
    return np.clip(samples, -32768, 32767).astype(np.int16)


@AMODE_DEVICES.register
class EchoDevice(AModeDevice):
    name = "one-echo"
    title = "One echo"

    @dataclass(frozen=True)
    class Settings(Parameters):
        pass

    refuse = ""

    def open(self):
        if EchoDevice.refuse:
            raise InputError(EchoDevice.refuse)
        self.rng = np.random.default_rng(0)

    def start(self):
        pass

    def stop(self):
        pass

    def close(self):
        pass

    @property
    def acquisition(self):
        return Acquisition(RATE_HZ, CARRIER_HZ)

    def read(self, timeout_s=1.0):
        time.sleep(0.01)
        return RfLine(echo_line(DEPTH_MM, self.rng), time.monotonic())


@pytest.fixture
def a_logic():
    host.scene().Clear(False)
    EchoDevice.refuse = ""
    logic = module.ModuleUltrasoundLogic()
    logic.parameters().change(device="one-echo")
    yield logic
    logic.disconnect()
    host.scene().Clear(False)


@pytest.fixture(scope="module")
def a_head():
    """An egg of a head's size, finely meshed, in RAS."""
    import vtk

    source = vtk.vtkSphereSource()
    source.SetThetaResolution(160)
    source.SetPhiResolution(120)
    source.SetRadius(1.0)
    source.Update()
    egg = Surface.from_polydata(source.GetOutput())
    return Surface(egg.vertices_mm * [72.0, 92.0, 85.0], egg.triangles)


def run_for(logic, seconds, pose=POSE, status="OK"):
    """The event loop; a tracker goes on at 20 poses a second however long a poll takes."""
    told_s = time.monotonic()
    end = told_s + seconds
    while (now := time.monotonic()) < end:
        for moment_s in (*np.arange(told_s + 0.05, now, 0.05), now):
            scene_data.set_pose("ProbeToReference", pose, status, float(moment_s))
        told_s = now
        logic.poll()
        time.sleep(0.01)


def test_the_protocol_is_planned_and_survives_a_saved_scene(a_logic, a_head, tmp_path):
    scene_data.set_surface("OuterTable", a_head)
    assert a_logic.planProtocol() == "18 points"
    positions, normals, labels = a_logic.protocolPoints()
    assert a_head.closest(positions).distances_mm.max() < 0.5
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    a_logic.nextPoint()
    save_scene(tmp_path / "s.mrb")
    load_scene(tmp_path / "s.mrb")
    assert a_logic.currentIndex() == 1
    again = a_logic.protocolPoints()
    np.testing.assert_allclose(again[1], normals, atol=1e-9)
    assert again[2] == labels
    assert a_logic.currentPoint().text == f"2. {labels[1]}"


def test_going_on_and_back_stays_within_the_protocol(a_logic, a_head):
    assert a_logic.nextPointBlocked() == "plan the points first"
    scene_data.set_surface("OuterTable", a_head)
    a_logic.planProtocol()
    a_logic.previousPoint()
    assert a_logic.currentIndex() == 0
    for _ in range(30):
        a_logic.nextPoint()
    assert a_logic.currentIndex() == 17


def test_points_edited_by_hand_are_planned_again(a_logic, a_head):
    scene_data.set_surface("OuterTable", a_head)
    a_logic.planProtocol()
    scene.find("ProtocolPoints").AddControlPoint([0.0, 0.0, 85.0], "mine")
    with pytest.raises(InputError, match="plan them again"):
        a_logic.protocolPoints()


def test_live_lines_are_shown_and_need_the_probes_pose(a_logic):
    assert a_logic.probePose().level is Level.BAD
    a_logic.connect()
    run_for(a_logic, 1.0)
    assert a_logic.deviceStatus().state is StepState.DONE
    table = scene_data.get_table("ALine")
    assert len(table["amplitude"]) == 1500
    assert table["time (µs)"][1] == pytest.approx(0.02)
    assert a_logic.depth() is not None
    assert a_logic.probePose().level is Level.GOOD


def test_a_gain_changed_while_connected_is_the_devices_at_once(a_logic):
    lines = np.stack([echo_line(DEPTH_MM, np.random.default_rng(0)) // 8] * 4)
    still = Recording(
        lines, Acquisition(RATE_HZ, CARRIER_HZ), np.tile(POSE, (4, 1, 1)), ("OK",) * 4, np.arange(4.0), np.zeros(4, int)
    )
    with served(SerialPulser(RecordedLines(still), Faults(), rate_hz=50)) as port:
        a_logic.parameters().change(device="serial")
        settings = a_logic.pluginSettings("amode", "serial")
        settings.change(port=port, range_us=25.0)
        a_logic.connect()
        run_for(a_logic, 0.5)
        assert a_logic.latest.line.gain_db == 30.0
        settings.change(gain_db=36.0)
        run_for(a_logic, 1.0)
        assert a_logic.latest.line.gain_db == 36.0
        a_logic.disconnect()


def test_a_recording_holds_every_line_with_its_pose_and_point(a_logic, a_head, tmp_path):
    scene_data.set_surface("OuterTable", a_head)
    a_logic.planProtocol()
    a_logic.parameters().change(recording_path=str(tmp_path / "r.igs.mha"))
    a_logic.connect()
    assert a_logic.startRecordingBlocked() == "no line has come yet"
    run_for(a_logic, 0.4)
    a_logic.startRecording()
    assert a_logic.measureRecordingBlocked() == "stop the recording first"
    run_for(a_logic, 0.4)
    a_logic.nextPoint()
    run_for(a_logic, 0.4)
    a_logic.closeRecording()
    recording = read_recording(tmp_path / "r.igs.mha")
    assert len(recording) > 20
    assert set(recording.palpation_points.tolist()) == {0, 1}
    ok = np.array([status == "OK" for status in recording.statuses])
    assert ok.sum() > 0.4 * len(ok), "a busy computer leaves gaps between this test's poses"
    np.testing.assert_allclose(recording.probe_to_reference[ok], np.tile(POSE, (ok.sum(), 1, 1)), atol=1e-6)


def test_lines_of_a_lost_probe_are_recorded_without_a_pose(a_logic, tmp_path):
    a_logic.parameters().change(recording_path=str(tmp_path / "r.igs.mha"))
    a_logic.connect()
    run_for(a_logic, 0.3)
    a_logic.startRecording()
    run_for(a_logic, 0.2)
    run_for(a_logic, 0.5, pose=None, status="MISSING")
    a_logic.closeRecording()
    recording = read_recording(tmp_path / "r.igs.mha")
    assert recording.statuses[-1] == "MISSING"
    assert np.isnan(recording.probe_to_reference[-1]).all()


def test_a_device_that_refuses_its_settings_says_so(a_logic):
    EchoDevice.refuse = "no such port COM9; give another"
    a_logic.connect()
    with pytest.raises(InputError, match="COM9"):
        run_for(a_logic, 3.0)
    assert a_logic.stream is None
    assert "COM9" in a_logic.connection().text
    assert a_logic.connectBlocked() == ""


def on_point(logic, index, tilt_deg=0.0):
    """ProbeToReference with the bone 6 mm below the face, square to it or tilted about the bone point."""
    positions, normals, _ = logic.protocolPoints()
    beam = -normals[index]
    across = np.cross(beam, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across)
    straight = rigid(np.column_stack([across, np.cross(beam, across), beam]), positions[index])
    turned = straight @ rigid_from_vector([np.radians(tilt_deg), 0, 0], np.zeros(3))
    return turned @ rigid(np.eye(3), [0, 0, -DEPTH_MM])


@pytest.fixture
def a_recording_logic(a_logic, a_head, tmp_path):
    """Recording with a planned protocol, registered: Reference is RAS."""
    scene_data.set_surface("OuterTable", a_head)
    a_logic.planProtocol()
    scene_data.set_transform("ReferenceToRas", np.eye(4)).SetAttribute(scene.STATUS_ATTRIBUTE, "landmarks")
    a_logic.parameters().change(recording_path=str(tmp_path / "r.igs.mha"))
    a_logic.connect()
    run_for(a_logic, 0.3, on_point(a_logic, 0))
    a_logic.startRecording()
    return a_logic


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
    assert logic.undoPoint() == f"{label} taken back"
    undone_s = time.monotonic() - logic.recorder.start_s
    assert logic.currentIndex() == 0
    assert scene.find("SurfacePoints") is None
    run_for(logic, 0.4, on_point(logic, 0))
    logic.closeRecording()
    recording = read_recording(tmp_path / "r.igs.mha")
    before = recording.timestamps_s < undone_s
    assert not any(status == "OK" for status, early in zip(recording.statuses, before) if early), "those of the point taken back"
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
    assert logic.clampPins().text == "1 pin; the probe keeps 30 mm away"
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
