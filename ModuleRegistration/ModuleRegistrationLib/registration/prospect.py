"""What bone points would do to the error of a registration, before it is made: how the expected error shrinks as they come."""

from __future__ import annotations

from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, check_points

from ModuleRegistrationLib.registration.landmarks import motion_jacobian


def covariance_with_points(
    covariance: npt.ArrayLike,
    pivot_ras_mm: npt.ArrayLike,
    points_ras_mm: npt.ArrayLike,
    normals: npt.ArrayLike,
    sds_mm: npt.ArrayLike,
    common_mm: Optional[npt.ArrayLike] = None,
) -> Array:
    """Covariance (6, 6) of a registration once these points lie on the surface.

    Parameters
    ----------
    covariance : array-like, shape (6, 6)
        Of the registration so far: a small rotation (rad) about the pivot and a translation (mm), RAS axes.
    pivot_ras_mm : array-like, shape (3,)
    points_ras_mm, normals : array-like, shape (N, 3)
        Where the points lie under the registration so far, and the surface's normals there.
    sds_mm : array-like, shape (N,)
        Error of each point along its normal, that of the surface included.
    common_mm : array-like, shape (N,), optional
        How far one SD of an error common to all moves each along its normal (the speed of sound).

    Returns
    -------
    ndarray, shape (6, 6)

    Notes
    -----
    The linear Gaussian update C - C A^T (A C A^T + R)^-1 A C with rows a = n^T J of the points: a prospect for a pose
    that is nearly right already, and optimistic where it is ambiguous. The registration says what it came to.
    """
    prior = np.asarray(covariance, dtype=float)
    points, directions = check_points(points_ras_mm, "points"), check_points(normals, "normals")
    sds = np.asarray(sds_mm, dtype=float)
    if prior.shape != (6, 6) or directions.shape != points.shape or sds.shape != (len(points),) or not (sds > 0).all():
        raise InputError(
            f"expected a (6, 6) covariance and a normal and a positive SD for each of {len(points)} points, "
            f"got {prior.shape}, {directions.shape}, {sds.shape}"
        )
    rows = np.einsum("ni,nij->nj", directions, motion_jacobian(points, pivot_ras_mm))
    noise = np.diag(sds**2)
    if common_mm is not None:
        common = np.asarray(common_mm, dtype=float)
        noise = noise + np.outer(common, common)
    reach = rows @ prior
    updated: Array = prior - reach.T @ np.linalg.solve(reach @ rows.T + noise, reach)
    return (updated + updated.T) / 2
