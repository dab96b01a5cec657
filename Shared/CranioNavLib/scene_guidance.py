"""What guidance rests on: the registration in force, or the same refined with the bone points that have been taken since.

Registration writes the refinement, ultrasound leads the hand by it. It is no result: ReferenceToRas stays what the user made it,
and nobody accepts, verifies or reports the refinement. That is why it is no transform among the others, but a note in a node of
its own, which says too of which ReferenceToRas it is a refinement. With another one in force it is void, whoever wrote that.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from CranioNavLib import host, scene, scene_data
from CranioNavLib.rigid import Array, check_rigid

NOTE = "refinement"  # parameter of the Guidance node: JSON

MotionError = tuple[Array, Array, "float | None"]  # as of scene_data.get_motion_error


@dataclass(frozen=True, eq=False)
class GuidanceRegistration:
    """Where the patient is, as far as it is known now."""

    reference_to_ras: Array  # (4, 4)
    error: MotionError | None  # None: not known
    points: tuple[str, ...]  # labels of the bone points that it rests on beside the landmarks
    refined: bool = False  # False: it is ReferenceToRas itself
    remark: str = ""  # why the last refinement was not taken


def get_guidance() -> GuidanceRegistration | None:
    """The best that is known; None before there is a registration."""
    node = scene.find("ReferenceToRas")
    if node is None or not node.GetAttribute(scene.STATUS_ATTRIBUTE):
        return None
    in_force = scene_data.get_transform("ReferenceToRas")
    note = _read(in_force)
    if "matrix" not in note:
        return GuidanceRegistration(in_force, scene_data.get_motion_error(), registered_points(), remark=note.get("remark", ""))
    covariance, pivot, freedom = note["error"]
    error = (np.array(covariance), np.array(pivot), freedom)
    return GuidanceRegistration(np.array(note["matrix"]), error, tuple(note["points"]), True, note.get("remark", ""))


def registered_points() -> tuple[str, ...]:
    """Labels of the bone points that ReferenceToRas was made of; none after landmarks alone."""
    node = scene.find("RegisteredPoints")
    count = node.GetNumberOfControlPoints() if node is not None else 0
    return tuple(node.GetNthControlPointLabel(index) for index in range(count)) if node is not None else ()


def set_refinement(
    matrix: npt.ArrayLike,
    covariance: npt.ArrayLike,
    pivot_ras_mm: npt.ArrayLike,
    degrees_of_freedom: float | None,
    points: tuple[str, ...],
) -> None:
    """Let guidance rest on a refinement of the ReferenceToRas in force: matrix (4, 4), error, and the points it was made of."""
    error = [np.asarray(covariance, dtype=float).tolist(), np.asarray(pivot_ras_mm, dtype=float).tolist(), degrees_of_freedom]
    _write({"matrix": check_rigid(matrix, "the refinement for guidance").tolist(), "error": error, "points": list(points)})


def set_remark(remark: str) -> None:
    """Say why the last refinement was not taken; guidance rests on what it rested on before."""
    _write({**_read(scene_data.get_transform("ReferenceToRas")), "remark": remark})


def forget_refinement() -> None:
    """Guidance rests on ReferenceToRas itself."""
    if scene.find("Guidance") is not None:
        host.check_thread()
        scene.find_or_create("Guidance").UnsetParameter(NOTE)


def _write(note: dict[str, Any]) -> None:
    host.check_thread()
    of = scene_data.get_transform("ReferenceToRas").tolist()
    scene.find_or_create("Guidance").SetParameter(NOTE, json.dumps({**note, "of": of}))


def _read(in_force: Array) -> dict[str, Any]:
    """The note, where it is of the registration in force."""
    node = scene.find("Guidance")
    text = node.GetParameter(NOTE) if node is not None else ""
    note: dict[str, Any] = json.loads(text) if text else {}
    return note if note.get("of") == in_force.tolist() else {}
