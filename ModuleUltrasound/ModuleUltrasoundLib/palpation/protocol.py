"""The palpation protocol: 18 points placed on any head, where a probe can stand square on bone.

The chapter palpates 3 points left lateral, 3 right lateral, 4 on the frontal convexity, 4 on the forehead
and 4 around the orbits. Here each has a window, a cone of directions seen from the head's middle; inside
the windows the points are chosen so that together they hold all six degrees of freedom best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, invert_rigid, transform_directions, transform_points
from CranioNavLib.surface import Surface

from ModuleUltrasoundLib.palpation.clamp import CLEARANCE_MM, clear_of_clamp
from ModuleUltrasoundLib.palpation.head_frame import head_frame

REGIONS = ("Left lateral", "Right lateral", "Frontal convexity", "Forehead", "Periorbital")

# Azimuth from the face to the side and elevation above the nasion's plane, degrees, of the nine mirrored pairs,
# seen from the point half a head's length behind the nasion.
PAIRS = {
    "Lateral 1": (62.0, 30.0),  # above the temporal line, in front of the ear
    "Lateral 2": (92.0, 16.0),  # temporal squama, above the ear
    "Lateral 3": (112.0, 42.0),  # parietal bone
    "Frontal convexity 1": (52.0, 54.0),
    "Frontal convexity 2": (22.0, 58.0),
    "Forehead 1": (34.0, 30.0),
    "Forehead 2": (11.0, 36.0),
    "Periorbital 1": (20.0, 11.0),  # above the supraorbital rim
    "Periorbital 2": (36.0, -21.0),  # body of the zygoma, below and beside the orbit
}
MOST_LEFT_OUT = 4  # a craniotomy takes the place of one or two points; more are missing where the CT is cut off
WINDOW_RADII_DEG = (12.0, 17.0, 23.0)  # tried in turn: a window that holds a defect or a clamp is widened
GRID_STEP_DEG = 1.8

PROBE_FACE_RADIUS_MM = 2.5  # 5 mm element
PROBE_BODY_RADIUS_MM = 7.0  # housing that must not meet bone beside the point
STAND_OFF_MM = 40.0  # a probe comes in from here without touching bone
LARGEST_STEP_MM = 2.5  # of the bone under the probe's body
LARGEST_ROUGHNESS_MM = 0.45  # RMS from the plane through the bone under the body
SMALLEST_SPACING_MM = 20.0
ADULT_LENGTH_MM = 178.0  # nasion to opisthocranion, where the CT does not reach the back of the head
NORMAL_SD_MM = 0.6  # of a bone point along the surface normal: one value for all, only ratios matter here
HEAD_RADIUS_MM = 75.0
ROUGHNESS_WEIGHT = 0.05  # mm^2 of predicted error that an ideal place is worth against one at a window's rim
PRIOR_SD_MM = 3.0  # landmark registration, per axis; keeps the information regular with few points

_Obstacles = tuple[Optional[npt.ArrayLike], float]  # points in the probe's way, RAS, and the distance to keep from them


@dataclass(frozen=True, eq=False)
class ProtocolPoints:
    """Where to palpate. RAS, mm; normals point out of the bone."""

    labels: tuple[str, ...]
    positions_ras_mm: Array  # (N, 3) on the surface
    normals: Array  # (N, 3) unit, of the plane through the bone under the probe
    regions: tuple[str, ...]
    head_to_ras: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) origin at the nasion, x right, y anterior, z up
    left_out: tuple[str, ...] = ()  # labels of points whose place is taken by an opening of the skull, the clamp or the base

    def __len__(self) -> int:
        return len(self.labels)


@dataclass(frozen=True, eq=False)
class _Spot:
    """A place where a probe can stand."""

    position: Array  # (3,)
    normal: Array  # (3,)
    offset: tuple[int, int]  # grid place within the window, the same number on both sides of the head
    penalty: float


def plan_protocol(
    surface: Surface,
    landmarks_ras_mm: Optional[npt.ArrayLike] = None,
    labels: Optional[Sequence[str]] = None,
    clamp_ras_mm: Optional[npt.ArrayLike] = None,
    clearance_mm: float = CLEARANCE_MM,
) -> ProtocolPoints:
    """The 18 points of the protocol on a skull.

    Parameters
    ----------
    surface : Surface
        Outer table of the skull, RAS, mm, outward normals; it may be open (cropped CT, craniotomy).
    landmarks_ras_mm : array-like, shape (N, 3), optional
        Anatomical landmarks. With the four of `LANDMARK_LABELS` among them (or four without labels, in that
        order) they give the head's axes; else the RAS axes and the surface's shape do.
    labels : sequence of str, optional
        Names of the landmarks.
    clamp_ras_mm : array-like, shape (K, 3), optional
        Points on the head clamp, and the reference base on it, that a probe has to keep clear of.
    clearance_mm : float
        How far: between each of them and the probe's axis.

    Returns
    -------
    ProtocolPoints
        Three left lateral, three right lateral, four each on frontal convexity, forehead and around the orbits; without
        those whose place, and all around it, is an opening of the skull or under clamp or base.

    Raises
    ------
    InputError
        Landmarks and labels differ in number, or the surface lacks a region of the protocol or more than four places.
    """
    head_to_ras = head_frame(surface, landmarks_ras_mm, labels)
    center, reach = _middle(surface, head_to_ras)
    windows: dict[tuple[str, int], list[_Spot]] = {}
    obstacles = (clamp_ras_mm, clearance_mm)
    for name in PAIRS:
        for side in (-1, 1):
            windows[name, side] = _spots_for(surface, head_to_ras, center, reach, name, side, obstacles)
    left_out = _check_left_out(windows)
    windows = {key: spots for key, spots in windows.items() if spots}
    chosen = _choose(windows, center)
    names, spots, regions = [], [], []
    for region in REGIONS:
        for label, key in _slots(region):
            if key in left_out:
                continue
            names.append(label)
            spots.append(chosen[key])
            regions.append(region)
    return ProtocolPoints(
        labels=tuple(names),
        positions_ras_mm=np.array([spot.position for spot in spots]),
        normals=np.array([spot.normal for spot in spots]),
        regions=tuple(regions),
        head_to_ras=head_to_ras,
        left_out=tuple(label for region in REGIONS for label, key in _slots(region) if key in left_out),
    )


def _check_left_out(windows: dict[tuple[str, int], list[_Spot]]) -> list[tuple[str, int]]:
    """The windows over an opening, which hold no place; refused where there are many, or all of a region."""
    empty = [key for key, spots in windows.items() if not spots]
    bare = any(all(key in empty for _, key in _slots(region)) for region in REGIONS)
    if bare or len(empty) > MOST_LEFT_OUT:
        name, side = empty[0]
        raise InputError(
            f"no place for the probe at {'left' if side < 0 else 'right'} {name.lower()}: the bone surface is missing or too "
            "rough there, or the clamp or the reference base is in the way; extend or mend the surface, check the landmarks that "
            "orient the head, or lessen the distance from clamp and base"
        )
    return empty


def _slots(region: str) -> list[tuple[str, tuple[str, int]]]:
    """Labels of a region with the pair and side each stands for; across the forehead they run from left to right."""
    if region.endswith("lateral"):
        side = -1 if region.startswith("Left") else 1
        return [(f"{region} {k}", (f"Lateral {k}", side)) for k in (1, 2, 3)]
    order = [(1, -1), (2, -1), (2, 1), (1, 1)]
    return [(f"{region} {k + 1}", (f"{region} {pair}", side)) for k, (pair, side) in enumerate(order)]


def _middle(surface: Surface, head_to_ras: Array) -> tuple[Array, float]:
    """The point that the windows are seen from (RAS), and a distance that lies outside the head in every direction."""
    vertices = transform_points(invert_rigid(head_to_ras), surface.vertices_mm)
    back = -float(vertices[:, 1].min())
    length = back if 0.85 * ADULT_LENGTH_MM < back < 1.2 * ADULT_LENGTH_MM else ADULT_LENGTH_MM
    center = transform_points(head_to_ras, [[0.0, -length / 2, 0.0]])[0]
    return center, float(np.linalg.norm(surface.vertices_mm - center, axis=1).max()) + STAND_OFF_MM


def _directions(name: str, side: int, radius_deg: float) -> tuple[Array, list[tuple[int, int]]]:
    """Unit directions (M, 3) of a window's grid in the head's frame, and their places in the grid."""
    azimuth, elevation = np.radians(PAIRS[name])
    outward = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    across = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    up = np.cross(across, outward)
    count = int(radius_deg / GRID_STEP_DEG)
    places = [(i, j) for i in range(-count, count + 1) for j in range(-count, count + 1) if i * i + j * j <= count * count]
    steps = np.tan(np.radians(GRID_STEP_DEG)) * np.array(places, dtype=float)
    rays = outward + steps[:, :1] * across + steps[:, 1:] * up
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays[:, 0] *= side
    return rays, places


def _spots_for(
    surface: Surface, head_to_ras: Array, center: Array, reach: float, name: str, side: int, obstacles: _Obstacles
) -> list[_Spot]:
    """Places of a window where a probe can stand; the window grows until it holds some, or is left empty."""
    for radius_deg in WINDOW_RADII_DEG:
        rays, places = _directions(name, side, radius_deg)
        outward = transform_directions(head_to_ras, rays)
        hits = surface.cast(center + reach * outward, -outward)
        seen = np.isfinite(hits.distances_mm) & (hits.distances_mm < reach - 30.0)  # nearer the middle: through a hole
        if not seen.any():
            continue
        positions = (center + (reach - hits.distances_mm[:, None]) * outward)[seen]
        positions, normals, roughness, good = probe_footprint(surface, positions, outward[seen])
        kept = [place for place, flag in zip(places, seen) if flag]
        spots = [
            _Spot(positions[k], normals[k], kept[k], 0.02 * float(np.hypot(*kept[k])) + 0.5 * float(roughness[k]))
            for k in np.flatnonzero(good & clear_of_clamp(positions, normals, *obstacles))
        ]
        if spots:
            return spots
    return []


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
        across, up = _tangents(axis)
        normals = axis - slopes[:, :1] * across - slopes[:, 1:] * up
        axis = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    step = np.abs(heights).max(axis=1)
    good = whole & (step < LARGEST_STEP_MM) & (roughness < LARGEST_ROUGHNESS_MM)
    return positions_mm, axis, roughness, good


def _tangents(axis: Array) -> tuple[Array, Array]:
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
    across, up = _tangents(axis)
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


def _rows(spots: Sequence[_Spot], center: Array) -> Array:
    """How each point's distance to the bone changes with a small motion (rotation about `center`, translation): (M, 6)."""
    positions, normals = (np.array([getattr(spot, name) for spot in spots]) for name in ("position", "normal"))
    rows: Array = np.concatenate([np.cross(positions - center, normals), normals], axis=1) / NORMAL_SD_MM
    return rows


def _choose(windows: dict[tuple[str, int], list[_Spot]], center: Array) -> dict[tuple[str, int], _Spot]:
    """One spot a window, so that the mean squared error over the head is least; both sides alike where they can be."""
    chosen = {key: min(spots, key=lambda spot: spot.penalty) for key, spots in windows.items()}
    found = {name: _pairings(windows.get((name, -1), []), windows.get((name, 1), [])) for name in PAIRS}
    pairings = {name: pairs for name, pairs in found.items() if pairs}
    for _ in range(4):
        before = dict(chosen)
        for name in pairings:
            others = [spot for key, spot in chosen.items() if key[0] != name]
            best = int(np.argmin(_costs(pairings[name], others, center)))
            chosen.update({(name, side): spot for side, spot in zip((-1, 1), pairings[name][best]) if (name, side) in chosen})
        if all(before[key] is chosen[key] for key in chosen):
            break
    return chosen


def _pairings(left: list[_Spot], right: list[_Spot]) -> list[tuple[_Spot, _Spot]]:
    """Pairs of spots that mirror each other; where the other side has no bone, its best spots near by stand in.

    A spot that has no partner at all is paired with itself.
    """
    if not (left and right):
        return [(spot, spot) for spot in left or right]
    by_place = {spot.offset: spot for spot in right}
    mirrored = [(spot, by_place[spot.offset]) for spot in left if spot.offset in by_place]
    if len(mirrored) >= 5:
        return mirrored
    best_left, best_right = (sorted(side, key=lambda spot: spot.penalty)[:12] for side in (left, right))
    return mirrored + [(a, b) for a in best_left for b in best_right]


def _costs(pairs: list[tuple[_Spot, _Spot]], others: list[_Spot], center: Array) -> Array:
    """(K,) predicted mean squared error (mm^2) over targets all round the head, raised for crowding and rough places."""
    known = _rows(others, center)
    prior = np.diag([(HEAD_RADIUS_MM / PRIOR_SD_MM) ** 2] * 3 + [1.0 / PRIOR_SD_MM**2] * 3)
    first, second = (_rows([pair[side] for pair in pairs], center) for side in (0, 1))
    information = known.T @ known + prior + _outer(first) + _outer(second)
    # targets at both ends of three axes and in the middle: four of the seven lie off each axis of rotation
    spread = np.array([4 / 7 * HEAD_RADIUS_MM**2] * 3 + [1.0] * 3)
    squared = (np.linalg.inv(information).diagonal(axis1=1, axis2=2) * spread).sum(axis=1)
    places = np.array([spot.position for spot in others])
    ends = np.array([[spot.position for spot in pair] for pair in pairs])  # (K, 2, 3)
    gaps = np.linalg.norm(ends[:, :, None] - places[None, None], axis=3).reshape(len(pairs), -1)
    between = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    gaps = np.concatenate([gaps, between[:, None]], axis=1)
    crowding = np.clip(SMALLEST_SPACING_MM - gaps, 0.0, None).sum(axis=1) / SMALLEST_SPACING_MM
    rough = np.array([pair[0].penalty + pair[1].penalty for pair in pairs])
    costs: Array = squared * (1.0 + 2.0 * crowding) + ROUGHNESS_WEIGHT * rough
    return costs


def _outer(rows: Array) -> Array:
    """(K, 6, 6) from rows (K, 6)."""
    return np.asarray(rows[:, :, None] * rows[:, None, :])
