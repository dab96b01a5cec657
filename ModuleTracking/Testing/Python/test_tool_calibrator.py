"""Collecting poses and keeping what they give, by simulated pivots whose tip is known."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid, rigid_from_vector
from ModuleTrackingLib.tool_calibrator import Kind, ToolCalibrator, geometry_of
from ModuleTrackingLib.tracker import ToolInfo

TIP, DIVOT = np.array([2.0, -3.0, 140.0]), np.array([30.0, 40.0, 10.0])
STYLUS = geometry_of("Stylus", [ToolInfo("Stylus", "P6", "0001", definition="abc")])


def pivoting(k, turn=None):
    turn = turn or [0.5 * np.sin(k / 7), 0.5 * np.sin(k / 11), 0.3 * np.sin(k / 5)]
    return rigid(np.eye(3), DIVOT) @ rigid_from_vector(turn, np.zeros(3)) @ rigid(np.eye(3), -TIP)


def pivoted(folder="", poses=200):
    calibrator = ToolCalibrator(folder)
    calibrator.begin(Kind.PIVOT, "Stylus", 10.0)
    for k in range(poses):
        calibrator.add("Stylus", pivoting(k))
        calibrator.add("Probe", np.eye(4))  # another tool's poses are none of its business
    assert calibrator.finish(9.9, STYLUS) is None
    assert calibrator.busy == "Stylus"
    return calibrator, calibrator.finish(10.0, STYLUS)


def test_a_pivot_gives_the_tip_and_is_found_again_on_disk(tmp_path):
    calibrator, found = pivoted(str(tmp_path))
    np.testing.assert_allclose(found.tool_to_marker[:3, 3], TIP, atol=1e-6)
    assert "pivot" in calibrator.words("Stylus")
    again = ToolCalibrator(str(tmp_path)).load("Stylus", STYLUS)
    np.testing.assert_allclose(again.tool_to_marker, found.tool_to_marker)
    assert (again.geometry.tool_id, again.date) == ("P6 0001 abc", found.date)


def test_a_calibration_is_refused_when_the_tool_s_definition_changed(tmp_path):
    calibrator, _ = pivoted(str(tmp_path))
    bent = geometry_of("Stylus", [ToolInfo("Stylus", "P6", "0001", definition="def")])
    for one in (calibrator, ToolCalibrator(str(tmp_path))):
        assert one.load("Stylus", bent) is None
        assert "does not fit" in one.failure
        assert one.tool_to_marker("Stylus") is None


def test_poses_that_tell_nothing_are_refused_with_the_reason():
    calibrator, found = pivoted(poses=5)
    assert found is None
    assert "at least 20 poses, got 5" in calibrator.failure
    assert not calibrator.busy


def test_the_axis_needs_the_tip_and_is_taken_through_it():
    with pytest.raises(InputError, match="pivot the stylus first"):
        ToolCalibrator().begin(Kind.SPIN, "Stylus", 1.0)
    calibrator, before = pivoted()
    calibrator.begin(Kind.SPIN, "Stylus", 20.0)
    axis = np.array([0.0, -0.28, 0.96])
    for k in range(100):  # poses of the calibrated tool, as they come from now on
        calibrator.add("Stylus", pivoting(k, list(axis * k / 20)) @ before.tool_to_marker)
    found = calibrator.finish(20.0, STYLUS)
    np.testing.assert_allclose(found.tool_to_marker[:3, 2], axis, atol=1e-6)
    np.testing.assert_allclose(found.tool_to_marker[:3, 3], TIP, atol=1e-6)
    assert found.covariance.shape == (5, 5)
