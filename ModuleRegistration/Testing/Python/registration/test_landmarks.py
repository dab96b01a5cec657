import numpy as np
import pytest
from CranioNavLib.rigid import rigid, rotation_angle_deg, transform_points
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleRegistrationLib.registration.error_theory import fitzpatrick_tre
from ModuleRegistrationLib.registration.landmarks import fit_anisotropic, fit_rigid, motion_jacobian, register_landmarks
from scipy.spatial.transform import Rotation

LANDMARKS = np.array([[0.0, 92, -20], [-46, 60, -20], [46, 58, -21], [0, 85, -55], [10, 20, 90]])


@given(seed=st.integers(0, 10**6), count=st.integers(3, 12))
@settings(max_examples=60, deadline=None)
def test_exact_pairs_give_back_any_pose(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    patient = rng.normal(0, 60, (count, 3))
    true_pose = rigid(Rotation.random(random_state=seed).as_matrix(), rng.uniform(-1000, 1000, 3))
    assert np.allclose(fit_rigid(patient, transform_points(true_pose, patient)), true_pose, atol=1e-7)


@given(seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_the_fit_agrees_with_scikit_surgerycore(seed: int) -> None:
    from sksurgerycore.algorithms.procrustes import orthogonal_procrustes

    rng = np.random.default_rng(seed)
    patient, ct = rng.normal(0, 50, (6, 3)), rng.normal(0, 50, (6, 3))
    rotation, translation, _ = orthogonal_procrustes(ct, patient)
    assert np.allclose(fit_rigid(patient, ct), rigid(rotation, translation.ravel()), atol=1e-6)


def test_a_mirrored_set_gives_a_rotation_never_a_reflection() -> None:
    fit = fit_rigid(LANDMARKS * [-1, 1, 1], LANDMARKS)
    assert np.linalg.det(fit[:3, :3]) == pytest.approx(1)


def test_weights_of_zero_take_a_pair_out() -> None:
    moved = LANDMARKS + 0.0
    moved[4] += 30
    assert np.allclose(fit_rigid(moved, LANDMARKS, weights=[1, 1, 1, 1, 1e-12]), np.eye(4), atol=1e-6)


def test_fle_estimated_from_the_residuals_is_unbiased() -> None:
    rng = np.random.default_rng(4)
    squares = [register_landmarks(LANDMARKS + rng.normal(0, 1.0, LANDMARKS.shape), LANDMARKS).fle_mm ** 2 for _ in range(1500)]
    assert np.mean(squares) == pytest.approx(3.0, rel=0.05)  # 9 degrees of freedom: SD of the mean 1.2%


def test_covariance_covers_the_spread_of_repeated_fits() -> None:
    rng = np.random.default_rng(5)
    targets = np.array([[0.0, 0, 60], [60, -40, 30]])
    errors = []
    for _ in range(2000):
        fit = fit_rigid(LANDMARKS + rng.normal(0, 0.7, LANDMARKS.shape), LANDMARKS)
        errors.append(transform_points(fit, targets) - targets)
    rms = np.sqrt(np.mean(np.sum(np.square(errors), axis=2), axis=0))
    assert rms == pytest.approx(fitzpatrick_tre(0.7 * np.sqrt(3), LANDMARKS, targets), rel=0.04)


def test_anisotropic_errors_are_weighed_and_their_covariance_holds() -> None:
    rng = np.random.default_rng(6)
    sds = np.array([[0.2, 0.2, 3.0], [3.0, 0.2, 0.2], [0.2, 3.0, 0.2], [0.3, 0.3, 0.3], [0.2, 0.2, 3.0]])
    covariances = np.einsum("ni,ij->nij", sds**2, np.eye(3))
    pivot, weighed, plain = LANDMARKS.mean(axis=0), [], []
    for _ in range(400):
        measured = LANDMARKS + rng.normal(size=LANDMARKS.shape) * sds
        pose, covariance = fit_anisotropic(measured, LANDMARKS, covariances)
        weighed.append(transform_points(pose, pivot[None])[0] - pivot)
        plain.append(transform_points(fit_rigid(measured, LANDMARKS), pivot[None])[0] - pivot)
    assert np.mean(np.square(weighed)) < 0.2 * np.mean(np.square(plain))
    assert np.std(weighed, axis=0) == pytest.approx(np.sqrt(np.diag(covariance))[3:], rel=0.15)


def test_equal_isotropic_errors_give_the_closed_form() -> None:
    measured = LANDMARKS + np.random.default_rng(7).normal(0, 1, LANDMARKS.shape)
    pose, _ = fit_anisotropic(measured, LANDMARKS, np.tile(np.eye(3), (5, 1, 1)))
    closed = fit_rigid(measured, LANDMARKS)
    assert rotation_angle_deg(pose, closed) < 1e-4
    assert np.allclose(pose, closed, atol=1e-5)


def test_the_jacobian_is_the_derivative_of_a_small_motion() -> None:
    from CranioNavLib.rigid import rigid_from_vector

    pivot = np.array([5.0, -3, 8])
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        moved = transform_points(rigid_from_vector(step[:3], step[3:], pivot), LANDMARKS)
        assert np.allclose((moved - LANDMARKS) / 1e-6, motion_jacobian(LANDMARKS, pivot)[:, :, k], atol=1e-3)
