"""Which point next: the one that shrinks the predicted TRE most, of those that a probe can reach.

Works from the landmark registration alone and gets better with every point that is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array, check_points

from ModuleUltrasoundLib.palpation.clamp import CLEARANCE_LIMITS, CLEARANCE_MM, clear_of_clamp
from ModuleUltrasoundLib.palpation.protocol import ProtocolPoints


@dataclass(frozen=True)
class ReachSettings(Parameters):
    """What is in the way of the probe, and what a point is worth."""

    clamp_clearance_mm: Annotated[float, CLEARANCE_LIMITS, "between the probe's axis and clamp or base"] = CLEARANCE_MM
    point_sd_mm: Annotated[float, Limits(0.05, 10), "expected error of a point along the bone's normal"] = 0.6
    support_angle_deg: Annotated[float, Limits(0, 90), "normals nearer than this to the table's direction are out of reach"] = (
        50.0
    )


DEFAULTS = ReachSettings()


@dataclass(frozen=True, eq=False)
class NextTarget:
    """The point to palpate next, and what it is expected to bring."""

    index: int  # in the protocol
    label: str
    tre_now_mm: float  # predicted, RMS over the targets
    tre_then_mm: float  # with this point


def motion_rows(positions_ras_mm: npt.ArrayLike, normals: npt.ArrayLike, pivot_ras_mm: npt.ArrayLike) -> Array:
    """(N, 6) how each point's distance to the bone changes with a rotation (rad) about the pivot and a translation (mm)."""
    positions = np.asarray(positions_ras_mm, dtype=float) - np.asarray(pivot_ras_mm, dtype=float)
    normals = np.asarray(normals, dtype=float)
    rows: Array = np.concatenate([np.cross(positions, normals), normals], axis=1)
    return rows


def rms_tre_mm(covariances: npt.ArrayLike, pivot_ras_mm: npt.ArrayLike, targets_ras_mm: npt.ArrayLike) -> Array:
    """(...) predicted TRE, root mean square over targets (T, 3), from motion covariances (..., 6, 6)."""
    arms = np.asarray(targets_ras_mm, dtype=float) - np.asarray(pivot_ras_mm, dtype=float)
    jacobians = np.zeros((len(arms), 3, 6))  # of r -> w x r + t
    jacobians[:, 0, 1], jacobians[:, 0, 2] = arms[:, 2], -arms[:, 1]
    jacobians[:, 1, 0], jacobians[:, 1, 2] = -arms[:, 2], arms[:, 0]
    jacobians[:, 2, 0], jacobians[:, 2, 1] = arms[:, 1], -arms[:, 0]
    jacobians[:, :, 3:] = np.eye(3)
    weight = np.einsum("tij,tik->jk", jacobians, jacobians) / len(arms)
    squared = np.einsum("...ij,ji->...", np.asarray(covariances, dtype=float), weight)
    rms: Array = np.sqrt(np.maximum(squared, 0.0))
    return rms


def covariance_with(
    covariance: npt.ArrayLike, position_ras_mm: npt.ArrayLike, normal: npt.ArrayLike, pivot_ras_mm: npt.ArrayLike, sd_mm: float
) -> Array:
    """A motion's covariance (6, 6) after one more point: C - C r r' C / (s^2 + r' C r), r its row of `motion_rows`."""
    covariance = np.asarray(covariance, dtype=float)
    row = motion_rows(np.asarray(position_ras_mm)[None], np.asarray(normal)[None], pivot_ras_mm)[0]
    gain = covariance @ row
    after: Array = covariance - np.outer(gain, gain) / (sd_mm**2 + row @ gain)
    return after


def choose_next(
    points: ProtocolPoints,
    open_points: npt.ArrayLike,
    covariance: npt.ArrayLike,
    pivot_ras_mm: npt.ArrayLike,
    targets_ras_mm: npt.ArrayLike,
    point_sd_mm: float = DEFAULTS.point_sd_mm,
) -> Optional[NextTarget]:
    """The open point of the protocol that shrinks the predicted TRE most.

    Parameters
    ----------
    points : ProtocolPoints
    open_points : array-like of bool, shape (N,)
        Neither taken nor out of reach.
    covariance : array-like, shape (6, 6)
        Of the registration in force: rotation (rad) about the pivot, translation (mm), RAS axes.
    pivot_ras_mm : array-like, shape (3,)
    targets_ras_mm : array-like, shape (T, 3)
        Where accuracy is wanted.
    point_sd_mm : float
        Expected error of a point along the bone's normal.

    Returns
    -------
    NextTarget, or None when no point is open.

    Notes
    -----
    A distance measured along a normal is one linear equation for the motion: the covariance after it is
    C - C r r' C / (s^2 + r' C r) with the row r of `motion_rows`.

    Raises
    ------
    InputError
        A covariance that is none, or no targets.
    """
    covariance = np.asarray(covariance, dtype=float)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance).min() < -1e-9:
        raise InputError("expected the registration's covariance as a finite positive 6x6 matrix; register the landmarks first")
    targets = check_points(targets_ras_mm, "targets", at_least=1)
    candidates = np.flatnonzero(np.asarray(open_points, dtype=bool))
    if len(candidates) == 0:
        return None
    rows = motion_rows(points.positions_ras_mm, points.normals, pivot_ras_mm)[candidates]
    gains = rows @ covariance  # (K, 6)
    shrunk = gains[:, :, None] * gains[:, None, :] / (point_sd_mm**2 + np.sum(gains * rows, axis=1))[:, None, None]
    after = rms_tre_mm(covariance - shrunk, pivot_ras_mm, targets)
    best = int(np.argmin(after))
    index = int(candidates[best])
    now = float(rms_tre_mm(covariance, pivot_ras_mm, targets))
    return NextTarget(index, points.labels[index], now, float(after[best]))


def reachable(
    points: ProtocolPoints,
    clamp_ras_mm: Optional[npt.ArrayLike] = None,
    table_direction_ras: Optional[npt.ArrayLike] = None,
    settings: Optional[ReachSettings] = None,
) -> npt.NDArray[np.bool_]:
    """(N,) whether a probe can stand at each point, clear of the clamp and of the table.

    Parameters
    ----------
    points : ProtocolPoints
    clamp_ras_mm : array-like, shape (K, 3), optional
        Points on the head clamp (pins, arms, reference base), touched with the stylus or known.
    table_direction_ras : array-like, shape (3,), optional
        From the head towards the table; (0, -1, 0) for a patient lying on the back.
    settings : ReachSettings, optional
    """
    settings = settings or DEFAULTS
    free = clear_of_clamp(points.positions_ras_mm, points.normals, clamp_ras_mm, settings.clamp_clearance_mm)
    if table_direction_ras is not None:
        down = np.asarray(table_direction_ras, dtype=float)
        free &= points.normals @ (down / np.linalg.norm(down)) < np.cos(np.radians(settings.support_angle_deg))
    return free
