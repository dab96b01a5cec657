"""Where the bone's edge lies between voxels: half way, in HU, from the soft tissue outside to the bone inside.

A slice of 2 mm mixes bone and soft tissue. One level for the whole CT then lies outside the true edge by an
amount that depends on the blur across the edge: little on the sides of the head, where the fine pixels cut it,
much on its top, where the slices do. At half way between the two tissues an evenly blurred edge stays in place.
"""

from __future__ import annotations

import numpy as np
from CranioNavLib.rigid import Array

from ModuleRegistrationLib.anatomy.bone import BoneMesh, BoneVoxels
from ModuleRegistrationLib.anatomy.grid import Floats
from ModuleRegistrationLib.anatomy.outer_table import Triangles
from ModuleRegistrationLib.anatomy.side_by_side import in_parts

STEP_MM = 0.25
INWARDS_MM, OUTWARDS_MM = 3.0, 3.0  # the profile across the surface: an outer table is 1 to 3 mm thick, a scalp 3 mm and more
PEAK_OUTWARDS_MM = 0.75  # the bone's peak is looked for from here inwards
SOFT_FROM_MM = 1.5  # the soft tissue's level is looked for from here outwards
FAT_HU, MUSCLE_HU = -120.0, 100.0
WELL_SEEN_PERCENT = 80.0  # of the peaks: what the table reaches where pixels or its own thickness show it unblurred
HIGHEST_SHARE = 0.75  # of a profile's own height: near its top the crossing is not sharp
LARGEST_SHIFT_MM = 1.5  # farther, the profile crosses something else
SMOOTHING_PASSES = 3  # averages over neighbouring vertices: the blur does not change from voxel to voxel, noise does


def shifted_to_edge(mesh: BoneMesh, voxels: BoneVoxels, triangles: Triangles) -> BoneMesh:
    """The mesh with the vertices of `triangles` moved along their normals to the bone's edge; the others stay."""
    used = np.zeros(len(mesh.points), dtype=bool)
    used[triangles.ravel()] = True
    found = np.flatnonzero(used)
    shift: Floats = np.zeros(len(mesh.points), dtype=np.float32)
    shift[found] = edge_shift(mesh.points[found], mesh.normals[found], voxels)
    shift = _smoothed(shift, triangles)
    return BoneMesh(mesh.points + shift[:, None] * mesh.normals, mesh.normals, mesh.triangles)


def edge_shift(points: Floats, normals: Floats, voxels: BoneVoxels) -> Floats:
    """(N,) distance (mm, outwards positive) from surface points (grid mm) to the half-way level along their normals."""
    from scipy.ndimage import map_coordinates

    steps = np.arange(-INWARDS_MM, OUTWARDS_MM + STEP_MM / 2, STEP_MM, dtype=np.float32)
    scale = (1 / voxels.grid.spacing_mm[::-1]).astype(np.float32)
    start, along = (points - voxels.corner_mm) * scale, normals * scale
    profile = np.empty((len(steps), len(points)), dtype=np.float32)

    def fill(part: slice) -> None:
        for row, step in zip(profile[:, part], steps):
            map_coordinates(voxels.hu, (start[part] + step * along[part]).T[::-1], output=row, order=1, mode="nearest")

    in_parts(fill, len(points))
    inner = steps <= PEAK_OUTWARDS_MM
    peak_at = np.argmax(profile[inner], axis=0)
    peak = np.take_along_axis(profile, peak_at[None], axis=0)[0]
    soft = np.clip(profile[steps >= SOFT_FROM_MM].min(axis=0), FAT_HU, min(MUSCLE_HU, voxels.threshold_hu - 1))
    # Blur lowers the peak of a table that is thin beside a slice, so the level of those seen well serves for all,
    # as far as the profile reaches it
    table = float(np.percentile(peak, WELL_SEEN_PERCENT))
    level = np.minimum((np.maximum(peak, table) + soft) / 2, soft + HIGHEST_SHARE * (peak - soft))
    below = (profile < level) & (np.arange(len(steps))[:, None] > peak_at)
    crossing = np.where(below.any(axis=0), below.argmax(axis=0), 0)
    after = np.take_along_axis(profile, crossing[None], axis=0)[0]
    before = np.take_along_axis(profile, np.maximum(crossing - 1, 0)[None], axis=0)[0]
    share = (before - level) / np.maximum(before - after, 1e-3)
    shift = steps[np.maximum(crossing - 1, 0)] + share * STEP_MM
    return np.where(crossing > 0, np.clip(shift, -LARGEST_SHIFT_MM, LARGEST_SHIFT_MM), 0).astype(np.float32)


def _smoothed(values: Floats, triangles: Triangles) -> Floats:
    """Values (V,) averaged with their neighbours along the triangles' edges."""
    start = np.concatenate([triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()])
    end = np.concatenate([triangles[:, [1, 2, 0]].ravel(), triangles[:, [0, 1, 2]].ravel()])
    count = np.bincount(start, minlength=len(values)) + 1
    smooth: Array = values.astype(float)
    for _ in range(SMOOTHING_PASSES):
        smooth = (smooth + np.bincount(start, smooth[end], len(values))) / count
    result: Floats = smooth.astype(np.float32)
    return result
