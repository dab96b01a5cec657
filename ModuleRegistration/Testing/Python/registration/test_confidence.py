"""Probabilities and expectations against random draws."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.rigid import rigid_from_vector
from ModuleRegistrationLib.registration.landmarks import motion_jacobian
from ModuleRegistrationLib.verification.confidence import Confidence, probability_within, probability_words
from ModuleRegistrationLib.verification.plausibility import expected_plausibility, plausibility

PIVOT = np.array([5.0, 20.0, 30.0])


@pytest.fixture(scope="module")
def a_covariance() -> np.ndarray:
    root = np.random.default_rng(3).normal(size=(6, 6)) * np.repeat([0.004, 0.35], 3)[:, None]
    return root @ root.T


@pytest.mark.parametrize("freedom", [None, 6.0])
def test_the_probability_is_the_share_of_draws_below_the_limit(a_covariance, freedom):
    rng = np.random.default_rng(8)
    targets = np.array([[0.0, 100, 0], [60, -20, 70], [5, 20, 30]])
    draws = rng.multivariate_normal(np.zeros(6), a_covariance, 40_000)
    if freedom is not None:
        draws *= np.sqrt(freedom / rng.chisquare(freedom, 40_000))[:, None]
    errors = np.linalg.norm(np.einsum("tij,nj->tni", motion_jacobian(targets, PIVOT), draws), axis=2)
    limit = float(np.median(errors[0]))
    expected = (errors < limit).mean(axis=1)
    assert probability_within(a_covariance, PIVOT, targets, limit, freedom) == pytest.approx(expected, abs=0.015)


def test_the_worst_target_is_told_and_never_as_certain():
    assert probability_words(np.array([0.8, 1.0]), 2.0).endswith("at the worst target is below 2 mm with a probability of 80%")
    assert probability_words(np.array([1.0]), 1.5).endswith("at the target is below 1.5 mm with a probability of more than 99%")
    assert "less than 1%" in probability_words(np.array([0.0]), 0.5)


def test_nothing_known_is_nothing_said():
    assert Confidence(2.0).sentences() == []


def test_plausibility_points_are_as_far_off_as_expected(a_skull, a_covariance):
    """Registrations with errors drawn from their covariance: the p-values must be even over 0 to 1."""
    rng = np.random.default_rng(5)
    faces = rng.choice(len(a_skull.triangles), 5, replace=False)
    truth, normals = a_skull.vertices_mm[a_skull.triangles[faces]].mean(axis=1), a_skull.triangle_normals[faces]
    chances = []
    for _ in range(400):
        error = rng.normal(0, 0.3) + rng.normal(0, 0.5, 5)
        touched = truth + normals * error[:, None]
        motion = rng.multivariate_normal(np.zeros(6), a_covariance / 25)  # small: the skull is flat for it
        found = plausibility(rigid_from_vector(motion[:3], motion[3:], PIVOT), touched, a_skull)
        chances.append(expected_plausibility(found, "abcde", a_covariance / 25, PIVOT, 0.5, 0.3).p_value)
    shares = np.histogram(chances, bins=5, range=(0, 1))[0] / len(chances)
    assert shares == pytest.approx(np.full(5, 0.2), abs=0.07)  # 0.02 is one SD of each


def test_a_point_far_from_the_bone_is_named(a_skull, a_covariance):
    points = a_skull.vertices_mm[[4000, 6000, 8000]]
    points = points + np.array([0.0, 6.0, 0.0])[:, None] * a_skull.vertex_normals[[4000, 6000, 8000]]
    found = plausibility(np.eye(4), points, a_skull)
    check = expected_plausibility(found, ("A", "B", "C"), a_covariance / 25, PIVOT, 0.5, 0.4)
    assert not check.as_expected
    words = check.words("the plausibility points")
    assert "further off than expected" in words
    assert "farthest is B, 6.0 mm off" in words


def test_an_uncertain_scale_makes_large_distances_less_telling(a_skull, a_covariance):
    points = a_skull.vertices_mm[[4000, 6000]] + 2.0 * a_skull.vertex_normals[[4000, 6000]]
    found = plausibility(np.eye(4), points, a_skull)
    sure, unsure = (
        expected_plausibility(found, ("A", "B"), a_covariance / 25, PIVOT, 0.5, 0.4, freedom).p_value for freedom in (None, 3.0)
    )
    assert unsure > sure
