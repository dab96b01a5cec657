"""What the emulated camera sees: pose files played exactly, and hands that move smoothly."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from emulator_process import write_poses
from ModuleTrackingLib.ndi.emulator.motion import HandMotion, ReplayedMotion

HEAD = "timestamp_s,tool,status,qw,qx,qy,qz,tx_mm,ty_mm,tz_mm,error_mm\n"


def test_a_pose_file_is_played_row_by_row_in_a_loop(tmp_path):
    rows = write_poses(tmp_path / "p.csv", ("A", "B"), frames=9, rate_hz=20.0)
    motion = ReplayedMotion(tmp_path / "p.csv")
    assert motion.tools == ("A", "B")
    assert motion.rate_hz == pytest.approx(20.0)
    for number in range(40):
        for part in (0.0, 0.4, 0.9):
            frame, poses = motion.sample((number + part) / 20.0)
            assert frame == number
            for tool in motion.tools:
                truth = rows[tool][number % 9]
                if np.isnan(truth).all():
                    assert poses[tool] is None
                else:
                    shown = (*poses[tool].quaternion, *poses[tool].translation_mm, poses[tool].error_mm)
                    assert shown == pytest.approx(truth, abs=2e-7)


def test_gaps_in_a_pose_file_show_in_the_frame_number(tmp_path):
    times = [0.0, 0.1, 0.2, 0.7, 0.8]
    (tmp_path / "p.csv").write_text(HEAD + "".join(f"{100 + time},A,OK,1,0,0,0,{time},0,0,\n" for time in times))
    motion = ReplayedMotion(tmp_path / "p.csv")
    assert [motion.sample(time)[0] for time in (0.0, 0.15, 0.25, 0.65, 0.75, 0.85, 0.95)] == [0, 1, 2, 2, 7, 8, 9]


def test_a_tool_without_a_row_is_missing_in_that_frame(tmp_path):
    (tmp_path / "p.csv").write_text(HEAD + "0,A,OK,1,0,0,0,1,2,3,0.1\n0,B,OK,1,0,0,0,1,2,3,0.1\n0.1,B,OK,1,0,0,0,1,2,3,0.1\n")
    assert ReplayedMotion(tmp_path / "p.csv").sample(0.1)[1]["A"] is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a pose table"),
        ("timestamp_s,tool\n0,A\n", "missing: status"),
        (HEAD, "holds no pose"),
        (HEAD + "0,A,OK,1,0,0,0,1,2,,0\n", "line 2"),
        (HEAD + "0,A,OK,1,0,0,0,1,2,3,0\nx,A,OK,1,0,0,0,1,2,3,0\n", "line 3"),
        (HEAD + "0,A,OK,2,0,0,0,1,2,3,0\n", "line 2: the quaternion has length 2"),
        (HEAD + "0,A,OK,nan,0,0,0,1,2,3,0\n", "line 2"),
    ],
)
def test_a_file_that_is_no_pose_file_is_refused_by_line(tmp_path, text, message):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        ReplayedMotion(tmp_path / "p.csv")


def test_a_file_that_is_not_there_is_refused():
    with pytest.raises(InputError, match=r"nowhere\.csv: cannot be read"):
        ReplayedMotion("nowhere.csv")


def test_hands_move_smoothly_and_stay_in_view():
    motion = HandMotion(rate_hz=60.0)
    places = {tool: [] for tool in motion.tools}
    for frame in range(1200):
        number, poses = motion.sample(frame / 60.0)
        assert number == frame
        for tool, pose in poses.items():
            assert np.linalg.norm(pose.quaternion) == pytest.approx(1.0)
            places[tool].append(pose.translation_mm)
    for track in map(np.array, places.values()):
        assert np.linalg.norm(np.diff(track, axis=0), axis=1).max() * 60.0 < 200.0  # mm/s
        assert (np.abs(track[:, :2]) < 500).all()
        assert (track[:, 2] < -900).all()
    assert np.ptp(np.array(places["Reference"]), axis=0).max() < 1.0
    assert np.ptp(np.array(places["Probe"]), axis=0).min() > 50.0
