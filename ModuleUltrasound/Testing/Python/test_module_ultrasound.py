"""The ultrasound module's logic on the real scene: protocol, live lines, recording, bone points."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.panel import Level, StepState
from CranioNavLib.sequence_metafile import Acquisition, Recording, read_recording
from CranioNavLib.slicer_files import load_scene, save_scene
from echo_logic import CARRIER_HZ, DEPTH_MM, POSE, RATE_HZ, EchoDevice, echo_line, run_for
from ModuleUltrasoundLib.emulators.amode_serial import SerialPulser
from ModuleUltrasoundLib.emulators.faults import Faults
from ModuleUltrasoundLib.emulators.line_source import RecordedLines
from ModuleUltrasoundLib.emulators.server import served


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
