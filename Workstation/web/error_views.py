"""The error in the 3-D view: the skull coloured by the error to expect there, or the bone points by their residuals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from CranioNavLib import host, scene, scene_data
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.rigid import Array, transform_points

from Workstation.web import words
from Workstation.web.color_scale import color_by, gradient, ticks

MAP, RESIDUALS, NONE = "map", "residuals", "none"
MOST_MM = {MAP: 5.0, RESIDUALS: 2.0}  # the scale's end
ERROR = "Expected error (mm)"
RESIDUAL = "Residual (mm)"
LEAST_SD_MM = 0.3  # of a point along the bone's normal: the surface is no better
USED_MM, REJECTED_MM = 3.0, 4.5  # half the size of a point as drawn


class ErrorViews:
    """Colours the bone as drawn, and draws the registered points; computes only what has changed.

    Parameters
    ----------
    start : callable
        Calls its first argument, off the main thread if it can, and then its second one with what came out (a result or an
        exception) in the main thread.
    """

    def __init__(self, start: Callable[[Callable[[], Any], Callable[[Any], None]], None] | None = None) -> None:
        self._start = start or (lambda compute, finished: finished(compute()))
        self._mapped: Any = None
        self._computing: Any = None
        self._residuals: Any = None
        self._points: Any = None

    def refresh(self, bone: Any, wanted: str) -> dict[str, Any] | None:
        """Show one of MAP, RESIDUALS, NONE on the model node `bone`; returns the legend, or None without one."""
        has_map = wanted == MAP and bone is not None and self._map(bone)
        if bone is not None and bone.GetDisplayNode().GetScalarVisibility() != int(has_map):
            bone.GetDisplayNode().SetScalarVisibility(has_map)
        has_points = wanted == RESIDUALS and self._draw_points()
        if self._points is not None and self._points.GetScene() is not None:
            self._points.GetDisplayNode().SetVisibility(has_points)
        if has_map:
            taken = self._mapped[3]
            return _legend(words.EXPECTED_ERROR, MAP, words.WITH_POINTS.format(count=taken) if taken else "")
        if has_points:
            rejected = scene_data.get_table("Residuals")["used"].count("no")
            return _legend(words.BONE_POINTS, RESIDUALS, words.LEFT_OUT.format(count=rejected) if rejected else "")
        return None

    def _map(self, bone: Any) -> bool:
        """Whether the bone carries an error to expect with the registration in force; computed anew if there is another one."""
        known, mesh = scene_data.get_motion_error(), bone.GetPolyData()
        if known is None or mesh is None or not mesh.GetNumberOfPoints():
            return False
        node = scene.find("SurfacePoints") if _landmarks_alone() else None
        taken = node.GetNumberOfControlPoints() if node is not None else 0
        last = node.GetNthControlPointPosition(taken - 1) if node is not None and taken else ()
        motion = scene.find_or_create("ReferenceToRas").GetAttribute(scene_data.MOTION_ERROR)
        stamp = (mesh, motion, tuple(last), taken)
        if stamp not in (self._mapped, self._computing):
            self._computing = stamp
            self._start(_errors_on(mesh, known, taken), lambda errors: self._color(bone, stamp, errors))
        return self._mapped is not None and self._mapped[:2] == stamp[:2]  # with fewer points, perhaps: the legend says how many

    def _color(self, bone: Any, stamp: Any, errors: Any) -> None:
        if isinstance(errors, Exception):
            raise errors
        if self._computing != stamp:
            return  # there is something newer by now
        from vtkmodules.util.numpy_support import numpy_to_vtk

        mesh, values = stamp[0], numpy_to_vtk(errors, deep=True)
        values.SetName(ERROR)
        mesh.GetPointData().AddArray(values)
        mesh.Modified()
        color_by(bone, ERROR, MOST_MM[MAP])
        self._mapped = stamp

    def _draw_points(self) -> bool:
        """Whether there are registered points to be drawn by residual; drawn anew if they are others."""
        registered, table = scene.find("RegisteredPoints"), scene.find("Residuals")
        if registered is None or table is None:
            return False
        stamp = (registered.GetID(), table.GetID(), table.GetTable().GetMTime())
        if self._residuals == stamp and self._points is not None and self._points.GetScene() is not None:
            return True
        columns = scene_data.get_table("Residuals")
        used = np.array([one == "yes" for one in columns["used"]])
        positions = scene_data.get_points("RegisteredPoints").positions_mm
        if len(positions) != len(used):
            return False
        if self._points is None or self._points.GetScene() is None:
            self._points = host.scene().AddNewNodeByClass("vtkMRMLModelNode", "Bone points by residual")
            self._points.CreateDefaultDisplayNodes()
            self._points.SetSelectable(False)
            self._points.SetSaveWithScene(False)
        self._points.SetAndObservePolyData(residual_glyphs(positions, np.abs(columns["residual (mm)"]), used))
        color_by(self._points, RESIDUAL, MOST_MM[RESIDUALS])
        self._residuals = stamp
        return True


def residual_glyphs(positions_mm: Array, residuals_mm: Array, used: Array) -> Any:
    """A ball for each point used and a cross of three bars for each one left out, with the residual as scalars."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkFiltersCore import vtkAppendPolyData
    from vtkmodules.vtkFiltersSources import vtkCubeSource, vtkSphereSource

    together = vtkAppendPolyData()
    for position, residual, is_used in zip(positions_mm, residuals_mm, used, strict=True):
        sources = []
        if is_used:
            ball = vtkSphereSource()
            ball.SetRadius(USED_MM)
            ball.SetThetaResolution(12)
            ball.SetPhiResolution(8)
            ball.SetCenter(*position)
            sources = [ball]
        else:
            for axis in range(3):
                bar = vtkCubeSource()
                lengths = [1.2] * 3
                lengths[axis] = 2 * REJECTED_MM
                bar.SetXLength(lengths[0])
                bar.SetYLength(lengths[1])
                bar.SetZLength(lengths[2])
                bar.SetCenter(*position)
                sources.append(bar)
        for source in sources:
            source.Update()
            shape = source.GetOutput()
            values = numpy_to_vtk(np.full(shape.GetNumberOfPoints(), float(residual)), deep=True)
            values.SetName(RESIDUAL)
            shape.GetPointData().AddArray(values)
            together.AddInputData(shape)
    together.Update()
    return together.GetOutput()


def _errors_on(mesh: Any, known: Any, taken: int) -> Callable[[], Array]:
    """Computes the 95% error (N,) to expect at the points of a mesh, from what the scene holds now. In any thread."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    vertices = vtk_to_numpy(mesh.GetPoints().GetData()).astype(float)
    normals = vtk_to_numpy(mesh.GetPointData().GetNormals()).astype(float)
    covariance, pivot, freedom = known
    points = scene_data.get_bone_points("SurfacePoints", LEAST_SD_MM) if taken else None
    matrix = scene_data.get_transform("ReferenceToRas")

    def compute() -> Array:
        from ModuleRegistrationLib.registration.error_theory import predict_tre

        then = covariance if points is None else _with_points_taken(covariance, pivot, vertices, normals, points, matrix)
        errors: Array = predict_tre(then, pivot, vertices, freedom).p95_mm
        return errors

    return compute


def _landmarks_alone() -> bool:
    """Whether the registration in force is the landmarks', and no surface registration has judged the points yet."""
    from ModuleRegistrationLib.quantities import QUANTITY, STATUS

    if scene.find_or_create("ReferenceToRas").GetAttribute(scene.STATUS_ATTRIBUTE) != "landmarks":
        return False
    return scene.find("Results") is None or STATUS not in scene_data.get_table("Results").get(QUANTITY, [])


def _with_points_taken(
    covariance: Array, pivot: Array, vertices: Array, normals: Array, points: BonePoints, matrix: Array
) -> Array:
    """The covariance to expect with these bone points, which lie in the reference's frame."""
    from ModuleRegistrationLib.registration.prospect import covariance_with_points
    from scipy.spatial import cKDTree

    positions = transform_points(matrix, points.positions_mm)
    across = normals[cKDTree(vertices).query(positions)[1]]
    in_reference = across @ matrix[:3, :3]  # the same normals, turned back
    variances = np.einsum("ni,nij,nj->n", in_reference, points.covariances_mm2, in_reference)
    known = np.isfinite(points.depths_mm) & np.isfinite(points.speed_of_sound_m_s)
    share = points.speed_of_sound_sd_m_s / points.speed_of_sound_m_s if known.any() else 0.0
    common = np.where(known, np.nan_to_num(points.depths_mm) * share, 0.0)
    return covariance_with_points(covariance, pivot, positions, across, np.sqrt(variances + LEAST_SD_MM**2), common)


def _legend(title: str, kind: str, note: str) -> dict[str, Any]:
    return {"title": title, "gradient": gradient(), "ticks": ticks(MOST_MM[kind]), "note": note}
