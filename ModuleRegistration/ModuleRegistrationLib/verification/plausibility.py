"""Plausibility: how far points touched on the bone lie from the bone of the CT.

A low distance is necessary for a good registration, not sufficient: a registration can slide along the
skull and keep every distance small. The chapter found the test of questionable validity; it is shown as
what it is, and never as an accuracy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, check_points, check_rigid, transform_points
from CranioNavLib.surface import Surface
from scipy import special

from ModuleRegistrationLib.registration.closest_field import find_feet
from ModuleRegistrationLib.registration.landmarks import motion_jacobian
from ModuleRegistrationLib.verification.held_out import DistanceCheck

SUSPICIOUS_MM = 3.0  # beyond the largest distance of the chapter's patients, 2.88 mm (its table 3)


@dataclass(frozen=True, eq=False)
class Plausibility:
    """Distance of each point to the bone surface (mm): a surface distance, not a TRE."""

    distances_mm: Array  # (P,) signed: + outside the bone
    registered_mm: Array  # (P, 3) RAS
    directions: Array  # (P, 3) unit, in which the distances grow
    mean_mm: float  # of the absolute distances
    max_mm: float
    plausible: bool  # no point farther than SUSPICIOUS_MM


def plausibility(reference_to_ras: npt.ArrayLike, points_mm: npt.ArrayLike, surface: Surface) -> Plausibility:
    """Surface distance of plausibility points (P, 3), Reference frame, under a registration.

    Raises
    ------
    InputError
        No points, or a transform that is not rigid.
    """
    matrix = check_rigid(reference_to_ras, "ReferenceToRas")
    registered = transform_points(matrix, check_points(points_mm, "plausibility points", at_least=1))
    closest = surface.closest(registered)
    outside = np.sum((registered - closest.points_mm) * closest.normals, axis=1) >= 0
    distances = np.where(outside, closest.distances_mm, -closest.distances_mm)
    return Plausibility(
        distances_mm=distances,
        registered_mm=registered,
        directions=find_feet(surface, registered).directions,
        mean_mm=float(np.abs(distances).mean()),
        max_mm=float(np.abs(distances).max()),
        plausible=bool(np.abs(distances).max() <= SUSPICIOUS_MM),
    )


def expected_plausibility(
    found: Plausibility,
    labels: Sequence[str],
    covariance: npt.ArrayLike,
    pivot_ras_mm: npt.ArrayLike,
    own_sd_mm: float,
    offset_sd_mm: float,
    degrees_of_freedom: Optional[float] = None,
) -> DistanceCheck:
    """The distances beside what the registration's stated error lets expect of them.

    Parameters
    ----------
    found : Plausibility of P points
    labels : P names
    covariance : array-like, shape (6, 6)
        Of the registration: rotation (rad) about `pivot_ras_mm` and translation (mm), RAS axes.
    own_sd_mm : float
        Error of one point and of the bone surface under it, along the surface's normal.
    offset_sd_mm : float
        Error of the bone surface that all points share (choice of the threshold).
    degrees_of_freedom : float, optional
        Behind the scale of `covariance`, when that was estimated from a few residuals.
    """
    rows = np.einsum("ni,nij->nj", found.directions, motion_jacobian(found.registered_mm, pivot_ras_mm))
    count = len(rows)
    expected = rows @ np.asarray(covariance, dtype=float) @ rows.T + offset_sd_mm**2 + own_sd_mm**2 * np.eye(count)
    squares = float(found.distances_mm @ np.linalg.solve(expected, found.distances_mm))
    if degrees_of_freedom is None:
        chance = special.chdtrc(count, squares)
    else:
        chance = special.fdtrc(count, degrees_of_freedom, squares / count)
    return DistanceCheck(tuple(labels), found.distances_mm, np.sqrt(np.diag(expected)), squares, float(count), float(chance))
