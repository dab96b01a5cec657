"""The voxel grid of a volume: spacing, orientation, points to RAS and back, a coarser copy.

Three ways to say where something is: RAS (mm); index (k, j, i), as arrays are subscripted, possibly fractional;
and grid millimetres (x, y, z) = (i, j, k) times the spacing, along the grid's own axes: RAS but for a rigid
motion (and a mirror, where the grid is left-handed), and what iso-surface filters work in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array
from CranioNavLib.volume import Volume

Mask = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Grid:
    """Where voxels lie."""

    shape: tuple[int, int, int]  # (K, J, I)
    ijk_to_ras: Array  # (4, 4)

    @classmethod
    def of(cls, volume: Volume) -> Grid:
        """The grid of a volume."""
        k, j, i = volume.hu.shape
        return cls((k, j, i), np.asarray(volume.ijk_to_ras, dtype=float))

    @property
    def spacing_mm(self) -> Array:
        """(3,) distance between voxels along k, j, i."""
        lengths: Array = np.linalg.norm(self.ijk_to_ras[:3, :3], axis=0)[::-1].copy()
        return lengths

    @property
    def voxel_mm3(self) -> float:
        """Volume of a voxel."""
        return float(abs(np.linalg.det(self.ijk_to_ras[:3, :3])))

    @property
    def axes(self) -> Array:
        """(3, 3) columns: unit vectors of i, j, k in RAS."""
        columns: Array = self.ijk_to_ras[:3, :3] / np.linalg.norm(self.ijk_to_ras[:3, :3], axis=0)
        return columns

    @property
    def left_handed(self) -> bool:
        """Whether the grid's axes mirror RAS."""
        return bool(np.linalg.det(self.ijk_to_ras[:3, :3]) < 0)

    def to_ras(self, kji: npt.ArrayLike) -> Array:
        """Points (N, 3) at voxel indices (N, 3), which may be fractional."""
        ijk = np.asarray(kji, dtype=float)[..., ::-1]
        points: Array = ijk @ self.ijk_to_ras[:3, :3].T + self.ijk_to_ras[:3, 3]
        return points

    def to_index(self, points_mm: npt.ArrayLike) -> Array:
        """Fractional voxel indices (N, 3), order k, j, i, of points (N, 3) in RAS."""
        inverse = np.linalg.inv(self.ijk_to_ras)
        ijk = np.asarray(points_mm, dtype=float) @ inverse[:3, :3].T + inverse[:3, 3]
        kji: Array = ijk[..., ::-1]
        return kji

    def grid_mm_to_ras(self, points: npt.ArrayLike) -> Array:
        """Points (N, 3) in RAS of points in grid millimetres."""
        moved: Array = np.asarray(points, dtype=float) @ self.axes.T + self.ijk_to_ras[:3, 3]
        return moved

    def axis_of(self, direction_ras: npt.ArrayLike) -> tuple[int, int]:
        """The array axis (0: k, 1: j, 2: i) nearest to a RAS direction, and the sign in which it grows."""
        along = np.asarray(direction_ras, dtype=float) @ self.axes
        axis = int(np.argmax(np.abs(along)))
        return 2 - axis, 1 if along[axis] > 0 else -1

    def strides(self, target_mm: float) -> tuple[int, int, int]:
        """Steps along k, j, i that bring the spacing near `target_mm`, never below one voxel."""
        k, j, i = np.maximum(1, np.round(target_mm / self.spacing_mm)).astype(int)
        return int(k), int(j), int(i)

    def coarser(self, strides: tuple[int, int, int]) -> Grid:
        """The grid of `subsampled(array, strides)`."""
        offset = np.array(strides) // 2
        k, j, i = (len(range(o, n, s)) for o, n, s in zip(offset, self.shape, strides))
        matrix = self.ijk_to_ras.copy()
        matrix[:3, :3] *= np.array(strides[::-1])
        matrix[:3, 3] = self.to_ras(offset[None].astype(float))[0]
        return Grid((k, j, i), matrix)


def subsampled(array: npt.NDArray[Any], strides: tuple[int, int, int]) -> npt.NDArray[Any]:
    """Every stride-th voxel, from the middle of the first block: fits `Grid.coarser`."""
    k, j, i = strides
    return array[k // 2 :: k, j // 2 :: j, i // 2 :: i]


def pooled(mask: Mask, strides: tuple[int, int, int]) -> Mask:
    """Whether any voxel of each block is set; blocks at the far end may be smaller."""
    for axis, stride in enumerate(strides):
        if stride > 1:
            along = np.moveaxis(mask, axis, 0)
            blocks = along[::stride].copy()
            for offset in range(1, stride):
                part = along[offset::stride]
                blocks[: len(part)] |= part
            mask = np.moveaxis(blocks, 0, axis)
    return mask


def nearest_voxels(points: npt.NDArray[Any], spacing_mm: Array, shape: tuple[int, ...]) -> npt.NDArray[np.int32]:
    """(N,) flat subscripts of the voxels nearest to points (N, 3) in grid mm; those outside go to the border."""
    flat = np.zeros(len(points), dtype=np.int32)
    for axis in range(3):  # k, j, i
        index = np.rint(points[:, 2 - axis] * np.float32(1 / spacing_mm[axis])).astype(np.int32)
        np.clip(index, 0, shape[axis] - 1, out=index)
        flat *= np.int32(shape[axis])
        flat += index
    return flat


def sample_linear(array: npt.NDArray[Any], kji: Array) -> Array:
    """Trilinear values at fractional indices (N, 3), clamped to the border. No copy of the array is made."""
    upper = np.array(array.shape) - 1
    clamped = np.clip(kji, 0, upper)
    low = np.minimum(clamped.astype(np.intp), np.maximum(upper - 1, 0))
    fraction = clamped - low
    high = np.minimum(low + 1, upper)
    flat = array.ravel()
    total = np.zeros(len(low))
    for corner in range(8):
        weight = np.ones(len(low))
        index = np.zeros(len(low), dtype=np.intp)
        for axis in range(3):
            up = corner >> axis & 1
            weight *= fraction[:, axis] if up else 1 - fraction[:, axis]
            index = index * array.shape[axis] + (high if up else low)[:, axis]
        total += weight * flat[index]
    return total
