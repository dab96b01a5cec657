"""Iterative closest points as the chapter has it, with exact closest points on the triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import transform_points

from ModuleRegistrationLib.registration.closest_fit import check_problem, finished_result
from ModuleRegistrationLib.registration.landmarks import fit_rigid
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration


class IterativeClosestPoint(SurfaceRegistration):
    """Equation (12): the mean squared distance to the surface falls with each step, to the nearest local minimum."""

    name = "icp"
    title = "Iterative closest points (Besl and McKay 1992), exact on triangles, from the landmark registration"

    @dataclass(frozen=True)
    class Settings(Parameters):
        """When to stop."""

        max_iterations: Annotated[int, Limits(1, 10000), "steps at most"] = 100
        tolerance_mm: Annotated[float, Limits(0, 1), "stop when the RMS distance falls by less"] = 1e-6

    def register(self, problem: RegistrationProblem) -> RegistrationResult:
        """See the base class; the covariance takes the residuals as the points' error."""
        check_problem(problem)
        points = problem.points.positions_mm
        reference_to_ras = problem.initial_reference_to_ras
        previous, iteration = np.inf, 0
        stop_reason = f"iteration limit {self.settings.max_iterations}"
        while iteration < self.settings.max_iterations:
            iteration += 1
            closest = problem.surface.closest(transform_points(reference_to_ras, points))
            rms = float(np.sqrt(np.mean(closest.distances_mm**2)))
            if previous - rms < self.settings.tolerance_mm:
                stop_reason = f"RMS distance fell by less than {self.settings.tolerance_mm:g} mm"
                break
            previous = rms
            reference_to_ras = fit_rigid(points, closest.points_mm)
        return finished_result(self.name, problem, reference_to_ras, iteration, stop_reason)
