"""Where planned landmarks lie on the head: a landmark that can be touched lies on the outside of the bone or on the skin.

Looked at from outside: rays from all sides towards a place first meet the surface there if it lies on the outside, and
something in front of it if it lies within. A single opening (a nostril, the foramen magnum) lets few rays through, so a
twentieth of all of them has to agree.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, transform_points
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.grid import Mask
from ModuleRegistrationLib.anatomy.head import AIR_TISSUE_HU

DIRECTIONS = 500  # over the whole sphere: neighbours are 9 degrees apart
AGREEING = 0.05  # share of the directions; openings of the skull let through less than 0.02 of them
FLAT = 1.0 - 2.0 * AGREEING  # under a flat surface the twentieth of the shortest ways is longer than the depth by 1 / this
OUTSIDE_MM, REACH_MM, STEP_MM = 400.0, 300.0, 1.0  # where rays start; how far and how finely the CT is looked at
ON_SURFACE_MM = 4.0  # a click, a thick slice and the surface itself explain less
SKIN_OVER_BONE_MM = 45.0  # the tip of the nose; what is farther off is holder, table or tube
BONE_UNDER_SKIN_MM = 30.0  # what lies deeper cannot be touched, though it may be seen from below: the base of the skull
ON_OUTSIDE_MM = 1.0  # of a place that was itself found on the bone
CANDIDATES = 100
ACROSS_MM = 10.0  # a landmark without its counterpart may lie so far beyond the middle: heads are not symmetric
SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}


@dataclass(frozen=True, eq=False)
class LandmarkPlaces:
    """How far landmarks lie from what can be touched."""

    bone_mm: Array  # (N,) from the outside of the bone
    skin_mm: Array  # (N,) from the skin, from within or without; inf where it is not known

    @property
    def off_mm(self) -> Array:
        """(N,) from the nearer of both."""
        off: Array = np.minimum(self.bone_mm, self.skin_mm)
        return off

    @property
    def doubtful(self) -> Mask:
        """(N,) whether a landmark lies on neither."""
        on_skin = (self.skin_mm <= ON_SURFACE_MM) & (self.bone_mm <= SKIN_OVER_BONE_MM)
        too_deep = np.isfinite(self.skin_mm) & (self.skin_mm > BONE_UNDER_SKIN_MM)
        return np.asarray(~on_skin & ((self.bone_mm > ON_SURFACE_MM) | too_deep))


def landmark_places(closed: Surface, volume: Optional[Volume], points_ras_mm: npt.ArrayLike) -> LandmarkPlaces:
    """How far points (N, 3) in RAS lie from the outside of the bone, and from the skin where the CT is given.

    Parameters
    ----------
    closed : Surface
        All of the bone, in RAS.
    volume : Volume, optional
        The CT.
    points_ras_mm : array-like, shape (N, 3)
    """
    points = np.asarray(points_ras_mm, dtype=float).reshape(-1, 3)
    bone = np.array([_agreed(_ways_to_bone(closed, point)[0]) for point in points])
    bone = np.where(np.isfinite(bone), bone, closed.closest(points).distances_mm)  # far away few rays meet the head
    skin = np.array([_to_skin(volume, point) if volume is not None else np.inf for point in points])
    return LandmarkPlaces(bone, skin)


def nearest_outside(closed: Surface, volume: Optional[Volume], point_ras_mm: npt.ArrayLike) -> Optional[Array]:
    """The place (3,) on the outside of the bone that is nearest to a point (3,) in RAS; None if there is none near."""
    ways, places = _ways_to_bone(closed, np.asarray(point_ras_mm, dtype=float))
    nearest = np.argsort(ways)[:CANDIDATES]
    for place in places[nearest][np.isfinite(ways[nearest])]:
        if _agreed(_ways_to_bone(closed, place)[0]) <= ON_OUTSIDE_MM and not landmark_places(closed, volume, place).doubtful[0]:
            return np.asarray(place, dtype=float)
    return None


def on_wrong_side(labels: Sequence[str], points_ras_mm: npt.ArrayLike, middle_right_mm: float) -> tuple[str, ...]:
    """The landmarks whose names say left or right and that lie on the other side, by their names.

    Parameters
    ----------
    labels : sequence of str, N names
        "Left" and "Right", or "L" and "R", as a word of the name; two names that differ by that alone are a pair.
    points_ras_mm : array-like, shape (N, 3)
        The first coordinate grows to the patient's right.
    middle_right_mm : float
        That of the head's middle, for landmarks that have no counterpart.
    """
    across = np.asarray(points_ras_mm, dtype=float).reshape(-1, 3)[:, 0]
    sided = {label: (side_of(label), value) for label, value in zip(labels, across) if side_of(label)}
    wrong = []
    for label, (side, value) in sided.items():
        partner = sided.get(counterpart(label, tuple(sided)))
        limit = partner[1] if partner else middle_right_mm + (ACROSS_MM if side == "left" else -ACROSS_MM)
        if (value > limit) if side == "left" else (value < limit):
            wrong.append(label)
    return tuple(wrong)


def side_of(label: str) -> str:
    """The side that a name says: "left", "right" or ""."""
    return next((SIDES[word] for word in _words(label) if word in SIDES), "")


def counterpart(label: str, labels: Sequence[str]) -> str:
    """The name that differs from this one by the side alone; "" if there is none."""
    side, rest = side_of(label), _without_side(label)
    return next((one for one in labels if side_of(one) not in ("", side) and _without_side(one) == rest), "")


def _words(label: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", label.lower()) if word]


def _without_side(label: str) -> list[str]:
    return [word for word in _words(label) if word not in SIDES]


def _directions() -> Array:
    """(DIRECTIONS, 3) unit vectors spread evenly over the sphere, on a spiral."""
    number = np.arange(DIRECTIONS) + 0.5
    height, turn = 1.0 - 2.0 * number / DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * number
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)


def _agreed(ways_mm: Array) -> float:
    """The distance that a twentieth of the ways undercuts, as under a flat surface."""
    return float(np.sort(ways_mm)[int(AGREEING * len(ways_mm))]) * FLAT


def _ways_to_bone(closed: Surface, point: Array) -> tuple[Array, Array]:
    """From all sides towards a point: its distance (D,) from the bone that is met first, and that place (D, 3)."""
    away = _directions()
    hits = closed.cast(point + OUTSIDE_MM * away, -away).distances_mm
    met = np.isfinite(hits)
    beyond = np.where(met, hits, 0.0) - OUTSIDE_MM
    return np.where(met, np.abs(beyond), np.inf), point - beyond[:, None] * away


def _to_skin(volume: Volume, point: Array) -> float:
    """Distance from the skin: along rays that leave the head into air, to the last tissue; outside, to the first."""
    steps = np.arange(0.0, REACH_MM, STEP_MM)
    places = point + steps[None, :, None] * _directions()[:, None, :]
    index = np.rint(transform_points(np.linalg.inv(volume.ijk_to_ras), places.reshape(-1, 3))).astype(int)[:, ::-1]
    inside = np.asarray(((index >= 0) & (index < volume.hu.shape)).all(axis=1))
    tissue = np.zeros(len(index), dtype=bool)
    tissue[inside] = volume.hu[tuple(index[inside].T)] > AIR_TISSUE_HU
    seen, dense = inside.reshape(DIRECTIONS, -1).sum(axis=1), tissue.reshape(DIRECTIONS, -1)
    meets = np.asarray(dense.any(axis=1))
    last = len(steps) - 1 - dense[:, ::-1].argmax(axis=1)
    into_air = seen - 1 > last  # not through the end of the volume
    depth = _agreed(np.where(meets, np.where(into_air, steps[last], np.inf), 0.0))
    if depth > 0:
        return depth
    return float(np.min(steps[dense.argmax(axis=1)][meets], initial=np.inf))
