"""Case folders of simulated sessions, in each of the chapter's modes of registration."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Optional

import numpy as np
import numpy.typing as npt

from CranioNavLib.errors import InputError
from CranioNavLib.files import output_folder, write_text, written_whole
from CranioNavLib.phantom import constants
from CranioNavLib.phantom.hand import bone_below
from CranioNavLib.phantom.palpation import palpate
from CranioNavLib.phantom.patient import VirtualPatient
from CranioNavLib.rigid import Array, check_points
from CranioNavLib.sequence_metafile import write_recording
from CranioNavLib.volume import Volume

MODES = ("Ia", "Ib", "IIa", "IIb", "III")
PLAUSIBILITY_COUNT = 5  # the chapter checks five points


def write_case(
    patient: VirtualPatient,
    folder: str | Path,
    protocol_points_ras_mm: npt.ArrayLike,
    protocol_normals: npt.ArrayLike,
    rng: np.random.Generator,
    mode: str = "III",
    protocol_labels: Optional[tuple[str, ...]] = None,
    ct_name: Optional[str] = None,
) -> Path:
    """A case folder as formats say, as a session in `mode` with this patient would leave it. Returns the folder.

    Ia: four bone screws. Ib: six adhesive markers. IIa: four anatomical landmarks. IIb: these and the protocol's points
    touched on the bone. III: these and an A-mode recording of the protocol's points. Targets and plausibility points are
    in every case.

    Parameters
    ----------
    patient : VirtualPatient
    folder : path
        Made if it is missing.
    protocol_points_ras_mm, protocol_normals : array-like, shape (N, 3)
        Planned places on the CT's bone and their outward normals, RAS.
    rng : numpy Generator
        All of the session's noise.
    mode : one of MODES
    protocol_labels : tuple of str, optional
    ct_name : str, optional
        A CT written before (relative to the case); then case.json refers to it and no ct.nrrd is written.

    Raises
    ------
    InputError
        Unknown mode, or the folder cannot be written to.
    """
    from CranioNavLib.slicer_files import LabelledPoints, write_points

    if mode not in MODES:
        raise InputError(f"unknown mode {mode!r}; modes are {', '.join(MODES)}")
    case = output_folder(folder)
    positions = check_points(protocol_points_ras_mm, "protocol points")
    labels = protocol_labels or tuple(f"P{index + 1}" for index in range(len(positions)))
    _write_ct(patient, case, ct_name)

    def put(name: str, point_labels: tuple[str, ...], points: Array) -> None:
        write_points(case / f"{name}.mrk.json", LabelledPoints(point_labels, points), name)

    fiducials, fle_mm = mode_fiducials(patient, mode)
    names = fiducial_labels(mode)
    put("landmarks-ct", names, fiducials)
    put("landmarks-patient", names, patient.digitise(fiducials, rng, fle_mm))
    touched = bone_below(patient, positions, protocol_normals)[0]
    touched = np.where(np.isfinite(touched), touched, positions)
    if mode == "IIb":
        put("points", labels, patient.digitise(touched, rng, constants.PALPATION_FLE_SD_MM))
    if mode == "III":
        recording = palpate(patient, positions, protocol_normals, rng).recording
        write_recording(case / "palpation.igs.mha", recording)
    targets = tuple(f"Target {index + 1}" for index in range(len(patient.markers_ras_mm)))
    put("targets-ct", targets, patient.markers_ras_mm)
    put("targets-patient", targets, patient.digitise(patient.markers_ras_mm, rng, constants.SPHERE_TOOL_FLE_SD_MM))
    checks = touched[np.linspace(0, len(touched) - 1, min(PLAUSIBILITY_COUNT, len(touched))).astype(int)]
    check_labels = tuple(f"Check {index + 1}" for index in range(len(checks)))
    put("plausibility", check_labels, patient.digitise(checks, rng, constants.PALPATION_FLE_SD_MM))
    return case


def fiducial_labels(mode: str) -> tuple[str, ...]:
    """Names of the points that a mode's first registration pairs."""
    from CranioNavLib.phantom.sites import LANDMARK_LABELS

    if mode == "Ia":
        return tuple(f"Bone screw {index + 1}" for index in range(constants.BONE_SCREW_COUNT))
    if mode == "Ib":
        return tuple(f"Skin marker {index + 1}" for index in range(constants.SKIN_MARKER_COUNT))
    return LANDMARK_LABELS


def mode_fiducials(patient: VirtualPatient, mode: str) -> tuple[Array, float]:
    """True places (N, 3) of a mode's fiducials, RAS, and how well they are found (SD per axis, mm)."""
    if mode == "Ia":
        return patient.scanned.screws_ras_mm, constants.BONE_SCREW_FLE_SD_MM
    if mode == "Ib":
        return patient.scanned.stickers_ras_mm, patient.condition.skin_marker_fle_sd_mm
    return patient.landmarks_ras_mm, patient.condition.landmark_fle_sd_mm


def _write_ct(patient: VirtualPatient, case: Path, ct_name: Optional[str]) -> None:
    if ct_name is not None:
        import json

        write_text(case / "case.json", json.dumps({"ct": ct_name}, indent=2) + "\n")
        return
    write_volume(case / "ct.nrrd", patient.planning_ct)


def write_volume(path: str | Path, volume: Volume) -> None:
    """A volume as .nrrd, .nii.gz or .mha (LPS on disk, as those formats want), whole or not at all."""
    with written_whole(path) as temporary:
        _write_image(volume, temporary)


def _write_image(volume: Volume, path: Path) -> None:
    import SimpleITK as sitk

    image: Any = sitk.GetImageFromArray(volume.hu)
    spacing = np.linalg.norm(volume.ijk_to_ras[:3, :3], axis=0)
    to_lps = np.diag([-1.0, -1.0, 1.0])
    image.SetSpacing([float(step) for step in spacing])
    image.SetDirection((to_lps @ (volume.ijk_to_ras[:3, :3] / spacing)).ravel().tolist())
    image.SetOrigin((to_lps @ volume.ijk_to_ras[:3, 3]).tolist())
    sitk.WriteImage(image, str(path), True)
