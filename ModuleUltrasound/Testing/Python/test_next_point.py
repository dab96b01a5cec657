"""The next point against closed forms: the information of a point, and what is in the way of the probe."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid_from_vector, transform_points
from ModuleUltrasoundLib.palpation.next_point import choose_next, covariance_with, motion_rows, reachable, rms_tre_mm
from ModuleUltrasoundLib.palpation.protocol import ProtocolPoints

CENTER = np.array([10.0, -60.0, 40.0])


def points_on_a_sphere(count: int = 12, seed: int = 0) -> ProtocolPoints:
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    labels = tuple(f"P{k}" for k in range(count))
    return ProtocolPoints(labels, CENTER + 80 * normals * (1.0, 1.2, 0.9), normals, labels)


def a_covariance(seed: int = 0) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(6, 6)) * [0.02, 0.02, 0.02, 1.5, 1.5, 1.5]
    return root.T @ root + np.diag([1e-6] * 3 + [1e-3] * 3)


def test_a_motions_row_is_the_change_of_the_distance_along_the_normal():
    points, rng = points_on_a_sphere(), np.random.default_rng(1)
    rotation, shift = 1e-5 * rng.normal(size=3), 1e-4 * rng.normal(size=3)
    moved = transform_points(rigid_from_vector(rotation, shift, CENTER), points.positions_ras_mm)
    change = np.sum((moved - points.positions_ras_mm) * points.normals, axis=1)
    rows = motion_rows(points.positions_ras_mm, points.normals, CENTER)
    assert rows @ np.concatenate([rotation, shift]) == pytest.approx(change, abs=1e-7)


def test_predicted_tre_agrees_with_motions_drawn_at_random():
    covariance, targets = a_covariance(), CENTER + np.random.default_rng(2).normal(size=(5, 3)) * 40
    motions = np.random.default_rng(3).multivariate_normal(np.zeros(6), covariance, size=40000)
    arms = targets - CENTER
    errors = np.cross(motions[:, None, :3], arms[None]) + motions[:, None, 3:]
    assert rms_tre_mm(covariance, CENTER, targets) == pytest.approx(np.sqrt(np.mean(np.sum(errors**2, axis=2))), rel=0.015)


@pytest.mark.parametrize("seed", range(5))
def test_the_next_point_is_the_one_that_full_least_squares_would_choose(seed):
    points, covariance, targets = points_on_a_sphere(seed=seed), a_covariance(seed), CENTER + 50 * np.eye(3)
    free = np.arange(12) % 3 != 0
    expected = np.full(12, np.inf)
    for index in np.flatnonzero(free):
        row = motion_rows(points.positions_ras_mm[index : index + 1], points.normals[index : index + 1], CENTER)
        after = np.linalg.inv(np.linalg.inv(covariance) + row.T @ row / 0.6**2)
        expected[index] = rms_tre_mm(after, CENTER, targets)
    chosen = choose_next(points, free, covariance, CENTER, targets, 0.6)
    assert chosen.index == int(np.argmin(expected))
    assert chosen.label == points.labels[chosen.index]
    assert chosen.tre_then_mm == pytest.approx(expected.min(), rel=1e-6)
    assert chosen.tre_then_mm < chosen.tre_now_mm == pytest.approx(rms_tre_mm(covariance, CENTER, targets))


def test_there_is_no_next_point_when_none_is_open():
    assert choose_next(points_on_a_sphere(), np.zeros(12, dtype=bool), a_covariance(), CENTER, CENTER[None]) is None


def test_a_covariance_that_is_none_is_refused():
    for bad in (np.eye(3), np.full((6, 6), np.nan), -np.eye(6)):
        with pytest.raises(InputError, match="register the landmarks first"):
            choose_next(points_on_a_sphere(), np.ones(12, dtype=bool), bad, CENTER, CENTER[None])


def test_points_under_the_clamp_and_on_the_table_are_out_of_reach():
    normals = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0]])
    points = ProtocolPoints(("right", "front", "back", "top"), 80 * normals, normals, ("",) * 4)
    pin = np.array([[110.0, 20.0, 0.0]])  # beside a probe on the right, not in its foot
    assert reachable(points, pin).tolist() == [False, True, True, True]
    assert reachable(points, None, (0.0, -1.0, 0.0)).tolist() == [True, True, False, True]
    assert reachable(points, pin + (0.0, 20.0, 0.0)).all()
    assert reachable(points).all()


def test_one_more_point_is_one_more_row_of_least_squares():
    points, covariance, pivot = points_on_a_sphere(), a_covariance(), np.array([3.0, -20.0, 8.0])
    row = motion_rows(points.positions_ras_mm[:1], points.normals[:1], pivot)
    expected = np.linalg.inv(np.linalg.inv(covariance) + row.T @ row / 0.5**2)
    after = covariance_with(covariance, points.positions_ras_mm[0], points.normals[0], pivot, 0.5)
    assert after == pytest.approx(expected, abs=1e-9)
