"""The outer table: the part of the bone surface that a probe on the skin can reach.

Matching palpated points to the whole bone surface lets them fall onto the inner table, into sinuses and
orbits. Kept here is what looks towards the skin, has no bone between itself and the skin, and lies no deeper
than a probe reaches.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.surface import Surface

from ModuleRegistrationLib.anatomy.bone import BoneVoxels
from ModuleRegistrationLib.anatomy.grid import Grid, Mask, sample
from ModuleRegistrationLib.anatomy.head import Head

REACH_MM = 22.0  # soft tissue over the temple with its muscle is up to 15 mm; some more for a swollen scalp
FACING_COSINE = 0.5  # 60 deg: a wall steeper to the skin than this gives no echo and is no place to touch
MARCH_MM = 1.0  # step along the way to the skin; structures thinner than this are below the CT's resolution
BORDER_MM = 4.0  # nothing is kept this close to where the volume ends: its caps are cuts, not bone
SMALLEST_PATCH_MM2 = 400.0  # separate patches smaller than 2 x 2 cm are crumbs of face and ear


def outer_table(closed: Surface, voxels: BoneVoxels, grid: Grid, head: Head) -> Surface:
    """The part of `closed` that can be palpated.

    Raises
    ------
    InputError
        Hardly anything can be reached: the volume is no head, or shows too little of it.
    """
    reachable = reachable_vertices(closed, voxels, grid, head)
    triangles = closed.triangles[reachable[closed.triangles].all(axis=1)]
    triangles = _large_patches(closed.vertices_mm, triangles)
    if len(triangles) == 0:
        raise InputError("no part of the bone can be reached from the skin; the CT shows too little of the head's outside")
    return _compact(closed.vertices_mm, triangles)


def reachable_vertices(closed: Surface, voxels: BoneVoxels, grid: Grid, head: Head) -> Mask:
    """(V,) whether a probe on the skin can reach a vertex of the bone surface."""
    points = closed.vertices_mm
    depth = head.depth_at(points)
    index = grid.to_index(points)
    margin = np.minimum(index, np.array(grid.shape) - 1 - index) * grid.spacing_mm
    found = np.flatnonzero((depth < REACH_MM) & (margin.min(axis=1) > BORDER_MM))
    towards = head.towards_skin(points[found])
    facing = np.einsum("ij,ij->i", closed.vertex_normals[found], towards) > FACING_COSINE
    found, towards = found[facing], towards[facing]
    seen = _sees_skin(points[found], closed.vertex_normals[found], towards, voxels, grid, head)
    reachable = np.zeros(len(points), dtype=bool)
    reachable[found[seen]] = True
    return reachable


def _sees_skin(points: Array, normals: Array, towards: Array, voxels: BoneVoxels, grid: Grid, head: Head) -> Mask:
    """(N,) whether the way from a bone point along `towards` leaves the head without meeting bone."""
    origin = np.asarray(voxels.to_index(grid.to_index(points)))
    start = float(grid.spacing_mm.max()) * normals  # clear of the voxel that the point itself lies in
    towards_index = grid.to_index(towards) - grid.to_index(np.zeros((1, 3)))
    origin += grid.to_index(start) - grid.to_index(np.zeros((1, 3)))
    scale = grid.spacing_mm / head.grid.spacing_mm
    to_head = head.grid.to_index(points + start)
    seen = np.zeros(len(points), dtype=bool)
    going = np.arange(len(points))
    for step in np.arange(MARCH_MM, 1.5 * REACH_MM, MARCH_MM):
        blocked = sample(voxels.hu, origin[going] + step * towards_index[going]) >= voxels.threshold_hu
        outside = ~sample(head.mask, to_head[going] + step * towards_index[going] * scale).astype(bool)
        seen[going[outside & ~blocked]] = True
        going = going[~blocked & ~outside]
        if len(going) == 0:
            break
    return seen


def _large_patches(vertices: Array, triangles: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    labels = patch_labels(len(vertices), triangles)[triangles[:, 0]]
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return triangles[np.bincount(labels, areas)[labels] >= SMALLEST_PATCH_MM2]


def patch_labels(vertex_count: int, triangles: npt.NDArray[np.int64]) -> npt.NDArray[np.int32]:
    """(V,) which connected part of a mesh each vertex belongs to."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    start = np.concatenate([triangles[:, 0], triangles[:, 1]])
    end = np.concatenate([triangles[:, 1], triangles[:, 2]])
    graph = coo_matrix((np.ones(len(start), dtype=bool), (start, end)), shape=(vertex_count, vertex_count))
    labels: npt.NDArray[np.int32] = connected_components(graph, directed=False)[1]
    return labels


def _compact(vertices: Array, triangles: npt.NDArray[np.int64]) -> Surface:
    """A surface of the vertices that the triangles use."""
    used = np.zeros(len(vertices), dtype=bool)
    used[triangles] = True
    number = np.cumsum(used) - 1
    return Surface(vertices[used], number[triangles])
