"""From what the device says of a tool to whether its pose may be used."""

from __future__ import annotations

import math

import numpy as np
import pytest
from CranioNavLib.rigid import check_rigid
from hypothesis import given
from hypothesis import strategies as st
from ModuleTrackingLib.ndi.poses import tool_poses
from ModuleTrackingLib.ndi.replies import PortInfo
from ModuleTrackingLib.ndi.session import Tool
from ModuleTrackingLib.ndi.tracking import HandleData, HandleState, RawPose, TrackingReply
from ModuleTrackingLib.ndi.words import ERRORS, error_in_words
from ModuleTrackingLib.tracker import PoseStatus
from scipy.spatial.transform import Rotation

TOOL = Tool(1, "Probe", PortInfo())
SOUND = RawPose((1.0, 0.0, 0.0, 0.0), (1.0, 2.0, -1000.0), 0.1)


def judged(pose=SOUND, status=0x31, info=0, frame=7, state=HandleState.VALID, system=0, handle=1):
    reply = TrackingReply((HandleData(handle, state, pose, status, frame, info),), system)
    (result,) = tool_poses(reply, (TOOL,), 7, 0.5, 123.0)
    return result


def test_documented_quaternion_gives_the_documented_matrix():
    half = math.sqrt(0.5)
    pose = judged(RawPose((half, 0.0, 0.0, half), (10.0, 20.0, 30.0), 0.1))
    expected = [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]]
    assert np.allclose(pose.tool_to_tracker, expected, atol=1e-12)
    assert (pose.status, pose.error_mm, pose.device_time_s, pose.host_time_s, pose.frame_number) == (
        PoseStatus.OK,
        0.1,
        0.5,
        123.0,
        7,
    )


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.3), st.floats(0.996, 1.004))
def test_any_quaternion_gives_the_rotation_that_another_library_gives(numbers, length):
    unit = np.array(numbers) / np.linalg.norm(numbers)
    pose = judged(RawPose(tuple(unit * length), (0.0, 0.0, -1000.0), 0.1))
    truth = Rotation.from_quat([*unit[1:], unit[0]]).as_matrix()
    assert np.allclose(pose.tool_to_tracker[:3, :3], truth, atol=1e-12)
    check_rigid(pose.tool_to_tracker)


@pytest.mark.parametrize(
    ("changes", "status", "flag"),
    [
        ({"status": 0x71}, PoseStatus.OUT_OF_VOLUME, "out of volume"),
        ({"status": 0xB1}, PoseStatus.OUT_OF_VOLUME, "partly out of volume"),
        ({"status": 0x131}, PoseStatus.INVALID, "algorithm limit"),
        ({"status": 0x231}, PoseStatus.INVALID, "infrared interference"),
        ({"status": 0x1031}, PoseStatus.INVALID, "processing exception"),
        ({"status": 0x4031}, PoseStatus.INVALID, "processing fell behind"),
        ({"info": 0x01}, PoseStatus.INVALID, "bad fit of the markers"),
        ({"info": 0x02}, PoseStatus.INVALID, "too few markers seen"),
        ({"system": 0x0010}, PoseStatus.INVALID, "hardware failure"),
        ({"state": HandleState.MISSING, "pose": None, "info": 0x02}, PoseStatus.MISSING, "too few markers seen"),
        ({"state": HandleState.MISSING, "pose": None, "status": 0x71}, PoseStatus.MISSING, "out of volume"),
        ({"state": HandleState.DISABLED, "pose": None}, PoseStatus.MISSING, "disabled"),
        ({"state": HandleState.UNOCCUPIED, "pose": None}, PoseStatus.MISSING, "unplugged"),
        ({"handle": 2}, PoseStatus.MISSING, "not reported by the tracker"),
        ({"frame": 6}, PoseStatus.MISSING, "not measured in this frame"),
        ({"pose": RawPose((0.9, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.1)}, PoseStatus.INVALID, "not a rotation"),
        ({"pose": RawPose((1.0, 0.0, 0.0, 0.0), (3e4, 0.0, 0.0), 0.1)}, PoseStatus.INVALID, "impossibly far away"),
        ({"pose": RawPose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), -0.1)}, PoseStatus.INVALID, "impossible error"),
    ],
)
def test_a_pose_with_a_flaw_is_not_usable_and_says_why(changes, status, flag):
    pose = judged(**changes)
    assert (pose.status, pose.usable) == (status, False)
    assert flag in pose.flags
    assert (pose.tool_to_tracker is not None) == (status is PoseStatus.OUT_OF_VOLUME)


def test_a_pressed_switch_and_a_plugged_tool_are_told_and_do_no_harm():
    pose = judged(status=0x33, system=0x0040)
    assert pose.usable
    assert pose.flags == ("switch 1", "a tool was plugged in")


def test_a_pose_of_a_handle_that_is_not_enabled_is_not_used():
    assert judged(status=0x11).status is PoseStatus.INVALID


def test_every_error_code_has_a_meaning_and_an_advice():
    for code, words in ERRORS.items():
        assert words.meaning
        assert words.advice
        assert error_in_words(code) == f"ERROR{code:02X}: {words.meaning}; {words.advice}"
    assert {0x01, 0x06, 0x0C, 0x10, 0x13, 0x2C, 0x42, 0xF1} <= set(ERRORS)
