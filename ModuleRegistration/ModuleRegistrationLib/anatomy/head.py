"""The head in a CT: what is patient, how deep a point lies under the skin, and which way the skin is."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.grid import Floats, Grid, Mask, nearest_voxels, sample_linear, subsampled

AIR_TISSUE_HU = -300  # above foam cushions (about -650) and hair, below fat (-120)
COARSE_MM = 2.5
NECK_MM = 5.0  # what hangs on the head by less than twice this (holder, straps, tubes, ear rims) is cut off
REGROW_MM = 5.0  # how far the cut is undone along the tissue, so that nose and brow keep their shape
ORIFICE_MM = 7.5  # nostrils and ear canals up to twice this wide are closed
SINUS_MM2 = 4000.0  # an air space within one slice up to this area belongs to the head (a nasal cavity has about 1500)
SMALLEST_HEAD_ML, LARGEST_HEAD_ML = 150.0, 20000.0  # a slab of a small head; a head with shoulders
MOST_AIR_ML = 2500.0  # the empty cranium of a dry skull holds up to 1900 ml, the lungs of a breath held 3000 and more


@dataclass(frozen=True, eq=False)
class Head:
    """The patient's tissue on a grid of about 2.5 mm, air-filled cavities included."""

    grid: Grid
    mask: Mask  # (K, J, I)
    depth_mm: npt.NDArray[np.float32]  # (K, J, I) distance to the skin: positive inside, negative outside

    def depth_at(self, points_mm: Array) -> Array:
        """(N,) depth under the skin of points (N, 3) in RAS, mm; negative outside the head."""
        return sample_linear(self.depth_mm, self.grid.to_index(points_mm))

    def contains(self, points_mm: Array) -> Mask:
        """(N,) whether points (N, 3) in RAS lie in the head."""
        return np.asarray(self.depth_at(points_mm) > 0)

    @cached_property
    def towards_skin(self) -> Floats:
        """(K * J * I, 3) unit vectors (grid mm: x, y, z) to where the skin is nearest, smoothed over about 5 mm."""
        from scipy import ndimage

        smooth = ndimage.gaussian_filter(np.clip(self.depth_mm, -60, 60), 2.0 / self.grid.spacing_mm, truncate=2.0)
        slopes = np.gradient(smooth, *self.grid.spacing_mm.astype(np.float32))
        field = np.stack([-slope.ravel() for slope in slopes[::-1]], axis=1)
        field /= np.maximum(np.sqrt(np.einsum("ij,ij->i", field, field)), 1e-6)[:, None]
        return np.asarray(field, dtype=np.float32)

    def cells(self, points: Floats, full: Grid) -> npt.NDArray[np.int32]:
        """(N,) flat subscripts of the head's cells nearest to points (N, 3) in the grid mm of the whole volume."""
        offset = (self.grid.ijk_to_ras[:3, 3] - full.ijk_to_ras[:3, 3]) @ full.axes
        return nearest_voxels(points - offset.astype(np.float32), self.grid.spacing_mm, self.grid.shape)


def find_head(volume: Volume) -> Head:
    """The head, without holder, table, cushions and air; its sinuses and orifices belong to it.

    Raises
    ------
    InputError
        Nothing of a head's size is denser than air, or it encloses lungs.
    """
    full = Grid.of(volume)
    strides = full.strides(COARSE_MM)
    grid = full.coarser(strides)
    if not (subsampled(volume.hu, strides) < 2 * AIR_TISSUE_HU).any():
        raise InputError(
            f"the CT shows no air: its lowest value is {int(volume.hu.min())} HU; "
            "it is not in Hounsfield units, or cropped inside the head"
        )
    tissue = _fill_slices(subsampled(volume.hu, strides) > AIR_TISSUE_HU, grid, SINUS_MM2)
    spacing = grid.spacing_mm
    core = _largest(_eroded(tissue, NECK_MM, grid))
    volume_ml = float(core.sum()) * grid.voxel_mm3 / 1000
    if volume_ml < SMALLEST_HEAD_ML:
        raise InputError(
            f"the CT holds no head: the largest connected tissue is {volume_ml:.0f} ml, expected at least "
            f"{SMALLEST_HEAD_ML:.0f} ml; give a CT of the head in Hounsfield units"
        )
    if volume_ml > LARGEST_HEAD_ML:
        raise InputError(
            f"the CT's tissue is {volume_ml / 1000:.1f} l, more than a head; check the voxel spacing "
            f"({', '.join(f'{s:.2f}' for s in full.spacing_mm[::-1])} mm) and give a CT of the head"
        )
    mask = _fill(_dilated(core, NECK_MM + REGROW_MM, grid, tissue), grid)
    air_ml = float((subsampled(volume.hu, strides)[mask] < 2 * AIR_TISSUE_HU).sum()) * grid.voxel_mm3 / 1000
    if air_ml > MOST_AIR_ML:
        raise InputError(
            f"the CT is no head: its tissue encloses {air_ml / 1000:.1f} l of air, as a chest does; give a CT of the head"
        )
    half = np.float32(spacing.mean() / 2)  # distances are between the cells' centres, the skin is half way
    depth = np.where(mask, distance_to(~mask, spacing) - half, half - distance_to(mask, spacing))
    return Head(grid, mask, depth.astype(np.float32, copy=False))


def distance_to(mask: Mask, spacing_mm: Array) -> Floats:
    """Distance (mm) of each voxel's centre to the nearest voxel of a mask; 0 in it, inf where the mask is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf, dtype=np.float32)
    if mask.all():
        return np.zeros(mask.shape, dtype=np.float32)
    sitk: Any = importlib.import_module("SimpleITK")
    image = sitk.GetImageFromArray(mask.view(np.uint8))
    image.SetSpacing([float(s) for s in spacing_mm[::-1]])
    distance = sitk.SignedMaurerDistanceMap(image, insideIsPositive=False, squaredDistance=False, useImageSpacing=True)
    outside: Floats = np.maximum(sitk.GetArrayViewFromImage(distance), np.float32(0)).astype(np.float32, copy=False)
    return outside


def _largest(mask: Mask) -> Mask:
    from scipy import ndimage

    labels, count = ndimage.label(mask)
    if count == 0:
        return mask
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.asarray(labels == int(np.argmax(sizes)))


def _eroded(mask: Mask, by_mm: float, grid: Grid) -> Mask:
    """The mask without its outer `by_mm`, in whole cells; the array's border is no edge of it."""
    from scipy import ndimage

    return np.asarray(ndimage.binary_erosion(mask, iterations=_cells(by_mm, grid), border_value=1), dtype=bool)


def _dilated(mask: Mask, by_mm: float, grid: Grid, within: Optional[Mask] = None) -> Mask:
    """The mask grown by `by_mm`, in whole cells, inside another mask where one is given."""
    from scipy import ndimage

    return np.asarray(ndimage.binary_dilation(mask, iterations=_cells(by_mm, grid), mask=within), dtype=bool)


def _cells(length_mm: float, grid: Grid) -> int:
    return max(1, round(length_mm / float(grid.spacing_mm.mean())))


def _fill(body: Mask, grid: Grid) -> Mask:
    """`body` with orifices closed and cavities filled, those that a clipped end opens included."""
    from scipy import ndimage

    cells = round(2 * ORIFICE_MM / float(grid.spacing_mm.min()))
    closed = _eroded(_dilated(np.pad(body, cells), ORIFICE_MM, grid), ORIFICE_MM, grid)
    inner = (slice(cells, -cells),) * 3
    mask = _fill_slices(body | closed[inner], grid, np.inf)
    return np.asarray(ndimage.binary_fill_holes(mask), dtype=bool)


def _fill_slices(mask: Mask, grid: Grid, up_to_mm2: float) -> Mask:
    """`mask` with the holes of its transverse slices filled that are no larger than `up_to_mm2`.

    Slice by slice, because the airway leaves the volume through the lowest slice.
    """
    from scipy import ndimage

    axis, _ = grid.axis_of((0.0, 0.0, 1.0))
    cell_mm2 = grid.voxel_mm3 / grid.spacing_mm[axis]
    empty = np.moveaxis(~mask, axis, 0)
    in_slice = np.zeros((3, 3, 3), dtype=bool)
    in_slice[1] = ndimage.generate_binary_structure(2, 1)
    labels, count = ndimage.label(empty, structure=in_slice)
    keep = np.bincount(labels.ravel(), minlength=count + 1) * cell_mm2 > up_to_mm2
    for border in (labels[:, 0], labels[:, -1], labels[:, :, 0], labels[:, :, -1]):
        keep[border.ravel()] = True
    keep[0] = False
    return np.moveaxis(~keep[labels], 0, axis)
