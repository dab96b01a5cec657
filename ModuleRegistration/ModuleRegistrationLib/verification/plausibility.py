"""Plausibility: how far points touched on the bone lie from the bone of the CT.

A low distance is necessary for a good registration, not sufficient: a registration can slide along the
skull and keep every distance small. The chapter found the test of questionable validity; it is shown as
what it is, and never as an accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, check_points, check_rigid, transform_points
from CranioNavLib.surface import Surface

SUSPICIOUS_MM = 3.0  # beyond the largest distance of the chapter's patients, 2.88 mm (its table 3)


@dataclass(frozen=True, eq=False)
class Plausibility:
    """Distance of each point to the bone surface (mm): a surface distance, not a TRE."""

    distances_mm: Array  # (P,) signed: + outside the bone
    registered_mm: Array  # (P, 3) RAS
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
        mean_mm=float(np.abs(distances).mean()),
        max_mm=float(np.abs(distances).max()),
        plausible=bool(np.abs(distances).max() <= SUSPICIOUS_MM),
    )
