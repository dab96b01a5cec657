"""The planning CT: the head as the study's scanner protocol shows it, with titanium spheres on the skull."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from CranioNavLib.phantom import constants
from CranioNavLib.phantom.anatomy import AIR_HU
from CranioNavLib.rigid import Array
from CranioNavLib.volume import Volume

SPHERE_SUBSAMPLES = 4  # an axis, within one voxel


def scan(volume: Volume, head_mask: npt.NDArray[np.bool_], markers_ras_mm: Array, rng: np.random.Generator) -> Volume:
    """`volume` at the study's pixel and slice distance, cropped to the head, with markers and noise.

    The axes of `volume` are kept (an oblique volume stays oblique). Slices are averages over their thickness.
    """
    spacing: Array = np.linalg.norm(volume.ijk_to_ras[:3, :3], axis=0)
    wanted = np.array([constants.CT_PIXEL_MM, constants.CT_PIXEL_MM, constants.CT_SLICE_MM])
    low, high = _bounds(head_mask, spacing)
    counts = np.floor((high - low) * spacing / wanted).astype(int) + 1
    hu: npt.NDArray[np.float32] = volume.hu.astype(np.float32)
    for axis, subsamples in ((2, constants.CT_SUBSLICES), (1, 1), (0, 1)):  # k first: it makes the array smaller
        step = wanted[axis] / spacing[axis]
        matrix = _interpolation(hu.shape[2 - axis], low[axis], step, counts[axis], subsamples)
        moved = np.moveaxis(hu, 2 - axis, 0)
        flat = matrix @ moved.reshape(moved.shape[0], -1)
        hu = np.moveaxis(flat.reshape(counts[axis], *moved.shape[1:]), 0, 2 - axis)
    hu = np.ascontiguousarray(hu, dtype=np.float32)
    ijk_to_ras = volume.ijk_to_ras.copy()
    ijk_to_ras[:3, :3] *= wanted / spacing
    ijk_to_ras[:3, 3] = volume.ijk_to_ras[:3, :3] @ low + volume.ijk_to_ras[:3, 3]
    for marker in markers_ras_mm:
        _add_sphere(hu, ijk_to_ras, marker)
    hu += constants.CT_NOISE_HU * rng.standard_normal(hu.shape, dtype=np.float32)
    clipped = np.clip(np.rint(hu), constants.CT_CLIP_LOW_HU, constants.CT_CLIP_HIGH_HU).astype(np.int16)
    clipped.setflags(write=False)
    return Volume(clipped, ijk_to_ras, f"simulated planning CT of: {volume.description}")


def _bounds(mask: npt.NDArray[np.bool_], spacing: Array) -> tuple[Array, Array]:
    """First and last index (i, j, k) to scan: the head and a margin, inside the volume."""
    low, high = np.zeros(3), np.zeros(3)
    for axis in range(3):
        filled = np.flatnonzero(mask.any(axis=tuple(other for other in range(3) if other != 2 - axis)))
        margin = constants.CT_MARGIN_MM / spacing[axis]
        low[axis] = max(0.0, filled[0] - margin)
        high[axis] = min(mask.shape[2 - axis] - 1.0, filled[-1] + margin)
    return low, high


def _interpolation(size: int, first: float, step: float, count: int, subsamples: int) -> Any:
    """Sparse (count, size): linear interpolation at first + n * step, averaged over the step's width."""
    from scipy import sparse

    inner = (np.arange(subsamples) + 0.5) / subsamples - 0.5
    at = np.clip(first + (np.arange(count)[:, None] + inner) * step, 0.0, size - 1.0)
    left = np.minimum(np.floor(at).astype(int), size - 2)
    share = (at - left).ravel()
    rows = np.repeat(np.arange(count), subsamples)
    weights = np.concatenate([1 - share, share]) / subsamples
    columns = np.concatenate([left.ravel(), left.ravel() + 1])
    return sparse.csr_matrix((weights.astype(np.float32), (np.tile(rows, 2), columns)), shape=(count, size))


def _add_sphere(hu: npt.NDArray[np.float32], ijk_to_ras: Array, center_ras_mm: Array) -> None:
    """One titanium sphere: each voxel gets the share of it that is metal, blurred as the scanner does."""
    from scipy.special import erfc

    spacing: Array = np.linalg.norm(ijk_to_ras[:3, :3], axis=0)
    turn = ijk_to_ras[:3, :3] / spacing
    middle = (turn.T @ (center_ras_mm - ijk_to_ras[:3, 3])) / spacing
    radius = constants.MARKER_DIAMETER_MM / 2
    reach = (radius + 4 * constants.MARKER_BLUR_MM) / spacing + 1
    low = np.maximum(np.floor(middle - reach).astype(int), 0)
    high = np.minimum(np.ceil(middle + reach).astype(int) + 1, hu.shape[::-1])
    if (high <= low).any():
        return
    inner = (np.arange(SPHERE_SUBSAMPLES) + 0.5) / SPHERE_SUBSAMPLES - 0.5
    squares = [(((np.arange(low[a], high[a])[:, None] + inner).ravel() - middle[a]) * spacing[a]) ** 2 for a in range(3)]
    distance = np.sqrt(squares[2][:, None, None] + squares[1][None, :, None] + squares[0][None, None, :])
    fine = 0.5 * erfc((distance - radius) / (np.sqrt(2.0) * constants.MARKER_BLUR_MM))
    sizes = high - low
    blocks = fine.reshape(sizes[2], SPHERE_SUBSAMPLES, sizes[1], SPHERE_SUBSAMPLES, sizes[0], SPHERE_SUBSAMPLES)
    metal = blocks.mean(axis=(1, 3, 5)).astype(np.float32)
    part = (slice(low[2], high[2]), slice(low[1], high[1]), slice(low[0], high[0]))
    hu[part] = metal * constants.TITANIUM_HU + (1 - metal) * np.maximum(hu[part], AIR_HU)
