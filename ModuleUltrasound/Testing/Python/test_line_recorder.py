"""What is written of lines with and without a pose."""

from __future__ import annotations

import numpy as np
from CranioNavLib.sequence_metafile import Acquisition, read_recording
from ModuleTrackingLib.tracker import PoseStatus, ToolPose
from ModuleUltrasoundLib.devices.device import RfLine
from ModuleUltrasoundLib.devices.line_recorder import LineRecorder
from ModuleUltrasoundLib.devices.line_stream import PosedLine


def line_at(time_s, value, status=PoseStatus.OK, point=-1):
    pose = np.eye(4) if status is PoseStatus.OK else None
    return PosedLine(RfLine(np.full(8, value, np.int16), time_s), ToolPose("Probe", pose, status, time_s), point)


def test_lines_of_a_point_that_was_taken_back_are_kept_but_never_become_points(tmp_path):
    path = tmp_path / "r.igs.mha"
    recorder = LineRecorder(str(path), line_at(100.0, 0).line, Acquisition(50e6, 5e6))
    for time_s, point in ((100.1, 0), (100.2, 1), (100.3, 1)):
        recorder.add(line_at(time_s, 7, point=point))
    recorder.take_back(1, 100.5)
    assert recorder.points == {0}
    for time_s, point in ((100.4, 1), (100.6, 1)):  # the first was still on its way
        recorder.add(line_at(time_s, 7, point=point))
    for killed in (True, False):  # before it could be finished
        if not killed:
            recorder.close()
        recording = read_recording(path)
        assert recording.statuses == ("OK", "INVALID", "INVALID", "INVALID", "OK")
        assert recording.palpation_points.tolist() == [0, 1, 1, 1, 1]
        assert (recording.lines == 7).all()


def test_lines_are_timed_from_the_first_and_a_lost_pose_says_why(tmp_path):
    first = line_at(100.0, 1, point=0)
    recorder = LineRecorder(str(tmp_path / "r.igs.mha"), first.line, Acquisition(50e6, 5e6))
    recorder.add(first)
    recorder.add(line_at(99.9, 9))  # from before the recording
    recorder.add(line_at(100.5, 2, PoseStatus.STALE, 1))
    recorder.add(line_at(101.0, 3, PoseStatus.OUT_OF_VOLUME, 2))
    recorder.add(line_at(101.5, 4, point=3))
    assert (recorder.lines, recorder.points) == (4, {0, 3})
    recorder.close()
    recording = read_recording(tmp_path / "r.igs.mha")
    np.testing.assert_array_equal(recording.lines[:, 0], [1, 2, 3, 4])
    np.testing.assert_allclose(recording.timestamps_s, [0, 0.5, 1.0, 1.5])
    assert recording.statuses == ("OK", "MISSING", "OUT_OF_VOLUME", "OK")
    assert recording.palpation_points.tolist() == [0, 1, 2, 3]
    assert np.isnan(recording.probe_to_reference[1]).all()
