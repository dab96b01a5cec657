"""The outer table: the part of the bone surface that a probe on the skin can reach.

Matching palpated points to the whole bone surface lets them fall onto the inner table, into sinuses and
orbits. Kept here is what looks towards the skin, has no bone between itself and the skin, and lies no deeper
than a probe reaches. Where that ends (orbits, openings, defects) a narrow margin is taken off as well.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError

from ModuleRegistrationLib.anatomy.bone import BoneMesh, BoneVoxels
from ModuleRegistrationLib.anatomy.grid import Floats, Grid, Mask
from ModuleRegistrationLib.anatomy.head import Head
from ModuleRegistrationLib.anatomy.side_by_side import in_parts

REACH_MM = 24.0  # soft tissue over the temple with its muscle is up to 15 mm; some more for a swollen scalp
FACING_COSINE = 0.5  # 60 deg: a wall steeper to the skin than this gives no echo and is no place to touch
MARCH_MM = 1.0  # step along the way to the skin; structures thinner than this are below the CT's resolution
BEYOND_MM, AT_SKIN_MM = 4.0, 2.5  # so far past the skin a place must be at most so deep: a cell of the head is 2.5 mm
BORDER_MM = 4.0  # nothing is kept this close to where the volume ends: its caps are cuts, not bone
OPENING_MM = 15.0  # an edge this long or longer is that of an opening; shorter ones are pits of the threshold
MARGIN_MM = 1.0  # taken off along such edges, where the surface bends inwards
SMALLEST_PATCH_MM2 = 400.0  # separate patches smaller than 2 x 2 cm are crumbs of face and ear

Triangles = npt.NDArray[np.int32]


def outer_table(mesh: BoneMesh, voxels: BoneVoxels, head: Head, barred: Mask) -> Triangles:
    """The triangles (M, 3) of the mesh that can be palpated.

    Parameters
    ----------
    mesh, voxels, head
        The bone and the head around it.
    barred
        The head's cells (its grid) whose bone is to be left out: metal, teeth, the jaw.

    Raises
    ------
    InputError
        Hardly anything can be reached: the volume is no head, or shows too little of it.
    """
    reachable = reachable_vertices(mesh, voxels, head, barred)
    corners = _corners(reachable, mesh.triangles)
    kept, torn = mesh.triangles[corners == 3], mesh.triangles[(corners == 1) | (corners == 2)]
    kept = _without_margins(mesh.points, kept, torn, head, voxels.grid)
    triangles = _large_patches(mesh.points, kept)
    if len(triangles) == 0:
        raise InputError("no part of the bone can be reached from the skin; the CT shows too little of the head's outside")
    return triangles


def reachable_vertices(mesh: BoneMesh, voxels: BoneVoxels, head: Head, barred: Mask) -> Mask:
    """(V,) whether a probe on the skin can reach a vertex of the bone surface."""
    grid = voxels.grid
    cells = head.cells(mesh.points, grid)
    near_skin = (head.depth_mm < REACH_MM) & ~barred
    found = np.flatnonzero(near_skin.ravel()[cells] & _clear_of_border(mesh.points, grid))
    towards = head.towards_skin[cells[found]]
    facing = np.einsum("ij,ij->i", mesh.normals[found], towards) > FACING_COSINE
    found, towards = found[facing], towards[facing]
    depth = head.depth_mm.ravel()[cells[found]]
    ends = mesh.points[found] + (depth + BEYOND_MM)[:, None] * towards
    leaves = head.depth_mm.ravel()[head.cells(ends, grid)] < AT_SKIN_MM  # not at the volume's end
    found, towards, depth = found[leaves], towards[leaves], depth[leaves]

    def clear_of_bone(part: slice) -> Mask:
        these = found[part]
        return _clear_of_bone(mesh.points[these], mesh.normals[these], towards[part], depth[part], voxels)

    clear = np.concatenate(in_parts(clear_of_bone, len(found)))
    reachable = np.zeros(len(mesh.points), dtype=bool)
    reachable[found[clear]] = True
    return reachable


def _clear_of_border(points: Floats, grid: Grid) -> Mask:
    """(N,) whether points (grid mm) are farther than BORDER_MM from the volume's six faces."""
    clear = np.ones(len(points), dtype=bool)
    for axis in range(3):
        size = (grid.shape[2 - axis] - 1) * grid.spacing_mm[2 - axis]
        clear &= (points[:, axis] > BORDER_MM) & (points[:, axis] < size - BORDER_MM)
    return clear


def _clear_of_bone(points: Floats, normals: Floats, towards: Floats, depth: Floats, voxels: BoneVoxels) -> Mask:
    """(N,) whether no bone lies between points (grid mm) and the skin, `depth` mm away along `towards`."""
    scale = (1 / voxels.grid.spacing_mm[::-1]).astype(np.float32)
    start = (points + np.float32(voxels.grid.spacing_mm.max()) * normals - voxels.corner_mm) * scale  # clear of its own voxel
    step = towards * scale * np.float32(MARCH_MM)
    steps = np.ceil(np.maximum(depth, 0) / MARCH_MM).astype(np.int32)
    dense = voxels.hu.ravel()
    size_k, size_j, size_i = voxels.hu.shape
    clear = np.ones(len(points), dtype=bool)
    going = np.arange(len(points))
    for number in range(1, int(steps.max(initial=0)) + 1):
        place = np.rint(start + np.float32(number) * step).astype(np.int32)
        within = (place[:, 0] >= 0) & (place[:, 1] >= 0) & (place[:, 2] >= 0)
        within &= (place[:, 0] < size_i) & (place[:, 1] < size_j) & (place[:, 2] < size_k)
        place[~within] = 0  # the cut-out's border is air
        blocked = dense[(place[:, 2] * size_j + place[:, 1]) * size_i + place[:, 0]] >= voxels.threshold_hu
        clear[going[blocked]] = False
        on = ~blocked & within & (steps > number)
        going, start, step, steps = going[on], start[on], step[on], steps[on]
    return clear


def _without_margins(points: Floats, kept: Triangles, torn: Triangles, head: Head, grid: Grid) -> Triangles:
    """The kept triangles without those near the edge of an opening; `torn` are those that the edge runs through."""
    from scipy import ndimage
    from scipy.spatial import cKDTree

    inside, outside = np.zeros(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    inside[kept.ravel()] = True
    outside[torn.ravel()] = True
    edge = inside & outside
    along = np.concatenate([kept[_corners(edge, kept) >= 2], torn[_corners(edge, torn) >= 2]])
    openings = _long_edges(points, along, edge)
    if len(openings) == 0:
        return kept
    cells = np.zeros(head.grid.shape, dtype=bool)  # only in these can a point be that near
    cells.ravel()[head.cells(openings, grid)] = True
    cells = ndimage.binary_dilation(cells, np.ones((3, 3, 3)), iterations=_cells(MARGIN_MM, head.grid))
    inner = np.flatnonzero(inside)
    inner = inner[cells.ravel()[head.cells(points[inner], grid)]]
    distance, _ = cKDTree(openings).query(points[inner], distance_upper_bound=MARGIN_MM)
    near = np.zeros(len(points), dtype=bool)
    near[inner[np.isfinite(distance)]] = True
    result: Triangles = kept[_corners(near, kept) == 0]
    return result


def _cells(length_mm: float, grid: Grid) -> int:
    return int(np.ceil(length_mm / grid.spacing_mm.min()))


def _long_edges(points: Floats, along: Triangles, edge: Mask) -> Floats:
    """The points of those edges, connected by the triangles `along`, whose extent is that of an opening."""
    groups = patch_labels(len(points), along)[edge]
    places = points[edge]
    order = np.argsort(groups, kind="stable")
    starts = np.flatnonzero(np.diff(groups[order], prepend=-1))
    if len(starts) == 0:
        return places
    spans = np.zeros(int(groups.max()) + 1)
    for axis in range(3):
        values = places[order, axis]
        spans[groups[order][starts]] += np.maximum.reduceat(values, starts) - np.minimum.reduceat(values, starts)
    long: Floats = places[spans[groups] >= OPENING_MM]
    return long


def _corners(marked: Mask, triangles: Triangles) -> npt.NDArray[np.int8]:
    """(T,) how many corners of each triangle are marked."""
    flags = marked.view(np.int8)
    count: npt.NDArray[np.int8] = flags[triangles[:, 0]] + flags[triangles[:, 1]] + flags[triangles[:, 2]]
    return count


def _large_patches(points: Floats, triangles: Triangles) -> Triangles:
    labels = patch_labels(len(points), triangles)[triangles[:, 0]]
    return triangles[np.bincount(labels, triangle_areas(points, triangles))[labels] >= SMALLEST_PATCH_MM2]


def triangle_areas(points: Floats, triangles: Triangles) -> Floats:
    """(T,) areas, mm^2."""
    corner = points[triangles[:, 0]]
    u, v = points[triangles[:, 1]] - corner, points[triangles[:, 2]] - corner
    squared = np.einsum("ij,ij->i", u, u) * np.einsum("ij,ij->i", v, v) - np.einsum("ij,ij->i", u, v) ** 2
    areas: Floats = 0.5 * np.sqrt(np.maximum(squared, 0))
    return areas


def patch_labels(vertex_count: int, triangles: Triangles) -> npt.NDArray[np.int32]:
    """(V,) which connected part of a mesh each vertex belongs to."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    start = np.concatenate([triangles[:, 0], triangles[:, 1]])
    end = np.concatenate([triangles[:, 1], triangles[:, 2]])
    graph = csr_matrix((np.ones(len(start), dtype=np.int8), (start, end)), shape=(vertex_count, vertex_count))
    labels: npt.NDArray[np.int32] = connected_components(graph, directed=False)[1]
    return labels
