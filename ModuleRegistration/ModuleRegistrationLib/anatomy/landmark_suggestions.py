"""Where the four anatomical landmarks probably lie in a head CT: a proposal for the user to check and move.

Geometric rules on the bone surface: the head's plane of symmetry, the profile of the face in it, the lateral rims
of the orbits beside it. The SDs stated are judgements from how the rules work, not from an atlas of marked heads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.surface import Surface

from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces

LABELS = ("Nasion", "Left frontozygomatic", "Right frontozygomatic", "Anterior nasal spine")
STATED_SD_MM = (3.0, 6.0, 6.0, 3.0)  # the suture itself is not seen: its height on the rim is a guess
NOTE = "Proposed by geometric rules; check each in the CT and move it before registering."
SYMMETRY_POINTS, SYMMETRY_ROUNDS, SYMMETRY_KEPT = 4000, 30, 0.95  # the worst twentieth: defects, one-sided pieces
UPRIGHT_ROUNDS = 3
FIRST_RANGE_MM, NEXT_RANGE_MM = (110.0, 140.0), (70.0, 80.0)  # of the profile: about the head's middle, then about the nasion
PROFILE_STEP_MM = 0.5
FAR_MM = 250.0  # rays start so far in front of the head
DROP_MM = 8.0  # a step back of the profile by this within 3 mm: the nasal bones end, the nasal cavity begins
LOWEST_CONCAVITY_MM = 1.5
SUTURE_BELOW_NASION_MM = 5.0
RIM_FROM_MM, RIM_TO_MM = 33.0, 64.0  # from the midline: half the distances between the lateral orbital rims, adults and children


@dataclass(frozen=True, eq=False)
class LandmarkSuggestions:
    """Proposed landmarks, in RAS."""

    labels: tuple[str, ...]
    positions_ras_mm: Array  # (N, 3)
    sd_mm: Array  # (N,) how far the proposal may be off, each axis: a judgement, see the module
    note: str


@dataclass(frozen=True, eq=False)
class FaceFrame:
    """Axes of the face in RAS: origin in the plane of symmetry."""

    origin: Array  # (3,)
    right: Array  # (3,) unit, normal of the plane of symmetry
    front: Array  # (3,) unit
    up: Array  # (3,) unit

    def to_ras(self, right_mm: Array | float, front_mm: Array | float, up_mm: Array | float) -> Array:
        """Points (N, 3) in RAS from coordinates along the axes."""
        parts = np.broadcast_arrays(np.atleast_1d(right_mm), np.atleast_1d(front_mm), np.atleast_1d(up_mm))
        points: Array = self.origin + sum(part[:, None] * axis for part, axis in zip(parts, (self.right, self.front, self.up)))
        return points


def suggest_landmarks(bone: BoneSurfaces) -> LandmarkSuggestions:
    """Nasion, both frontozygomatic sutures and the anterior nasal spine of a head.

    Raises
    ------
    InputError
        The face is not in the CT, or does not show what the rules look for.
    """
    upright = _symmetry_frame(bone.outer_table)
    above, below = FIRST_RANGE_MM
    for _ in range(UPRIGHT_ROUNDS):  # a head that nods is looked at from its own front the second time
        nasion, spine = _profile_landmarks(bone.closed, upright, above, below)
        upright = _upright(upright, nasion, spine)
        above, below = NEXT_RANGE_MM
    left, right = (_lateral_rim(bone.closed, upright, side) for side in (-1.0, 1.0))
    return LandmarkSuggestions(LABELS, np.stack([nasion, left, right, spine]), np.array(STATED_SD_MM), NOTE)


def _symmetry_frame(outer: Surface) -> FaceFrame:
    """The plane that mirrors the outer table best onto itself: Gauss-Newton on the distances to the surface's planes."""
    step = max(1, len(outer.vertices_mm) // SYMMETRY_POINTS)
    points = outer.vertices_mm[::step] - outer.center_mm
    normal, offset = np.array([1.0, 0.0, 0.0]), 0.0
    for _ in range(SYMMETRY_ROUNDS):
        side = points @ normal - offset
        mirrored = points - 2 * side[:, None] * normal
        found = outer.closest(mirrored + outer.center_mm)
        residual = np.einsum("ij,ij->i", mirrored + outer.center_mm - found.points_mm, found.normals)
        near = found.distances_mm <= np.quantile(found.distances_mm, SYMMETRY_KEPT)
        tilts = np.linalg.svd(normal[None])[2][1:]  # two directions across the normal
        facing = found.normals @ normal
        columns = [-2 * ((points @ tilt) * facing + side * (found.normals @ tilt)) for tilt in tilts]
        slope = np.stack([*columns, 2 * facing], axis=1)
        change, *_ = np.linalg.lstsq(slope[near], -residual[near], rcond=None)
        normal = normal + change[:2] @ tilts
        normal /= np.linalg.norm(normal)
        offset += float(change[2])
    front = np.array([0.0, 1.0, 0.0])
    front = front - (front @ normal) * normal
    front /= np.linalg.norm(front)
    return FaceFrame(outer.center_mm + offset * normal, normal, front, np.cross(normal, front))


def _front_of(surface: Surface, frame: FaceFrame, right_mm: Array, up_mm: Array) -> Array:
    """How far in front of the origin the first bone lies for each place, seen from the front; -inf where there is none."""
    hits = surface.cast(frame.to_ras(right_mm, FAR_MM, up_mm), -frame.front)
    front: Array = np.where(np.isfinite(hits.distances_mm), FAR_MM - hits.distances_mm, -np.inf)
    return front


def _profile_landmarks(closed: Surface, frame: FaceFrame, above_mm: float, below_mm: float) -> tuple[Array, Array]:
    heights = np.arange(above_mm, -below_mm, -PROFILE_STEP_MM, dtype=np.float64)
    sides = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    front = _front_of(closed, frame, np.tile(sides, len(heights)), np.repeat(heights, len(sides)))
    profile: Array = front.reshape(-1, len(sides)).max(axis=1)  # nasal bones may part in the midline
    tip = _end_of_nasal_bones(profile)
    brow = max(0, tip - int(75 / PROFILE_STEP_MM))
    part = slice(brow, tip + 1)
    gap = _concavity(heights[part], profile[part])
    if gap.max() < LOWEST_CONCAVITY_MM:
        raise InputError("landmarks: no nasion is seen in the profile of the face; place the landmarks by hand")
    nasion = brow + int(np.argmax(gap))
    spine = _spine(profile, tip, nasion)
    at = [frame.to_ras(0.0, profile[index], heights[index])[0] for index in (nasion, spine)]
    return at[0], at[1]


def _end_of_nasal_bones(profile: Array) -> int:
    """Index of the last profile point before the first large step back, seen from the forehead downwards."""
    span = int(3 / PROFILE_STEP_MM)
    finite = np.where(np.isfinite(profile), profile, -FAR_MM)
    forehead = int(np.argmax(finite > finite.max() - 35))  # above it the vault slopes back
    for index in range(forehead + int(25 / PROFILE_STEP_MM), len(finite) - span):
        if finite[index] - finite[index + 1 : index + 1 + span].max() > DROP_MM:
            return index
    raise InputError("landmarks: the nose is not in the CT or not open below; place the landmarks by hand")


def _concavity(heights: Array, profile: Array) -> Array:
    """How far each profile point lies behind the straight line that spans the hollow it is in."""
    from scipy.spatial import ConvexHull

    if len(profile) < 10 or not np.isfinite(profile).all() or np.ptp(profile) == 0:
        return np.zeros(len(profile))
    points = np.stack([heights, profile], axis=1)
    hull = ConvexHull(points)
    inner = points @ hull.equations[:, :2].T + hull.equations[:, 2]
    facing = hull.equations[:, 1] > 0.2  # edges of the hull that look to the front
    gap: Array = -inner[:, facing].max(axis=1)
    return gap


def _spine(profile: Array, tip: int, nasion: int) -> int:
    """Index of the foremost point where bone comes forward again below the nasal cavity."""
    finite = np.where(np.isfinite(profile), profile, -FAR_MM)
    lowest = min(len(finite), nasion + int(75 / PROFILE_STEP_MM))
    start = nasion + int(35 / PROFILE_STEP_MM)
    back = finite[nasion] - 22
    for index in range(max(tip + 1, start), lowest):
        if finite[index] > back:
            near = slice(index, min(lowest, index + int(5 / PROFILE_STEP_MM)))
            return index + int(np.argmax(finite[near]))
    raise InputError("landmarks: the floor of the nose is not in the CT; place the landmarks by hand")


def _upright(frame: FaceFrame, nasion: Array, spine: Array) -> FaceFrame:
    """The face's axes with `up` from the spine to the nasion, which stand upright over each other in a level head."""
    away = nasion - spine
    away = away - (away @ frame.right) * frame.right
    up: Array = (away / np.linalg.norm(away)).astype(np.float64)
    front: Array = np.cross(up, frame.right).astype(np.float64)
    return FaceFrame(nasion, frame.right, front, up)


def _lateral_rim(closed: Surface, frame: FaceFrame, side: float) -> Array:
    """The foremost bone beside the orbit, a little below the nasion; `side` is +1 on the right."""
    across = np.arange(RIM_FROM_MM, RIM_TO_MM, 0.5, dtype=np.float64)
    front = _front_of(closed, frame, side * across, np.full(len(across), -SUTURE_BELOW_NASION_MM))
    if not np.isfinite(front).any() or front.max() < -60:
        raise InputError("landmarks: a lateral rim of the orbits is not in the CT; place the landmarks by hand")
    best = int(np.argmax(front))
    point: Array = frame.to_ras(side * across[best], front[best], -SUTURE_BELOW_NASION_MM)[0]
    return point
