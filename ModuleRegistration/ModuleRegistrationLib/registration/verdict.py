"""Whether a registration may be used, in words, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt

from ModuleRegistrationLib.registration.error_theory import predict_tre_of
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult

ACCEPTED, WARNING, REFUSED = "accepted", "warning", "refused"


@dataclass(frozen=True, eq=False)
class NextPoint:
    """Where to palpate next."""

    position_ras_mm: npt.NDArray[np.float64]  # (3,)
    region: str
    p95_mm: float  # predicted 95% error at the worst target, with this point and those before it


@dataclass(frozen=True)
class Verdict:
    """The judgement on a registration."""

    status: str  # accepted, warning, refused
    messages: tuple[str, ...] = ()
    next_points: tuple[NextPoint, ...] = ()


@dataclass(frozen=True)
class Limits:
    """What is asked of a registration."""

    warn_p95_mm: float = 3.0
    refuse_p95_mm: float = 6.0


def judge(
    problem: RegistrationProblem,
    result: RegistrationResult,
    targets_ras_mm: npt.ArrayLike,
    limits: Optional[Limits] = None,
) -> Verdict:
    """Accept, warn or refuse `result` by the error to expect at the targets."""
    limits = limits or Limits()
    worst = float(predict_tre_of(result, targets_ras_mm).p95_mm.max())
    if worst > limits.refuse_p95_mm:
        return Verdict(REFUSED, (f"the 95% error at a target is {worst:.1f} mm, more than {limits.refuse_p95_mm:g} mm",))
    if worst > limits.warn_p95_mm:
        return Verdict(WARNING, (f"the 95% error at a target is {worst:.1f} mm, more than {limits.warn_p95_mm:g} mm",))
    return Verdict(ACCEPTED)
