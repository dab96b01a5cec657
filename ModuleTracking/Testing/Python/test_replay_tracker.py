"""Replay of pose tables and recordings: the same poses, in their time, faster, and step by step."""

from __future__ import annotations

import time

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid
from CranioNavLib.sequence_metafile import RecordingWriter
from ModuleTrackingLib.plugins.replay import ReplaySettings, ReplayTracker
from ModuleTrackingLib.pose_csv import COLUMNS, PoseCsvWriter, read_pose_csv
from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, TrackerError
from scipy.spatial.transform import Rotation
from scripted_tracker import a_pose, missing, ok


@pytest.fixture
def a_table(tmp_path):
    with PoseCsvWriter(tmp_path / "poses.csv") as writer:
        for k in range(30):
            stylus = missing("Stylus", 0) if k % 3 else ok("Stylus", a_pose(100 + k), 0)
            writer.write(5 + k / 60, [ok("Probe", a_pose(k), 0, error_mm=0.2), stylus])
    return tmp_path / "poses.csv"


def replayed(path, count, **settings):
    with ReplayTracker(ReplaySettings(path=str(path), **settings)) as tracker:
        return [tracker.read() for _ in range(count)]


def test_it_is_found_by_name():
    assert TRACKERS.find("replay") is ReplayTracker


def test_a_pose_table_is_read_as_it_was_written(a_table):
    frames = read_pose_csv(a_table)
    assert len(frames) == 30
    for k, frame in enumerate(frames):
        assert [row.tool for row in frame] == ["Probe", "Stylus"]
        np.testing.assert_allclose(frame[0].tool_to_tracker, a_pose(k), atol=1e-6)
        assert frame[0].error_mm == pytest.approx(0.2)
        assert frame[1].status is (PoseStatus.MISSING if k % 3 else PoseStatus.OK)
        assert frame[0].timestamp_s == pytest.approx(5 + k / 60, abs=1e-6)


def test_step_by_step_gives_every_frame_at_once(a_table):
    begin = time.monotonic()
    frames = replayed(a_table, 30, speed=0)
    assert time.monotonic() - begin < 0.4  # the recording lasts 0.5 s
    for k, (probe, stylus) in enumerate(frames):
        np.testing.assert_allclose(probe.tool_to_tracker, a_pose(k), atol=1e-6)
        assert probe.frame_number == k
        assert stylus.usable == (k % 3 == 0)
        assert (stylus.tool_to_tracker is None) == (k % 3 != 0)


@pytest.mark.parametrize(("speed", "seconds"), [(1, 29 / 60), (4, 29 / 240)])
def test_frames_come_in_their_time_or_faster(a_table, speed, seconds):
    frames = replayed(a_table, 30, speed=speed)
    elapsed = frames[-1][0].host_time_s - frames[0][0].host_time_s
    assert elapsed >= seconds - 0.02  # never early; how late depends on the computer's load
    assert frames[-1][0].device_time_s == pytest.approx(seconds)


def test_a_frame_that_is_not_due_is_not_given(tmp_path):
    with PoseCsvWriter(tmp_path / "p.csv") as writer:
        writer.write(0, [ok("Probe", a_pose(1), 0)])
        writer.write(100, [ok("Probe", a_pose(2), 0)])
    with ReplayTracker(ReplaySettings(path=str(tmp_path / "p.csv"))) as tracker:
        assert tracker.read()[0].usable
        assert tracker.read(0.01) == []


def test_the_end_is_told_or_begins_again(a_table):
    with ReplayTracker(ReplaySettings(path=str(a_table), speed=0, loop=False)) as tracker:
        frames = [tracker.read() for _ in range(30)]
        assert all(frames)
        assert tracker.finished
        assert tracker.read() == tracker.read() == []


@pytest.mark.parametrize("speed", [0, 100])
def test_a_looped_recording_begins_again_after_a_frame_without_tools(a_table, speed):
    frames = replayed(a_table, 63, speed=speed)
    for again in (30, 61):
        assert [pose.status for pose in frames[again]] == [PoseStatus.MISSING] * 2
        assert frames[again][0].flags == ("the recording begins again",)
    np.testing.assert_array_equal(frames[31][0].tool_to_tracker, frames[0][0].tool_to_tracker)
    np.testing.assert_array_equal(frames[62][0].tool_to_tracker, frames[0][0].tool_to_tracker)
    if speed:
        times = [frame[0].device_time_s for frame in frames]
        np.testing.assert_allclose(np.diff(times[:30]), 1 / 6000, atol=1e-6)
        np.testing.assert_allclose(np.diff(times[29:32]), 1 / 12000, atol=1e-6)


def test_a_recording_is_replayed_in_the_tracker_s_frame(tmp_path):
    with RecordingWriter(tmp_path / "r.igs.mha") as writer:
        for k in range(4):
            poses = {"ProbeToReference": a_pose(k), "ProbeToTracker": a_pose(10 + k), "ReferenceToTracker": a_pose(20 + k)}
            poses["StylusToTracker"] = None if k == 2 else a_pose(30 + k)
            writer.append(k / 60, poses)
    frames = [{pose.tool: pose for pose in frame} for frame in replayed(tmp_path / "r.igs.mha", 4, speed=0)]
    assert frames[0].keys() == {"Probe", "Reference", "Stylus"}
    for k, frame in enumerate(frames):
        assert np.array_equal(frame["Probe"].tool_to_tracker, a_pose(10 + k))
        assert frame["Stylus"].usable == (k != 2)


def test_a_recording_without_a_tracker_frame_is_replayed_in_reference(tmp_path):
    with RecordingWriter(tmp_path / "r.igs.mha") as writer:
        writer.append(0.0, {"ProbeToReference": a_pose(1)})
        writer.append(0.1, {"ProbeToReference": None}, {"ProbeToReference": "OUT_OF_VIEW"})
    first, second = ({pose.tool: pose for pose in frame} for frame in replayed(tmp_path / "r.igs.mha", 2, speed=0))
    np.testing.assert_array_equal(first["Probe"].tool_to_tracker, a_pose(1))
    np.testing.assert_array_equal(first["Reference"].tool_to_tracker, np.eye(4))
    assert second["Probe"].status is PoseStatus.MISSING


def test_reading_before_opening_is_told(a_table):
    with pytest.raises(TrackerError, match="not open"):
        ReplayTracker(ReplaySettings(path=str(a_table))).read()


def test_no_path_is_refused():
    with pytest.raises(InputError, match="no recording given"):
        ReplayTracker().open()


def test_a_recording_without_tools_is_refused(tmp_path):
    with RecordingWriter(tmp_path / "r.igs.mha") as writer:
        writer.append(0.0, {"ProbeToReference": None})
    with pytest.raises(InputError, match="holds no tool"):
        ReplayTracker(ReplaySettings(path=str(tmp_path / "r.igs.mha"))).open()


HEAD = ",".join(COLUMNS) + "\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "its first line must be timestamp_s,tool"),
        ("a,b,c\n1,2,3\n", "its first line must be"),
        (HEAD, "holds no pose"),
        (HEAD + "0,Probe,OK,1,0,0\n", "line 2: 6 columns, expected 11"),
        (HEAD + "0,Probe,OK,1,0,0,0,1,2,x,0\n", "line 2: a number is missing"),
        (HEAD + "0,Probe,OK,1,0,0,0,1,2,nan,0\n", "line 2: a number is missing"),
        (HEAD + "0,Probe,OK,1,1,0,0,1,2,3,0\n", "quaternion has length 1.414"),
        (HEAD + "0,Probe,OK,1,0,0,0,1,2,3e8,0\n", "more than 100 m away"),
        (HEAD + "1,Probe,OK,1,0,0,0,1,2,3,0\n1,Probe,MISSING\n", "'Probe' stands twice at 1.0 s"),
        (HEAD + "1,,OK,1,0,0,0,1,2,3,0\n", "line 2: no tool is named"),
        ("\x00\x01", "its first line must be|cannot be read"),
    ],
)
def test_a_damaged_pose_table_is_refused_by_name(tmp_path, text, message):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_pose_csv(tmp_path / "p.csv")


def test_rows_columns_and_blanks_may_stand_in_any_order(tmp_path):
    lines = ["tool, timestamp_s,status,error_mm,tx_mm,ty_mm,tz_mm,qw,qx,qy,qz,note"]
    lines += ["B,1.5,OK,,1,2,3,0,0,0,-1,held", "", "A,0.5,missing", "B,0.5,OK,0.2,4,5,6,0.5,0.5,-0.5,0.5,", "A,1.5,OUT_OF_VOLUME"]
    (tmp_path / "p.csv").write_text("\ufeff" + "\r\n".join(lines), encoding="utf-8")
    first, second = read_pose_csv(tmp_path / "p.csv")
    assert [(row.tool, row.timestamp_s, row.status.value) for row in first] == [("A", 0.5, "MISSING"), ("B", 0.5, "OK")]
    assert {row.tool: row.status.value for row in second} == {"A": "OUT_OF_VOLUME", "B": "OK"}
    pose = {row.tool: row for row in first}["B"]
    turn = Rotation.from_quat([0.5, -0.5, 0.5, 0.5]).as_matrix()
    np.testing.assert_allclose(pose.tool_to_tracker, rigid(turn, [4, 5, 6]), atol=1e-12)
    assert (pose.quaternion, pose.error_mm) == ((0.5, 0.5, -0.5, 0.5), 0.2)


def test_a_missing_pose_table_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_pose_csv(tmp_path / "none.csv")
