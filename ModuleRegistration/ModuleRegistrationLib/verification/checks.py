"""Everything that can be said of a registration after it: by markers, by touched bone, by its own points left out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
from CranioNavLib.rigid import Array
from CranioNavLib.slicer_files import LabelledPoints
from CranioNavLib.surface import Surface

from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration
from ModuleRegistrationLib.verification.confidence import Confidence, probability_within
from ModuleRegistrationLib.verification.held_out import DistanceCheck, check_held_out, leave_one_out
from ModuleRegistrationLib.verification.plausibility import Plausibility, expected_plausibility, plausibility
from ModuleRegistrationLib.verification.tre import TargetErrors, target_errors


@dataclass(frozen=True, eq=False)
class StatedError:
    """What a registration says of its own error, and its surface of itself."""

    covariance: Array  # (6, 6) rotation (rad) about the pivot, translation (mm), RAS axes
    pivot_ras_mm: Array  # (3,)
    degrees_of_freedom: Optional[float] = None
    surface_sd_mm: float = RegistrationProblem.surface_sd_mm
    surface_offset_sd_mm: float = RegistrationProblem.surface_offset_sd_mm


@dataclass(frozen=True, eq=False)
class ToVerify:
    """A registration and what there is to verify it with; None: there is none of that."""

    reference_to_ras: Array
    targets_ras_mm: Array  # (T, 3) where the error matters
    limit_mm: float  # the probability of an error below this is told
    touched_sd_mm: float  # of a plausibility point, per axis
    stated: Optional[StatedError] = None
    markers: Optional[tuple[Array, Array]] = None  # (M, 3) Reference and (M, 3) RAS, paired
    touched: Optional[LabelledPoints] = None  # plausibility points, Reference
    bone: Optional[Surface] = None  # that they were touched on
    surface: Optional[tuple[RegistrationProblem, RegistrationResult, SurfaceRegistration]] = None  # of surface registration


@dataclass(frozen=True, eq=False)
class Checks:
    """What came of it."""

    errors: Optional[TargetErrors]
    distances: Optional[Plausibility]
    confidence: Confidence


def verify(given: ToVerify) -> Checks:
    """All checks that `given` allows.

    Raises
    ------
    InputError
        A transform that is not rigid, or points that are no points.
    """
    stated, below, held_out, left_out = given.stated, None, None, None
    if stated is not None:
        below = probability_within(
            stated.covariance, stated.pivot_ras_mm, given.targets_ras_mm, given.limit_mm, stated.degrees_of_freedom
        )
    if given.surface is not None:
        problem, result, method = given.surface
        held_out, left_out = check_held_out(problem, result, method), leave_one_out(problem, result, given.targets_ras_mm)
    distances = touched = None
    if given.touched is not None and given.bone is not None:
        distances = plausibility(given.reference_to_ras, given.touched.positions_mm, given.bone)
        touched = expected_of(distances, given.touched.labels, stated, given.touched_sd_mm)
    errors = None
    if given.markers is not None:
        patient, planned = given.markers
        errors = target_errors(given.reference_to_ras, planned, patient)
    return Checks(errors, distances, Confidence(given.limit_mm, below, held_out, left_out, touched))


def expected_of(
    distances: Plausibility, labels: tuple[str, ...], stated: Optional[StatedError], touched_sd_mm: float
) -> Optional[DistanceCheck]:
    """Plausibility distances beside what the stated error lets expect; None where no error is stated."""
    if stated is None:
        return None
    own = float(np.hypot(touched_sd_mm, stated.surface_sd_mm))
    return expected_plausibility(
        distances,
        labels,
        stated.covariance,
        stated.pivot_ras_mm,
        own,
        stated.surface_offset_sd_mm,
        stated.degrees_of_freedom,
    )
