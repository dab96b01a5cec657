"""The tables that people read: quantities of a registration by name, residuals point by point."""

from __future__ import annotations

from typing import Optional

import numpy as np
from CranioNavLib.bone_points import BonePoints

from ModuleRegistrationLib import quantities as names
from ModuleRegistrationLib.registration.error_theory import PredictedTre
from ModuleRegistrationLib.registration.landmarks import LandmarkRegistration
from ModuleRegistrationLib.registration.problem import RegistrationResult
from ModuleRegistrationLib.registration.verdict import Verdict
from ModuleRegistrationLib.verification.checks import Checks
from ModuleRegistrationLib.verification.confidence import probability

NOT_STATED = "the registration states no error, so nothing is known of what to expect"

Rows = dict[str, str]  # quantity -> value, in order


def landmark_rows(landmarks: LandmarkRegistration) -> Rows:
    """What landmark registration alone says."""
    return {names.FRE: f"{landmarks.fre_mm:.3f}", names.FLE: f"{landmarks.fle_mm:.3f}"}


def surface_rows(result: RegistrationResult, verdict: Verdict, predicted: Optional[PredictedTre]) -> Rows:
    """What surface registration and its verdict say."""
    rows = {
        names.METHOD: result.method,
        **verdict_rows(verdict),
        names.POINTS_USED: str(int(result.used.sum())),
        names.POINTS_REJECTED: str(int((~result.used).sum())),
        names.SURFACE_RMS: f"{result.surface_rms_mm:.3f}",
    }
    if np.isfinite(result.speed_of_sound_m_s):
        rows[names.SPEED] = f"{result.speed_of_sound_m_s:.0f}"
    if predicted is not None:
        rows[names.PREDICTED_MEAN] = f"{predicted.mean_mm.mean():.3f}"
        rows[names.PREDICTED_P95] = f"{predicted.p95_mm.max():.3f}"
    return rows


def verdict_rows(verdict: Verdict) -> Rows:
    """The judgement."""
    return {names.STATUS: verdict.status, names.MESSAGE: "; ".join(verdict.messages)}


def verification_rows(checks: Checks) -> Rows:
    """What markers, points that the registration has not used, and its own points left out of it say."""
    rows: Rows = {}
    tre, distances, confidence = checks.errors, checks.distances, checks.confidence
    if tre is not None:
        rows.update({names.TRE_MEAN: f"{tre.mean_mm:.3f}", names.TRE_SD: f"{tre.sd_mm:.3f}", names.TRE_MAX: f"{tre.max_mm:.3f}"})
    if distances is not None:
        rows.update({names.PLAUSIBILITY_MEAN: f"{distances.mean_mm:.3f}", names.PLAUSIBILITY_MAX: f"{distances.max_mm:.3f}"})
        touched = confidence.touched
        rows[names.TOUCHED] = NOT_STATED if touched is None else f"{touched.outcome}; {touched.expectation}"
    if confidence.below_limit is not None:
        rows[names.BELOW_LIMIT] = f"{probability(confidence.below_limit)} for {confidence.limit_mm:g} mm"
    if confidence.held_out is not None:
        rows[names.HELD_OUT] = f"{confidence.held_out.outcome}; {confidence.held_out.expectation}"
    if confidence.left_out is not None:
        rows[names.INFLUENTIAL] = confidence.left_out.influence
    return rows


def residual_columns(points: BonePoints, result: RegistrationResult) -> dict[str, list[object]]:
    """One row a bone point, for a table and the plot made of it."""
    return {
        "point": list(points.labels),
        "residual (mm)": [float(value) for value in result.residuals_mm],
        "used": ["yes" if used else "no" for used in result.used],
        "quality": [float(value) for value in points.qualities],
        "tissue depth (mm)": [float(value) for value in points.depths_mm],
    }
