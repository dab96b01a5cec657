"""A registered case as a scene of shared nodes, for scene.mrb."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from CranioNavLib import host, scene_data
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.slicer_files import LabelledPoints

if TYPE_CHECKING:
    from ModuleRegistrationLib.procedure import CaseResult


def fill_scene(result: CaseResult) -> None:
    """Clear the scene and write the case's shared nodes into it; patient points hang under ReferenceToRas.

    A refused registration leaves ReferenceToRas at the identity, so that the scene cannot be taken for a result.
    """
    host.scene().Clear(False)
    scene_data.set_volume("CT", result.volume)
    scene_data.set_surface("Bone", result.bone.closed)
    scene_data.set_surface("OuterTable", result.bone.outer_table)
    scene_data.set_transform(
        "ReferenceToRas", result.registration.reference_to_ras if result.verdict.status != "refused" else np.eye(4)
    )
    labels = result.landmarks.labels
    scene_data.set_points("LandmarksCT", LabelledPoints(labels, result.landmarks_ct_mm))
    scene_data.set_points("LandmarksPatient", LabelledPoints(labels, result.landmarks_patient_mm))
    if len(result.points):
        scene_data.set_bone_points(_at_estimated_speed(result))
    for role, points in (
        ("TargetsCT", result.case.targets_ct),
        ("TargetsPatient", result.case.targets_patient),
        ("PlausibilityPoints", result.case.plausibility),
    ):
        if points is not None:
            scene_data.set_points(role, points)
    scene_data.set_table("Results", _results(result))
    if len(result.points):
        scene_data.set_table("Residuals", _residuals(result))
    scene_data.set_text("Report", "\n".join([f"{result.case.name}: {result.verdict.status}", *result.verdict.messages]))


def _at_estimated_speed(result: CaseResult) -> BonePoints:
    speed = result.registration.speed_of_sound_m_s
    return (
        result.points.at_speed(speed) if np.isfinite(speed) and np.isfinite(result.points.speed_of_sound_m_s) else result.points
    )


def _results(result: CaseResult) -> dict[str, list[object]]:
    rows: list[tuple[str, object]] = [
        ("mode", result.mode),
        ("method", result.registration.method),
        ("status", result.verdict.status),
        ("FRE (mm, RMS of the landmarks)", f"{result.landmarks.fre_mm:.3f}"),
        ("points used", str(int(result.registration.used.sum()))),
    ]
    if len(result.points):
        rows.append(("surface residual (mm, RMS)", f"{result.registration.surface_rms_mm:.3f}"))
    if np.isfinite(result.registration.speed_of_sound_m_s):
        rows.append(("speed of sound (m/s)", f"{result.registration.speed_of_sound_m_s:.0f}"))
    if result.predicted is not None:
        rows.append(("predicted TRE (mm, mean over targets)", f"{result.predicted.mean_mm.mean():.3f}"))
        rows.append(("predicted TRE (mm, 95%, worst target)", f"{result.predicted.p95_mm.max():.3f}"))
    if result.tre is not None:
        rows += [
            ("TRE (mm, mean)", f"{result.tre.mean_mm:.3f}"),
            ("TRE (mm, SD)", f"{result.tre.sd_mm:.3f}"),
            ("TRE (mm, max)", f"{result.tre.max_mm:.3f}"),
        ]
    return {"quantity": [name for name, _ in rows], "value": [value for _, value in rows]}


def _residuals(result: CaseResult) -> dict[str, list[object]]:
    return {
        "point": list(result.points.labels),
        "residual (mm)": result.registration.residuals_mm.tolist(),
        "used": ["yes" if used else "no" for used in result.registration.used],
    }
