"""A registered case as a scene of shared nodes, for scene.mrb."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from CranioNavLib import host, scene, scene_data
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.slicer_files import LabelledPoints
from ModuleRegistrationLib import result_tables as tables
from ModuleRegistrationLib.quantities import QUANTITY, VALUE
from ModuleRegistrationLib.verification.checks import Checks

if TYPE_CHECKING:
    from ModuleRegistrationLib.procedure import CaseResult


def fill_scene(result: CaseResult) -> None:
    """Clear the scene and write the case's shared nodes into it; patient points hang under ReferenceToRas.

    A refused registration leaves ReferenceToRas at the identity, so that the scene cannot be taken for a result.
    """
    host.scene().Clear(False)
    scene_data.set_volume("CT", result.volume)
    scene_data.set_surface("Bone", result.bone.closed)
    table = scene_data.set_surface("OuterTable", result.bone.outer_table)
    table.GetDisplayNode().SetVisibility(False)  # it lies on Bone: drawn with it, both flicker
    refused = result.verdict.status == "refused"
    registration = scene_data.set_transform("ReferenceToRas", np.eye(4) if refused else result.registration.reference_to_ras)
    if not refused:
        registration.SetAttribute(scene.STATUS_ATTRIBUTE, result.verdict.status)
        found = result.registration
        scene_data.set_motion_error(found.covariance, found.pivot_ras_mm, found.degrees_of_freedom)
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
    rows = {"mode": result.mode, **tables.landmark_rows(result.landmarks)}
    rows.update(tables.surface_rows(result.registration, result.verdict, result.predicted))
    rows.update(tables.verification_rows(Checks(result.tre, result.plausibility, result.confidence)))
    scene_data.set_table("Results", {QUANTITY: list(rows), VALUE: list(rows.values())})
    if len(result.points):
        scene_data.set_table("Residuals", tables.residual_columns(result.points, result.registration))
    scene_data.set_text("Report", "\n".join([f"{result.case.name}: {result.verdict.status}", *result.verdict.messages]))


def _at_estimated_speed(result: CaseResult) -> BonePoints:
    speed = result.registration.speed_of_sound_m_s
    return (
        result.points.at_speed(speed) if np.isfinite(speed) and np.isfinite(result.points.speed_of_sound_m_s) else result.points
    )
