import numpy as np
import pytest
from CranioNavLib.errors import InputError
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleRegistrationLib.registration.error_theory import fitzpatrick_tre, length_statistics, predict_tre, probability_below
from ModuleRegistrationLib.registration.landmarks import motion_jacobian

FIDUCIALS = np.array([[0.0, 92, -20], [-46, 60, -20], [46, 58, -21], [0, 85, -55]])
TARGETS = np.array([[0.0, 0, 0], [30, -80, 40], [0, 92, -20]])
PIVOT = FIDUCIALS.mean(axis=0)


def fiducial_covariance(axis_sd: float) -> np.ndarray:
    jacobian = motion_jacobian(FIDUCIALS, PIVOT).reshape(-1, 6)
    return axis_sd**2 * np.linalg.inv(jacobian.T @ jacobian)


def test_the_covariance_of_equal_errors_is_fitzpatricks_formula() -> None:
    predicted = predict_tre(fiducial_covariance(1.0), PIVOT, TARGETS)
    assert predicted.rms_mm == pytest.approx(fitzpatrick_tre(np.sqrt(3), FIDUCIALS, TARGETS))


@given(st.tuples(*[st.floats(0.0, 3.0)] * 3).filter(lambda sds: max(sds) > 0.1))
@settings(max_examples=15, deadline=None)
def test_mean_and_quantile_of_a_gaussians_length_agree_with_simulation(sds: tuple[float, float, float]) -> None:
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    statistics = length_statistics((turn * np.square(sds)) @ turn.T)
    lengths = np.linalg.norm(np.random.default_rng(1).normal(size=(200_000, 3)) * sds, axis=1)
    assert float(statistics.mean_mm) == pytest.approx(lengths.mean(), rel=0.01)
    assert float(statistics.p95_mm) == pytest.approx(np.quantile(lengths, 0.95), rel=0.015)


def test_a_line_and_a_sphere_give_the_textbook_quantiles() -> None:
    statistics = length_statistics(np.stack([np.diag([1.0, 0, 0]), np.eye(3)]))
    assert statistics.p95_mm == pytest.approx([1.959964, 2.795483], rel=1e-3)
    assert statistics.mean_mm == pytest.approx([np.sqrt(2 / np.pi), 2 * np.sqrt(2 / np.pi)], rel=1e-3)


def test_the_error_is_below_its_95_percent_limit_with_probability_95_percent() -> None:
    limits = predict_tre(fiducial_covariance(2.0), PIVOT, TARGETS).p95_mm
    for target, limit in zip(TARGETS, limits):
        assert probability_below(fiducial_covariance(2.0), PIVOT, target[None], float(limit))[0] == pytest.approx(0.95, abs=2e-3)


def test_a_scale_known_from_few_residuals_widens_the_limit_as_student_does() -> None:
    rng = np.random.default_rng(2)
    freedom = 6
    lengths = np.linalg.norm(rng.normal(size=(200_000, 3)), axis=1) / np.sqrt(rng.chisquare(freedom, 200_000) / freedom)
    covariance = np.diag([0.0, 0, 0, 1, 1, 1])
    predicted = predict_tre(covariance, np.zeros(3), np.zeros((1, 3)), degrees_of_freedom=freedom)
    assert predicted.p95_mm[0] == pytest.approx(np.quantile(lengths, 0.95), rel=0.01)


def test_a_covariance_that_is_not_finite_is_refused() -> None:
    with pytest.raises(InputError, match="finite covariance"):
        predict_tre(np.full((6, 6), np.nan), PIVOT, TARGETS)
