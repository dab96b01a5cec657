"""Iterative closest points over the closest share of the points: gross outliers are left out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from CranioNavLib.parameters import Limits

from ModuleRegistrationLib.registration.closest_fit import (
    LEAST_POINTS,
    Stopping,
    check_problem,
    finished_result,
    iterate_closest,
    signed_distances,
)
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration


class TrimmedIterativeClosestPoint(SurfaceRegistration):
    """Chetverikov et al., "The trimmed iterative closest point algorithm", ICPR 2002."""

    name = "trimmed-icp"
    title = "Closest points over the best share of the points (Chetverikov 2002)"

    @dataclass(frozen=True)
    class Settings(Stopping):
        """How many points to trust."""

        keep_share: Annotated[float, Limits(0.3, 1), "share of the points used, the closest ones"] = 0.8

    def register(self, problem: RegistrationProblem) -> RegistrationResult:
        """See the base class."""
        check_problem(problem)
        fits = iterate_closest(
            problem.surface,
            problem.points.positions_mm,
            problem.initial_reference_to_ras[None],
            self.settings.max_iterations,
            self.settings.tolerance_mm,
            self.settings.keep_share,
        )
        _, distances, _ = signed_distances(problem, fits.reference_to_ras[0])
        kept = max(round(self.settings.keep_share * len(distances)), LEAST_POINTS)
        used = np.zeros(len(distances), dtype=bool)
        used[np.argsort(np.abs(distances), kind="stable")[:kept]] = True
        return finished_result(self.name, problem, fits.reference_to_ras[0], fits.iterations, fits.stop_reason, used)
