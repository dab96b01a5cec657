"""The registration in the scene and the Results table beside it: written whole, read value by value for the panel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Optional

import numpy.typing as npt
from CranioNavLib import scene, scene_data
from CranioNavLib.panel import Level, Reading

from ModuleRegistrationLib.quantities import QUANTITY, VALUE

LEVELS = {"accepted": Level.GOOD, "warning": Level.WARNING, "refused": Level.BAD, "landmarks": Level.WARNING}


def status() -> str:
    """What ReferenceToRas is: "landmarks", the verdict on a surface registration, or "" before there is any."""
    node = scene.find("ReferenceToRas")
    return str(node.GetAttribute(scene.STATUS_ATTRIBUTE) or "") if node is not None else ""


def rows() -> dict[str, str]:
    """The Results table: quantity to value."""
    if scene.find("Results") is None:
        return {}
    table = scene_data.get_table("Results")
    return dict(zip(table.get(QUANTITY, []), table.get(VALUE, [])))


def write_rows(values: Mapping[str, str]) -> None:
    """Make these the Results table."""
    scene_data.set_table("Results", {QUANTITY: list(values), VALUE: list(values.values())})


def set_registration(matrix: npt.ArrayLike, status: str, values: Mapping[str, str], error: Any) -> None:
    """A new registration and its rows: results of the one before do not stay beside it.

    Parameters
    ----------
    matrix : array-like, shape (4, 4)
        ReferenceToRas.
    error : LandmarkRegistration or RegistrationResult
        Whose covariance (6, 6), pivot and degrees of freedom tell the registration's error.
    """
    for role in ("Residuals", "TargetErrors", "RegisteredPoints"):
        scene.release(role)
    write_rows(values)
    node = scene.find_or_create("ReferenceToRas")
    node.SetAttribute(scene.STATUS_ATTRIBUTE, status)
    scene_data.set_motion_error(error.covariance, error.pivot_ras_mm, error.degrees_of_freedom)
    scene_data.set_transform("ReferenceToRas", matrix)


def set_verdict(status: str) -> None:
    """What the registration in force is from now on."""
    scene.find_or_create("ReferenceToRas").SetAttribute(scene.STATUS_ATTRIBUTE, status)


def forget_registration() -> None:
    """ReferenceToRas is the identity again, and no registration."""
    node = scene.find("ReferenceToRas")
    if node is not None:
        node.RemoveAttribute(scene.STATUS_ATTRIBUTE)
        scene_data.set_motion_error(None, (0.0, 0.0, 0.0), None)
        scene_data.set_transform("ReferenceToRas", [[float(row == column) for column in range(4)] for row in range(4)])


def reading(*parts: str, level: Optional[Level] = None) -> Optional[Reading]:
    """Values of the Results table by name, with the words between them; None if the first is not known."""
    known = rows()
    if parts[0] not in known:
        return None
    words = "".join(_in_tenths(known[part]) if part in known else part for part in parts)
    return Reading(words, level or LEVELS.get(status(), Level.PLAIN))


def said(name: str) -> Optional[Reading]:
    """A sentence of the Results table; None if there is none."""
    text = rows().get(name)
    return Reading(text, Level.WARNING if contradicts(text) else Level.PLAIN) if text else None


def contradicts(sentence: str) -> bool:
    """Whether a sentence about points and what was expected of them says that the stated error is too small."""
    from ModuleRegistrationLib.verification.held_out import TOO_SMALL

    return TOO_SMALL in sentence


def _in_tenths(value: str) -> str:
    """Tenths of a millimetre are what a reader can use; the table and the files keep all digits."""
    return f"{float(value):.1f}" if "." in value else value
