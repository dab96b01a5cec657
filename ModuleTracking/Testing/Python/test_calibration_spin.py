"""Spin calibration against a known axis."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid
from ModuleTrackingLib.calibration import calibrate_spin, tool_to_marker
from scipy.spatial.transform import Rotation

AXIS = np.array([0.2, -0.1, -0.97]) / np.linalg.norm([0.2, -0.1, -0.97])


def spinning(rng, count=200, degrees=300.0, wobble_deg=0.5):
    turn = Rotation.from_rotvec(AXIS * np.radians(np.linspace(0, degrees, count))[:, None])
    wobble = Rotation.from_rotvec(rng.normal(0, np.radians(wobble_deg), (count, 3)))
    return rigid((Rotation.random(random_state=3) * wobble * turn).as_matrix(), rng.normal(0, 1, (count, 3)))


@pytest.fixture
def rng():
    return np.random.default_rng(2)


def angle_deg(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1, 1)))


def test_the_axis_is_exact_without_noise(rng):
    result = calibrate_spin(spinning(rng, wobble_deg=0), tip_in_marker_mm=150 * AXIS)
    assert angle_deg(result.axis_in_marker, AXIS) < 1e-4
    assert result.turned_deg == pytest.approx(300, abs=2)


def test_the_axis_points_to_the_tip(rng):
    poses = spinning(rng)
    assert calibrate_spin(poses, 150 * AXIS).axis_in_marker @ AXIS > 0
    assert calibrate_spin(poses, -150 * AXIS).axis_in_marker @ AXIS < 0


def test_the_stated_sd_is_that_of_repeated_calibrations():
    ratios = []
    for seed in range(150):
        result = calibrate_spin(spinning(np.random.default_rng(seed), wobble_deg=1.0), 150 * AXIS)
        ratios.append(angle_deg(result.axis_in_marker, AXIS) ** 2 / (2 * result.sd_deg**2))
    assert 0.6 < np.mean(ratios) < 1.6


def test_tilted_frames_are_left_out(rng):
    poses = spinning(rng)
    poses[50:60, :3, :3] = poses[50:60, :3, :3] @ Rotation.from_rotvec([0.4, 0, 0]).as_matrix()
    result = calibrate_spin(poses, 150 * AXIS)
    assert not result.used[50:60].any()
    assert angle_deg(result.axis_in_marker, AXIS) < 0.2


def test_too_little_turning_is_refused(rng):
    with pytest.raises(InputError, match="turned by .* deg about its axis; turn it by more"):
        calibrate_spin(spinning(rng, degrees=40))


def test_tilting_instead_of_rolling_is_refused(rng):
    with pytest.raises(InputError, match="wobbled"):
        calibrate_spin(spinning(rng, wobble_deg=12))


def test_the_tool_frame_has_its_z_along_the_axis_and_its_origin_at_the_tip():
    frame = tool_to_marker([1, 2, 3], AXIS)
    np.testing.assert_allclose(frame[:3, 2], AXIS)
    np.testing.assert_allclose(frame[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(frame[:3, :3]) == pytest.approx(1)
