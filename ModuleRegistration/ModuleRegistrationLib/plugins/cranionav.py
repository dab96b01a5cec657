"""CranioNav's own method: maximum likelihood with anisotropic errors, outliers and common unknowns, searched globally."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from CranioNavLib.parameters import Limits, Parameters

from ModuleRegistrationLib.registration.closest_fit import check_problem
from ModuleRegistrationLib.registration.maximum_likelihood import solve
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration


class MaximumLikelihood(SurfaceRegistration):
    """The default."""

    name = "cranionav"
    title = "Maximum likelihood with outliers, common offset and speed of sound, and a global search around the landmarks"

    @dataclass(frozen=True)
    class Settings(Parameters):
        """How thoroughly to search; accuracy hardly depends on it once the minimum is found."""

        starts: Annotated[int, Limits(1, 2000), "poses drawn from the landmarks' uncertainty"] = 200
        samples: Annotated[int, Limits(50, 20000), "posterior samples that the pose and its error come from"] = 800

    def register(self, problem: RegistrationProblem) -> RegistrationResult:
        """See the base class."""
        check_problem(problem)
        return solve(problem, self.settings.starts, self.settings.samples)
