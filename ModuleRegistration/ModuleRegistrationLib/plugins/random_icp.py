"""Iterative closest points from many perturbed starts: an escape from local minima."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import rigid_from_vector, transform_points

from ModuleRegistrationLib.registration.closest_fit import check_problem, finished_result, iterate_closest
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration


class RandomIterativeClosestPoint(SurfaceRegistration):
    """After Fieten et al., "Cranial CT and A-mode registration" (IJCARS 2009): perturb the best pose found, and run again."""

    name = "random-icp"
    title = "Closest points from many random perturbations of the best pose so far (idea: Fieten 2009)"

    @dataclass(frozen=True)
    class Settings(Parameters):
        """How far and how often to perturb."""

        rounds: Annotated[int, Limits(1, 100), "times the best pose is perturbed"] = 4
        starts: Annotated[int, Limits(1, 1000), "perturbed poses a round, run together"] = 25
        rotation_sd_deg: Annotated[float, Limits(0, 90), "of a perturbation, per axis"] = 5.0
        translation_sd_mm: Annotated[float, Limits(0, 100), "of a perturbation, per axis"] = 5.0
        max_iterations: Annotated[int, Limits(1, 10000), "steps at most, a round"] = 100
        tolerance_mm: Annotated[float, Limits(0, 1), "stop when no RMS distance falls by more"] = 1e-4

    def register(self, problem: RegistrationProblem) -> RegistrationResult:
        """See the base class; the draws follow from the problem's seed."""
        check_problem(problem)
        settings, rng, points = self.settings, np.random.default_rng(problem.seed), problem.points.positions_mm
        best, best_rms, steps = problem.initial_reference_to_ras, np.inf, 0
        for _ in range(settings.rounds):
            turns = rng.normal(0, np.radians(settings.rotation_sd_deg), (settings.starts, 3))
            shifts = rng.normal(0, settings.translation_sd_mm, (settings.starts, 3))
            turns[0], shifts[0] = 0, 0
            starts = rigid_from_vector(turns, shifts, transform_points(best, points).mean(axis=0)) @ best
            fits = iterate_closest(problem.surface, points, starts, settings.max_iterations, settings.tolerance_mm)
            steps += fits.iterations
            leader = int(np.argmin(fits.rms_mm))
            if fits.rms_mm[leader] < best_rms:
                best, best_rms = fits.reference_to_ras[leader], float(fits.rms_mm[leader])
        reason = f"best of {settings.rounds * settings.starts} perturbed starts"
        return finished_result(self.name, problem, best, steps, reason)
