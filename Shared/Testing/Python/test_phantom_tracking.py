"""The simulated tracker's error: as large as stated, worst in depth, standing still while a tool is held."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.phantom import constants
from CranioNavLib.phantom.tracking import TrackerError, draw_error
from CranioNavLib.rigid import rigid
from scipy.spatial.transform import Rotation

COUNT = 40_000


def test_one_source_has_a_quarter_millimetre_rms_and_depth_is_worst():
    shifts = draw_error(np.random.default_rng(0), COUNT)[:, 3:]
    assert np.sqrt((shifts**2).sum(axis=1).mean()) == pytest.approx(0.25, rel=0.03)
    assert shifts[:, 2].std() > 1.5 * shifts[:, :2].std()


def test_points_scatter_by_both_sources_and_the_levers_of_their_rotations():
    turn = Rotation.from_rotvec((0.4, 1.0, -0.2)).as_matrix()
    point = np.array([150.0, -80.0, 60.0])
    measured = TrackerError(turn).of_points(np.tile(point, (COUNT, 1)), np.random.default_rng(1))
    covariance = np.cov((measured - point).T)
    camera = np.diag(np.square([constants.TRACKER_LATERAL_SD_MM] * 2 + [constants.TRACKER_DEPTH_SD_MM]))
    expected = 2 * turn @ camera @ turn.T
    for lever in (point, np.array([0.0, 0.0, constants.TOOL_ORIGIN_OFFSET_MM])):
        cross = np.cross(np.eye(3), lever)
        expected += constants.TRACKER_ROTATION_SD_RAD**2 * cross.T @ cross
    assert np.allclose(covariance, expected, atol=0.004)


def test_most_of_the_error_stands_still_while_a_tool_is_held():
    poses = rigid(np.eye(3), np.tile([50.0, 0.0, 0.0], (4000, 1)))
    groups = np.repeat(np.arange(200), 20)
    measured = TrackerError(np.eye(3)).of_poses(poses, np.random.default_rng(2), groups)[:, :3, 3].reshape(200, 20, 3)
    within = measured.std(axis=1, ddof=1)
    between = measured.mean(axis=1).std(axis=0)
    share = np.sqrt((within**2).mean() / ((within**2).mean() + (between**2).mean()))
    assert share == pytest.approx(constants.TRACKER_JITTER_SHARE, abs=0.04)


def test_reported_poses_are_rigid():
    poses = rigid(Rotation.random(50, random_state=0).as_matrix(), np.zeros((50, 3)))
    seen = TrackerError(np.eye(3)).of_poses(poses, np.random.default_rng(3), np.arange(50))
    turns = seen[:, :3, :3]
    assert np.allclose(turns @ np.swapaxes(turns, 1, 2), np.eye(3), atol=1e-12)
