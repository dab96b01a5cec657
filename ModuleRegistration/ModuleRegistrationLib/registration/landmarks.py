"""Landmark registration: orthogonal Procrustes in closed form, its residuals and its uncertainty.

Equation numbers are those of Popovic, Heger et al., "Efficient Non-Invasive Registration with A-mode
Ultrasound in Skull Surgery".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, rigid, rigid_from_vector, rotate_covariances, transform_points

from ModuleRegistrationLib.registration.landmark_checks import check_landmarks


@dataclass(frozen=True, eq=False)
class LandmarkRegistration:
    """A rigid fit of paired points.

    `fre_mm` is the root mean square residual of the fit. It is no accuracy: it does not correlate with the
    error at a target (Fitzpatrick, SPIE 7261, 2009). `fle_mm` and `covariance` speak of accuracy.
    """

    reference_to_ras: Array  # (4, 4)
    fre_mm: float  # root mean square of residuals_mm
    residuals_mm: Array  # (N,) distance of each mapped patient point from its CT point
    residual_vectors_mm: Array  # (N, 3) mapped patient point minus CT point, RAS
    fle_mm: float  # root mean square 3D fiducial localisation error, estimated from the residuals
    degrees_of_freedom: float  # behind that estimate; 3N - 6 when nothing else was known
    covariance: Array  # (6, 6) of a small motion: rotation (rad) about pivot_ras_mm, then translation (mm), RAS axes
    pivot_ras_mm: Array  # (3,) centroid of the CT points
    labels: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()  # what looks wrong but was not refused


def fit_rigid(patient_mm: npt.ArrayLike, ct_mm: npt.ArrayLike, weights: Optional[npt.ArrayLike] = None) -> Array:
    """The rigid transform(s) with the least (weighted) sum of squared distances, patient to CT.

    Parameters
    ----------
    patient_mm, ct_mm : array-like, shape (..., N, 3), broadcast against each other; N >= 3
    weights : array-like, shape (..., N), optional
        One positive weight a pair; equal by default.

    Returns
    -------
    ndarray, shape (..., 4, 4)

    References
    ----------
    The chapter's equations (3)-(11): centroids, cross-covariance, its singular value decomposition, and the
    determinant that keeps a reflection out.
    """
    patient, ct = np.broadcast_arrays(np.asarray(patient_mm, dtype=float), np.asarray(ct_mm, dtype=float))
    share = np.ones(patient.shape[:-1]) if weights is None else np.broadcast_to(np.asarray(weights, float), patient.shape[:-1])
    share = (share / share.sum(axis=-1, keepdims=True))[..., None]
    m_mean, d_mean = (share * patient).sum(axis=-2), (share * ct).sum(axis=-2)  # (4), (5)
    m_centred, d_centred = patient - m_mean[..., None, :], ct - d_mean[..., None, :]  # (6), (7)
    cross_covariance = np.swapaxes(share * m_centred, -1, -2) @ d_centred  # (8): H = sum m' d'^T
    left, _, right = np.linalg.svd(cross_covariance)  # (9): H = U S V^T
    u, v = left, np.swapaxes(right, -1, -2)
    guard = np.zeros_like(u)
    guard[..., 0, 0] = guard[..., 1, 1] = 1.0
    guard[..., 2, 2] = np.linalg.det(v @ np.swapaxes(u, -1, -2))  # (10): +1, or -1 where V U^T would mirror
    rotation = v @ guard @ np.swapaxes(u, -1, -2)
    return rigid(rotation, d_mean - np.einsum("...ij,...j->...i", rotation, m_mean))  # (11)


def motion_jacobian(points_ras_mm: npt.ArrayLike, pivot_ras_mm: npt.ArrayLike) -> Array:
    """(..., N, 3, 6) derivative of points (..., N, 3) by a small motion: rotation about the pivot, then translation."""
    arm = np.asarray(points_ras_mm, dtype=float) - np.asarray(pivot_ras_mm, dtype=float)
    x, y, z = arm[..., 0], arm[..., 1], arm[..., 2]
    jacobian = np.zeros((*arm.shape, 6))
    jacobian[..., 0, 1], jacobian[..., 0, 2] = z, -y  # omega x arm
    jacobian[..., 1, 0], jacobian[..., 1, 2] = -z, x
    jacobian[..., 2, 0], jacobian[..., 2, 1] = y, -x
    jacobian[..., 0, 3] = jacobian[..., 1, 4] = jacobian[..., 2, 5] = 1.0
    return jacobian


def register_landmarks(
    patient_mm: npt.ArrayLike,
    ct_mm: npt.ArrayLike,
    labels: Sequence[str] = (),
    expected_fle_mm: Optional[float] = None,
) -> LandmarkRegistration:
    """Register paired landmarks or markers; degenerate and contradictory sets are refused by name.

    Parameters
    ----------
    patient_mm : array-like, shape (N >= 3, 3), Reference frame, mm
    ct_mm : array-like, shape (N, 3), RAS, mm, paired with the former
    labels : sequence of str, optional
        Names for messages.
    expected_fle_mm : float, optional
        Root mean square 3D localisation error that such points usually have (0.5 for bone screws, 3.5 for
        anatomical landmarks). Worth as much as three degrees of freedom beside the residuals; unset, the
        residuals speak alone.

    Raises
    ------
    InputError
        Fewer than 3 pairs, duplicates, collinear points, another unit, swapped or wrongly paired landmarks.

    References
    ----------
    FLE from FRE: Sibson 1979; Fitzpatrick, West, Maurer, IEEE TMI 17(5), 1998: FRE^2 = (1 - 2/N) FLE^2.
    """
    patient, ct, warnings = check_landmarks(patient_mm, ct_mm, labels)
    reference_to_ras = fit_rigid(patient, ct)
    misses = transform_points(reference_to_ras, patient) - ct
    residuals = np.linalg.norm(misses, axis=1)
    variance, freedom = _axis_variance(float(residuals @ residuals), len(ct), expected_fle_mm)
    pivot = ct.mean(axis=0)
    jacobian = motion_jacobian(ct, pivot).reshape(-1, 6)
    return LandmarkRegistration(
        reference_to_ras=reference_to_ras,
        fre_mm=float(np.sqrt(np.mean(residuals**2))),
        residuals_mm=residuals,
        residual_vectors_mm=misses,
        fle_mm=float(np.sqrt(3 * variance)),
        degrees_of_freedom=freedom,
        covariance=np.asarray(variance * np.linalg.inv(jacobian.T @ jacobian), dtype=np.float64),
        pivot_ras_mm=pivot,
        labels=tuple(labels),
        warnings=warnings,
    )


def fit_anisotropic(
    patient_mm: npt.ArrayLike,
    ct_mm: npt.ArrayLike,
    patient_covariances_mm2: npt.ArrayLike,
    ct_covariances_mm2: Optional[npt.ArrayLike] = None,
) -> tuple[Array, Array]:
    """Rigid transform that weighs each pair by its own 3D covariance, and the covariance of the result.

    Parameters
    ----------
    patient_mm, ct_mm : array-like, shape (N >= 3, 3)
    patient_covariances_mm2 : array-like, shape (N, 3, 3), Reference axes
    ct_covariances_mm2 : array-like, shape (N, 3, 3), RAS axes, optional
        Zero by default.

    Returns
    -------
    reference_to_ras : ndarray, shape (4, 4)
    covariance : ndarray, shape (6, 6)
        Of rotation (rad) about the CT points' centroid and translation (mm), RAS axes.

    References
    ----------
    Balachandran and Fitzpatrick, SPIE 7261, 2009; first-order covariance: Danilchenko and Fitzpatrick, IEEE TMI 30(3), 2011.
    """
    patient, ct, _ = check_landmarks(patient_mm, ct_mm)
    measured = np.asarray(patient_covariances_mm2, dtype=float)
    planned = np.zeros_like(measured) if ct_covariances_mm2 is None else np.asarray(ct_covariances_mm2, dtype=float)
    reference_to_ras, pivot = fit_rigid(patient, ct), ct.mean(axis=0)
    information = np.eye(6)
    for _ in range(ANISOTROPIC_STEPS):
        moved = transform_points(reference_to_ras, patient)
        weights = np.linalg.inv(rotate_covariances(reference_to_ras, measured) + planned)
        jacobian = motion_jacobian(moved, pivot)
        pulled = np.swapaxes(jacobian, -1, -2) @ weights
        information = (pulled @ jacobian).sum(axis=0)
        step = np.linalg.solve(information, (pulled @ (ct - moved)[..., None]).sum(axis=0)[:, 0])
        reference_to_ras = rigid_from_vector(step[:3], step[3:], pivot) @ reference_to_ras
        if np.abs(step).max() < 1e-10:
            break
    return reference_to_ras, np.asarray(np.linalg.inv(information), dtype=np.float64)


ANISOTROPIC_STEPS = 50
PRIOR_FREEDOM = 3.0  # degrees of freedom that an expected FLE is worth: it is known to a factor of about 1.7


def _axis_variance(sum_of_squares_mm2: float, count: int, expected_fle_mm: Optional[float]) -> tuple[float, float]:
    """Variance of the localisation error per axis (mm^2) and the degrees of freedom behind it.

    3N residuals less six parameters leave E[sum] = (3N - 6) variance, which is the 2/N rule.
    """
    freedom = 3.0 * count - 6.0
    if expected_fle_mm is None:
        return sum_of_squares_mm2 / freedom, freedom
    total = freedom + PRIOR_FREEDOM
    return (sum_of_squares_mm2 + PRIOR_FREEDOM * expected_fle_mm**2 / 3) / total, total
