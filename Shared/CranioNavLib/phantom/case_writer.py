"""Case folders of simulated sessions, in each of the chapter's modes of registration."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Optional

import numpy as np
import numpy.typing as npt

from CranioNavLib.files import output_folder, write_text, written_whole
from CranioNavLib.phantom.patient import VirtualPatient
from CranioNavLib.phantom.session_data import draw_session
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import write_recording
from CranioNavLib.volume import Volume


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

    What a session measures in each mode is told in draw_session.

    Parameters
    ----------
    patient : VirtualPatient
    folder : path
        Made if it is missing.
    protocol_points_ras_mm, protocol_normals : array-like, shape (N, 3)
        Planned places on the CT's bone and their outward normals, RAS.
    rng : numpy Generator
        All of the session's noise.
    mode : "Ia", "Ib", "IIa", "IIb" or "III"
    protocol_labels : tuple of str, optional
    ct_name : str, optional
        A CT written before (relative to the case); then case.json refers to it and no ct.nrrd is written.

    Raises
    ------
    InputError
        Unknown mode, or the folder cannot be written to.
    """
    from CranioNavLib.slicer_files import LabelledPoints, write_points

    data = draw_session(patient, mode, protocol_points_ras_mm, protocol_normals, rng, protocol_labels)
    case = output_folder(folder)
    _write_ct(patient, case, ct_name)

    def put(name: str, point_labels: tuple[str, ...], points: Array) -> None:
        write_points(case / f"{name}.mrk.json", LabelledPoints(point_labels, points), name)

    put("landmarks-ct", data.fiducial_labels, data.fiducials_ct_mm)
    put("landmarks-patient", data.fiducial_labels, data.fiducials_patient_mm)
    if len(data.points_patient_mm):
        put("points", data.point_labels, data.points_patient_mm)
    if data.recording is not None:
        write_recording(case / "palpation.igs.mha", data.recording)
    put("targets-ct", data.target_labels, data.targets_ct_mm)
    put("targets-patient", data.target_labels, data.targets_patient_mm)
    checks = tuple(f"Check {index + 1}" for index in range(len(data.checks_patient_mm)))
    put("plausibility", checks, data.checks_patient_mm)
    return case


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
