"""What the libraries compute, written into the shared nodes of the scene and read back from them.

Arrays and small dataclasses on one side, MRML nodes on the other; roles as in scene.py. Every write checks that it
happens in the thread that owns the scene. Positions are in the node's own frame: RAS, or Reference for a node that
hangs under ReferenceToRas.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from CranioNavLib import host, scene
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, check_rigid
from CranioNavLib.slicer_files import LabelledPoints, add_points, points_of_node
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume

SPEED, SPEED_SD = "CranioNav.SpeedOfSoundMps", "CranioNav.SpeedOfSoundSdMps"
POSE_STATUS, POSE_TIME = "CranioNav.PoseStatus", "CranioNav.PoseTimeS"  # on the transforms of tracked tools
MOTION_ERROR = "CranioNav.MotionError"  # on ReferenceToRas: JSON of its covariance, pivot and degrees of freedom
AXES = "xyz"
_surfaces: dict[str, tuple[Any, int, Surface]] = {}  # role: (its mesh, when that was changed last, the same with its index)


@dataclass(frozen=True, eq=False)
class ScenePose:
    """What a tool's transform in the scene says. Without a trustworthy pose there is no matrix."""

    matrix: Array | None  # (4, 4) mm; None unless the status is OK
    status: str  # the words of PLUS: OK, MISSING, INVALID...; MISSING before the first pose
    host_time_s: float  # time.monotonic() of this computer when the pose was taken; NaN before the first


def set_points(role: str, points: LabelledPoints) -> Any:
    """Replace the control points of a role's node; returns the node."""
    host.check_thread()
    node = scene.find_or_create(role)
    with host.slicer_package().util.NodeModify(node):
        node.RemoveAllControlPoints()
        _forget_measurements(node)
        add_points(node, points)
    return node


def get_points(role: str) -> LabelledPoints:
    """The control points of a role's node.

    Raises
    ------
    InputError
        There is no such node, it is empty, or a point is not placed.
    """
    return points_of_node(_node(role), f"{role} in the scene")


def set_transform(role: str, matrix: npt.ArrayLike) -> Any:
    """Set the rigid ToParent matrix (4, 4) of a role's transform; returns the node."""
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    host.check_thread()
    node, to_parent = scene.find_or_create(role), vtkMatrix4x4()
    to_parent.DeepCopy(check_rigid(matrix, role).ravel().tolist())
    node.SetMatrixTransformToParent(to_parent)
    return node


def get_transform(role: str) -> Array:
    """The rigid ToParent matrix (4, 4) of a role's transform.

    Raises
    ------
    InputError
        There is no such node, or the user replaced its matrix by one that is not rigid.
    """
    return check_rigid(host.slicer_package().util.arrayFromTransformMatrix(_node(role)), f"{role} in the scene")


def set_motion_error(covariance: npt.ArrayLike | None, pivot_ras_mm: npt.ArrayLike, degrees_of_freedom: float | None) -> None:
    """Keep the error of ReferenceToRas with it: covariance (6, 6) of a small motion about the pivot; None: not known."""
    host.check_thread()
    node = scene.find_or_create("ReferenceToRas")
    if covariance is None:
        node.RemoveAttribute(MOTION_ERROR)
        return
    kept = [np.asarray(covariance, dtype=float).tolist(), np.asarray(pivot_ras_mm, dtype=float).tolist(), degrees_of_freedom]
    node.SetAttribute(MOTION_ERROR, json.dumps(kept))


def get_motion_error() -> tuple[Array, Array, float | None] | None:
    """Covariance (6, 6), pivot (3,) and degrees of freedom of ReferenceToRas; None where its error is not known."""
    node = scene.find("ReferenceToRas")
    text = node.GetAttribute(MOTION_ERROR) if node is not None else None
    if not text:
        return None
    covariance, pivot, freedom = json.loads(text)
    return np.array(covariance), np.array(pivot), freedom


def set_pose(role: str, matrix: npt.ArrayLike | None, status: str, host_time_s: float) -> Any:
    """Write a tracked tool's pose, or (matrix None) that it has none now. Observers hear of it once.

    A lost tool keeps its old matrix in the node, as MRML has no transform without one: `get_pose` does not give it
    away, and what is drawn under the node has to be hidden while the status is not OK.
    """
    host.check_thread()
    node = scene.find_or_create(role)
    with host.slicer_package().util.NodeModify(node):
        node.SetAttribute(POSE_STATUS, status if matrix is not None or status != "OK" else "MISSING")
        node.SetAttribute(POSE_TIME, repr(float(host_time_s)))
        if matrix is not None:
            set_transform(role, matrix)
    return node


def get_pose(role: str) -> ScenePose:
    """What the transform of a tracked tool says now."""
    node = scene.find(role)
    status = (node.GetAttribute(POSE_STATUS) if node is not None else None) or "MISSING"
    taken = node.GetAttribute(POSE_TIME) if node is not None else None
    return ScenePose(get_transform(role) if status == "OK" else None, status, float(taken) if taken else float("nan"))


def set_surface(role: str, surface: Surface) -> Any:
    """Set the mesh of a role's model; returns the node."""
    host.check_thread()
    node = scene.find_or_create(role)
    mesh = surface.to_polydata()
    node.SetAndObservePolyData(mesh)
    _surfaces[role] = (mesh, mesh.GetMTime(), surface)
    return node


def get_surface(role: str) -> Surface:
    """The mesh of a role's model.

    Raises
    ------
    InputError
        There is no such node, or it holds no triangles.
    """
    mesh = _node(role).GetPolyData()
    if mesh is None or mesh.GetNumberOfPoints() == 0:
        raise InputError(f"{role} in the scene holds no surface; make it first")
    kept, stamp, surface = _surfaces.get(role, (None, 0, None))
    if surface is None or stamp != mesh.GetMTime() or kept is not mesh:
        surface = Surface.from_polydata(mesh)
        _surfaces[role] = (mesh, mesh.GetMTime(), surface)
    return surface


def set_volume(role: str, volume: Volume) -> Any:
    """Set the voxels and the place of a role's volume; returns the node."""
    host.check_thread()
    node, util = scene.find_or_create(role), host.slicer_package().util
    node.SetAndObserveImageData(None)  # another image, not other voxels in it: who keeps something of an image tells by that
    node.SetIJKToRASMatrix(util.vtkMatrixFromArray(volume.ijk_to_ras))
    node.CreateDefaultDisplayNodes()
    display = node.GetDisplayNode()
    display.AutoWindowLevelOff()  # before there are voxels: their histogram takes half a second, and nobody wants it
    util.updateVolumeFromArray(node, np.ascontiguousarray(volume.hu))
    display.SetWindowLevel(2000.0, 400.0)  # the bone window of radiology, wide enough for the scalp to be seen
    display.SetAndObserveColorNodeID("vtkMRMLColorTableNodeGrey")
    node.SetDescription(volume.description)
    return node


def get_volume(role: str) -> Volume:
    """The voxels (HU) of a role's volume with their place in RAS.

    Raises
    ------
    InputError
        There is no such node, it is empty, or its transform is not rigid.
    """
    node, util = _node(role), host.slicer_package().util
    if node.GetImageData() is None:
        raise InputError(f"{role} in the scene holds no image; load the CT first")
    if node.GetParentTransformNode() is not None:
        raise InputError(f"{role} in the scene hangs under a transform; harden it, or take it out from under the transform")
    to_ras = util.vtkMatrixFromArray(np.eye(4))
    node.GetIJKToRASMatrix(to_ras)
    voxels = np.clip(util.arrayFromVolume(node), -32768, 32767).astype(np.int16)
    return Volume(voxels, util.arrayFromVTKMatrix(to_ras), node.GetDescription() or node.GetName())


def set_bone_points(points: BonePoints, role: str = "SurfacePoints") -> Any:
    """Write measured bone points with all that is known of their error; returns the node.

    Positions are control points. Covariance, beam, depth, quality and other echoes are static measurements of the
    node, one value a control point, so that they are saved with it in .mrk.json and .mrb. A measurement holds the
    points' ids too: deleting a point in 3D Slicer deletes its values.
    """
    node = set_points(role, LabelledPoints(points.labels, points.positions_mm))
    with host.slicer_package().util.NodeModify(node):
        for name, values in _point_columns(points).items():
            add_measurement(node, name, values)
        add_measurement(node, "PointId", [float(node.GetNthControlPointID(index)) for index in range(len(points))])
        node.SetAttribute(SPEED, repr(float(points.speed_of_sound_m_s)))
        node.SetAttribute(SPEED_SD, repr(float(points.speed_of_sound_sd_m_s)))
        for index in range(len(points)):
            node.SetNthControlPointDescription(index, f"quality {points.qualities[index]:.2f}")
    return node


def get_bone_points(role: str = "SurfacePoints", palpated_sd_mm: float | None = None) -> BonePoints:
    """The measured bone points of a role's node, in its order.

    A node without measurements (a plain point list) is taken as palpated with `palpated_sd_mm` (mm per axis).

    Raises
    ------
    InputError
        No such node, no points, a point was added or moved by hand among measured ones, or the list has no
        measurements and `palpated_sd_mm` is not given.
    """
    points, node = get_points(role), _node(role)
    columns = read_measurements(node)
    if "PointId" not in columns:
        if palpated_sd_mm is None:
            raise InputError(f"{role} in the scene says nothing of its points' error; give the error of palpation in mm")
        return BonePoints.palpated(points.positions_mm, palpated_sd_mm, points.labels)
    rows = {int(identity): row for row, identity in enumerate(columns["PointId"])}
    ids = [int(node.GetNthControlPointID(index)) for index in range(len(points))]
    strangers = [label for label, identity in zip(points.labels, ids) if identity not in rows]
    if strangers:
        raise InputError(f"{role} in the scene: point {strangers[0]!r} was not measured; delete it, or measure it with the probe")
    order = [rows[identity] for identity in ids]
    columns = {name: values[order] for name, values in columns.items()}
    moved = np.linalg.norm(np.stack([columns[f"Measured_{axis}"] for axis in AXES], axis=1) - points.positions_mm, axis=1)
    if moved.max() > 1e-3:
        worst = int(np.argmax(moved))
        raise InputError(
            f"{role} in the scene: point {points.labels[worst]!r} was moved by {moved[worst]:.2f} mm; undo it or measure it again"
        )
    return _bone_points(points, columns, node)


def set_table(role: str, columns: Mapping[str, Sequence[object]]) -> Any:
    """Replace a role's table; a column of numbers becomes a double column, any other text. Returns the node."""
    from vtkmodules.vtkCommonCore import vtkDoubleArray, vtkStringArray

    host.check_thread()
    node = scene.find_or_create(role)
    with host.slicer_package().util.NodeModify(node):
        node.RemoveAllColumns()
        for name, values in columns.items():
            numbers = all(isinstance(value, (int, float, np.integer, np.floating)) for value in values)
            array = vtkDoubleArray() if numbers and values else vtkStringArray()
            array.SetName(name)
            for value in values:
                array.InsertNextValue(float(value) if numbers else str(value))  # type: ignore[arg-type]
            node.AddColumn(array)
        node.SetUseColumnTitleAsColumnHeader(True)
        node.Modified()
    return node


def get_table(role: str) -> dict[str, list[Any]]:
    """The columns of a role's table: floats where the column holds numbers, else text."""
    table = _node(role).GetTable()
    columns = {}
    for index in range(table.GetNumberOfColumns()):
        array = table.GetColumn(index)
        columns[array.GetName()] = [array.GetValue(row) for row in range(table.GetNumberOfRows())]
    return columns


def set_text(role: str, text: str) -> Any:
    """Replace the text of a role's node; returns the node."""
    host.check_thread()
    node = scene.find_or_create(role)
    node.SetText(text)
    return node


def _node(role: str) -> Any:
    node = scene.find(role)
    if node is None:
        writers = " or ".join(scene.role(role).writers)
        raise InputError(f"there is no {role} in the scene yet; it is made by {writers}")
    return node


def _point_columns(points: BonePoints) -> dict[str, Array]:
    """One value a point under each name. A stylus has no beam: zeros, since JSON has no NaN."""
    columns = {f"Measured_{axis}": points.positions_mm[:, k] for k, axis in enumerate(AXES)}
    for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        columns[f"Covariance_{AXES[row]}{AXES[column]}_mm2"] = points.covariances_mm2[:, row, column]
    for k, axis in enumerate(AXES):
        columns[f"Beam_{axis}"] = np.nan_to_num(points.beam_directions[:, k])
    columns.update(Depth_mm=points.depths_mm, Quality=points.qualities, Group=points.groups.astype(float))
    for k in range(points.alternative_depths_mm.shape[1]):
        given = np.isfinite(points.alternative_depths_mm[:, k])
        columns[f"OtherDepth{k + 1}_mm"] = np.where(given, points.alternative_depths_mm[:, k], -1.0)
        columns[f"OtherProbability{k + 1}"] = np.where(given, points.alternative_probabilities[:, k], 0.0)
    return columns


def _bone_points(points: LabelledPoints, columns: dict[str, Array], node: Any) -> BonePoints:
    count = len(points)
    covariances = np.zeros((count, 3, 3))
    for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
        values = columns[f"Covariance_{AXES[row]}{AXES[column]}_mm2"]
        covariances[:, row, column] = covariances[:, column, row] = values
    beams = np.stack([columns[f"Beam_{axis}"] for axis in AXES], axis=1)
    beams[np.linalg.norm(beams, axis=1) < 0.5] = np.nan
    others = sum(name.startswith("OtherDepth") for name in columns)
    depths, probabilities = np.empty((count, others)), np.empty((count, others))
    for k in range(others):
        given = columns[f"OtherDepth{k + 1}_mm"] >= 0
        depths[:, k] = np.where(given, columns[f"OtherDepth{k + 1}_mm"], np.nan)
        probabilities[:, k] = np.where(given, columns[f"OtherProbability{k + 1}"], np.nan)
    speed, speed_sd = float("nan"), 0.0
    with suppress(TypeError, ValueError):  # a hand-made node has no such attribute
        speed, speed_sd = float(node.GetAttribute(SPEED)), float(node.GetAttribute(SPEED_SD))
    return BonePoints(
        positions_mm=points.positions_mm,
        covariances_mm2=covariances,
        beam_directions=beams,
        depths_mm=columns["Depth_mm"],
        qualities=columns["Quality"],
        labels=points.labels,
        speed_of_sound_m_s=speed,
        speed_of_sound_sd_m_s=speed_sd,
        alternative_depths_mm=depths,
        alternative_probabilities=probabilities,
        groups=np.rint(columns["Group"]).astype(np.int64),
    )


def add_measurement(node: Any, name: str, values: npt.ArrayLike) -> None:
    """Keep one value (N,) a control point with a markups node; finite numbers only, JSON knows no others."""
    from vtkmodules.util.numpy_support import numpy_to_vtk

    array = numpy_to_vtk(np.ascontiguousarray(values, dtype=float), deep=True)
    array.SetName(name)
    measurement = host.slicer_package().vtkMRMLStaticMeasurement()
    measurement.SetName(name)
    measurement.SetEnabled(False)  # kept and saved, but not printed beside the points in the views
    measurement.SetControlPointValues(array)
    node.AddMeasurement(measurement)


def read_measurements(node: Any) -> dict[str, Array]:
    """The values (N,) a control point that a markups node keeps, by name."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    columns = {}
    for index in range(node.GetNumberOfMeasurements()):
        measurement = node.GetNthMeasurement(index)
        if measurement.GetControlPointValues() is not None:
            columns[measurement.GetName()] = vtk_to_numpy(measurement.GetControlPointValues()).astype(float)
    return columns


def _forget_measurements(node: Any) -> None:
    if node.GetNumberOfMeasurements():
        node.RemoveAllMeasurements()
    node.RemoveAttribute(SPEED)
    node.RemoveAttribute(SPEED_SD)
