"""The true head behind the virtual patient: bone and skin as surfaces, from a head CT at its own resolution.

This is not the registration's segmentation, and the two share no code: the patient must not be made of what the
estimator will later assume.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from CranioNavLib.errors import InputError
from CranioNavLib.phantom import constants
from CranioNavLib.rigid import Array
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume

AIR_HU = -1024
SHAVED_MM = 2.0  # thin shells (head holder) that touch the head come loose when this much is shaved off
SMALLEST_HEAD_MM3 = 5e5  # half a litre: less is no head


@dataclass(frozen=True, eq=False)
class HeadSurfaces:
    """The true surfaces (RAS, mm, outward normals) and the region of the CT that is head."""

    bone: Surface  # closed, inner table and openings included
    skin: Surface  # closed, airways sealed
    head_mask: npt.NDArray[np.bool_]  # (K, J, I) head and air inside it; head holder and table left out


def extract_head(volume: Volume) -> HeadSurfaces:
    """Bone and skin of the head in `volume`.

    Raises
    ------
    InputError
        No head-sized body or no bone in it.
    """
    mask = head_region(volume)
    hu = volume.hu.astype(np.float32)
    voxels = _voxels(SHAVED_MM, volume)
    near = np.where(_grow(mask, voxels), hu, AIR_HU)  # the skin runs through the voxels beside the mask
    inside = mask & ~_grow(~mask, voxels)  # cells of air in here are airways, not the world outside
    skin = _iso_surface(np.where(inside, np.maximum(near, 0.0), near), volume, constants.TRUE_SKIN_HU)
    bone = _iso_surface(np.where(mask, hu, AIR_HU), volume, constants.TRUE_BONE_HU)
    return HeadSurfaces(bone, skin, mask)


def head_region(volume: Volume) -> npt.NDArray[np.bool_]:
    """(K, J, I) voxels of the head, the air inside it included; head holder, table and cushions left out."""
    from scipy import ndimage

    spacing = np.linalg.norm(volume.ijk_to_ras[:3, :3], axis=0)
    tissue = volume.hu > constants.TRUE_SKIN_HU
    voxels = _voxels(SHAVED_MM, volume)
    core = ndimage.binary_erosion(tissue, iterations=voxels)
    labels, count = ndimage.label(core)
    if count == 0:
        raise InputError("the CT holds no body: nothing in it is denser than air; give a CT of a head in HU")
    sizes = np.bincount(labels.ravel())[1:]
    body = ndimage.binary_dilation(labels == 1 + int(np.argmax(sizes)), iterations=voxels + 1) & tissue
    if body.sum() * float(np.prod(spacing)) < SMALLEST_HEAD_MM3:
        raise InputError("the CT holds no head: its largest body is smaller than half a litre; give a CT of a whole head")
    radius = max(1, round(constants.NOSE_AND_EAR_SEAL_MM / 2 / float(spacing[0])))
    box = ndimage.find_objects(body)[0]
    filled = np.zeros_like(body)
    filled[box] = np.stack([_sealed(section, radius) for section in body[box]])
    region: npt.NDArray[np.bool_] = filled
    return region


def _sealed(section: npt.NDArray[np.bool_], radius: int) -> npt.NDArray[np.bool_]:
    """An axial section of the body with openings narrower than 2 * radius pixels closed, and what lies inside filled."""
    from scipy import ndimage

    padded = np.pad(section, 2 * radius + 1)
    grown = ndimage.distance_transform_edt(~padded) <= radius
    closed = ndimage.distance_transform_edt(grown) > radius
    outside, _ = ndimage.label(~(closed | padded))
    inner = slice(2 * radius + 1, -2 * radius - 1)
    filled: npt.NDArray[np.bool_] = (outside != outside[0, 0])[inner, inner]
    return filled


def _voxels(length_mm: float, volume: Volume) -> int:
    return max(1, round(length_mm / float(np.linalg.norm(volume.ijk_to_ras[:3, :3], axis=0).min())))


def _grow(mask: npt.NDArray[np.bool_], voxels: int) -> npt.NDArray[np.bool_]:
    from scipy import ndimage

    grown: npt.NDArray[np.bool_] = ndimage.binary_dilation(mask, iterations=voxels)
    return grown


def _iso_surface(values: npt.NDArray[Any], volume: Volume, level: float) -> Surface:
    """The largest closed piece of an iso-surface of `values` (on the volume's grid), smoothed, in RAS."""
    # a border of air closes the surface where the scan ends
    vertices, triangles = _contour(np.pad(values.astype(np.float32), 1, constant_values=AIR_HU), level)
    if len(triangles) == 0:
        raise InputError(f"nothing in the CT reaches {level:.0f} HU; give a CT of a head in HU")
    ras = (vertices - 1.0) @ volume.ijk_to_ras[:3, :3].T + volume.ijk_to_ras[:3, 3]
    surface = Surface(ras, triangles)
    return surface if _enclosed_volume_mm3(surface) > 0 else Surface(ras, np.ascontiguousarray(triangles[:, ::-1]))


def _contour(values: npt.NDArray[np.float32], level: float) -> tuple[Array, npt.NDArray[np.int64]]:
    """Largest connected iso-surface in index coordinates (i, j, k), smoothed by a windowed sinc."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D, vtkPolyDataConnectivityFilter, vtkWindowedSincPolyDataFilter

    image = vtkImageData()
    image.SetDimensions(values.shape[2], values.shape[1], values.shape[0])
    image.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(values).ravel(), deep=True))
    contour = vtkFlyingEdges3D()
    contour.SetInputData(image)
    contour.SetValue(0, level)
    contour.ComputeNormalsOff()
    largest = vtkPolyDataConnectivityFilter()
    largest.SetInputConnection(contour.GetOutputPort())
    largest.SetExtractionModeToLargestRegion()
    smooth = vtkWindowedSincPolyDataFilter()
    smooth.SetInputConnection(largest.GetOutputPort())
    smooth.SetNumberOfIterations(constants.SURFACE_SMOOTHING_ITERATIONS)
    smooth.SetPassBand(constants.SURFACE_SMOOTHING_PASS_BAND)
    smooth.NormalizeCoordinatesOn()
    smooth.Update()
    mesh = smooth.GetOutput()
    if mesh.GetNumberOfPolys() == 0:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    points = vtk_to_numpy(mesh.GetPoints().GetData()).astype(float)
    return points, vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)


def _enclosed_volume_mm3(surface: Surface) -> float:
    """Signed volume: positive when normals point outwards."""
    a, b, c = (surface.vertices_mm[surface.triangles[:, k]] - surface.center_mm for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)
