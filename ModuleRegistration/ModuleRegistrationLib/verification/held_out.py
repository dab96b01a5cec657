"""Points that a registration has not used, against where it says they should lie.

A distance of 1 mm to the bone is good or bad by what was to be expected there: the point's own error and the
registration's at that place. The squares of the distances, in units of that expectation, follow a chi-square law when
the stated errors are right. The test sees what moves points off the bone; a registration that slides along the bone
without leaving it passes, as it does every test that knows distances alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Optional

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array

from ModuleRegistrationLib.registration.landmarks import motion_jacobian
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration
from ModuleRegistrationLib.verification.linear_model import LinearModel, expected_covariance, linear_model, seen_from

FOLDS = 6  # of the protocol's 18 points three are left out at a time, from different regions
LEAST_POINTS, MOST_POINTS = 9, 60  # fewer leave too few to register; the samples of a sweep share their errors
TOO_SMALL = "the stated error is too small"
UNLIKELY = 0.01  # p-value below which the distances are called larger than expected


@dataclass(frozen=True, eq=False)
class DistanceCheck:
    """Distances (P) of points to the bone beside what was expected of them."""

    labels: tuple[str, ...]
    distances_mm: Array  # (P,) signed, + outside the bone
    expected_sd_mm: Array  # (P,) the point's own error and the registration's there
    chi_square: float  # expected: degrees_of_freedom
    degrees_of_freedom: float
    p_value: float  # of distances at least this large when the stated errors are right

    @property
    def as_expected(self) -> bool:
        """Whether the stated errors explain the distances."""
        return self.p_value >= UNLIKELY

    @property
    def outcome(self) -> str:
        """How the points lie, in words; TOO_SMALL stands among them where the stated errors do not explain it."""
        p = f"p = {self.p_value:.2f}" if self.p_value >= UNLIKELY else f"p = {self.p_value:.1g}"
        if self.as_expected:
            return f"as far off as expected ({p})"
        worst = int(np.argmax(np.abs(self.distances_mm) / self.expected_sd_mm))
        return (
            f"further off than expected ({p}): {TOO_SMALL}; farthest is "
            f"{self.labels[worst]}, {abs(self.distances_mm[worst]):.1f} mm off where {self.expected_sd_mm[worst]:.1f} mm (SD) "
            "was expected"
        )

    @property
    def expectation(self) -> str:
        """The distribution that was expected, in words."""
        low, high = (f"{value:.1f}" for value in (self.expected_sd_mm.min(), self.expected_sd_mm.max()))
        return f"expected: 0 ± {low if low == high else f'{low} to {high}'} mm (mean ± SD)"

    def words(self, what: str) -> str:
        """The outcome as a sentence about `what` ("the held-out points")."""
        return f"{what} lie {self.outcome}"


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """What each of the N used points would show if it had been left out, by the linearised registration."""

    labels: tuple[str, ...]
    residuals_mm: Array  # (N,) signed distance to the bone of a registration without the point
    expected_sd_mm: Array  # (N,) of those
    shifts_mm: Array  # (N,) how far the targets would move without the point, at most

    @property
    def most_influential(self) -> int:
        """Index of the point without which the targets would move most."""
        return int(np.argmax(self.shifts_mm))

    def words(self) -> str:
        """The most influential point as a sentence."""
        return f"the most influential point is {self.influence}"

    @property
    def influence(self) -> str:
        """The most influential point's name and what leaving it out would do."""
        k = self.most_influential
        return (
            f"{self.labels[k]}: without it the targets would move by up to {self.shifts_mm[k]:.1f} mm, "
            f"and it would lie {abs(self.residuals_mm[k]):.1f} mm off the bone"
        )


def check_held_out(
    problem: RegistrationProblem, result: RegistrationResult, method: SurfaceRegistration, folds: int = FOLDS
) -> Optional[DistanceCheck]:
    """Register without each fold of the used points in turn, and see how far off the points left out lie.

    Points that the registration rejects are left out of the test. Each fold holds every `folds`-th point, so that
    what remains still covers the head.

    Returns
    -------
    DistanceCheck, or None where it says nothing: too few points, a sweep, a method without uncertainty, or a
    fold that cannot be registered.

    Notes
    -----
    The folds share most of their points, so the sum of their chi-squares keeps its mean, the number of points, but
    spreads as one with fewer degrees of freedom: those that the fit leaves (its number of points less the trace of
    its hat matrix). It is scaled to that number.
    """
    used = np.flatnonzero(result.used)
    if result.covariance is None or not LEAST_POINTS <= len(used) <= MOST_POINTS:
        return None
    distances, sds, squares = np.zeros(len(result.used)), np.ones(len(result.used)), 0.0
    for fold in range(folds):
        left_out = used[fold::folds]
        kept = np.setdiff1d(np.arange(len(result.used)), left_out)
        remaining = replace(problem, points=problem.points.subset(kept))
        try:
            without = method.register(remaining)
        except InputError:
            return None
        seen = seen_from(problem, without, linear_model(remaining, without))
        expected = expected_covariance(seen, left_out)
        distances[left_out], sds[left_out] = seen.residuals_mm[left_out], np.sqrt(np.diag(expected))
        squares += float(distances[left_out] @ np.linalg.solve(expected, distances[left_out]))
    freedom = max(len(used) - float(leverages(linear_model(problem, result))[used].sum()), 1.0)
    chi_square = squares * freedom / len(used)
    return DistanceCheck(
        labels=tuple(problem.points.labels[i] for i in used),
        distances_mm=distances[used],
        expected_sd_mm=sds[used],
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        p_value=float(scipy.special.chdtrc(freedom, chi_square)),
    )


def leave_one_out(
    problem: RegistrationProblem, result: RegistrationResult, targets_ras_mm: npt.ArrayLike
) -> Optional[LeaveOneOut]:
    """Residual of each used point if it had been left out, and how far the targets (T, 3) would move.

    From the hat matrix: without point i its residual r becomes r / (1 - h), and the unknowns move by
    C a w r / (1 - h). None for a sweep, whose single samples decide nothing.
    """
    used = np.flatnonzero(result.used)
    if not LEAST_POINTS <= len(used) <= MOST_POINTS:
        return None
    model = linear_model(problem, result)
    remains = 1 - np.clip(leverages(model)[used], 0, 0.99)
    residuals = model.residuals_mm[used] / remains
    step = (model.weights[used] * residuals)[:, None] * (model.design[used] @ model.fit_covariance)  # (n, 8)
    moved = motion_jacobian(np.asarray(targets_ras_mm, dtype=float), model.pivot_ras_mm) @ step[:, None, :6, None]
    return LeaveOneOut(
        labels=tuple(problem.points.labels[i] for i in used),
        residuals_mm=residuals,
        expected_sd_mm=np.sqrt(model.variances_mm2[used] / remains),
        shifts_mm=np.asarray(np.linalg.norm(moved[..., 0], axis=2).max(axis=1), dtype=np.float64),
    )


def leverages(model: LinearModel) -> Array:
    """(N,) share of each point's error that the fit follows: the diagonal of its hat matrix."""
    values: Array = model.weights * np.einsum("ni,ij,nj->n", model.design, model.fit_covariance, model.design)
    return values
