"""The head's own frame, in which the palpation points are laid out: by landmarks, or by the dip at the root of the nose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, check_points, rigid
from CranioNavLib.surface import Surface

LANDMARK_LABELS = ("Nasion", "Left frontozygomatic", "Right frontozygomatic", "Anterior nasal spine")
NASION_CHORD_MM = 14  # half the chord over the dip between brow and nose
NASION_DIP_MM = 2.0  # its least depth below that chord
PROFILE_STEP_MM = 4.0  # between the profiles in which it is looked for
FACE_DEPTH_MM = 40.0  # from the foremost bone to the nasion, at most
LARGEST_PROFILE_STEP_MM = 5.0  # a longer step is the rim of a hole


def head_frame(surface: Surface, landmarks: Optional[npt.ArrayLike], labels: Optional[Sequence[str]]) -> Array:
    """HeadToRas: origin at the nasion, x to the right, y anterior, z superior.

    From the anatomical landmarks (N, 3), RAS, if `labels` name all of LANDMARK_LABELS; else from the surface's shape.

    Raises
    ------
    InputError
        Labels and landmarks differ in number, or the landmarks do not span a face.
    """
    if landmarks is not None:
        points = check_points(landmarks, "landmarks")
        if labels is None:
            labels = LANDMARK_LABELS if len(points) == len(LANDMARK_LABELS) else [""] * len(points)
        if len(labels) != len(points):
            raise InputError(f"got {len(points)} landmarks and {len(labels)} labels; give one label a landmark")
        known = {label.strip().lower(): point for label, point in zip(labels, points)}
        wanted = [known.get(label.lower()) for label in LANDMARK_LABELS]
        if all(point is not None for point in wanted):
            return _frame_from_landmarks(np.array(wanted, dtype=float))
    return _frame_from_shape(surface)


def _frame_from_landmarks(points: Array) -> Array:
    nasion, left, right, spine = points
    x = right - left
    z = nasion - spine
    if np.linalg.norm(x) < 30.0 or np.linalg.norm(z) < 20.0:
        raise InputError(
            "the landmarks do not span a face (frontozygomatic points closer than 30 mm, or nasion closer than 20 mm to the "
            "nasal spine); check their labels and their unit (mm)"
        )
    x /= np.linalg.norm(x)
    z -= (z @ x) * x
    z /= np.linalg.norm(z)
    return rigid(np.column_stack([x, np.cross(z, x), z]), nasion)


def _frame_from_shape(surface: Surface) -> Array:
    """Axes of RAS, origin at the nasion as profiles near the midline show it: the dip between brow and nose."""
    low, high = surface.vertices_mm.min(axis=0), surface.vertices_mm.max(axis=0)
    middle_x = (low[0] + high[0]) / 2
    heights = np.arange(high[2] - 45.0, max(low[2], high[2] - 150.0), -1.0)
    found = []
    for x in middle_x + np.arange(-36.0, 37.0, PROFILE_STEP_MM):  # a head that leans has its nose beside the middle
        origins = np.column_stack([np.full(len(heights), x), np.full(len(heights), high[1] + 50.0), heights])
        profile = high[1] + 50.0 - surface.cast(origins, np.array([0.0, -1.0, 0.0])).distances_mm
        profile[profile < high[1] - FACE_DEPTH_MM] = np.nan  # seen through a hole: the far side
        dip = _first_dip(profile)
        if dip is not None:
            found.append([x, profile[dip], heights[dip]])
    if not found:  # no face: where an adult's would be
        return rigid(np.eye(3), [middle_x, high[1] - 8.0, high[2] - 100.0])
    places = np.array(found)
    top = _shared_top(places)
    agreeing = places[(places[:, 2] <= top) & (places[:, 2] > top - NASION_CHORD_MM)]
    return rigid(np.eye(3), agreeing[np.argmax(agreeing[:, 1])])  # beside the nose the bone lies further back


def _shared_top(places: Array) -> float:
    """Height of the uppermost dip (x, y, z) that a neighbouring profile has, too; else of the middle one of all.

    Of a real skull's profiles most miss the root of the nose and find a dip under the orbit.
    """
    for top in places[np.argsort(-places[:, 2])]:
        beside = np.abs(np.abs(places[:, 0] - top[0]) - PROFILE_STEP_MM) < PROFILE_STEP_MM / 2
        if (np.abs(places[beside, 2] - top[2]) < NASION_CHORD_MM).any():
            return float(top[2])
    return float(np.sort(places[:, 2])[len(places) // 2])  # one of them, not between two that differ


def _first_dip(profile: Array) -> Optional[int]:
    """Index of the uppermost dip of a profile that runs downwards in steps of 1 mm; None if it has none.

    Its depth is taken from the chord over it, which does not mind a nodding head. A hole in the bone is no dip.
    """
    reach = NASION_CHORD_MM
    depths = np.full(len(profile), -np.inf)
    for k in range(reach, len(profile) - reach):
        piece = profile[k - reach : k + reach + 1]
        if np.isfinite(piece).all() and np.abs(np.diff(piece)).max() < LARGEST_PROFILE_STEP_MM:
            slant = piece[0] - piece[-1]
            depths[k] = ((piece[0] + piece[-1]) / 2 - profile[k]) * 2 * reach / np.hypot(2 * reach, slant)
    for k in range(reach, len(profile) - reach):  # further down come the dips below the nose
        if depths[k] > NASION_DIP_MM and depths[k] >= depths[k - reach // 2 : k + reach // 2 + 1].max():
            return k
    return None
