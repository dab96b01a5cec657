"""Landmarks only: the closed-form fit of the pairs; bone points are shown but not used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Parameters
from CranioNavLib.rigid import Array

from ModuleRegistrationLib.registration.closest_fit import signed_distances
from ModuleRegistrationLib.registration.landmarks import fit_anisotropic, register_landmarks
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration


class Procrustes(SurfaceRegistration):
    """Modes Ia, Ib and IIa of the chapter, equations (3)-(11); weighted where the pairs' covariances are known."""

    name = "procrustes"
    title = "Paired landmarks or markers only, orthogonal Procrustes"

    @dataclass(frozen=True)
    class Settings(Parameters):
        """Nothing to choose."""

    def register(self, problem: RegistrationProblem) -> RegistrationResult:
        """See the base class; residuals are those of the bone points, if there are any.

        Raises
        ------
        InputError
            No landmark pairs, or pairs that are degenerate or contradict each other.
        """
        if len(problem.landmarks_ct_mm) == 0:
            raise InputError("method procrustes needs landmark pairs and got none; add landmarks or choose another method")
        expected = None if problem.landmark_sd_mm is None else problem.landmark_sd_mm * float(np.sqrt(3.0))
        fit = register_landmarks(problem.landmarks_patient_mm, problem.landmarks_ct_mm, expected_fle_mm=expected)
        pose, covariance = fit.reference_to_ras, fit.covariance
        freedom: Optional[float] = fit.degrees_of_freedom
        if problem.landmark_covariances_mm2 is not None:  # then their size is known, too, and not read off the residuals
            pose, covariance = fit_anisotropic(
                problem.landmarks_patient_mm, problem.landmarks_ct_mm, problem.landmark_covariances_mm2
            )
            freedom = None
        points: Array = np.empty((0, 3))
        residuals: Array = np.empty(0)
        if len(problem.points):
            points, residuals, _ = signed_distances(problem, pose)
        return RegistrationResult(
            method=self.name,
            reference_to_ras=pose,
            surface_rms_mm=float(np.sqrt(np.mean(residuals**2))) if len(residuals) else float("nan"),
            residuals_mm=residuals,
            used=np.zeros(len(residuals), dtype=bool),
            iterations=1,
            stop_reason="closed form" if problem.landmark_covariances_mm2 is None else "each pair weighed by its own covariance",
            points_ras_mm=points,
            covariance=covariance,
            pivot_ras_mm=fit.pivot_ras_mm,
            degrees_of_freedom=freedom,
        )
