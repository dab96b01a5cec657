"""Whether a registration may be used, in words, and what to do about it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

from ModuleRegistrationLib.registration.closest_fit import LEAST_POINTS
from ModuleRegistrationLib.registration.error_theory import predict_tre_of
from ModuleRegistrationLib.registration.findings import (
    ACCEPTED,
    LEAST_CHECKED,
    ORDER,
    REFUSED,
    WARNING,
    Finding,
    find_ambiguity,
    find_bad_fit,
    find_few_points,
    find_inconsistent_points,
    find_landmark_conflict,
    find_large_offset,
    find_moved_reference,
    find_one_sidedness,
    find_scale_error,
    find_weak_direction,
)
from ModuleRegistrationLib.registration.next_point import NextPoint, plan_next_points
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult

__all__ = ["ACCEPTED", "REFUSED", "WARNING", "Limits", "NextPoint", "Verdict", "judge"]


@dataclass(frozen=True, eq=False)
class Verdict:
    """The judgement on a registration."""

    status: str  # accepted, warning, refused
    messages: tuple[str, ...] = ()
    next_points: tuple[NextPoint, ...] = ()


@dataclass(frozen=True)
class Limits:
    """What is asked of a registration: its predicted 95% error at the worst target, and the points it rests on."""

    wanted_p95_mm: float = 2.0  # what the next points are planned for
    warn_p95_mm: float = 2.5  # 3 mm are a failure: the 99% limit of an error that is alike in all directions
    refuse_p95_mm: float = 6.0
    least_points: int = LEAST_CHECKED  # used, so that they show whether they agree


# To lead the hand a registration has to be better than the landmarks alone, not good enough to operate by: neither its error nor
# how few its points are speaks against it, all else does. Simulated (375 registrations of 25 patients with 6 to 14 points, two
# thirds with one point 4 or 5 mm off): 5.3 mm at the targets by landmarks; 1.1 to 1.6 mm in those that pass, none of which is
# worse than its landmarks by 1 mm.
FOR_GUIDANCE = Limits(wanted_p95_mm=math.inf, warn_p95_mm=math.inf, refuse_p95_mm=math.inf, least_points=LEAST_POINTS)


def judge(
    problem: RegistrationProblem,
    result: RegistrationResult,
    targets_ras_mm: npt.ArrayLike,
    limits: Optional[Limits] = None,
) -> Verdict:
    """Accept, warn or refuse `result`, with the reasons and, where more points would help, where to take them.

    Parameters
    ----------
    targets_ras_mm : array-like, shape (T, 3)
        Where the error matters: the planned target, or points spread over the head.
    """
    limits = limits or Limits()
    targets = np.asarray(targets_ras_mm, dtype=float)
    with_points = bool(len(result.residuals_mm)) and bool(result.used.any())
    findings: list[Finding] = []
    next_points: tuple[NextPoint, ...] = ()
    if result.covariance is None:
        findings.append(Finding(WARNING, f"method {result.method} states no uncertainty; judge it by measured targets only"))
    else:
        p95 = float(predict_tre_of(result, targets).p95_mm.max())
        findings += _find_large_error(p95, limits)
        if findings:
            findings += find_weak_direction(result)
        if with_points and p95 > limits.wanted_p95_mm:
            sd = _point_sd(result)
            wanted = limits.wanted_p95_mm
            next_points = plan_next_points(problem.surface, result.covariance, result.pivot_ras_mm, targets, sd, wanted)
            if findings:
                findings.append(Finding(ACCEPTED, _cure(p95, next_points)))
    findings += find_ambiguity(result, targets)
    if with_points:
        findings += find_bad_fit(result)
        findings += find_one_sidedness(problem, result)
        findings += find_few_points(result, limits.least_points)
        findings += find_large_offset(problem, result)
        findings += find_inconsistent_points(problem, result)
        findings += find_scale_error(problem, result)
        findings += find_moved_reference(problem, result)
        findings += find_landmark_conflict(problem, result)
    status = max((finding.status for finding in findings), key=ORDER.index, default=ACCEPTED)
    return Verdict(status, tuple(finding.message for finding in findings), next_points)


def _find_large_error(p95_mm: float, limits: Limits) -> list[Finding]:
    if p95_mm > limits.refuse_p95_mm:
        return [
            Finding(REFUSED, f"the predicted 95% error is {p95_mm:.1f} mm at the worst target, above {limits.refuse_p95_mm:g} mm")
        ]
    if p95_mm > limits.warn_p95_mm:
        return [
            Finding(WARNING, f"the predicted 95% error is {p95_mm:.1f} mm at the worst target, above {limits.warn_p95_mm:g} mm")
        ]
    return []


def _point_sd(result: RegistrationResult) -> float:
    """What a further point is worth: the residuals' SD, freed of what the fit took out of them."""
    residuals: Array = result.residuals_mm[result.used]
    return float(np.sqrt(np.sum(residuals**2) / max(len(residuals) - 6, 1)).clip(0.2, 3.0))


def _cure(p95_mm: float, points: tuple[NextPoint, ...]) -> str:
    regions = list(dict.fromkeys(point.region for point in points))
    number = f"{len(points)} more point{'s' if len(points) > 1 else ''}"
    return f"{number} ({', '.join(regions)}) would bring the 95% error from {p95_mm:.1f} to {points[-1].p95_mm:.1f} mm"
