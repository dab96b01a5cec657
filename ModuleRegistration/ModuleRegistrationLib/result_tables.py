"""The tables that people read: quantities of a registration by name, residuals point by point."""

from __future__ import annotations

from typing import Optional

import numpy as np
from CranioNavLib.bone_points import BonePoints

from ModuleRegistrationLib.registration.error_theory import PredictedTre
from ModuleRegistrationLib.registration.landmarks import LandmarkRegistration
from ModuleRegistrationLib.registration.problem import RegistrationResult
from ModuleRegistrationLib.registration.verdict import Verdict
from ModuleRegistrationLib.verification.plausibility import Plausibility
from ModuleRegistrationLib.verification.tre import TargetErrors

QUANTITY, VALUE = "quantity", "value"
METHOD, STATUS, MESSAGE = "method", "status", "message"
FRE, FLE = "FRE (mm, RMS of the landmarks)", "landmark error FLE (mm, RMS, estimated)"
POINTS_USED, POINTS_REJECTED = "points used", "points rejected"
SURFACE_RMS, SPEED = "surface residual (mm, RMS)", "speed of sound (m/s)"
PREDICTED_MEAN, PREDICTED_P95 = "predicted TRE (mm, mean over targets)", "predicted TRE (mm, 95%, worst target)"
TRE_MEAN, TRE_SD, TRE_MAX = "TRE (mm, mean)", "TRE (mm, SD)", "TRE (mm, max)"
PLAUSIBILITY_MEAN, PLAUSIBILITY_MAX = "plausibility distance (mm, mean)", "plausibility distance (mm, max)"

Rows = dict[str, str]  # quantity -> value, in order


def landmark_rows(landmarks: LandmarkRegistration) -> Rows:
    """What landmark registration alone says."""
    return {FRE: f"{landmarks.fre_mm:.3f}", FLE: f"{landmarks.fle_mm:.3f}"}


def surface_rows(result: RegistrationResult, verdict: Verdict, predicted: Optional[PredictedTre]) -> Rows:
    """What surface registration and its verdict say."""
    rows = {
        METHOD: result.method,
        STATUS: verdict.status,
        MESSAGE: "; ".join(verdict.messages),
        POINTS_USED: str(int(result.used.sum())),
        POINTS_REJECTED: str(int((~result.used).sum())),
        SURFACE_RMS: f"{result.surface_rms_mm:.3f}",
    }
    if np.isfinite(result.speed_of_sound_m_s):
        rows[SPEED] = f"{result.speed_of_sound_m_s:.0f}"
    if predicted is not None:
        rows[PREDICTED_MEAN] = f"{predicted.mean_mm.mean():.3f}"
        rows[PREDICTED_P95] = f"{predicted.p95_mm.max():.3f}"
    return rows


def verification_rows(tre: Optional[TargetErrors], plausibility: Optional[Plausibility]) -> Rows:
    """What markers and points that the registration has not used say."""
    rows: Rows = {}
    if tre is not None:
        rows.update({TRE_MEAN: f"{tre.mean_mm:.3f}", TRE_SD: f"{tre.sd_mm:.3f}", TRE_MAX: f"{tre.max_mm:.3f}"})
    if plausibility is not None:
        rows.update({PLAUSIBILITY_MEAN: f"{plausibility.mean_mm:.3f}", PLAUSIBILITY_MAX: f"{plausibility.max_mm:.3f}"})
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
