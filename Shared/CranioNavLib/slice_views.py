"""The slice views by their MRML nodes, in 3D Slicer as in the workstation: where they cross, and to go somewhere with all."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from CranioNavLib import host
from CranioNavLib.rigid import Array


def slice_nodes() -> list[Any]:
    """The slice views' nodes."""
    scene = host.scene()
    return [scene.GetNthNodeByClass(k, "vtkMRMLSliceNode") for k in range(scene.GetNumberOfNodesByClass("vtkMRMLSliceNode"))]


def crossing() -> Array | None:
    """The point (3,) in RAS where the slices cross; None without three slices in different directions."""
    util = host.slicer_package().util
    planes = [util.arrayFromVTKMatrix(node.GetSliceToRAS()) for node in slice_nodes()]
    if not planes:
        return None
    normals = np.array([plane[:3, 2] for plane in planes])
    offsets = np.array([plane[:3, 2] @ plane[:3, 3] for plane in planes])
    if np.linalg.matrix_rank(normals, tol=1e-3) < 3:
        return None
    point: Array = np.linalg.lstsq(normals, offsets, rcond=None)[0]
    return point


def go_to(position_ras_mm: npt.ArrayLike) -> None:
    """Let all slices pass through a point."""
    place = [float(value) for value in np.asarray(position_ras_mm, dtype=float)]
    for node in slice_nodes():
        node.JumpSliceByOffsetting(*place)


def zoom_on(position_ras_mm: npt.ArrayLike, width_mm: float) -> None:
    """Put a point into the middle of all slices, which show so many millimetres about it."""
    place = [float(value) for value in np.asarray(position_ras_mm, dtype=float)]
    for node in slice_nodes():
        across, up, deep = node.GetFieldOfView()
        scale = width_mm / min(across, up)
        if abs(scale - 1) > 0.01:
            node.SetFieldOfView(across * scale, up * scale, deep)
        if any(node.GetXYZOrigin()[:2]):
            node.SetXYZOrigin(0.0, 0.0, node.GetXYZOrigin()[2])
        node.JumpSliceByCentering(*place)


def show_crossing(shown: bool) -> None:
    """In each slice lines where the others cut it, or none."""
    scene = host.scene()
    for index in range(scene.GetNumberOfNodesByClass("vtkMRMLSliceDisplayNode")):
        node = scene.GetNthNodeByClass(index, "vtkMRMLSliceDisplayNode")
        if bool(node.GetIntersectingSlicesVisibility()) != shown:
            node.SetIntersectingSlicesVisibility(shown)
