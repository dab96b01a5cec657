"""The openigtlink tracker against our own server, damaged streams, and servers that go away."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.openigtlink import IgtlServer, encode
from CranioNavLib.openigtlink.messages import Position, TrackedTool, TrackingData, Transform
from ModuleTrackingLib.plugins.openigtlink import OpenIGTLinkSettings, OpenIGTLinkTracker
from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, TrackerError
from scripted_tracker import a_pose, wait_until


@pytest.fixture
def a_server():
    with IgtlServer(port=0, status_interval_s=0.1) as server:
        yield server


def connected(server, **settings):
    tracker = OpenIGTLinkTracker(OpenIGTLinkSettings(port=server.port, connect_timeout_s=0.2, **settings))
    tracker.open()
    tracker.start()
    wait_until(lambda: server.clients)
    return tracker


def next_frame(tracker):
    frame = []
    wait_until(lambda: frame.extend(tracker.read(0.1)) or frame)
    return {pose.tool: pose for pose in frame}


def test_it_is_found_by_name():
    assert TRACKERS.find("openigtlink") is OpenIGTLinkTracker


def test_transforms_of_one_time_are_one_frame(a_server):
    with connected(a_server) as tracker:
        for k in range(5):
            a_server.publish(Transform("ProbeToTracker", 100.0 + k, matrix=a_pose(k)))
            a_server.publish(Transform("ReferenceToTracker", 100.0 + k, matrix=a_pose(50 + k)))
        time.sleep(0.05)
        for k in range(5):
            frame = next_frame(tracker)
            assert frame.keys() == {"Probe", "Reference"}
            np.testing.assert_allclose(frame["Probe"].tool_to_tracker, a_pose(k), atol=1e-4)
            np.testing.assert_allclose(frame["Reference"].tool_to_tracker, a_pose(50 + k), atol=1e-4)
            assert frame["Probe"].device_time_s == 100.0 + k


def test_tracking_data_are_asked_for_and_read(a_server):
    with connected(a_server, request_tdata=True) as tracker:
        wait_until(lambda: a_server.clients[0].wants_tracking)
        a_server.publish_tracking(
            TrackingData("T", 7.0, tools=(TrackedTool("Probe", a_pose(1)), TrackedTool("Stylus", a_pose(2))))
        )
        frame = next_frame(tracker)
        np.testing.assert_allclose(frame["Stylus"].tool_to_tracker, a_pose(2), atol=1e-4)


def test_positions_are_read(a_server):
    with connected(a_server) as tracker:
        a_server.publish(Position("Probe", 7.0, position_mm=(1, 2, 3), quaternion_xyzw=(0, 0, np.sqrt(0.5), np.sqrt(0.5))))
        expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
        np.testing.assert_allclose(next_frame(tracker)["Probe"].tool_to_tracker, expected, atol=1e-6)


def test_other_frames_are_left_alone(a_server):
    with connected(a_server) as tracker:
        a_server.publish(Transform("ReferenceToRas", 1.0, matrix=a_pose(1)))
        a_server.publish(Transform("ProbeToTracker", 1.0, matrix=a_pose(2)))
        assert next_frame(tracker).keys() == {"Probe"}


def test_poses_that_are_in_reference_already_are_taken_as_such(a_server):
    with connected(a_server, frame="Reference") as tracker:
        a_server.publish(Transform("ProbeToReference", 1.0, matrix=a_pose(1)))
        frame = next_frame(tracker)
        np.testing.assert_allclose(frame["Probe"].tool_to_tracker, a_pose(1), atol=1e-4)
        np.testing.assert_array_equal(frame["Reference"].tool_to_tracker, np.eye(4))


def test_a_tool_that_is_no_longer_sent_is_missing(a_server):
    with connected(a_server) as tracker:
        a_server.publish(Transform("ProbeToTracker", 1.0, matrix=a_pose(1)))
        assert next_frame(tracker)["Probe"].usable
        lost = next_frame(tracker)["Probe"]
        assert (lost.status, lost.tool_to_tracker) == (PoseStatus.MISSING, None)


def test_a_matrix_that_is_not_rigid_is_no_pose(a_server):
    with connected(a_server) as tracker:
        a_server.publish(Transform("ProbeToTracker", 1.0, matrix=2 * a_pose(1)))
        pose = next_frame(tracker)["Probe"]
        assert (pose.status, pose.tool_to_tracker) == (PoseStatus.INVALID, None)
        assert "not rigid" in pose.flags[0] or "scales" in pose.flags[0] or "not affine" in pose.flags[0]
        assert tracker.refused_poses == 1


def test_the_status_in_the_metadata_counts():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        tracker = OpenIGTLinkTracker(OpenIGTLinkSettings(port=listener.getsockname()[1], connect_timeout_s=0.2))
        with tracker:
            peer, _ = listener.accept()
            message = Transform("ProbeToTracker", 1.0, {"TransformStatus": "OUT_OF_VOLUME"}, matrix=a_pose(1))
            peer.sendall(encode(message, header_version=2))
            pose = next_frame(tracker)["Probe"]
            assert (pose.status, pose.tool_to_tracker) == (PoseStatus.OUT_OF_VOLUME, None)
            peer.close()


def test_no_damaged_message_ever_becomes_a_pose():
    rng = np.random.default_rng(4)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        settings = OpenIGTLinkSettings(port=listener.getsockname()[1], connect_timeout_s=0.2)
        with OpenIGTLinkTracker(settings) as tracker:
            peer, _ = listener.accept()
            sent, damaged = {}, 0
            for k in range(500):
                data = bytearray(encode(Transform("ProbeToTracker", 1000.0 + k, matrix=a_pose(k % 50))))
                if rng.random() < 0.5:
                    data[58 + rng.integers(48)] ^= 1 << rng.integers(8)
                    damaged += 1
                else:
                    sent[1000.0 + k] = a_pose(k % 50)
                peer.sendall(data)
            got = 0
            while got < len(sent):
                for pose in tracker.read(0.2):
                    if pose.usable:
                        np.testing.assert_allclose(pose.tool_to_tracker, sent[pose.device_time_s], atol=1e-4)
                        got += 1
            end = time.monotonic() + 10  # damaged messages behind the last good one may still be under way
            while tracker.crc_errors < damaged and time.monotonic() < end:
                tracker.read(0.2)
            assert tracker.crc_errors == damaged
            assert tracker.rejected == damaged
            peer.close()


def test_a_closed_server_is_told_at_once(a_server):
    with connected(a_server) as tracker:
        a_server.close()
        begin = time.monotonic()
        with pytest.raises(TrackerError, match="closed the connection"):
            wait_until(lambda: tracker.read(1.0))
        assert time.monotonic() - begin < 0.9


def test_a_silent_server_is_told():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        settings = OpenIGTLinkSettings(port=listener.getsockname()[1], connect_timeout_s=0.1, silence_s=0.2)
        with OpenIGTLinkTracker(settings) as tracker, pytest.raises(TrackerError, match="nothing heard"):
            wait_until(lambda: tracker.read(1.0))


def test_nobody_there_is_told():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        settings = OpenIGTLinkSettings(port=unused.getsockname()[1], connect_timeout_s=0.2)
        with pytest.raises(TrackerError, match="connection refused"):
            OpenIGTLinkTracker(settings).open()


def test_a_frame_that_is_no_name_is_refused():
    with pytest.raises(InputError, match="frame is 'my frame'"):
        OpenIGTLinkTracker(OpenIGTLinkSettings(frame="my frame"))
