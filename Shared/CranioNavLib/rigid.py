"""Rigid transforms and points: checked at the border, applied everywhere.

A transform `a_to_b` is a 4x4 matrix that acts on column vectors: `p_b = a_to_b @ p_a` (mm).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy  # by its own name: its parts load when they are first used, after the start

from CranioNavLib.errors import InputError

Array = npt.NDArray[np.float64]

ORTHONORMAL_TOLERANCE = 1e-3  # TX replies carry four decimals of a quaternion; files from other tools carry six digits
LARGEST_COORDINATE_MM = 1e5  # a hundred metres: nothing in an operating room is farther from its camera


def check_points(points: npt.ArrayLike, name: str = "points", at_least: int = 0) -> Array:
    """`points` as a finite float array of shape (N, 3), mm.

    Raises
    ------
    InputError
        Another shape, fewer than `at_least`, a value that is not finite or farther than 100 m.
    """
    array = np.asarray(points, dtype=float)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"expected {name} of shape (N, 3), got {array.shape}")
    if len(array) < at_least:
        raise InputError(f"expected at least {at_least} {name}, got {len(array)}; add the missing ones")
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        raise InputError(
            f"{name}: number {int(np.argmax(bad)) + 1} has a coordinate that is not a finite number; remove or measure it again"
        )
    if array.size and np.abs(array).max() > LARGEST_COORDINATE_MM:
        worst = int(np.argmax(np.abs(array).max(axis=1))) + 1
        raise InputError(f"{name}: number {worst} lies {np.abs(array).max():.3g} mm away; coordinates are expected in mm")
    return array


def check_rigid(matrix: npt.ArrayLike, name: str = "transform") -> Array:
    """`matrix` as a rigid 4x4 transform with an exactly orthonormal rotation.

    Raises
    ------
    InputError
        Not 4x4, not finite, transposed, mirrored, scaled or sheared; the message says which.
    """
    array = np.array(matrix, dtype=float)
    if array.shape != (4, 4):
        raise InputError(f"expected {name} as a 4x4 matrix, got shape {array.shape}")
    if _is_exactly_rigid(array):  # poses come hundreds of times a second
        return array
    if not np.isfinite(array).all():
        raise InputError(f"{name} holds a value that is not a finite number")
    if not np.allclose(array[3], (0, 0, 0, 1), atol=1e-6):
        if np.allclose(array[:3, 3], 0, atol=1e-6):
            raise InputError(f"{name} looks transposed: its translation stands in the last row; give it row by row")
        raise InputError(f"{name} is not affine: its last row is {array[3].tolist()}, expected 0 0 0 1")
    rotation = array[:3, :3]
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{name} mirrors (its determinant is negative); check for swapped or flipped axes")
    left, singular, right = np.linalg.svd(rotation)
    if np.abs(singular - 1).max() > ORTHONORMAL_TOLERANCE:
        raise InputError(f"{name} is not rigid: it scales by {singular.min():.4f} to {singular.max():.4f}; expected 1")
    array[:3, :3] = left @ right
    array[3] = (0, 0, 0, 1)
    return array


def _is_exactly_rigid(matrix: Array) -> bool:
    """Whether a 4x4 is rigid to rounding; False, too, for values that are not finite."""
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = matrix.tolist()
    return (
        last == [0.0, 0.0, 0.0, 1.0]
        and math.isfinite(x + y + z)
        and abs(a * a + b * b + c * c - 1) < 1e-12
        and abs(d * d + e * e + f * f - 1) < 1e-12
        and abs(g * g + h * h + i * i - 1) < 1e-12
        and abs(a * d + b * e + c * f) < 1e-12
        and abs(a * g + b * h + c * i) < 1e-12
        and abs(d * g + e * h + f * i) < 1e-12
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0
    )


def rigid(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> Array:
    """4x4 transform(s) from rotation(s) (..., 3, 3) and translation(s) (..., 3) in mm."""
    rotation, translation = np.asarray(rotation, dtype=float), np.asarray(translation, dtype=float)
    matrix = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    matrix[..., :3, :3] = rotation
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1.0
    return matrix


def rigid_from_vector(rotation_vector: npt.ArrayLike, translation: npt.ArrayLike, pivot: npt.ArrayLike = (0, 0, 0)) -> Array:
    """Transform(s) that rotate about `pivot` (mm) by a rotation vector (rad), then translate (mm). Batched."""
    turn = scipy.spatial.transform.Rotation.from_rotvec(np.asarray(rotation_vector, dtype=float)).as_matrix()
    pivot = np.asarray(pivot, dtype=float)
    return rigid(turn, np.asarray(translation, dtype=float) + pivot - np.einsum("...ij,...j->...i", turn, pivot))


def invert_rigid(matrix: npt.ArrayLike) -> Array:
    """Inverse of rigid transform(s), shape (..., 4, 4)."""
    matrix = np.asarray(matrix, dtype=float)
    if matrix.shape == (4, 4):  # poses come hundreds of times a second
        inverse = np.zeros((4, 4))
        inverse[:3, :3] = matrix[:3, :3].T
        inverse[:3, 3] = -inverse[:3, :3] @ matrix[:3, 3]
        inverse[3, 3] = 1.0
        return inverse
    transposed = np.swapaxes(matrix[..., :3, :3], -1, -2)
    return rigid(transposed, -np.einsum("...ij,...j->...i", transposed, matrix[..., :3, 3]))


def transform_points(matrix: npt.ArrayLike, points: npt.ArrayLike) -> Array:
    """Points (N, 3) mapped by a transform (4, 4), or by each of several (..., 4, 4) giving (..., N, 3)."""
    matrix, points = np.asarray(matrix, dtype=float), np.asarray(points, dtype=float)
    moved: Array = points @ np.swapaxes(matrix[..., :3, :3], -1, -2) + matrix[..., None, :3, 3]
    return moved


def transform_directions(matrix: npt.ArrayLike, directions: npt.ArrayLike) -> Array:
    """Directions (N, 3) turned by a transform's rotation; translation does not touch them."""
    turned: Array = np.asarray(directions, dtype=float) @ np.swapaxes(np.asarray(matrix, dtype=float)[..., :3, :3], -1, -2)
    return turned


def rotate_covariances(matrix: npt.ArrayLike, covariances: npt.ArrayLike) -> Array:
    """Covariances (N, 3, 3) in mm^2, expressed in the frame that `matrix` maps to."""
    turn = np.asarray(matrix, dtype=float)[:3, :3]
    turned: Array = turn @ np.asarray(covariances, dtype=float) @ turn.T
    return turned


def rotation_angle_deg(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Angle between the rotations of two transforms."""
    turn: Any = np.asarray(a, dtype=float)[:3, :3].T @ np.asarray(b, dtype=float)[:3, :3]
    return float(np.degrees(scipy.spatial.transform.Rotation.from_matrix(turn).magnitude()))
