"""What the scene holds for a registration: which nodes are filled, points by pairs, the bone and what is promised of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Optional, TypeVar

from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.module_logic import ParametersInScene
from CranioNavLib.rigid import Array

from ModuleRegistrationLib.panel_description import RegistrationParameters

# on OuterTable: what its segmentation promises
POSITION_SD, OFFSET_SD, THRESHOLD = "CranioNav.PositionSdMm", "CranioNav.OffsetSdMm", "CranioNav.ThresholdHu"


WORDS = {  # for what is missing
    "Bone": "bone",
    "OuterTable": "bone",
    "LandmarksCT": "landmarks in the CT",
    "LandmarksPatient": "landmarks touched on the patient",
    "SurfacePoints": "bone points",
    "TargetsCT": "targets in the CT",
    "TargetsPatient": "targets measured on the patient",
    "PlausibilityPoints": "plausibility points",
    "ClampPins": "pins of the head clamp",
}


T = TypeVar("T")


class RegistrationStep(ParametersInScene[RegistrationParameters]):
    """What every step of the panel stands on."""

    parameterClass = RegistrationParameters
    sessionRole = "RegistrationSession"


def lacking(*roles: str) -> str:
    """Which of these nodes are missing or empty, in words; "" if none."""
    empty = dict.fromkeys(WORDS[role] for role in roles if not _has_content(scene.find(role)))
    return f"still missing: {', '.join(empty)}" if empty else ""


def lacking_ct() -> str:
    """What to do before anything can be done with the CT; "" if it is there."""
    return "" if scene.find("CT") is not None else "load a CT first"


def of_this_ct(take: Callable[..., T]) -> Callable[..., T]:
    """`take`, which brings into the scene what is computed from it now, refused where another CT has come meanwhile.

    Raises
    ------
    InputError
        By what is returned: it would be of the CT before.
    """
    before = _image()

    def take_if_same(*found: Any) -> T:
        if _image() is not before:
            raise InputError("another CT has been loaded meanwhile; what was found in the one before is dropped: press it again")
        return take(*found)

    return take_if_same


def _image() -> Any:
    node = scene.find("CT")
    return node.GetImageData() if node is not None else None


def filled(*roles: str) -> list[str]:
    """What these nodes hold, in words; those that are missing or empty are left out."""
    return list(dict.fromkeys(WORDS[role] for role in roles if _has_content(scene.find(role))))


def pairs(patient_role: str, ct_role: str) -> tuple[Array, Array, tuple[str, ...]]:
    """Points (N, 3) in Reference and in RAS with the same labels, and these.

    Raises
    ------
    InputError
        The lists do not pair.
    """
    from ModuleRegistrationLib.registration.pairing import pair_points

    patient, planned = scene_data.get_points(patient_role), scene_data.get_points(ct_role)
    return pair_points(patient.labels, patient.positions_mm, planned.labels, planned.positions_mm)


def promised() -> dict[str, Any]:
    """What the segmentation promises of the outer table, as far as it is known."""
    table = scene.find("OuterTable")
    texts: list[Optional[str]] = [table.GetAttribute(name) for name in (POSITION_SD, OFFSET_SD)] if table is not None else []
    known = [float(text) for text in texts if text]
    return dict(zip(("surface_sd_mm", "surface_offset_sd_mm"), known)) if len(known) == 2 else {}


def targets() -> Array:
    """Where the error matters (T, 3): the targets of the CT, or places all over the outer table, or the landmarks.

    Raises
    ------
    InputError
        There is none of these.
    """
    return targets_found_by()()


def targets_found_by() -> Callable[[], Array]:
    """What finds these, in any thread: the scene is asked now, but places all over a fine mesh take half a second.

    Raises
    ------
    InputError
        There is nothing to find them by.
    """
    from ModuleRegistrationLib.procedure import DEFAULT_TARGETS, spread_over

    for role in ("TargetsCT", "OuterTable", "LandmarksCT"):
        if not lacking(role) and role == "OuterTable":
            vertices = scene_data.get_surface(role).vertices_mm
            return lambda: spread_over(vertices, DEFAULT_TARGETS)
        if not lacking(role):
            positions = scene_data.get_points(role).positions_mm
            return lambda: positions
    raise InputError("there are no targets in the CT to tell an error at; load or find them, or find the bone")


def _has_content(node: Any) -> bool:
    if node is None:
        return False
    if node.IsA("vtkMRMLMarkupsNode"):
        return bool(node.GetNumberOfControlPoints() > 0)
    if node.IsA("vtkMRMLModelNode"):
        return node.GetPolyData() is not None and bool(node.GetPolyData().GetNumberOfPoints() > 0)
    return True
