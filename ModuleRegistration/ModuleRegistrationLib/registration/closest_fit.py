"""What the closest-point methods share: the check of the input, and residuals and uncertainty at the end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array, transform_points
from CranioNavLib.surface import Surface

from ModuleRegistrationLib.registration.landmarks import fit_rigid, motion_jacobian
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult

LEAST_POINTS = 6  # each point holds one degree of freedom of six
FARTHEST_START_MM = 100.0  # farther from the surface than a head is wide: the wrong frame, not a poor start


def check_problem(problem: RegistrationProblem) -> None:
    """Refuse what no method can register.

    Raises
    ------
    InputError
        Fewer than 6 points, or a start that puts them nowhere near the surface.
    """
    count = len(problem.points)
    if count < LEAST_POINTS:
        raise InputError(f"expected at least {LEAST_POINTS} bone points, got {count}; palpate more points")
    start = transform_points(problem.initial_reference_to_ras, problem.points.positions_mm)
    distance = float(np.median(problem.surface.closest(start).distances_mm))
    if distance > FARTHEST_START_MM:
        raise InputError(
            f"the bone points start {distance:.0f} mm from the skull; "
            "check the landmarks, their pairing and the frame of the points"
        )


@dataclass(frozen=True)
class Stopping(Parameters):
    """When closest-point iterations stop."""

    max_iterations: Annotated[int, Limits(1, 10000), "steps at most"] = 100
    tolerance_mm: Annotated[float, Limits(0, 1), "stop when the RMS distance falls by less"] = 1e-6


@dataclass(frozen=True, eq=False)
class ClosestFits:
    """Where closest-point iterations from several starts ended."""

    reference_to_ras: Array  # (M, 4, 4)
    rms_mm: Array  # (M,) over the points kept
    iterations: int
    stop_reason: str


def iterate_closest(
    surface: Surface, points_mm: Array, starts: Array, max_iterations: int, tolerance_mm: float, keep_share: float = 1.0
) -> ClosestFits:
    """Closest points and fit in turn, from all starts at once, the chapter's equation (12).

    Parameters
    ----------
    points_mm : ndarray, shape (N, 3), Reference
    starts : ndarray, shape (M, 4, 4)
    max_iterations, tolerance_mm
        Stop at that many steps, or when no start's RMS distance falls by more than the tolerance.
    keep_share : float
        Share of the points, the closest ones, that each fit uses (Chetverikov 2002); 1: all.
    """
    kept = max(round(keep_share * len(points_mm)), LEAST_POINTS)
    fits = np.asarray(starts, dtype=float)
    previous, rms, iteration = np.full(len(fits), np.inf), np.full(len(fits), np.inf), 0
    stop_reason = f"iteration limit {max_iterations}"
    while iteration < max_iterations:
        iteration += 1
        moved = transform_points(fits, points_mm)
        closest = surface.closest(moved.reshape(-1, 3))
        distances = closest.distances_mm.reshape(moved.shape[:2])
        chosen = np.argsort(distances, axis=1, kind="stable")[:, :kept]
        rms = np.sqrt(np.mean(np.take_along_axis(distances, chosen, axis=1) ** 2, axis=1))
        if (previous - rms < tolerance_mm).all():
            stop_reason = f"RMS distance fell by less than {tolerance_mm:g} mm"
            break
        previous = rms
        feet = np.take_along_axis(closest.points_mm.reshape(moved.shape), chosen[..., None], axis=1)
        fits = fit_rigid(points_mm[chosen], feet)
    return ClosestFits(fits, rms, iteration, stop_reason)


def signed_distances(problem: RegistrationProblem, reference_to_ras: Array) -> tuple[Array, Array, Array]:
    """Points in RAS (N, 3), signed distances (N,), + outside the bone, and unit directions away from the surface (N, 3)."""
    points = transform_points(reference_to_ras, problem.points.positions_mm)
    closest = problem.surface.closest(points)
    gap = points - closest.points_mm
    outside = np.where(np.einsum("ij,ij->i", gap, closest.normals) < 0, -1.0, 1.0)
    length = closest.distances_mm[:, None]
    away = np.where(length > 1e-3, outside[:, None] * gap / np.maximum(length, 1e-3), closest.normals)
    return points, outside * closest.distances_mm, away


def finished_result(
    method: str,
    problem: RegistrationProblem,
    reference_to_ras: Array,
    iterations: int,
    stop_reason: str,
    used: Optional[npt.NDArray[np.bool_]] = None,
) -> RegistrationResult:
    """A result with residuals, and the covariance that follows from them by the points' normals."""
    points, residuals, normals = signed_distances(problem, reference_to_ras)
    used = np.ones(len(points), dtype=bool) if used is None else used
    pivot = points[used].mean(axis=0)
    rows = np.einsum("ni,nij->nj", normals[used], motion_jacobian(points[used], pivot))
    variance = float(np.sum(residuals[used] ** 2)) / max(int(used.sum()) - 6, 1)
    return RegistrationResult(
        method=method,
        reference_to_ras=reference_to_ras,
        surface_rms_mm=float(np.sqrt(np.mean(residuals[used] ** 2))),
        residuals_mm=residuals,
        used=used,
        iterations=iterations,
        stop_reason=stop_reason,
        points_ras_mm=points,
        covariance=variance * np.linalg.pinv(rows.T @ rows, hermitian=True),
        pivot_ras_mm=pivot,
        speed_of_sound_m_s=problem.points.speed_of_sound_m_s,
        speed_of_sound_sd_m_s=problem.points.speed_of_sound_sd_m_s,
    )
