"""From the uncertainty of a registration to the error to expect at a target."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Optional

import numpy as np
import numpy.typing as npt
import scipy  # by its own name: its parts load when they are first used, after the start
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, check_points

from ModuleRegistrationLib.registration.landmarks import motion_jacobian
from ModuleRegistrationLib.registration.problem import RegistrationResult


@dataclass(frozen=True, eq=False)
class PredictedTre:
    """Expected target registration error, one value a target."""

    mean_mm: Array  # (T,) mean of the error's length
    p95_mm: Array  # (T,) the error is shorter than this with probability 0.95
    rms_mm: Array  # (T,) root mean square, Fitzpatrick's measure


def fitzpatrick_tre(fle_mm: float, fiducials_mm: npt.ArrayLike, targets_mm: npt.ArrayLike) -> Array:
    """(T,) root mean square TRE of an unweighted fit of N fiducials with equal isotropic errors.

    Parameters
    ----------
    fle_mm : float
        Root mean square 3D fiducial localisation error.
    fiducials_mm : array-like, shape (N >= 3, 3)
    targets_mm : array-like, shape (T, 3), same frame

    References
    ----------
    Fitzpatrick, West, Maurer, IEEE TMI 17(5), 1998: TRE^2 = FLE^2 / N (1 + 1/3 sum_k d_k^2 / f_k^2).
    """
    fiducials = check_points(fiducials_mm, "fiducials", at_least=3)
    centred = fiducials - fiducials.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)  # columns are the principal axes
    ratio = np.zeros(len(np.asarray(targets_mm)))
    for k in range(3):
        others = [j for j in range(3) if j != k]
        f_squared = np.mean(np.sum((centred @ axes[:, others]) ** 2, axis=1))
        d_squared = np.sum(((np.asarray(targets_mm, dtype=float) - fiducials.mean(axis=0)) @ axes[:, others]) ** 2, axis=1)
        ratio += d_squared / f_squared
    tre: Array = fle_mm / np.sqrt(len(fiducials)) * np.sqrt(1 + ratio / 3)
    return tre


def predict_tre(
    covariance: npt.ArrayLike,
    pivot_ras_mm: npt.ArrayLike,
    targets_ras_mm: npt.ArrayLike,
    degrees_of_freedom: Optional[float] = None,
) -> PredictedTre:
    """Error to expect at targets from the covariance of a small motion.

    Parameters
    ----------
    covariance : array-like, shape (6, 6)
        Of a rotation (rad) about the pivot and a translation (mm), RAS axes.
    pivot_ras_mm : array-like, shape (3,)
    targets_ras_mm : array-like, shape (T, 3), RAS, mm
    degrees_of_freedom : float, optional
        Behind the scale of the covariance, when that was estimated from a few residuals: the 95% limit is then
        wider (Student's t instead of a Gaussian).

    Returns
    -------
    PredictedTre
        Of the registration alone; the error of finding the target itself is not in it.
    """
    covariance = np.asarray(covariance, dtype=float)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise InputError(f"expected a finite covariance of shape (6, 6), got {covariance.shape}")
    jacobian = motion_jacobian(check_points(targets_ras_mm, "targets"), pivot_ras_mm)
    return length_statistics(jacobian @ covariance @ np.swapaxes(jacobian, -1, -2), degrees_of_freedom)


def length_statistics(covariances_mm2: npt.ArrayLike, degrees_of_freedom: Optional[float] = None) -> PredictedTre:
    """Mean, 95% quantile and root mean square of the length of Gaussian vectors with covariances (T, 3, 3).

    The square of the length is a weighted sum of three chi-square variables; its quantile is read from a table
    over the ratios of the three SDs that was integrated numerically (error below 0.1%).
    """
    variances: Array = np.maximum(np.linalg.eigvalsh(np.asarray(covariances_mm2, dtype=float)), 0.0)
    sds: Array = np.sqrt(variances)
    largest = np.maximum(sds[..., 2], 1e-300)
    means, quantiles = _length_tables()
    middle, small = sds[..., 1] / largest, sds[..., 0] / largest
    mean = np.asarray(largest * means.ev(middle, small), dtype=np.float64)
    p95 = np.asarray(largest * quantiles.ev(middle, small), dtype=np.float64)
    total = np.asarray(variances.sum(axis=-1), dtype=np.float64)
    if degrees_of_freedom is not None:
        active = total**2 / np.maximum(np.sum(variances**2, axis=-1), 1e-300)  # 1 for a line, 3 for a sphere
        widening = np.sqrt(active * scipy.special.fdtri(active, degrees_of_freedom, 0.95) / scipy.special.chdtri(active, 0.05))
        p95 = np.asarray(p95 * widening, dtype=np.float64)
    return PredictedTre(mean, p95, np.sqrt(total))


def probability_below(
    covariance: npt.ArrayLike, pivot_ras_mm: npt.ArrayLike, targets_ras_mm: npt.ArrayLike, limit_mm: float
) -> Array:
    """(T,) probability that the error at a target is shorter than `limit_mm`; arguments as for predict_tre."""
    jacobian = motion_jacobian(check_points(targets_ras_mm, "targets"), pivot_ras_mm)
    variances = np.linalg.eigvalsh(jacobian @ np.asarray(covariance, dtype=float) @ np.swapaxes(jacobian, -1, -2))
    sds = np.sqrt(np.maximum(variances, 1e-24))
    return _probability_within(limit_mm / sds[:, 2], sds[:, 1] / sds[:, 2], sds[:, 0] / sds[:, 2])


GRID = 21  # ratios 0, 0.05 ... 1 of the SDs: the tables are smooth, a cubic spline between them is good to 0.01%


@lru_cache(maxsize=1)
def _length_tables() -> tuple[Any, Any]:
    """Splines of the mean length and its 95% quantile over (middle SD / largest, smallest SD / largest)."""
    from scipy.interpolate import RectBivariateSpline  # slow to load, and this module is loaded at the start

    ratios = np.linspace(0, 1, GRID)
    middle, small = (grid.ravel() for grid in np.meshgrid(ratios, ratios, indexing="ij"))
    low: Array = np.full(GRID * GRID, 1.5)
    high: Array = np.full(GRID * GRID, 3.0)
    for _ in range(30):
        radius = (low + high) / 2
        below = _probability_within(radius, middle, small) < 0.95
        low, high = np.where(below, radius, low), np.where(below, high, radius)
    mean = _mean_length(middle, small)
    shape = (GRID, GRID)
    return (RectBivariateSpline(ratios, ratios, mean.reshape(shape)), RectBivariateSpline(ratios, ratios, high.reshape(shape)))


def _probability_within(radius: Array, middle: Array, small: Array) -> Array:
    """P(z1^2 + (middle z2)^2 + (small z3)^2 <= radius^2): the last two in polar form, the first by Gauss-Legendre."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    angle = (nodes + 1) * np.pi / 4  # z1 = radius sin(angle): takes the square root's corner out
    turn = (np.arange(48) + 0.5) * np.pi / 2 / 48  # a quarter turn is enough, and the midpoint rule is exact for periods
    reach = np.minimum(radius, 12.0)  # beyond, the probability is 1 in double precision
    z = reach[:, None] * np.sin(angle)
    rest = (reach[:, None] * np.cos(angle)) ** 2
    spread = (middle[:, None] * np.cos(turn)) ** 2 + (small[:, None] * np.sin(turn)) ** 2
    with np.errstate(divide="ignore", under="ignore"):
        inside = 1 - np.exp(-rest[:, :, None] / (2 * np.maximum(spread, 1e-12))[:, None, :]).mean(axis=2)
    density = np.exp(-(z**2) / 2) * np.sqrt(2 / np.pi) * reach[:, None] * np.cos(angle)
    probability: Array = np.sum(weights * np.pi / 4 * density * inside, axis=1)
    return probability


def _mean_length(middle: Array, small: Array) -> Array:
    """E|e| = 2 sqrt(2 / pi) times the mean over the sphere of sqrt(u1^2 + (middle u2)^2 + (small u3)^2)."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    cosine = (nodes + 1) / 2
    turn = (np.arange(64) + 0.5) * np.pi / 2 / 64
    sine = np.sqrt(1 - cosine**2)
    flat = (middle[:, None] * np.cos(turn)) ** 2 + (small[:, None] * np.sin(turn)) ** 2
    lengths = np.sqrt(cosine[:, None] ** 2 + sine[:, None] ** 2 * flat[:, None, :]).mean(axis=2)
    mean: Array = 2 * np.sqrt(2 / np.pi) * (lengths * weights / 2).sum(axis=1)
    return mean


def predict_tre_of(result: RegistrationResult, targets_ras_mm: npt.ArrayLike) -> PredictedTre:
    """Error to expect at targets after `result`.

    Raises
    ------
    InputError
        The method gave no covariance.
    """
    if result.covariance is None:
        raise InputError(f"method {result.method} gives no uncertainty; register with cranionav to get a predicted error")
    return predict_tre(result.covariance, result.pivot_ras_mm, targets_ras_mm, result.degrees_of_freedom)
