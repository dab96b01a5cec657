"""The prospect of further bone points: the textbook's information form says the same, and more points never hurt."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from ModuleRegistrationLib.registration.landmarks import motion_jacobian
from ModuleRegistrationLib.registration.prospect import covariance_with_points

PIVOT = np.array([2.0, -5.0, 10.0])


@pytest.fixture
def a_prior():
    mixed = np.random.default_rng(4).normal(size=(6, 6))
    scale = np.diag([0.01, 0.01, 0.01, 1, 1, 1])
    return scale @ (mixed @ mixed.T + np.eye(6)) @ scale


@pytest.fixture
def points_on_a_sphere():
    directions = np.random.default_rng(5).normal(size=(18, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return PIVOT + 80 * directions, directions


def test_the_information_of_independent_points_adds_up(a_prior, points_on_a_sphere):
    points, normals = points_on_a_sphere
    sds = np.linspace(0.3, 1.2, len(points))
    rows = np.einsum("ni,nij->nj", normals, motion_jacobian(points, PIVOT))
    expected = np.linalg.inv(np.linalg.inv(a_prior) + (rows / sds[:, None] ** 2).T @ rows)
    np.testing.assert_allclose(covariance_with_points(a_prior, PIVOT, points, normals, sds), expected, rtol=1e-6, atol=1e-12)


def test_points_on_a_sphere_say_nothing_of_its_turning(a_prior, points_on_a_sphere):
    points, normals = points_on_a_sphere
    after = covariance_with_points(np.diag([1e-4] * 3 + [4.0] * 3), PIVOT, points, normals, np.full(len(points), 0.5))
    np.testing.assert_allclose(np.diag(after)[:3], 1e-4, rtol=1e-9)
    assert (np.diag(after)[3:] < 0.1).all()


def test_each_further_point_shrinks_the_error_or_leaves_it(a_prior, points_on_a_sphere):
    points, normals = points_on_a_sphere
    traces = [np.trace(a_prior)]
    for count in (1, 4, 9, 18):
        after = covariance_with_points(a_prior, PIVOT, points[:count], normals[:count], np.full(count, 0.5))
        assert np.linalg.eigvalsh(after).min() > 0
        traces.append(np.trace(after))
    assert traces == sorted(traces, reverse=True)


def test_an_error_common_to_all_points_does_not_average_out():
    """Points on one flat patch: with a common error c the height cannot be known better than c."""
    points = np.array([[x, y, 0.0] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    normals, prior = np.tile([0.0, 0, 1], (9, 1)), np.diag([1e-12] * 3 + [100.0] * 3)
    alone = covariance_with_points(prior, np.zeros(3), points, normals, np.full(9, 0.3))
    common = covariance_with_points(prior, np.zeros(3), points, normals, np.full(9, 0.3), np.full(9, 0.4))
    assert alone[5, 5] == pytest.approx(0.3**2 / 9, rel=1e-2)
    assert common[5, 5] == pytest.approx(0.3**2 / 9 + 0.4**2, rel=1e-2)


def test_a_point_without_an_error_is_refused(a_prior):
    with pytest.raises(InputError, match="positive SD"):
        covariance_with_points(a_prior, PIVOT, [[1.0, 2, 3]], [[0.0, 0, 1]], [0.0])
