"""The stream from a scripted device's thread to this one: order, loss, staleness, reconnection."""

from __future__ import annotations

import time

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import invert_rigid
from ModuleTrackingLib.pose_stream import PoseStream
from ModuleTrackingLib.tracker import PoseStatus, TrackerError
from scripted_tracker import ScriptedTracker, a_pose, missing, ok, wait_until


class HandClock:
    """A host clock that a test sets."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def a_tracker():
    return ScriptedTracker()


@pytest.fixture
def a_clock():
    return HandClock()


@pytest.fixture
def a_stream(a_tracker, a_clock):
    with PoseStream(a_tracker, clock=a_clock) as stream:
        yield stream


def polled(stream: PoseStream, count: int) -> list:
    frames: list = []
    wait_until(lambda: frames.extend(stream.poll()) or len(frames) >= count)
    return frames


def test_frames_arrive_whole_and_in_order(a_tracker, a_stream):
    for k in range(200):
        a_tracker.put([ok("Probe", a_pose(k), 1000 + k / 60), missing("Stylus", 1000 + k / 60)])
    frames = polled(a_stream, 200)
    for k, frame in enumerate(frames):
        assert [pose.tool for pose in frame] == ["Probe", "Stylus"]
        assert np.array_equal(frame[0].tool_to_tracker, a_pose(k))
    assert a_stream.state.dropped_frames == 0
    assert a_stream.state.frames == 200


def test_waiting_ends_with_the_news_and_begins_anew_when_they_are_taken(a_tracker, a_stream):
    assert a_stream.wait(10)  # the connection is news, too
    a_stream.poll()
    assert not a_stream.wait(0.01)
    a_tracker.put([ok("Probe", a_pose(0), 1000)])
    assert a_stream.wait(10)
    assert a_stream.wait(0)
    assert len(a_stream.poll()) == 1
    assert not a_stream.wait(0)


def test_who_listens_is_told_of_every_frame_when_it_can_be_taken(a_tracker, a_stream):
    wait_until(lambda: a_stream.wait(0))  # it is connected
    a_stream.poll()
    told: list = []
    a_stream.on_news = lambda: told.append(a_stream.wait(0))
    for count in (1, 2, 3):
        a_tracker.put([ok("Probe", a_pose(count), 1000 + count / 60)])
        wait_until(lambda wanted=count: len(told) == wanted)
        assert told[-1]
        assert len(a_stream.poll()) == 1


def test_a_full_queue_drops_the_oldest_and_counts(a_tracker, a_clock):
    with PoseStream(a_tracker, queue_frames=10, clock=a_clock) as stream:
        for k in range(50):
            a_tracker.put([ok("Probe", a_pose(k), 1000 + k / 60)])
        wait_until(a_tracker.script.empty)
        wait_until(lambda: stream.state.dropped_frames == 41)  # the queue also holds the word that it connected
        frames = polled(stream, 9)
        assert np.array_equal(frames[-1][0].tool_to_tracker, a_pose(49))
        assert stream.state.connected


def test_a_silent_tool_is_stale_after_the_limit(a_tracker, a_stream, a_clock):
    a_tracker.put([ok("Probe", a_pose(1), 1000.0)])
    polled(a_stream, 1)
    a_clock.now = 1000.19
    assert a_stream.current("Probe").usable
    a_clock.now = 1000.21
    lost = a_stream.current("Probe")
    assert lost.status is PoseStatus.STALE
    assert lost.tool_to_tracker is None
    assert lost.flags == ("no news for 0.2 s",)


def test_a_pose_that_was_delayed_is_stale_although_it_just_came(a_tracker, a_stream, a_clock):
    for k in range(60):
        a_tracker.put([ok("Probe", a_pose(k), 1000 + k / 60, device_s=k / 60)])
    a_tracker.put([ok("Probe", a_pose(60), 1001.5, device_s=1.0)])
    polled(a_stream, 61)
    a_clock.now = 1001.5
    assert a_stream.current("Probe").status is PoseStatus.STALE


def test_a_missing_tool_is_missing_and_keeps_no_pose(a_tracker, a_stream):
    a_tracker.put([ok("Probe", a_pose(1), 1000.0)])
    a_tracker.put([missing("Probe", 1000.01)])
    polled(a_stream, 2)
    assert a_stream.current("Probe").status is PoseStatus.MISSING
    assert a_stream.current("Probe").tool_to_tracker is None


def test_an_unknown_tool_is_missing(a_stream):
    assert a_stream.current("Sphere").status is PoseStatus.MISSING


def test_a_lost_tracker_is_told_at_once_and_found_again(a_tracker, a_stream, a_clock):
    a_tracker.put([ok("Probe", a_pose(1), 1000.0)])
    polled(a_stream, 1)
    a_clock.now = 1000.02
    a_tracker.fail_open = TrackerError("still unplugged")
    a_tracker.put(TrackerError("the cable was pulled; put it back"))
    wait_until(lambda: a_stream.poll() == [] and not a_stream.state.connected)
    lost = a_stream.current("Probe")
    assert lost.tool_to_tracker is None
    assert lost.status is PoseStatus.MISSING
    assert "cable was pulled" in lost.flags[0]
    a_tracker.fail_open = None
    a_clock.now = 1005.0
    back = time.monotonic()
    wait_until(lambda: a_stream.poll() == [] and a_stream.state.connected)
    assert time.monotonic() - back < 2.0
    assert not a_stream.current("Probe").usable  # connected, but nothing seen yet
    a_tracker.put([ok("Probe", a_pose(2), 1005.0)])
    polled(a_stream, 1)
    assert np.array_equal(a_stream.current("Probe").tool_to_tracker, a_pose(2))
    assert a_stream.state.reconnections == 1


def test_a_device_clock_that_starts_anew_after_reconnection_is_followed(a_tracker, a_stream, a_clock):
    for k in range(5):
        a_tracker.put([ok("Probe", a_pose(k), 1000 + k / 60, device_s=500 + k / 60)])
    a_tracker.put(TrackerError("power was lost"))
    wait_until(lambda: (a_stream.poll(), a_stream.state.reconnections)[1])
    a_clock.now = 1030.0
    a_tracker.put([ok("Probe", a_pose(9), 1030.0, device_s=501.0)])  # its clock stood still for half a minute
    polled(a_stream, 1)
    assert a_stream.current("Probe").usable


def test_nothing_is_interpolated_across_a_reconnection(a_tracker, a_stream, a_clock):
    a_tracker.put([ok("Probe", a_pose(1), 1000.0)])
    a_clock.now = 1000.01
    a_tracker.put(TrackerError("noise"))
    wait_until(lambda: (a_stream.poll(), a_stream.state.reconnections)[1])
    a_tracker.put([ok("Probe", a_pose(2), 1000.05)])
    polled(a_stream, 1)
    assert not a_stream.pose_at("Probe", 1000.03).usable


def test_refused_settings_are_raised_where_they_can_be_shown(a_tracker):
    a_tracker.fail_open = InputError("no such port; choose another")
    with PoseStream(a_tracker) as stream, pytest.raises(InputError, match="no such port"):
        wait_until(stream.poll)


def test_a_defect_of_a_plugin_is_raised_not_hidden(a_tracker, a_stream):
    a_tracker.put(ZeroDivisionError("plugin bug"))
    with pytest.raises(ZeroDivisionError, match="plugin bug"):
        wait_until(a_stream.poll)
    assert a_tracker.closed == 1
    assert not a_stream.state.connected


def test_stop_closes_the_tracker_and_may_be_called_twice(a_tracker):
    stream = PoseStream(a_tracker)
    stream.start()
    wait_until(lambda: a_tracker.opened)
    stream.stop()
    stream.stop()
    assert a_tracker.closed == 1


def test_a_calibration_moves_the_tool_to_its_calibrated_frame(a_tracker, a_clock):
    with PoseStream(a_tracker, calibrations={"Probe": a_pose(7)}, clock=a_clock) as stream:
        a_tracker.put([ok("Probe", a_pose(1), 1000.0), ok("Stylus", a_pose(2), 1000.0)])
        polled(stream, 1)
        np.testing.assert_allclose(stream.current("Probe").tool_to_tracker, a_pose(1) @ a_pose(7))
        np.testing.assert_allclose(stream.current("Stylus").tool_to_tracker, a_pose(2))


def test_the_probe_in_reference_is_the_same_wherever_head_and_base_go(a_tracker, a_stream, a_clock):
    probe_to_reference = a_pose(5)
    for k in range(20):
        base = a_pose(100 + k)
        time_s = 1000 + k / 60
        a_tracker.put([ok("Probe", base @ probe_to_reference, time_s), ok("Reference", base, time_s)])
    polled(a_stream, 20)
    a_clock.now = 1000 + 20 / 60
    np.testing.assert_allclose(a_stream.current_in_reference("Probe").tool_to_reference, probe_to_reference, atol=1e-9)
    for k in range(20):
        pose = a_stream.in_reference_at("Probe", 1000 + k / 60)
        np.testing.assert_allclose(pose.tool_to_reference, probe_to_reference, atol=1e-9)


def test_without_the_reference_base_no_tool_has_a_pose(a_tracker, a_stream):
    a_tracker.put([ok("Probe", a_pose(1), 1000.0), missing("Reference", 1000.0)])
    polled(a_stream, 1)
    relative = a_stream.current_in_reference("Probe")
    assert relative.tool_to_reference is None
    assert relative.status is PoseStatus.MISSING
    assert relative.reason.startswith("Reference")


@pytest.mark.parametrize("first", ["Probe", "Reference"])
def test_tools_reported_one_by_one_are_brought_to_one_time(a_tracker, a_stream, a_clock, first):
    second = {"Probe": "Reference", "Reference": "Probe"}[first]
    base, probe_to_reference = a_pose(3), a_pose(4)
    poses = {"Probe": base @ probe_to_reference, "Reference": base}
    for k in range(6):
        a_tracker.put([ok(first, poses[first], 1000 + k / 60)])
        a_tracker.put([ok(second, poses[second], 1000 + k / 60 + 0.005)])
    polled(a_stream, 12)
    a_clock.now = 1000.1
    np.testing.assert_allclose(
        a_stream.current_in_reference("Probe").tool_to_reference, invert_rigid(base) @ poses["Probe"], atol=1e-9
    )


def test_four_tools_at_250_hz_reach_a_slow_display_without_a_dropped_frame(a_tracker):
    tools = ("Probe", "Reference", "Stylus", "Sphere")
    begin = time.monotonic()

    def due(k: int):
        time.sleep(max(begin + k / 250 - time.monotonic(), 0))
        return [ok(tool, a_pose(1), time.monotonic(), device_s=k / 250) for tool in tools]

    for k in range(500):
        a_tracker.put(lambda k=k: due(k))
    with PoseStream(a_tracker) as stream:
        frames: list = []
        deadline = time.monotonic() + 30
        while len(frames) < 500:
            frames += stream.poll()
            assert time.monotonic() < deadline
            time.sleep(0.05)  # a display at 20 frames a second
        assert stream.state.dropped_frames == 0
    times = [frame[0].device_time_s for frame in frames]
    np.testing.assert_allclose(times, np.arange(500) / 250)
    assert all(len(frame) == 4 for frame in frames)
