"""Where to palpate next: the point of the skull that shrinks the predicted error at the targets most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array
from CranioNavLib.surface import Surface

from ModuleRegistrationLib.registration.error_theory import length_statistics
from ModuleRegistrationLib.registration.landmarks import motion_jacobian

CELL_MM = 15.0  # candidates are one vertex a cube of this side: closer points say the same
MOST_POINTS = 5


@dataclass(frozen=True, eq=False)
class NextPoint:
    """A place to palpate."""

    position_ras_mm: Array  # (3,)
    region: str  # in words
    p95_mm: float  # predicted 95% error at the worst target with this point and those before it


def plan_next_points(
    surface: Surface,
    covariance: Array,
    pivot_ras_mm: npt.ArrayLike,
    targets_ras_mm: npt.ArrayLike,
    point_sd_mm: float,
    wanted_p95_mm: float,
    most: int = MOST_POINTS,
) -> tuple[NextPoint, ...]:
    """Points added one by one, each the best after those before it, until the worst target is good enough.

    Parameters
    ----------
    surface : Surface
        Where a probe can reach.
    covariance : ndarray, shape (6, 6)
        Of the present registration, about `pivot_ras_mm`.
    point_sd_mm : float
        Error of a new point along the surface's normal.
    wanted_p95_mm : float
        Stop when the predicted 95% error at every target is below it.

    Notes
    -----
    A new point of variance s^2 and row a changes the covariance C to C - C a a^T C / (s^2 + a^T C a): the linear
    Gaussian update, so the prediction is optimistic where the present pose is ambiguous.
    """
    vertices, normals = _candidates(surface)
    rows = np.einsum("ni,nij->nj", normals, motion_jacobian(vertices, pivot_ras_mm))
    targets = motion_jacobian(np.asarray(targets_ras_mm, dtype=float), pivot_ras_mm)
    centre = surface.center_mm
    chosen: list[NextPoint] = []
    while len(chosen) < most:
        reach = rows @ covariance  # (n, 6)
        gain = 1 / (point_sd_mm**2 + np.einsum("ni,ni->n", reach, rows))
        updated = covariance - gain[:, None, None] * reach[:, :, None] * reach[:, None, :]
        at_targets = targets[None] @ updated[:, None] @ np.swapaxes(targets, -1, -2)[None]  # (n, T, 3, 3)
        worst = length_statistics(at_targets).p95_mm.max(axis=1)
        best = int(np.argmin(worst))
        covariance = updated[best]
        chosen.append(NextPoint(vertices[best], region_name(vertices[best], centre), float(worst[best])))
        if worst[best] <= wanted_p95_mm:
            break
    return tuple(chosen)


def _candidates(surface: Surface) -> tuple[Array, Array]:
    cells = np.floor(surface.vertices_mm / CELL_MM).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return surface.vertices_mm[first], surface.vertex_normals[first]


def region_name(point_ras_mm: Array, centre_ras_mm: Array) -> str:
    """The region of the head in words, by the direction from the middle of the skull (RAS: x right, y front, z up)."""
    x, y, z = np.asarray(point_ras_mm, dtype=float) - centre_ras_mm
    side = "right" if x > 0 else "left"
    azimuth = float(np.degrees(np.arctan2(abs(x), y)))
    elevation = float(np.degrees(np.arctan2(z, np.hypot(x, y))))
    if elevation > 65:
        return "vertex"
    if azimuth < 45:
        if elevation > 40:
            return "frontal convexity"
        return "forehead" if elevation > 5 else f"{side} periorbital"
    if azimuth > 130:
        return "occiput"
    return f"{side} parietal" if elevation > 40 else f"{side} temporal"
