"""Target registration error at markers that the registration has not used: equations (14)-(16) of the chapter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, check_points, check_rigid, transform_points


@dataclass(frozen=True, eq=False)
class TargetErrors:
    """TRE at each of T targets, and what became of it over all (mm)."""

    errors_mm: Array  # (T,)
    vectors_mm: Array  # (T, 3) registered minus planned, in RAS
    mean_mm: float  # equation (15)
    sd_mm: float  # equation (16), over T - 1; 0 for a single target
    max_mm: float
    min_mm: float
    rms_mm: float


def target_errors(
    reference_to_ras: npt.ArrayLike, targets_ct_mm: npt.ArrayLike, targets_patient_mm: npt.ArrayLike
) -> TargetErrors:
    """TRE of a registration: distance between each target in the CT and its registered patient position.

    The localisation error of the targets themselves is part of it: with 0.25 mm noise per axis on each
    side a perfect registration shows about 0.55 mm.

    Parameters
    ----------
    reference_to_ras : (4, 4)
    targets_ct_mm : (T, 3) RAS
    targets_patient_mm : (T, 3) Reference, paired with targets_ct_mm

    Raises
    ------
    InputError
        No targets, lists of unequal length, or a transform that is not rigid.

    References
    ----------
    Popovic, Heger et al., "Efficient Non-Invasive Registration with A-mode Ultrasound in Skull Surgery",
    equations (14)-(16).
    """
    matrix = check_rigid(reference_to_ras, "ReferenceToRas")
    planned = check_points(targets_ct_mm, "targets in the CT", at_least=1)
    touched = check_points(targets_patient_mm, "targets on the patient", at_least=len(planned))
    vectors = transform_points(matrix, touched[: len(planned)]) - planned
    errors = np.linalg.norm(vectors, axis=1)
    return TargetErrors(
        errors_mm=errors,
        vectors_mm=vectors,
        mean_mm=float(errors.mean()),
        sd_mm=float(errors.std(ddof=1)) if len(errors) > 1 else 0.0,
        max_mm=float(errors.max()),
        min_mm=float(errors.min()),
        rms_mm=float(np.sqrt(np.mean(errors**2))),
    )
