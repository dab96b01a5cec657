"""Interpolation against screw motions of constant speed, and its refusals."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.rigid import rigid
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleTrackingLib.pose_history import PoseHistory, interpolate
from ModuleTrackingLib.tracker import PoseStatus
from scipy.spatial.transform import Rotation
from scripted_tracker import a_pose, missing, ok


def motion(time_s: float) -> np.ndarray:
    """Constant turning about one axis, constant velocity of the origin."""
    return rigid(Rotation.from_rotvec(np.array([0.3, -0.5, 0.8]) * time_s).as_matrix(), np.array([10.0, -20, 5]) * time_s + 3)


def a_history(times, **options) -> PoseHistory:
    history = PoseHistory("Probe", **options)
    for time_s in times:
        history.add(ok("Probe", motion(time_s), time_s))
    return history


@given(st.floats(0, 0.5))
@settings(max_examples=100, deadline=None)
def test_a_uniform_motion_is_interpolated_exactly(time_s):
    history = a_history(np.arange(0, 0.6, 1 / 60))
    np.testing.assert_allclose(history.at(time_s).tool_to_tracker, motion(time_s), atol=1e-9)


@given(st.integers(0, 1000), st.integers(0, 1000), st.floats(0, 1))
@settings(max_examples=100, deadline=None)
def test_an_interpolated_pose_is_rigid_and_in_between(a, b, share):
    between = interpolate(a_pose(a), a_pose(b), share)
    np.testing.assert_allclose(between[:3, :3].T @ between[:3, :3], np.eye(3), atol=1e-9)
    full = Rotation.from_matrix(a_pose(a)[:3, :3].T @ a_pose(b)[:3, :3]).magnitude()
    assert Rotation.from_matrix(a_pose(a)[:3, :3].T @ between[:3, :3]).magnitude() == pytest.approx(share * full, abs=1e-6)


def test_nothing_is_interpolated_across_a_gap():
    history = a_history([0.0, 0.05, 0.3])
    refused = history.at(0.2)
    assert refused.tool_to_tracker is None
    assert refused.status is PoseStatus.STALE
    assert refused.flags == ("in a gap of 250 ms",)


def test_nothing_is_interpolated_next_to_a_missing_pose():
    history = a_history([0.0, 0.016])
    history.add(missing("Probe", 0.033))
    history.add(ok("Probe", motion(0.05), 0.05))
    for time_s in (0.02, 0.033, 0.04):
        assert history.at(time_s).tool_to_tracker is None
        assert history.at(time_s).status is PoseStatus.MISSING
    assert history.at(0.01).usable
    assert history.at(0.05).usable


def test_nothing_is_extrapolated():
    history = a_history([1.0, 1.016])
    assert history.at(0.99).flags == ("no pose so early",)
    assert history.at(1.02).flags == ("no pose so late yet",)
    assert not history.covers(1.02)
    assert history.covers(1.016)


def test_a_pose_out_of_order_is_left_out_and_counted():
    history = a_history([1.0, 1.1, 1.05])
    assert (len(history), history.out_of_order) == (2, 1)


def test_the_history_stays_bounded():
    history = a_history(np.arange(0, 100, 0.05), history_s=2.0)
    assert len(history) <= 82
    assert history.at(98.5).usable


def test_the_worse_error_of_the_neighbours_counts():
    history = PoseHistory("Probe")
    history.add(ok("Probe", motion(0), 0.0, error_mm=0.1))
    history.add(ok("Probe", motion(0.01), 0.01, error_mm=0.7))
    assert history.at(0.001).error_mm == 0.7
