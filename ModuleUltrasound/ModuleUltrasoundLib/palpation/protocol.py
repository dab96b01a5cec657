"""The palpation protocol: 18 points placed on any head, where a probe can stand square on bone.

The chapter palpates 3 points left lateral, 3 right lateral, 4 on the frontal convexity, 4 on the forehead
and 4 around the orbits. Here each has a window, a cone of directions seen from the head's middle; inside
the windows the points are chosen so that together they hold all six degrees of freedom best.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, invert_rigid, transform_directions, transform_points
from CranioNavLib.surface import Surface

from ModuleUltrasoundLib.palpation.beside import places_beside
from ModuleUltrasoundLib.palpation.clamp import CLEARANCE_MM, clear_of_clamp, stands_beside_pins
from ModuleUltrasoundLib.palpation.footprint import STAND_OFF_MM, probe_footprint
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
GRID_STEP_MM = 2.8  # of the same, on the bone

SMALLEST_SPACING_MM = 20.0
ADULT_LENGTH_MM = 178.0  # nasion to opisthocranion, where the CT does not reach the back of the head
NORMAL_SD_MM = 0.6  # of a bone point along the surface normal: one value for all, only ratios matter here
HEAD_RADIUS_MM = 75.0
ROUGHNESS_WEIGHT = 0.05  # mm^2 of predicted error that an ideal place is worth against one at a window's rim
PRIOR_SD_MM = 3.0  # landmark registration, per axis; keeps the information regular with few points

_Stands = Callable[[Array, Array], npt.NDArray[np.bool_]]  # feet and normals (M, 3) to whether a probe may stand there (M,)
_Key = tuple[str, int]  # a window: a pair's name and -1 for its left, 1 for its right one


@dataclass(frozen=True, eq=False)
class ProtocolPoints:
    """Where to palpate. RAS, mm; normals point out of the bone."""

    labels: tuple[str, ...]
    positions_ras_mm: Array  # (N, 3) on the surface
    normals: Array  # (N, 3) unit, of the plane through the bone under the probe
    regions: tuple[str, ...]
    head_to_ras: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) origin at the nasion, x right, y anterior, z up
    left_out: tuple[str, ...] = ()  # labels of points whose place is taken by an opening of the skull, or by a pin
    too_near: tuple[str, ...] = ()  # labels of points that keep their place near clamp or base: there is no free one in reach

    def __len__(self) -> int:
        return len(self.labels)


@dataclass(frozen=True, eq=False)
class _Head:
    """What the windows are looked at through."""

    surface: Surface
    head_to_ras: Array  # (4, 4)
    center: Array  # (3,) RAS, mm: the point that they are seen from
    reach_mm: float  # from there, outside the head in every direction


@dataclass(frozen=True, eq=False)
class _Spot:
    """A place where a probe can stand."""

    position: Array  # (3,)
    normal: Array  # (3,)
    offset: Optional[tuple[int, int]]  # grid place within the window, the same number on both sides of the head; None beside it
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
        those whose place, and all around it, is an opening of the skull. Clamp and base take none away: where they are in
        the way of all of a window, the point moves along the bone of its region; where there is no free place in reach, it
        keeps its own and is named in `too_near`. Only a place that a pin sits in is none.

    Raises
    ------
    InputError
        Landmarks and labels differ in number, or the surface lacks a region of the protocol or more than four places.
    """
    head_to_ras = head_frame(surface, landmarks_ras_mm, labels)
    head = _Head(surface, head_to_ras, *_middle(surface, head_to_ras))

    def stands(positions: Array, normals: Array) -> npt.NDArray[np.bool_]:
        return stands_beside_pins(positions, normals, clamp_ras_mm, clearance_mm)

    def is_clear(positions: Array, normals: Array) -> npt.NDArray[np.bool_]:
        return clear_of_clamp(positions, normals, clamp_ras_mm, clearance_mm)

    windows = {(name, side): _spots_for(head, (name, side), stands) for name in PAIRS for side in (-1, 1)}
    left_out = _check_left_out(windows)
    windows, too_near = _clear_windows(head, {key: spots for key, spots in windows.items() if spots}, is_clear)
    chosen = _choose(windows, head.center)
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
        too_near=tuple(label for region in REGIONS for label, key in _slots(region) if key in too_near),
    )


def _clear_windows(
    head: _Head, windows: dict[_Key, list[_Spot]], is_clear: _Stands
) -> tuple[dict[_Key, list[_Spot]], list[_Key]]:
    """Of each window the places clear of clamp and base; where it has none those beside it, else its own, which is named."""
    clear = {key: _those(spots, is_clear) for key, spots in windows.items()}
    blocked = [key for key, spots in clear.items() if not spots]
    too_near = []
    if blocked:
        own = _choose(windows, head.center)
        for key in blocked:
            others = np.array([spot.position for other, spot in own.items() if other != key])
            clear[key] = _beside(head, key, own[key], others, is_clear) or _spots_for(head, key, is_clear)
            if not clear[key]:
                clear[key] = [own[key]]
                too_near.append(key)
    return clear, too_near


def _those(spots: list[_Spot], stands: _Stands) -> list[_Spot]:
    """Those of some places where a probe may stand."""
    positions, normals = (np.array([getattr(spot, name) for spot in spots]).reshape(-1, 3) for name in ("position", "normal"))
    return [spot for spot, good in zip(spots, stands(positions, normals)) if good]


def _beside(head: _Head, key: _Key, own: _Spot, others: Array, is_clear: _Stands) -> list[_Spot]:
    """Clear places of the same region farther along the bone; not among the other points, unless all are."""
    positions, normals, roughness = places_beside(head.surface, own.position, own.normal)
    ways = np.linalg.norm(positions - own.position, axis=1)
    at_home = _of_region(transform_directions(invert_rigid(head.head_to_ras), positions - head.center), key)
    found = [
        _Spot(positions[k], normals[k], None, 0.02 * float(ways[k]) / GRID_STEP_MM + 0.5 * float(roughness[k]))
        for k in np.flatnonzero(at_home & is_clear(positions, normals))
    ]
    spaced = [spot for spot in found if np.linalg.norm(others - spot.position, axis=1).min() >= SMALLEST_SPACING_MM]
    return spaced or found


def _of_region(directions: Array, key: _Key) -> npt.NDArray[np.bool_]:
    """(M,) whether the window nearest to each direction (M, 3; head's frame) is of this one's region and side."""
    keys = [(name, side) for name in PAIRS for side in (-1, 1)]
    nearest = np.argmax(directions @ np.array([_outward(*one) for one in keys]).T, axis=1)
    region = key[0].rsplit(" ", 1)[0]
    its_own = np.array([name.rsplit(" ", 1)[0] == region and side == key[1] for name, side in keys])
    return np.asarray(its_own[nearest])


def _check_left_out(windows: dict[_Key, list[_Spot]]) -> list[_Key]:
    """The windows over an opening or a pin, which hold no place; refused where there are many, or all of a region."""
    empty = [key for key, spots in windows.items() if not spots]
    bare = any(all(key in empty for _, key in _slots(region)) for region in REGIONS)
    if bare or len(empty) > MOST_LEFT_OUT:
        name, side = empty[0]
        raise InputError(
            f"no place for the probe at {'left' if side < 0 else 'right'} {name.lower()}: the bone surface is missing or too "
            "rough there, or a pin of the clamp sits in the place; extend or mend the surface, or check the landmarks that "
            "orient the head"
        )
    return empty


def _slots(region: str) -> list[tuple[str, _Key]]:
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


def _outward(name: str, side: int) -> Array:
    """The unit direction of a window's middle in the head's frame."""
    azimuth, elevation = np.radians(PAIRS[name])
    return np.array([side * np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])


def _directions(name: str, side: int, radius_deg: float) -> tuple[Array, list[tuple[int, int]]]:
    """Unit directions (M, 3) of a window's grid in the head's frame, and their places in the grid."""
    azimuth = np.radians(PAIRS[name][0])
    outward = _outward(name, 1)
    across = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    up = np.cross(across, outward)
    count = int(radius_deg / GRID_STEP_DEG)
    places = [(i, j) for i in range(-count, count + 1) for j in range(-count, count + 1) if i * i + j * j <= count * count]
    steps = np.tan(np.radians(GRID_STEP_DEG)) * np.array(places, dtype=float)
    rays = outward + steps[:, :1] * across + steps[:, 1:] * up
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays[:, 0] *= side
    return rays, places


def _spots_for(head: _Head, key: _Key, stands: _Stands) -> list[_Spot]:
    """Places of a window where a probe may stand; the window grows until it holds some, or is left empty."""
    surface, center, reach = head.surface, head.center, head.reach_mm
    for radius_deg in WINDOW_RADII_DEG:
        rays, places = _directions(*key, radius_deg)
        outward = transform_directions(head.head_to_ras, rays)
        hits = surface.cast(center + reach * outward, -outward)
        seen = np.isfinite(hits.distances_mm) & (hits.distances_mm < reach - 30.0)  # nearer the middle: through a hole
        if not seen.any():
            continue
        positions = (center + (reach - hits.distances_mm[:, None]) * outward)[seen]
        positions, normals, roughness, good = probe_footprint(surface, positions, outward[seen])
        kept = [place for place, flag in zip(places, seen) if flag]
        spots = [
            _Spot(positions[k], normals[k], kept[k], 0.02 * float(np.hypot(*kept[k])) + 0.5 * float(roughness[k]))
            for k in np.flatnonzero(good & stands(positions, normals))
        ]
        if spots:
            return spots
    return []


def _rows(spots: Sequence[_Spot], center: Array) -> Array:
    """How each point's distance to the bone changes with a small motion (rotation about `center`, translation): (M, 6)."""
    positions, normals = (np.array([getattr(spot, name) for spot in spots]) for name in ("position", "normal"))
    rows: Array = np.concatenate([np.cross(positions - center, normals), normals], axis=1) / NORMAL_SD_MM
    return rows


def _choose(windows: dict[_Key, list[_Spot]], center: Array) -> dict[_Key, _Spot]:
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
    by_place = {spot.offset: spot for spot in right if spot.offset is not None}
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
