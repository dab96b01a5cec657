"""Signed distance of points from the skull and the direction in which it changes: exact on the triangles, or by planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array
from CranioNavLib.surface import Surface

OFF_NORMAL_COSINE = 0.7  # a gap that leans more than 45 deg from the normal ends at an edge or a hole, not on the table
SMALL_GAP_MM = 0.05  # the direction of a shorter gap is rounding
PLANE_REACH_MM = 6.0  # sideways; a point farther from the middle of its plane hangs over a hole or beyond the surface


@dataclass(frozen=True, eq=False)
class Feet:
    """Where points meet the surface."""

    distances_mm: Array  # (N,) signed, + outside the bone
    directions: Array  # (N, 3) unit, the distance's gradient
    at_edge: npt.NDArray[np.bool_]  # (N,) the closest point lies on a rim: the point hangs over a hole or beyond the surface


def find_feet(surface: Surface, points_ras_mm: Array) -> Feet:
    """Feet of points (N, 3) on the surface.

    Above the table the direction is the normal interpolated between the vertices, which is smoother than the
    facets that marching cubes leaves between the slices; at a rim it is the direction of the gap itself, so that
    sliding over a hole costs the distance to its rim.
    """
    closest = surface.closest(points_ras_mm)
    gap = points_ras_mm - closest.points_mm
    normals = smooth_normals(surface, closest.points_mm, closest.triangles)
    along = np.einsum("ij,ij->i", gap, normals)
    length = closest.distances_mm
    at_edge = (length > SMALL_GAP_MM) & (np.abs(along) < OFF_NORMAL_COSINE * length)
    side = np.where(along < 0, -1.0, 1.0)
    distances = np.where(at_edge, side * length, along)
    tilted = side[:, None] * gap / np.maximum(length, SMALL_GAP_MM)[:, None]
    return Feet(distances, np.where(at_edge[:, None], tilted, normals), at_edge)


def find_feet_on_planes(surface: Surface, points_ras_mm: Array) -> Feet:
    """Feet of points (N, 3) on planes through triangles taken evenly from the surface: good enough to search with."""
    tree, middles, normals = surface.planes
    length, nearest = tree.query(points_ras_mm)
    gap, direction = points_ras_mm - middles[nearest], normals[nearest]
    along = np.einsum("ij,ij->i", gap, direction)
    at_edge = length**2 - along**2 > PLANE_REACH_MM**2
    side = np.where(along < 0, -1.0, 1.0)
    tilted = side[:, None] * gap / np.maximum(length, SMALL_GAP_MM)[:, None]
    return Feet(np.where(at_edge, side * length, along), np.where(at_edge[:, None], tilted, direction), at_edge)


def smooth_normals(surface: Surface, on_surface_mm: Array, triangles: npt.NDArray[np.int64]) -> Array:
    """(N, 3) vertex normals interpolated at points (N, 3) of known triangles (N,)."""
    corners = surface.triangles[triangles]
    a = surface.vertices_mm[corners[:, 0]]
    ab, ac = surface.vertices_mm[corners[:, 1]] - a, surface.vertices_mm[corners[:, 2]] - a
    ap = on_surface_mm - a
    d00, d01, d11 = (np.einsum("ij,ij->i", u, v) for u, v in ((ab, ab), (ab, ac), (ac, ac)))
    d20, d21 = np.einsum("ij,ij->i", ap, ab), np.einsum("ij,ij->i", ap, ac)
    area = np.maximum(d00 * d11 - d01 * d01, 1e-20)
    v = np.clip((d11 * d20 - d01 * d21) / area, 0, 1)
    w = np.clip((d00 * d21 - d01 * d20) / area, 0, 1)
    shares = np.stack([np.clip(1 - v - w, 0, 1), v, w], axis=1)
    normals = np.einsum("nc,ncj->nj", shares, surface.vertex_normals[corners])
    unit: Array = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    return unit
