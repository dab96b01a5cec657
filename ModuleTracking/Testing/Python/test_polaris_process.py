"""The Polaris driver on real ports: a pseudo-terminal and a TCP connection to the emulator's process."""

from __future__ import annotations

import sys
import time

import numpy as np
import pytest
from emulator_process import emulator, write_poses
from ModuleTrackingLib.tracker import TRACKERS, PoseStatus
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")
TOOLS = ("Reference", "Probe", "Stylus", "Sphere")


def until(tracker, condition, limit_s):
    """Read until the condition holds for a frame; how long it took."""
    began_s = time.monotonic()
    while time.monotonic() - began_s < limit_s:
        poses = tracker.read(timeout_s=0.1)
        if poses and condition(poses):
            return time.monotonic() - began_s
    raise AssertionError(f"nothing of the kind within {limit_s} s: {tracker.state} {tracker.message}")


def all_usable(poses):
    return all(pose.usable for pose in poses)


def none_usable(poses):
    return not any(pose.usable for pose in poses)


@pytest.mark.parametrize("tcp", [False, True])
def test_poses_of_a_file_arrive_over_the_port(tmp_path, tcp):
    path = tmp_path / "poses.csv"
    rows = write_poses(path, TOOLS, frames=50, rate_hz=40.0)
    with emulator(replay=path, tcp=tcp) as running, TRACKERS.create("polaris", port=running.url) as tracker:
        compared = 0
        for _ in range(30):
            for pose in tracker.read():
                truth = rows[pose.tool][(pose.frame_number - 1) % 50]
                if np.isnan(truth).all():
                    assert pose.status is PoseStatus.MISSING
                    continue
                turn = Rotation.from_quat([*truth[1:4], truth[0]]).as_matrix()
                assert np.abs(pose.tool_to_tracker[:3, 3] - truth[4:7]).max() < 1e-3
                assert np.abs(pose.tool_to_tracker[:3, :3] - turn).max() < 1e-6
                assert 0.0 <= time.monotonic() - pose.host_time_s < 1.0
                compared += 1
        assert compared > 80


def test_faults_are_switched_and_the_device_reset_while_it_runs():
    with emulator() as running, TRACKERS.create("polaris", port=running.url) as tracker:
        until(tracker, all_usable, 3.0)
        assert running.control("fault missing=1") == "done: fault missing=1"
        until(tracker, none_usable, 1.0)
        assert running.control("clear missing").startswith("done")
        until(tracker, all_usable, 1.0)
        assert running.control("fault nonsense").startswith("refused: unknown fault")
        assert "known: fault NAME" in running.control("dance")
        assert running.control("reset") == "done: reset"
        until(tracker, none_usable, 1.0)
        until(tracker, all_usable, 6.0)
        assert tracker.losses == 1


@pytest.mark.parametrize("way", ["terminal", "socket"])
def test_a_port_that_vanishes_and_comes_back_is_taken_up_again(tmp_path, way):
    link = tmp_path / "tracker"
    first = {"link": link} if way == "terminal" else {"tcp": True}
    with emulator(**first) as running:
        tracker = TRACKERS.create("polaris", port=running.url)
        tracker.open()
        tracker.start()
        until(tracker, all_usable, 3.0)
        url = running.url
    try:
        assert until(tracker, none_usable, 1.0) < 0.5  # the process has ended, and its port with it
        until(tracker, lambda poses: "tracker lost" in poses[0].flags, 2.0)
        second = first if way == "terminal" else {"tcp": True, "port": int(url.rsplit(":", 1)[1])}
        with emulator(**second) as running:
            assert running.url == url
            until(tracker, all_usable, 2.0)
            tracker.stop()
            tracker.close()
    finally:
        tracker.close()


def test_a_host_that_died_at_high_speed_is_no_hindrance_without_a_break():
    with emulator(keep_state=True) as running:
        dead = TRACKERS.create("polaris", port=running.url)
        dead.open()
        dead.start()
        dead._conductor.close_port()  # no farewell: the device goes on tracking at its speed
        with TRACKERS.create("polaris", port=running.url) as tracker:
            until(tracker, all_usable, 3.0)
