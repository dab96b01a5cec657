"""Live coverage of the pivot cone: sides are named as the camera sees them, whatever the marker's own axes."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from ModuleTrackingLib.calibration.coverage import ENOUGH_DEG, SIDES, draw_coverage, tilt_coverage
from scipy.spatial.transform import Rotation

CAMERA = np.array([0.0, -1500.0, 0.0])  # looks along +y; z is up, its right is +x
TIP = np.array([20.0, -15.0, -140.0])  # oblique in the marker's frame
PIVOT = np.array([30.0, 10.0, 5.0])


def tilted(tilts_deg):
    """Poses of a tool that stands upright (along +z) and is tilted to the right and away from the camera by so many degrees."""
    level = Rotation.align_vectors([[0, 0, -1.0]], [TIP / np.linalg.norm(TIP)])[0]
    poses = []
    for right, away in tilts_deg:
        turn = Rotation.from_rotvec(np.radians([-away, right, 0.0])) * level  # about +y: the top goes to +x
        pose = np.eye(4)
        pose[:3, :3] = turn.as_matrix()
        pose[:3, 3] = PIVOT - turn.apply(TIP)
        poses.append(pose)
    return np.array(poses)


def circle(half_angle_deg, count=96):
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return half_angle_deg * np.stack([np.sin(angles), np.cos(angles)], axis=1)


def test_a_full_cone_covers_every_side():
    coverage = tilt_coverage(tilted(circle(30.0)), CAMERA)
    np.testing.assert_allclose(coverage.reached_deg, 30.0, atol=0.5)
    assert coverage.covered.all()
    assert coverage.advice == ""


@pytest.mark.parametrize("missing", range(8))
def test_the_side_left_out_is_named(missing):
    cone = circle(30.0)
    sides = np.rint(np.arctan2(cone[:, 0], cone[:, 1]) / (np.pi / 4)).astype(int) % 8
    coverage = tilt_coverage(tilted(np.where((sides == missing)[:, None], cone / 6, cone)), CAMERA)
    assert coverage.advice == f"tilt further {SIDES[missing]}"
    assert list(np.flatnonzero(~coverage.covered)) == [missing]


def test_a_narrow_cone_covers_nothing():
    assert not tilt_coverage(tilted(circle(ENOUGH_DEG - 3)), CAMERA).covered.any()


def test_the_present_tilt_is_where_the_tool_is():
    poses = tilted([*circle(30.0), (10.0, 0.0)])
    right, away = tilt_coverage(poses, CAMERA).tilts_deg[-1]
    assert right == pytest.approx(10.0, abs=1.0)
    assert away == pytest.approx(0.0, abs=1.0)


def test_a_tool_whose_tip_the_tracker_gives_is_judged_by_its_axis():
    poses = tilted(circle(30.0))
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.align_vectors([TIP / np.linalg.norm(TIP)], [[0, 0, 1.0]])[0].as_matrix()
    poses[:, :3, 3] = PIVOT
    assert tilt_coverage(poses, CAMERA).covered.all()


def test_a_tool_that_is_not_tilted_has_no_coverage_yet():
    assert tilt_coverage(tilted([(0.0, 0.0)] * 50), CAMERA) is None
    assert tilt_coverage(tilted(circle(30.0, 10)), CAMERA) is None


def test_the_drawing_is_svg_with_a_wedge_for_each_side_covered():
    drawing = ET.fromstring(draw_coverage(tilt_coverage(tilted(circle(30.0)), CAMERA)))
    assert len(drawing.findall("{http://www.w3.org/2000/svg}path")) == 8
