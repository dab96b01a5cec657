"""How a probe stands on bone: square to it, with bone under all of its body and nothing in the way of its approach."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array
from CranioNavLib.surface import Surface

PROBE_FACE_RADIUS_MM = 2.5  # 5 mm element
PROBE_BODY_RADIUS_MM = 7.0  # housing that must not meet bone beside the point
STAND_OFF_MM = 40.0  # a probe comes in from here without touching bone
LARGEST_STEP_MM = 2.5  # of the bone under the probe's body
LARGEST_ROUGHNESS_MM = 0.45  # RMS from the plane through the bone under the body


def probe_footprint(surface: Surface, positions_mm: Array, outward: Array) -> tuple[Array, Array, Array, npt.NDArray[np.bool_]]:
    """How a probe would stand on a surface at points (M, 3), coming in roughly along -`outward` (M, 3).

    Returns
    -------
    positions (M, 3) on the surface, normals (M, 3) of the plane through the bone under the probe's body,
    roughness (M,) RMS distance from that plane in mm, and (M,) whether a probe can stand there: bone under
    all of its body, no step, nothing in the way of its approach.
    """
    axis = outward
    for _ in range(2):  # the first plane straightens the approach, the second is measured along it
        offsets, heights = _heights_under_probe(surface, positions_mm, axis)
        whole = np.asarray(np.abs(heights).max(axis=1) < 2 * PROBE_BODY_RADIUS_MM)
        slopes, roughness = _fit_planes(offsets, np.where(whole[:, None], heights, 0.0))
        across, up = tangents(axis)
        normals = axis - slopes[:, :1] * across - slopes[:, 1:] * up
        axis = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    step = np.abs(heights).max(axis=1)
    good = whole & (step < LARGEST_STEP_MM) & (roughness < LARGEST_ROUGHNESS_MM)
    return positions_mm, axis, roughness, good


def tangents(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors (M, 3) each, square to `axis` (M, 3) and to each other."""
    helper = np.where(np.abs(axis[:, 2:]) < 0.9, np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0]]))
    across: Array = np.asarray(np.cross(helper, axis), dtype=float)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return across, np.asarray(np.cross(axis, across), dtype=float)


def _heights_under_probe(surface: Surface, positions: Array, axis: Array) -> tuple[Array, Array]:
    """Heights (M, R) of the bone over the plane through each point square to `axis`; offsets (R, 2) in that plane."""
    angles = np.arange(8) * np.pi / 4
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    offsets = np.concatenate([[[0.0, 0.0]], PROBE_FACE_RADIUS_MM * circle, PROBE_BODY_RADIUS_MM * circle])
    across, up = tangents(axis)
    feet = positions[:, None] + offsets[None, :, :1] * across[:, None] + offsets[None, :, 1:] * up[:, None]
    origins = feet + STAND_OFF_MM * axis[:, None]
    rays = np.broadcast_to(-axis[:, None], origins.shape)
    distances = surface.cast(origins.reshape(-1, 3), rays.reshape(-1, 3)).distances_mm.reshape(origins.shape[:2])
    return offsets, STAND_OFF_MM - distances


def _fit_planes(offsets: Array, heights: Array) -> tuple[Array, Array]:
    """Slopes (M, 2) and RMS residual (M,) of planes fitted to heights (M, R) at offsets (R, 2)."""
    design = np.column_stack([offsets, np.ones(len(offsets))])
    solution = heights @ np.linalg.pinv(design).T
    residuals: Array = heights - solution @ design.T
    slopes: Array = solution[:, :2]
    roughness: Array = np.sqrt(np.mean(residuals**2, axis=1))
    return slopes, roughness
