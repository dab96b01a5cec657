"""Which measured landmark belongs to which planned one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, check_points


def pair_points(
    patient_labels: Sequence[str],
    patient_mm: npt.ArrayLike,
    ct_labels: Sequence[str],
    ct_mm: npt.ArrayLike,
) -> tuple[Array, Array, tuple[str, ...]]:
    """Paired lists in the order of the CT's: by label when both carry the same labels, by order otherwise.

    Labels are compared without regard to case and surrounding blanks.

    Parameters
    ----------
    patient_labels, ct_labels : sequences of str
    patient_mm : array-like, shape (N, 3), Reference frame, mm
    ct_mm : array-like, shape (N, 3), RAS, mm

    Returns
    -------
    patient : ndarray, shape (N, 3)
    ct : ndarray, shape (N, 3)
    labels : tuple of str, the CT's

    Raises
    ------
    InputError
        The lists differ in length, or shared labels contradict the order.
    """
    patient = check_points(patient_mm, "patient points")
    ct = check_points(ct_mm, "CT points")
    keys = [label.strip().casefold() for label in patient_labels]
    planned = [label.strip().casefold() for label in ct_labels]
    for name, labels, points in (("patient", keys, patient), ("CT", planned, ct)):
        if len(labels) != len(points):
            raise InputError(f"expected one label per {name} point, got {len(labels)} labels and {len(points)} points")
    if len(patient) != len(ct):
        raise InputError(
            f"expected one CT point per patient point, got {len(patient)} patient and {len(ct)} CT points"
            f"{_only_in_one(patient_labels, ct_labels)}; measure or remove the unpaired ones"
        )
    unique = len(set(keys)) == len(keys) and len(set(planned)) == len(planned)
    if unique and set(keys) == set(planned):
        where = {label: index for index, label in enumerate(keys)}
        patient = patient[[where[label] for label in planned]]
    elif unique:
        _check_order(keys, planned, patient_labels)
    return patient, ct, tuple(ct_labels)


def _only_in_one(patient_labels: Sequence[str], ct_labels: Sequence[str]) -> str:
    """Labels that one list alone carries, said in words; empty when the lists share none."""
    patient, ct = ({label.strip().casefold() for label in labels} for labels in (patient_labels, ct_labels))
    if not patient & ct:
        return ""
    extra = [f"{label!r} (patient)" for label in patient_labels if label.strip().casefold() not in ct]
    extra += [f"{label!r} (CT)" for label in ct_labels if label.strip().casefold() not in patient]
    return f" (only in one list: {', '.join(extra)})" if extra else ""


def _check_order(keys: list[str], planned: list[str], names: Sequence[str]) -> None:
    """Refuse lists that share some labels but hold them at different places: neither rule would be safe."""
    for index, label in enumerate(keys):
        if label in planned and planned.index(label) != index:
            raise InputError(
                f"landmark {names[index]!r} is number {index + 1} of the patient list but number "
                f"{planned.index(label) + 1} of the CT list, and the other labels differ; give both lists the same labels"
            )
