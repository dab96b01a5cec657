"""The simulated tracker behaves like a tracker, its faults included."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.phantom import make_patient
from CranioNavLib.phantom.session import SimulatedSession, SteppedClock, use_session
from CranioNavLib.rigid import check_rigid, invert_rigid
from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, TrackerError


@pytest.fixture
def a_session():
    session = SimulatedSession(make_patient(None, 1), 1, SteppedClock())
    use_session(session)
    yield session
    use_session(None)


def test_it_lists_its_tools_and_gives_every_one_in_each_frame(a_session):
    a_session.touch_landmark(0)
    with TRACKERS.create("simulated") as tracker:
        assert [tool.name for tool in tracker.tools] == ["Reference", "Probe", "Stylus", "Sphere"]
        frame = {pose.tool: pose for pose in tracker.read()}
    assert set(frame) == {"Reference", "Probe", "Stylus", "Sphere"}
    assert frame["Stylus"].status is PoseStatus.OK
    check_rigid(frame["Stylus"].tool_to_tracker)
    assert frame["Probe"].status is PoseStatus.MISSING
    assert frame["Probe"].tool_to_tracker is None
    assert frame["Probe"].flags == ("not seen by the camera",)
    assert 900 < frame["Reference"].tool_to_tracker[2, 3] < 1900


def test_a_hand_that_goes_round_shows_every_tool_and_stays_on_the_head(a_session):
    with TRACKERS.create("simulated", hand="round") as tracker:
        frames = [{pose.tool: pose for pose in tracker.read()} for _ in range(600)]  # half a minute
    for tool in ("Probe", "Stylus", "Sphere"):
        assert {frame[tool].status for frame in frames} == {PoseStatus.OK}
        tips = np.array(
            [(invert_rigid(frame["Reference"].tool_to_tracker) @ frame[tool].tool_to_tracker)[:3, 3] for frame in frames]
        )
        assert np.ptp(tips, axis=0).max() > 30  # from place to place
        assert np.linalg.norm(np.diff(tips, axis=0), axis=1).max() * 20 < 1000  # mm/s: never a jump


def test_frames_come_at_the_rate_and_carry_the_hosts_time(a_session):
    with TRACKERS.create("simulated", rate_hz="50") as tracker:
        frames = [tracker.read()[0] for _ in range(100)]
    times = np.array([frame.host_time_s for frame in frames])
    assert np.diff(times) == pytest.approx(np.full(99, 0.02))
    assert [frame.frame_number for frame in frames] == list(range(1, 101))
    assert frames[-1].device_time_s == pytest.approx(2.0)


def test_the_tip_is_where_the_session_has_it_up_to_the_noise(a_session):
    a_session.touch_landmark(1)
    tips = {}
    for noise in ("0", "1"):
        with TRACKERS.create("simulated", noise=noise) as tracker:
            for _ in range(60):
                frame = {pose.tool: pose for pose in tracker.read()}
        moment = frame["Stylus"].host_time_s
        relative = invert_rigid(frame["Reference"].tool_to_tracker) @ frame["Stylus"].tool_to_tracker
        tips[noise] = np.linalg.norm(relative[:3, 3] - a_session.tool_to_reference("Stylus", moment)[:3, 3])
    assert tips["0"] < 1e-6
    assert 1e-3 < tips["1"] < 2.5


def test_a_hidden_tool_is_missing_though_it_is_in_hand(a_session):
    a_session.touch_landmark(0)
    with TRACKERS.create("simulated", missing_tools="Stylus") as tracker:
        assert {pose.tool: pose.status for pose in tracker.read()}["Stylus"] is PoseStatus.MISSING


def test_an_unknown_tool_to_hide_is_refused():
    with pytest.raises(InputError, match="no tool Drill; tools are Reference, Probe, Stylus, Sphere"):
        TRACKERS.create("simulated", missing_tools="Stylus, Drill")


def test_the_share_of_lost_frames_is_as_asked(a_session):
    with TRACKERS.create("simulated", missing_share="0.2") as tracker:
        lost = [tracker.read()[0].status is PoseStatus.MISSING for _ in range(600)]
    assert np.mean(lost) == pytest.approx(0.2, abs=0.06)


def test_a_broken_link_is_an_error_that_says_what_to_do(a_session):
    tracker = TRACKERS.create("simulated", fail_after_s="1")
    with pytest.raises(TrackerError, match="broke; open it again"), tracker:
        for _ in range(100):
            tracker.read()
    tracker.close()
    with tracker:  # comes back
        assert tracker.read()


def test_reading_before_the_start_is_an_error_and_a_frame_not_yet_due_is_none(a_session):
    tracker = TRACKERS.create("simulated", rate_hz="1")
    with pytest.raises(TrackerError, match="not open"):
        tracker.start()
    with pytest.raises(TrackerError, match="start it first"):
        tracker.read()
    with tracker:
        assert tracker.read(timeout_s=0.3) == []
        assert tracker.read(timeout_s=1.0)[0].frame_number == 1


def test_frames_that_nobody_fetched_are_gone(a_session):
    with TRACKERS.create("simulated", rate_hz="20") as tracker:
        assert tracker.read()[0].frame_number == 1
        a_session.clock.wait_until(a_session.clock.now() + 1.0)
        assert tracker.read()[0].frame_number >= 20
