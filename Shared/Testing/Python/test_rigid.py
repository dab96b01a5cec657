"""Rigid transforms: checked where they come in, right where they are used."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import (
    check_points,
    check_rigid,
    invert_rigid,
    rigid,
    rigid_from_vector,
    rotate_covariances,
    rotation_angle_deg,
    transform_directions,
    transform_points,
)
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

coordinates = st.floats(-500, 500, allow_nan=False)
vectors = st.tuples(coordinates, coordinates, coordinates).map(np.array)
poses = st.builds(lambda w, t: rigid_from_vector(w / 500, t), vectors, vectors)


@given(poses, vectors)
def test_a_transform_and_its_inverse_cancel(pose, point):
    back = transform_points(invert_rigid(pose), transform_points(pose, point[None]))
    np.testing.assert_allclose(back[0], point, atol=1e-9)


@given(poses, poses, vectors)
def test_neighbours_meet(a_to_b, b_to_c, point):
    step = transform_points(b_to_c, transform_points(a_to_b, point[None]))
    np.testing.assert_allclose(transform_points(b_to_c @ a_to_b, point[None]), step, atol=1e-9)


@given(poses, vectors)
def test_directions_ignore_translation(pose, direction):
    expected = Rotation.from_matrix(pose[:3, :3]).apply(direction)
    np.testing.assert_allclose(transform_directions(pose, direction[None])[0], expected, atol=1e-9)


def test_a_rotation_about_a_pivot_leaves_the_pivot_alone():
    moved = transform_points(rigid_from_vector([0, 0, 1], [0, 0, 0], [10, 20, 30]), [[10, 20, 30]])
    np.testing.assert_allclose(moved, [[10, 20, 30]])


def test_batches_agree_with_single_transforms():
    rng = np.random.default_rng(0)
    batch = rigid_from_vector(rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=(5, 3)))
    points = rng.normal(size=(7, 3))
    np.testing.assert_allclose(transform_points(batch, points), [transform_points(one, points) for one in batch])
    np.testing.assert_allclose(invert_rigid(batch), np.linalg.inv(batch), atol=1e-12)


def test_covariances_turn_with_the_frame():
    turned = rotate_covariances(rigid_from_vector([0, 0, np.pi / 2], [1, 2, 3]), np.diag([1.0, 4.0, 9.0])[None])
    np.testing.assert_allclose(turned[0], np.diag([4.0, 1.0, 9.0]), atol=1e-12)


def test_the_angle_between_two_poses():
    assert rotation_angle_deg(np.eye(4), rigid_from_vector([0, np.radians(12), 0], [5, 5, 5])) == pytest.approx(12)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), "4x4"),
        (np.diag([1, 1, 1, np.nan]), "not a finite number"),
        (rigid(np.eye(3), [5, 6, 7]).T, "looks transposed"),
        (np.diag([-1.0, 1, 1, 1]), "mirrors"),
        (np.diag([2.0, 2, 2, 1]), "not rigid: it scales by 2.0"),
    ],
)
def test_what_is_not_rigid_is_refused_by_name(matrix, message):
    with pytest.raises(InputError, match=message):
        check_rigid(matrix)


def test_rounded_rotations_are_made_orthonormal():
    rough = np.round(rigid_from_vector([0.3, -0.2, 0.9], [1, 2, 3]), 4)
    turn = check_rigid(rough)[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[1, 2]], r"shape \(N, 3\)"),
        ([[1, 2, 3], [1, np.nan, 3]], "number 2 has a coordinate that is not a finite"),
        ([[1, 2, 1e9]], "1e\\+09 mm away"),
    ],
)
def test_what_is_not_points_is_refused_by_name(points, message):
    with pytest.raises(InputError, match=message):
        check_points(points)
