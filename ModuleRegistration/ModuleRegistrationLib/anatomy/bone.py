"""The whole bone of a head CT: its threshold, its voxels and its closed surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.grid import Floats, Grid, Mask, pooled, subsampled
from ModuleRegistrationLib.anatomy.head import COARSE_MM, Head

SOFT_RANGE_HU = (-150, 150)  # where the soft tissue's peak is looked for
LOWEST_BONE_HU, HIGHEST_BONE_HU = 150, 2000  # the range in which bone is told from soft tissue; metal and enamel lie above
LOWEST_THRESHOLD_HU, HIGHEST_THRESHOLD_HU = 180.0, 450.0
AIR_HU = -1024
PIECES_MM = 0.9  # grid on which separate pieces are told apart
SMALLEST_PIECE_ML = 1.0  # smaller separate pieces (calcifications, hyoid, electrodes) are left out
SMALLEST_BONE_ML = 20.0  # a slab of skull a few slices thick


@dataclass(frozen=True, eq=False)
class BoneVoxels:
    """The part of a volume around the head in which everything denser than `threshold_hu` is the head's bone.

    `hu` is a copy with one voxel of air around it; its index (0, 0, 0) is the volume's voxel `origin` - 1.
    """

    hu: npt.NDArray[np.int16]
    origin: tuple[int, int, int]  # first voxel of the cut-out in the volume, order k, j, i
    grid: Grid  # of the whole volume
    threshold_hu: float
    soft_hu: float  # the soft tissue's peak

    @property
    def corner_mm(self) -> Floats:
        """(3,) grid mm of the whole volume at which `hu[0, 0, 0]` lies."""
        corner: Floats = ((np.array(self.origin) - 1) * self.grid.spacing_mm)[::-1].astype(np.float32)
        return corner


@dataclass(frozen=True, eq=False)
class BoneMesh:
    """The closed iso-surface in the grid mm of the whole volume; triangles are counter-clockwise seen in RAS from outside."""

    points: Floats  # (V, 3)
    normals: Floats  # (V, 3) unit, outward: against the gradient of the CT
    triangles: npt.NDArray[np.int32]  # (T, 3)

    def surface(self, grid: Grid, which: npt.NDArray[np.int32] | None = None) -> Surface:
        """The mesh in RAS, or the part of it that the triangles `which` (M, 3) make up."""
        if which is None:
            return Surface(grid.grid_mm_to_ras(self.points), self.triangles.astype(np.int64))
        used = np.zeros(len(self.points), dtype=bool)
        used[which.ravel()] = True
        number = np.cumsum(used) - 1
        return Surface(grid.grid_mm_to_ras(self.points[used]), number[which])


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
    values = subsampled(volume.hu, full.strides(COARSE_MM))[head.mask]
    soft = values[(values > SOFT_RANGE_HU[0]) & (values < SOFT_RANGE_HU[1])]
    dense = values[(values > LOWEST_BONE_HU) & (values < HIGHEST_BONE_HU)]
    if len(soft) < 0.2 * len(values):
        raise InputError(
            f"the CT is not in Hounsfield units: only {100 * len(soft) / len(values):.0f}% of the head lies between "
            f"{SOFT_RANGE_HU[0]} and {SOFT_RANGE_HU[1]} HU; export it with its rescale slope and intercept applied"
        )
    if len(dense) * full.coarser(full.strides(COARSE_MM)).voxel_mm3 < SMALLEST_BONE_ML * 1000:
        raise InputError("the CT holds no bone of a skull above 150 HU; give a CT of the head in Hounsfield units")
    counts, edges = np.histogram(soft, bins=60, range=SOFT_RANGE_HU)
    peak = int(np.argmax(np.convolve(counts, np.ones(5), mode="same")))
    soft_hu = float((edges[peak] + edges[peak + 1]) / 2)
    split = _otsu(dense)
    bone_hu = float(dense[dense > split].mean())
    threshold = float(np.clip(soft_hu + (bone_hu - soft_hu) / 3, LOWEST_THRESHOLD_HU, HIGHEST_THRESHOLD_HU))
    return soft_hu, threshold, bone_hu


def _otsu(values: npt.NDArray[np.int16]) -> float:
    """Otsu's threshold (IEEE Trans. SMC 9:62, 1979): the split with the largest variance between its two classes.

    Below all values where they are all the same, as in a phantom of one material.
    """
    if values.min() == values.max():
        return float(values.min()) - 1
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
    coarse = grid.strides(COARSE_MM)
    inside = _grown(head.mask)
    box = _box(inside, coarse, grid.shape)
    cut = volume.hu[box]
    dense = cut >= threshold_hu
    fine = grid.strides(PIECES_MM)
    blocks = pooled(dense, fine)
    centers = [np.minimum((np.arange(n) * s + s // 2 + part.start) // c, m - 1)
               for n, s, c, m, part in zip(blocks.shape, fine, coarse, inside.shape, box)]  # fmt: skip
    kept = _pieces(blocks & inside[np.ix_(*centers)], SMALLEST_PIECE_ML * 1000 / (grid.voxel_mm3 * float(np.prod(fine))))
    hu = np.full(tuple(n + 2 for n in cut.shape), AIR_HU, dtype=np.int16)
    inner = hu[1:-1, 1:-1, 1:-1]
    inner[...] = cut
    lowered = _lower(inner, blocks & ~kept, fine, threshold_hu, int(min(soft_hu, threshold_hu - 1)))
    if (np.count_nonzero(dense) - lowered) * grid.voxel_mm3 < SMALLEST_BONE_ML * 1000:
        raise InputError(f"the CT holds no skull denser than {threshold_hu:.0f} HU; lower the threshold or give a head CT in HU")
    return BoneVoxels(hu, (box[0].start, box[1].start, box[2].start), grid, threshold_hu, soft_hu)


def _lower(hu: npt.NDArray[np.int16], blocks: Mask, strides: tuple[int, int, int], threshold_hu: float, level_hu: int) -> int:
    """Set to `level_hu` what is at least `threshold_hu` in the marked blocks; how many voxels that were."""
    first, count = np.argwhere(blocks) * np.array(strides), 0
    for offset in np.ndindex(*strides):
        place = first + np.array(offset)
        place = place[(place < np.array(hu.shape)).all(axis=1)]
        place = place[hu[tuple(place.T)] >= threshold_hu]
        hu[tuple(place.T)] = level_hu
        count += len(place)
    return count


def bone_mesh(voxels: BoneVoxels) -> BoneMesh:
    """The closed iso-surface of the bone at the threshold."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    image: Any = vtkImageData()
    image.SetDimensions(*voxels.hu.shape[::-1])
    image.SetSpacing(*voxels.grid.spacing_mm[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(voxels.hu.ravel(), deep=False))
    contour = vtkFlyingEdges3D()
    contour.SetInputData(image)
    contour.SetValue(0, voxels.threshold_hu)
    contour.ComputeNormalsOn()
    contour.ComputeGradientsOff()
    contour.ComputeScalarsOff()
    contour.Update()
    mesh = contour.GetOutput()
    points = vtk_to_numpy(mesh.GetPoints().GetData()).astype(np.float32) + voxels.corner_mm
    normals = vtk_to_numpy(mesh.GetPointData().GetNormals()).astype(np.float32)
    triangles = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int32)
    if voxels.grid.left_handed:
        triangles = np.ascontiguousarray(triangles[:, ::-1])
    return BoneMesh(points, normals, triangles)


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


def _pieces(bone: Mask, at_least: float) -> Mask:
    """The connected pieces of a mask that have at least so many voxels."""
    from scipy import ndimage

    labels, _ = ndimage.label(bone)
    keep = np.bincount(labels.ravel()) >= at_least
    keep[0] = False
    return np.asarray(keep[labels])
