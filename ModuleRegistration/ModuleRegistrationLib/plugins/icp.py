"""Iterative closest points as the chapter has it, with exact closest points on the triangles."""

from __future__ import annotations

from ModuleRegistrationLib.registration.closest_fit import Stopping, check_problem, finished_result, iterate_closest
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration


class IterativeClosestPoint(SurfaceRegistration):
    """Equation (12): the mean squared distance to the surface falls with each step, to the nearest local minimum."""

    name = "icp"
    title = "Iterative closest points (Besl and McKay 1992), exact on triangles, from the landmark registration"

    Settings = Stopping

    def register(self, problem: RegistrationProblem) -> RegistrationResult:
        """See the base class; the covariance takes the residuals as the points' error."""
        check_problem(problem)
        fits = iterate_closest(
            problem.surface,
            problem.points.positions_mm,
            problem.initial_reference_to_ras[None],
            self.settings.max_iterations,
            self.settings.tolerance_mm,
        )
        return finished_result(self.name, problem, fits.reference_to_ras[0], fits.iterations, fits.stop_reason)
