"""What one simulated session leaves behind, in each of the chapter's modes of registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt

from CranioNavLib.errors import InputError
from CranioNavLib.phantom import constants
from CranioNavLib.phantom.hand import bone_below
from CranioNavLib.phantom.palpation import palpate
from CranioNavLib.phantom.patient import VirtualPatient
from CranioNavLib.phantom.sites import LANDMARK_LABELS
from CranioNavLib.rigid import Array, check_points
from CranioNavLib.sequence_metafile import Recording

MODES = ("Ia", "Ib", "IIa", "IIb", "III")
PLAUSIBILITY_COUNT = 5  # the chapter checks five points


@dataclass(frozen=True, eq=False)
class SessionData:
    """A session in one mode. Planned points are in RAS, touched ones in Reference; mm."""

    mode: str
    fiducial_labels: tuple[str, ...]
    fiducials_ct_mm: Array  # (L, 3)
    fiducials_patient_mm: Array  # (L, 3)
    point_labels: tuple[str, ...]
    points_patient_mm: Array  # (P, 3) bone touched with the stylus; empty but in mode IIb
    recording: Optional[Recording]  # mode III only
    target_labels: tuple[str, ...]
    targets_ct_mm: Array  # (10, 3)
    targets_patient_mm: Array  # (10, 3)
    checks_patient_mm: Array  # (5, 3) plausibility points


def draw_session(
    patient: VirtualPatient,
    mode: str,
    protocol_points_ras_mm: npt.ArrayLike,
    protocol_normals: npt.ArrayLike,
    rng: np.random.Generator,
    protocol_labels: Optional[tuple[str, ...]] = None,
) -> SessionData:
    """A session with `patient` in `mode`; all noise comes from `rng`.

    Ia: four bone screws. Ib: six adhesive markers. IIa: four anatomical landmarks. IIb: these and the protocol's points
    touched on the bone. III: these and an A-mode recording of the protocol's points. Targets and plausibility points are
    in every mode.

    Raises
    ------
    InputError
        Unknown mode.
    """
    if mode not in MODES:
        raise InputError(f"unknown mode {mode!r}; modes are {', '.join(MODES)}")
    positions = check_points(protocol_points_ras_mm, "protocol points")
    labels = protocol_labels or tuple(f"P{index + 1}" for index in range(len(positions)))
    fiducial_labels, fiducials, fle_mm = _fiducials(patient, mode)
    fiducials_patient = patient.digitise(fiducials, rng, fle_mm)
    on_bone = bone_below(patient, positions, protocol_normals)[0]
    on_bone = np.where(np.isfinite(on_bone), on_bone, positions)
    touched = patient.digitise(on_bone, rng, constants.PALPATION_FLE_SD_MM) if mode == "IIb" else np.empty((0, 3))
    recording = palpate(patient, positions, protocol_normals, rng).recording if mode == "III" else None
    targets = patient.digitise(patient.markers_ras_mm, rng, constants.SPHERE_TOOL_FLE_SD_MM)
    some = np.linspace(0, len(on_bone) - 1, min(PLAUSIBILITY_COUNT, len(on_bone))).astype(int)
    return SessionData(
        mode=mode,
        fiducial_labels=fiducial_labels,
        fiducials_ct_mm=fiducials,
        fiducials_patient_mm=fiducials_patient,
        point_labels=labels if mode == "IIb" else (),
        points_patient_mm=touched,
        recording=recording,
        target_labels=tuple(f"Target {index + 1}" for index in range(len(targets))),
        targets_ct_mm=patient.markers_ras_mm,
        targets_patient_mm=targets,
        checks_patient_mm=patient.digitise(on_bone[some], rng, constants.PALPATION_FLE_SD_MM),
    )


def _fiducials(patient: VirtualPatient, mode: str) -> tuple[tuple[str, ...], Array, float]:
    """Names and true places (N, 3; RAS) of a mode's fiducials, and how well they are found (SD per axis, mm)."""
    if mode == "Ia":
        names = tuple(f"Bone screw {index + 1}" for index in range(constants.BONE_SCREW_COUNT))
        return names, patient.scanned.screws_ras_mm, constants.BONE_SCREW_FLE_SD_MM
    if mode == "Ib":
        names = tuple(f"Skin marker {index + 1}" for index in range(constants.SKIN_MARKER_COUNT))
        return names, patient.scanned.stickers_ras_mm, patient.condition.skin_marker_fle_sd_mm
    return LANDMARK_LABELS, patient.landmarks_ras_mm, patient.condition.landmark_fle_sd_mm
