"""The whole bone of a head CT: its threshold, its voxels and its closed surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.grid import Grid, Mask, subsampled
from ModuleRegistrationLib.anatomy.head import Head

SOFT_RANGE_HU = (-150, 150)  # where the soft tissue's peak is looked for
LOWEST_BONE_HU, HIGHEST_BONE_HU = 150, 2000  # the range in which bone is told from soft tissue; metal and enamel lie above
LOWEST_THRESHOLD_HU, HIGHEST_THRESHOLD_HU = 180.0, 450.0
SMALLEST_PIECE_ML = 1.0  # smaller separate pieces (calcifications, hyoid, electrodes) are left out
SMALLEST_BONE_ML = 20.0  # a slab of skull a few slices thick


@dataclass(frozen=True, eq=False)
class BoneVoxels:
    """The part of a volume around the head in which everything denser than `threshold_hu` is the head's bone.

    `hu` is a copy with one voxel of air around it; its index (0, 0, 0) is the volume's voxel `origin` - 1.
    """

    hu: npt.NDArray[np.int16]
    origin: tuple[int, int, int]  # first voxel of the cut-out in the volume, order k, j, i
    threshold_hu: float
    soft_hu: float  # the soft tissue's peak

    def to_index(self, kji: Array) -> Array:
        """Indices into `hu` for fractional indices (N, 3) of the whole volume."""
        shifted: Array = kji - (np.array(self.origin) - 1)
        return shifted


def tissue_levels(volume: Volume, head: Head) -> tuple[float, float, float]:
    """The head's soft tissue peak, bone threshold and bone level, HU.

    The bone level is the mean of what Otsu's criterion, applied to the range of bone, calls dense bone; the
    threshold lies a third of the way from soft tissue to it, within fixed bounds: at half way, the level of
    an ideal edge, thin and spongy parts of the outer table would be lost at 2 mm slices.

    Raises
    ------
    InputError
        The values in the head are not Hounsfield units of a head, or it has no bone.
    """
    full = Grid.of(volume)
    values = subsampled(volume.hu, full.strides(2.5))[head.mask]
    soft = values[(values > SOFT_RANGE_HU[0]) & (values < SOFT_RANGE_HU[1])]
    dense = values[(values > LOWEST_BONE_HU) & (values < HIGHEST_BONE_HU)]
    if len(soft) < 0.2 * len(values):
        raise InputError(
            f"the CT is not in Hounsfield units: only {100 * len(soft) / len(values):.0f}% of the head lies between "
            f"{SOFT_RANGE_HU[0]} and {SOFT_RANGE_HU[1]} HU; export it with its rescale slope and intercept applied"
        )
    if len(dense) * full.coarser(full.strides(2.5)).voxel_mm3 < SMALLEST_BONE_ML * 1000:
        raise InputError("the CT holds no bone of a skull above 150 HU; give a CT of the head in Hounsfield units")
    counts, edges = np.histogram(soft, bins=60, range=SOFT_RANGE_HU)
    peak = int(np.argmax(np.convolve(counts, np.ones(5), mode="same")))
    soft_hu = float((edges[peak] + edges[peak + 1]) / 2)
    split = _otsu(dense)
    bone_hu = float(dense[dense > split].mean())
    threshold = float(np.clip(soft_hu + (bone_hu - soft_hu) / 3, LOWEST_THRESHOLD_HU, HIGHEST_THRESHOLD_HU))
    return soft_hu, threshold, bone_hu


def _otsu(values: npt.NDArray[np.int16]) -> float:
    """Otsu's threshold (IEEE Trans. SMC 9:62, 1979): the split with the largest variance between its two classes."""
    counts, edges = np.histogram(values, bins=128)
    centers = (edges[1:] + edges[:-1]) / 2
    below = np.cumsum(counts)
    above = below[-1] - below
    sums = np.cumsum(counts * centers)
    with np.errstate(divide="ignore", invalid="ignore"):
        between = below * above * (sums / below - (sums[-1] - sums) / above) ** 2
    return float(edges[1 + int(np.nanargmax(between))])


def bone_voxels(volume: Volume, head: Head, threshold_hu: float, soft_hu: float) -> BoneVoxels:
    """The head's bone cut out of the volume, everything else denser than the threshold lowered to soft tissue.

    Raises
    ------
    InputError
        Nothing of a skull's size is denser than the threshold.
    """
    grid = Grid.of(volume)
    strides = grid.strides(2.5)
    inside = _grown(head.mask)
    box = _box(inside, strides, grid.shape)
    hu = np.pad(volume.hu[box], 1, constant_values=-1024)
    bone = np.zeros(hu.shape, dtype=bool)
    bone[1:-1, 1:-1, 1:-1] = (volume.hu[box] >= threshold_hu) & _refined(inside, strides, box)
    kept = _pieces(bone, SMALLEST_PIECE_ML * 1000 / grid.voxel_mm3)
    if kept.sum() * grid.voxel_mm3 < SMALLEST_BONE_ML * 1000:
        raise InputError(f"the CT holds no skull denser than {threshold_hu:.0f} HU; lower the threshold or give a head CT in HU")
    hu[(hu >= threshold_hu) & ~kept] = min(soft_hu, threshold_hu - 1)
    return BoneVoxels(hu, (box[0].start, box[1].start, box[2].start), threshold_hu, soft_hu)


def closed_surface(voxels: BoneVoxels, grid: Grid) -> Surface:
    """The closed iso-surface of the bone at the threshold, outward normals, RAS."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    image: Any = vtkImageData()
    image.SetDimensions(*voxels.hu.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(voxels.hu.ravel(), deep=False))
    contour = vtkFlyingEdges3D()
    contour.SetInputData(image)
    contour.SetValue(0, voxels.threshold_hu)
    contour.ComputeNormalsOff()
    contour.ComputeGradientsOff()
    contour.ComputeScalarsOff()
    contour.Update()
    mesh = contour.GetOutput()
    ijk = vtk_to_numpy(mesh.GetPoints().GetData()).astype(float)
    kji = ijk[:, ::-1] + (np.array(voxels.origin) - 1)
    triangles = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    vertices = grid.to_ras(kji)
    if _signed_volume(vertices, triangles) < 0:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
    return Surface(vertices, triangles)


def _signed_volume(vertices: Array, triangles: npt.NDArray[np.int64]) -> float:
    a, b, c = (vertices[triangles[:, corner]] - vertices[0] for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


def _grown(mask: Mask) -> Mask:
    from scipy import ndimage

    return np.asarray(ndimage.binary_dilation(mask), dtype=bool)


def _box(mask: Mask, strides: tuple[int, int, int], shape: tuple[int, int, int]) -> tuple[slice, slice, slice]:
    """The box of full-resolution voxels that holds a coarse mask."""
    slices = []
    for axis, (stride, size) in enumerate(zip(strides, shape)):
        used = np.flatnonzero(mask.any(axis=tuple(other for other in range(3) if other != axis)))
        last = size if used[-1] == mask.shape[axis] - 1 else (used[-1] + 1) * stride
        slices.append(slice(int(used[0] * stride), int(min(last, size))))
    return slices[0], slices[1], slices[2]


def _refined(mask: Mask, strides: tuple[int, int, int], box: tuple[slice, slice, slice]) -> Mask:
    """A coarse mask at full resolution, inside `box`."""
    for axis, (stride, part) in enumerate(zip(strides, box)):
        index = np.minimum(np.arange(part.start, part.stop) // stride, mask.shape[axis] - 1)
        mask = np.take(mask, index, axis=axis)
    return mask


def _pieces(bone: Mask, at_least: float) -> Mask:
    """The connected pieces of a mask that have at least so many voxels."""
    from scipy import ndimage

    labels, _ = ndimage.label(bone)
    keep = np.bincount(labels.ravel()) >= at_least
    keep[0] = False
    return np.asarray(keep[labels])
