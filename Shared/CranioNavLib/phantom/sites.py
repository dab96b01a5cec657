"""Places on the head: landmarks, target spheres, markers of the other modes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from CranioNavLib.errors import InputError
from CranioNavLib.phantom import constants
from CranioNavLib.rigid import Array, check_points
from CranioNavLib.surface import Surface

LANDMARK_LABELS = ("Nasion", "Left frontozygomatic", "Right frontozygomatic", "Anterior nasal spine")

# The sample head, RAS mm, picked on a rendering of its bone: the deepest point of the frontonasal notch, the middle of
# the lateral orbital rim at the height of the frontozygomatic suture, and the tip of the nasal spine.
SAMPLE_HEAD_LANDMARKS_MM = ((-2.6, 78.5, -10.3), (-53.2, 55.9, -15.0), (51.2, 57.2, -14.0), (-3.4, 83.6, -60.0))

REACHABLE_SHARE = 0.7  # of the head's height, from the top: where spheres and screws may sit
CLEAR_OF_LANDMARKS_MM = 18.0
CANDIDATES = 4000
PROBE_OF_FLATNESS_MM = 3.0  # a seat for a sphere: no edge or hole this close


def snap_to_bone(points_mm: npt.ArrayLike, bone: Surface, farthest_mm: float = 5.0) -> Array:
    """Points moved onto the bone.

    Raises
    ------
    InputError
        One lies farther than `farthest_mm` from it.
    """
    found = bone.closest(check_points(points_mm, "landmarks"))
    if found.distances_mm.max() > farthest_mm:
        worst = int(np.argmax(found.distances_mm))
        raise InputError(
            f"landmark {worst + 1} lies {found.distances_mm[worst]:.1f} mm from the bone (allowed: {farthest_mm} mm); "
            "give landmarks on the skull of this CT, in RAS"
        )
    return found.points_mm


def outer_seats(bone: Surface, skin: Surface, rng: np.random.Generator) -> tuple[Array, Array]:
    """Candidate places on the outside of the skull: points (N, 3) and outward unit normals (N, 3).

    Rays from all sides towards the head's middle; where the bone is smooth, faces outwards and is covered by thin scalp.
    """
    middle = skin.center_mm
    drawn = rng.normal(size=(CANDIDATES, 3))
    directions: Array = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    origins = middle + 300.0 * directions
    hits = bone.cast(origins, -directions)
    found = np.isfinite(hits.distances_mm)
    directions = directions[found]
    points = origins[found] - directions * hits.distances_mm[found, None]
    normals, spread = _smooth_normals(bone, points, directions)
    to_skin = skin.cast(points + 0.1 * normals, normals).distances_mm
    top, bottom = skin.vertices_mm[:, 2].max(), skin.vertices_mm[:, 2].min()
    good = (spread < 0.5) & ((normals * directions).sum(axis=1) > 0.8) & (to_skin < 12.0)
    good &= points[:, 2] > top - REACHABLE_SHARE * (top - bottom)
    return points[good], normals[good]


def _smooth_normals(bone: Surface, points: Array, directions: Array) -> tuple[Array, Array]:
    """Normals of planes through the bone within PROBE_OF_FLATNESS_MM, and how far it leaves them (mm)."""
    helper = np.where(np.abs(directions[:, [2]]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(directions, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(directions, across)
    angles = np.arange(8) * np.pi / 4
    ring = np.concatenate([np.zeros((1, 2)), PROBE_OF_FLATNESS_MM * np.column_stack([np.cos(angles), np.sin(angles)])])
    starts = points[:, None] + ring[:, 0, None] * across[:, None] + ring[:, 1, None] * along[:, None] + 20 * directions[:, None]
    found = bone.cast(starts.reshape(-1, 3), -np.repeat(directions, len(ring), axis=0)).distances_mm
    ranges = np.where(np.isfinite(found), found, 1e3).reshape(len(points), -1)
    design = np.column_stack([np.ones(len(ring)), ring])
    plane = ranges @ np.linalg.pinv(design).T
    spread = np.abs(ranges - plane @ design.T).max(axis=1)
    normals = directions + plane[:, [1]] * across + plane[:, [2]] * along
    return normals / np.linalg.norm(normals, axis=1, keepdims=True), spread


def spread_out(points: Array, count: int, away_from: Array, first: Array) -> npt.NDArray[np.int64]:
    """Indices of `count` points, each chosen farthest from those before (and from `away_from`); begins near `first`."""
    blocked = (np.linalg.norm(points[:, None] - away_from[None], axis=2) < CLEAR_OF_LANDMARKS_MM).any(axis=1)
    chosen = [int(np.argmin(np.linalg.norm(points - first, axis=1) + np.where(blocked, 1e3, 0.0)))]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        candidate = int(np.argmax(np.where(blocked, -1.0, nearest)))
        chosen.append(candidate)
        nearest = np.minimum(nearest, np.linalg.norm(points - points[candidate], axis=1))
    return np.array(chosen, dtype=np.int64)


def marker_positions(bone: Surface, skin: Surface, landmarks: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Target spheres (10, 3), bone screws (4, 3) and adhesive skin markers (6, 3), RAS mm, spread over the skull."""
    points, normals = outer_seats(bone, skin, rng)
    needed = constants.MARKER_COUNT + constants.BONE_SCREW_COUNT + constants.SKIN_MARKER_COUNT
    if len(points) < 10 * needed:
        raise InputError(
            f"only {len(points)} places on this skull are smooth and reachable; give a CT of a whole head with its vault"
        )
    chosen = spread_out(points, constants.MARKER_COUNT, landmarks, points[np.argmax(points[:, 2])])
    markers = points[chosen] + constants.MARKER_STANDOFF_MM * normals[chosen]
    taken = np.vstack([landmarks, points[chosen]])
    screws = spread_out(points, constants.BONE_SCREW_COUNT, taken, points[np.argmax(points[:, 1])])
    taken = np.vstack([taken, points[screws]])
    stickers = spread_out(points, constants.SKIN_MARKER_COUNT, taken, points[np.argmax(points[:, 1])])
    reach = skin.cast(points[stickers] + 0.1 * normals[stickers], normals[stickers]).distances_mm + 0.1
    on_skin = points[stickers] + (reach + constants.SKIN_MARKER_STANDOFF_MM)[:, None] * normals[stickers]
    return markers, points[screws], on_skin
