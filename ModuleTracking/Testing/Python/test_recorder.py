"""The session recorder: every tool, every line, at the right time, with nothing invented."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import invert_rigid, rigid
from CranioNavLib.sequence_metafile import Acquisition, read_recording
from ModuleTrackingLib.pose_stream import PoseStream
from ModuleTrackingLib.recorder import SessionRecorder
from scipy.spatial.transform import Rotation
from scripted_tracker import ScriptedTracker, a_pose, missing, ok, wait_until

ACQUISITION = Acquisition(50e6, 5e6, 10.0, 2730.0)
START = 1000.0


class HandClock:
    def __init__(self) -> None:
        self.now = START

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def a_clock():
    return HandClock()


@pytest.fixture
def a_tracker():
    return ScriptedTracker()


@pytest.fixture
def a_stream(a_tracker, a_clock):
    with PoseStream(a_tracker, clock=a_clock) as stream:
        yield stream


def poll(stream, count):
    frames: list = []
    wait_until(lambda: frames.extend(stream.poll()) or len(frames) >= count)
    return frames


def base_at(time_s):
    """Head and base drift and turn together while the surgeon palpates."""
    seconds = time_s - START
    return rigid(
        Rotation.from_rotvec([0.2 * seconds, -0.1 * seconds, 0.05]).as_matrix(), [50 * seconds, 20, -1500 + 30 * seconds]
    )


def test_every_tool_is_recorded_in_both_frames(tmp_path, a_tracker, a_stream, a_clock):
    for k in range(30):
        time_s = START + k / 60
        stylus = missing("Stylus", time_s) if k % 4 == 1 else ok("Stylus", a_pose(k), time_s)
        a_tracker.put([ok("Probe", a_pose(50 + k), time_s), ok("Reference", base_at(time_s), time_s), stylus])
    with SessionRecorder(tmp_path / "r.igs.mha", a_stream, clock=a_clock) as recorder:
        recorder.add_frames(poll(a_stream, 30))
    recording = read_recording(tmp_path / "r.igs.mha")
    assert len(recording) == 30
    np.testing.assert_allclose(recording.timestamps_s, np.arange(30) / 60, atol=1e-9)
    names = {"ProbeToTracker", "ReferenceToTracker", "StylusToTracker", "StylusToReference"}
    assert recording.other_transforms.keys() == names
    for k in range(30):
        inverse = invert_rigid(base_at(START + k / 60))
        np.testing.assert_allclose(recording.probe_to_reference[k], inverse @ a_pose(50 + k), atol=1e-9)
        assert recording.other_statuses["StylusToReference"][k] == ("MISSING" if k % 4 == 1 else "OK")
    assert recording.fields["CranioNavTimeZero"].startswith("start of recording, 20")


def test_head_and_base_move_and_the_recorded_points_do_not(tmp_path, a_tracker, a_stream, a_clock):
    probe_to_reference = a_pose(3)
    times = START + np.arange(60) / 60
    for time_s in times:
        a_tracker.put([ok("Probe", base_at(time_s) @ probe_to_reference, time_s), ok("Reference", base_at(time_s), time_s)])
    poll(a_stream, 60)
    a_clock.now = times[-1]
    line_times = START + np.linspace(0.01, 0.95, 150)  # lines are not taken when poses are
    with SessionRecorder(tmp_path / "r.igs.mha", a_stream, ACQUISITION, 8, clock=HandClock()) as recorder:
        for k, time_s in enumerate(line_times):
            recorder.add_line(np.full(8, k, dtype=np.int16), float(time_s), palpation_point=k % 18)
    recording = read_recording(tmp_path / "r.igs.mha")
    assert recording.statuses == ("OK",) * 150
    # Between two frames the base turns by 4 mrad: its turning is interpolated exactly, the origin's arc by a chord.
    np.testing.assert_allclose(recording.probe_to_reference, np.broadcast_to(probe_to_reference, (150, 4, 4)), atol=2e-3)
    np.testing.assert_array_equal(recording.lines[:, 0], np.arange(150))
    np.testing.assert_array_equal(recording.palpation_points, np.arange(150) % 18)


def test_a_line_waits_for_the_pose_after_it_and_not_longer_than_80_ms(tmp_path, a_tracker, a_stream, a_clock):
    a_tracker.put([ok("Probe", a_pose(1), START), ok("Reference", np.eye(4), START)])
    poll(a_stream, 1)
    recorder = SessionRecorder(tmp_path / "r.igs.mha", a_stream, ACQUISITION, 4, clock=a_clock)
    a_clock.now = START + 0.02
    recorder.add_line(np.zeros(4, dtype=np.int16), START + 0.01)
    assert recorder.state.frames == 0
    a_tracker.put([ok("Probe", a_pose(1), START + 0.03), ok("Reference", np.eye(4), START + 0.03)])
    recorder.add_frames(poll(a_stream, 1))
    assert recorder.state.frames == 1
    recorder.add_line(np.zeros(4, dtype=np.int16), START + 0.04)
    a_clock.now = START + 0.13
    recorder.flush()
    assert recorder.state.frames == 2
    assert recorder.state.without_probe == 1
    recorder.close()
    assert read_recording(tmp_path / "r.igs.mha").statuses == ("OK", "MISSING")


def test_lines_across_a_gap_or_beside_a_missing_pose_have_none(tmp_path, a_tracker, a_stream, a_clock):
    for time_s in (0.0, 0.02, 0.3, 0.32):
        a_tracker.put([ok("Probe", a_pose(1), START + time_s), ok("Reference", np.eye(4), START + time_s)])
    a_tracker.put([missing("Probe", START + 0.34), ok("Reference", np.eye(4), START + 0.34)])
    poll(a_stream, 5)
    a_clock.now = START + 1
    with SessionRecorder(tmp_path / "r.igs.mha", a_stream, ACQUISITION, 4, clock=HandClock()) as recorder:
        for time_s in (0.01, 0.1, 0.31, 0.33):
            recorder.add_line(np.zeros(4, dtype=np.int16), START + time_s)
    recording = read_recording(tmp_path / "r.igs.mha")
    assert recording.statuses == ("OK", "MISSING", "OK", "MISSING")


def test_tools_that_come_one_by_one_are_brought_to_one_time(tmp_path, a_tracker, a_stream, a_clock):
    for k in range(10):
        a_tracker.put([ok("Probe", a_pose(1), START + k / 60)])
        a_tracker.put([ok("Reference", a_pose(2), START + k / 60 + 0.004)])
    frames = poll(a_stream, 20)
    with SessionRecorder(tmp_path / "r.igs.mha", a_stream, clock=a_clock) as recorder:
        recorder.add_frames(frames)
    recording = read_recording(tmp_path / "r.igs.mha")
    good = [k for k, status in enumerate(recording.statuses) if status == "OK"]
    assert len(good) == 18  # before the first and after the last there is nothing to interpolate between
    np.testing.assert_allclose(recording.probe_to_reference[good[5]], invert_rigid(a_pose(2)) @ a_pose(1), atol=1e-9)


def test_a_line_of_another_length_is_refused(tmp_path, a_stream):
    recorder = SessionRecorder(tmp_path / "r.igs.mha", a_stream, ACQUISITION, 4)
    with pytest.raises(InputError, match="an RF line of 4 samples"):
        recorder.add_line(np.zeros(5, dtype=np.int16), START)


def test_a_buffer_that_the_driver_reuses_does_no_harm(tmp_path, a_tracker, a_stream, a_clock):
    a_tracker.put([ok("Probe", a_pose(1), START), ok("Reference", np.eye(4), START)])
    poll(a_stream, 1)
    buffer = np.zeros(4, dtype=np.int16)
    with SessionRecorder(tmp_path / "r.igs.mha", a_stream, ACQUISITION, 4, clock=a_clock) as recorder:
        for k in range(3):
            buffer[:] = k
            recorder.add_line(buffer, START + k / 1000)
    assert read_recording(tmp_path / "r.igs.mha").lines[:, 0].tolist() == [0, 1, 2]
