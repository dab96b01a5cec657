"""How far a registration is to be believed: beside TRE and plausibility, and apart from the registration itself."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array
from scipy import special

from ModuleRegistrationLib.registration.error_theory import probability_below
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration
from ModuleRegistrationLib.registration.verdict import ACCEPTED, WARNING, Verdict
from ModuleRegistrationLib.verification.held_out import DistanceCheck, LeaveOneOut, check_held_out, leave_one_out
from ModuleRegistrationLib.verification.plausibility import Plausibility, expected_plausibility

LIMIT_MM = 2.0  # error that the probability is told for unless another is asked for
CONTRADICTED_P = 1e-3  # plausibility points as far off as these make an accepted registration a doubtful one
SCALES = 24  # quantiles of the unknown scale of a covariance that the probability is averaged over


@dataclass(frozen=True, eq=False)
class Confidence:
    """What speaks for and against the stated error. None: there is nothing to say it with."""

    limit_mm: float
    below_limit: Optional[Array] = None  # (T,) probability that the true error at each target is below the limit
    held_out: Optional[DistanceCheck] = None
    left_out: Optional[LeaveOneOut] = None
    touched: Optional[DistanceCheck] = None  # the plausibility points

    def sentences(self) -> list[str]:
        """What it comes to, for people."""
        said = []
        if self.below_limit is not None:
            said.append(probability_words(self.below_limit, self.limit_mm))
        if self.held_out is not None:
            said.append(self.held_out.words("the held-out points"))
        if self.left_out is not None:
            said.append(self.left_out.words())
        if self.touched is not None:
            said.append(self.touched.words("the plausibility points"))
        return said


def probability_words(below_limit: Array, limit_mm: float) -> str:
    """The worst target's probability as a sentence."""
    where = "the worst target" if len(below_limit) > 1 else "the target"
    return f"the true error at {where} is below {limit_mm:g} mm with a probability of {probability(below_limit)}"


def probability(below_limit: Array) -> str:
    """The worst target's probability in per cent; more digits than these are not known."""
    worst = float(below_limit.min())
    return "more than 99%" if worst > 0.99 else "less than 1%" if worst < 0.01 else f"{worst:.0%}"


def doubted(verdict: Verdict, confidence: Confidence) -> Verdict:
    """The verdict on a registration, doubted where the plausibility points contradict its stated error."""
    touched = confidence.touched
    if touched is None or touched.p_value >= CONTRADICTED_P:
        return verdict
    status, words = (WARNING if verdict.status == ACCEPTED else verdict.status), touched.words("the plausibility points")
    return replace(verdict, status=status, messages=(*(text for text in verdict.messages if text != words), words))


def assess(
    problem: RegistrationProblem,
    result: RegistrationResult,
    targets_ras_mm: npt.ArrayLike,
    method: Optional[SurfaceRegistration] = None,
    limit_mm: float = LIMIT_MM,
) -> Confidence:
    """Probability at the targets (T, 3), leave-one-out residuals and, with `method`, the points held out of it."""
    below = None
    if result.covariance is not None:
        below = probability_within(result.covariance, result.pivot_ras_mm, targets_ras_mm, limit_mm, result.degrees_of_freedom)
    with_points = len(problem.points) > 0
    return Confidence(
        limit_mm=limit_mm,
        below_limit=below,
        held_out=check_held_out(problem, result, method) if with_points and method is not None else None,
        left_out=leave_one_out(problem, result, targets_ras_mm) if with_points else None,
    )


def touched_points(
    problem: RegistrationProblem, result: RegistrationResult, found: Plausibility, labels: tuple[str, ...], point_sd_mm: float
) -> Optional[DistanceCheck]:
    """Plausibility points beside what is expected of them; None where the method states no uncertainty."""
    if result.covariance is None:
        return None
    own = float(np.hypot(point_sd_mm, problem.surface_sd_mm))
    return expected_plausibility(
        found, labels, result.covariance, result.pivot_ras_mm, own, problem.surface_offset_sd_mm, result.degrees_of_freedom
    )


def probability_within(
    covariance: npt.ArrayLike,
    pivot_ras_mm: npt.ArrayLike,
    targets_ras_mm: npt.ArrayLike,
    limit_mm: float,
    degrees_of_freedom: Optional[float] = None,
) -> Array:
    """(T,) probability that the error at targets (T, 3) is below a limit.

    Parameters
    ----------
    covariance, pivot_ras_mm, targets_ras_mm
        As for `predict_tre`.
    limit_mm : float
    degrees_of_freedom : float, optional
        Behind the scale of the covariance: its true scale is then spread as an inverse chi-square.
    """
    if degrees_of_freedom is None:
        return probability_below(covariance, pivot_ras_mm, targets_ras_mm, limit_mm)
    shares = (np.arange(SCALES) + 0.5) / SCALES
    factors = degrees_of_freedom / special.chdtri(degrees_of_freedom, shares)
    stated = np.asarray(covariance, dtype=float)
    each = [probability_below(factor * stated, pivot_ras_mm, targets_ras_mm, limit_mm) for factor in factors]
    return np.asarray(np.mean(each, axis=0), dtype=np.float64)
