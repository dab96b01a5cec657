"""How the hand moves the probe over the head: it comes to the perpendicular, leans over, sweeps, slips off."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import rigid
from scipy.signal import lfilter

from Testing.Studies.simulators.kirchhoff_plan import Array, Bools, Places, World

DWELL, TRACK, AIR, APPROACH, SLIP = (11, 21), (40, 56), (40, 90), (2, 6), (2, 5)  # lines: least, one more than most
DWELLS, TRACKS = (3, 7), (1, 3)  # of them in a recording of usual length
DWELL_LINES, TRACK_LINES = 19, 51  # of one of them, about, with the way to it
USUAL = (0.75, 1.3)  # lines over those asked for that are left as drawn
LEAST_DWELL, LEAST_LINES = 6, 8
DEPTH_MM = (2.0, 15.0)
STEEP_DEG, MOST_DEG = 7.0, 14.0
HEAD_MM, CENTRE_MM = 78.0, (0.0, 0.0, -60.0)  # the bone as a sphere in Reference
POSE_DEG, POSE_MM = 0.15, 0.1  # noise of the tracker


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the probe is in n lines."""

    place: npt.NDArray[np.int64]  # (n,)
    kind: npt.NDArray[np.str_]  # (n,) bone, sweep, steep, poor, edge, hole, air, soft, gel
    wet: Array  # (n,) share of the face that touches; 0: air
    depth_mm: Array  # (n,) of the bone, or where it would be
    tilt_deg: Array  # (n, 2)
    at_mm: Array  # (n, 2) along the head
    hole_mm: Array  # (n, 2) middle of a hole along the way, and half its width; infinite: none

    @property
    def angle_deg(self) -> Array:
        """Angle to the bone's perpendicular (n,)."""
        return np.asarray(np.degrees(np.arctan(np.hypot(*np.tan(np.radians(self.tilt_deg)).T))))

    @property
    def boneless(self) -> Bools:
        """Lines without bone under any part of the face (n,)."""
        return np.isin(self.kind, ("hole", "air", "soft", "gel"))


def _wander(rng: np.random.Generator, lines: int, sigma: float, lasts: float) -> Array:
    """A value that wanders about zero (n,): its standard deviation, and for how many lines it stays alike."""
    keeps = np.exp(-1 / lasts)
    steps = rng.standard_normal(lines + 200) * sigma * np.sqrt(1 - keeps**2)
    return np.asarray(lfilter([1], [1, -keeps], steps)[200:])


def _in_air(rng: np.random.Generator, place: int, lines: int, depth: float, turns_deg: float) -> Hand:
    return Hand(
        place=np.full(lines, place),
        kind=np.full(lines, "air"),
        wet=np.zeros(lines),
        depth_mm=np.full(lines, depth),
        tilt_deg=rng.normal(0, turns_deg, (lines, 2)),
        at_mm=np.zeros((lines, 2)),
        hole_mm=np.tile([np.inf, 0.0], (lines, 1)),
    )


def _glide(rng: np.random.Generator, world: World, lines: int, base: float) -> tuple[Array, Array, Array]:
    """Way (n,), tilt (n, 2) and depth (n,) of a sweep."""
    along = np.cumsum(np.full(lines, rng.uniform(5, 18) / world.rate_hz)) + _wander(rng, lines, 0.1, 5)
    tilt = np.stack([_wander(rng, lines, 1.8, 12) for _ in range(2)], axis=1)
    swell = 0.12 * np.sin(along / rng.uniform(4, 9) + rng.uniform(0, 2 * np.pi))
    return along, tilt, base * (1 + swell + _wander(rng, lines, 0.02, 10))


def _dwell(rng: np.random.Generator, lines: int, base: float) -> tuple[Array, Array, Array]:
    """The same of a dwell: the hand comes to the perpendicular, guided, with tremor, and presses more or less."""
    along = np.cumsum(_wander(rng, lines, 0.06, 3))
    aside, settled = rng.uniform(0, 2 * np.pi), rng.uniform(0, 2)
    off = rng.uniform(2, 8) * np.exp(-np.arange(lines) / rng.uniform(2, 6))
    tilt = np.outer(off, [np.cos(aside), np.sin(aside)]) + settled * np.array([np.cos(aside + 1), np.sin(aside + 1)])
    tilt += np.stack([_wander(rng, lines, 0.5, 3) for _ in range(2)], axis=1)
    return along, tilt, base * (1 + _wander(rng, lines, 0.03, 8))


def _coupling(rng: np.random.Generator, lines: int) -> Array:
    """Share of the face that touches (n,): the gel has to spread first, or there is a bubble or hair under the face."""
    wet = np.ones(lines)
    if rng.random() < 0.35:
        first = int(rng.integers(1, 4))
        wet[:first] = np.sort(rng.uniform(0.25, 0.9, first))
    if rng.random() < 0.12:
        start = int(rng.integers(0, max(lines - 5, 1)))
        wet[start : start + 5] = rng.uniform(0.3, 0.8)
    return wet


def _kinds(world: World, wet: Array, tilt: Array, gap: Array) -> npt.NDArray[np.str_]:
    """What each line is; `gap`: mm from the hole's edge, negative inside."""
    if world.without:
        return np.full(len(wet), world.without)
    steep = np.linalg.norm(tilt, axis=1) > STEEP_DEG
    seen = np.where(wet < 1, "poor", np.where(steep, "steep", "sweep" if world.sweeps else "bone"))
    reach = 0.55 * world.footprint_mm
    return np.where(gap > reach, seen, np.where(gap < -reach, "hole", "edge"))


def _touch(rng: np.random.Generator, world: World, place: int, odd: bool, drawn: int, lines: int, base: float) -> Hand:
    """The lines on one place; of a sweep that is cut short, a part of the way that was drawn."""
    whole = max(drawn, lines) if world.sweeps else lines
    along, tilt, depth = _glide(rng, world, whole, base) if world.sweeps else _dwell(rng, whole, base)
    at = np.stack([along, np.cumsum(_wander(rng, whole, 0.05, 3))], axis=1)
    wet = _coupling(rng, whole)
    if world.steep and odd:  # the hand leans over for a second
        start = int(rng.integers(0, max(whole // 2, 1)))
        tilt[start : start + whole // 3, 0] += rng.uniform(7, 11)
    angle = np.linalg.norm(tilt, axis=1, keepdims=True)
    tilt *= MOST_DEG / np.maximum(angle, MOST_DEG)
    middle, half = np.inf, 0.0
    if world.hole and odd:  # burr hole or flap: a strip of a sweep, a whole place otherwise
        middle, half = float(along[whole // 2]), rng.uniform(1.3, 2.2) * world.footprint_mm if world.sweeps else 50.0
    hand = Hand(
        place=np.full(whole, place),
        kind=_kinds(world, wet, tilt, np.abs(along - middle) - half),
        wet=wet,
        depth_mm=np.clip(depth, *_range_mm(world)),
        tilt_deg=tilt,
        at_mm=at,
        hole_mm=np.tile([middle, half], (whole, 1)),
    )
    first = int(rng.integers(0, whole - lines + 1))
    return Hand(*(getattr(hand, one.name)[first : first + lines] for one in fields(Hand)))


def _range_mm(world: World) -> tuple[float, float]:
    return DEPTH_MM[0], min(DEPTH_MM[1], 1.25 * world.depth_mm + 1)


def _fitted(sizes: npt.NDArray[np.int64], frames: int) -> npt.NDArray[np.int64]:
    """Lines of each place on the way and there (P, 2), so that they are about as many as asked for."""
    factor = frames / sizes.sum()
    if USUAL[0] < 1 / factor < USUAL[1]:
        factor = 1.0
    fitted = np.maximum(np.rint(sizes * factor).astype(np.int64), np.where(sizes > 0, [1, LEAST_DWELL], 0))
    last = (len(sizes) - 1, int(sizes[-1].argmax()))
    fitted[last] += max(LEAST_LINES - int(fitted.sum()), 0)
    return np.asarray(fitted)


def draw_hand(rng: np.random.Generator, world: World, frames: int) -> Hand:
    """The whole recording, of about `frames` lines: for fewer, fewer places, then less time on each."""
    if world.without == "air":
        sizes = _fitted(np.array([[int(rng.integers(*AIR)), 0]]), frames)
        return _in_air(rng, 0, int(sizes.sum()), world.depth_mm * rng.uniform(0.8, 1.2), 8)
    each, usual, lines = (TRACK, TRACKS, TRACK_LINES) if world.sweeps else (DWELL, DWELLS, DWELL_LINES)
    drawn = int(rng.integers(*usual))
    odd = int(rng.integers(drawn))  # where a hole is, or the hand leans over; unless it never gets there
    count = min(drawn, max(1, round(frames / lines)))
    natural = np.stack([rng.integers(*APPROACH, count), rng.integers(*each, count)], axis=1)
    parts = []
    for place, (before, there) in enumerate(_fitted(natural, frames)):
        base = float(np.clip(world.depth_mm * rng.uniform(0.8, 1.2), *_range_mm(world)))
        parts.append(_in_air(rng, place, int(before), base, 8))
        parts.append(_touch(rng, world, place, place == odd, int(natural[place, 1]), int(there), base))
        if world.sweeps and rng.random() < 0.3 and frames >= lines // 2:
            parts.append(_in_air(rng, place, int(rng.integers(*SLIP)), base, 0))
    return Hand(*(np.concatenate([getattr(part, one.name) for part in parts]) for one in fields(Hand)))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def draw_poses(rng: np.random.Generator, places: Places, hand: Hand) -> Array:
    """ProbeToReference of every line (n, 4, 4), with the tracker's noise; in the air the probe is 3 to 30 mm away."""
    lines = len(hand.place)
    outwards = places.normal[hand.place]
    along = _unit(np.asarray(np.cross(outwards, [0, 1, 0.3]), dtype=float))
    moved = hand.at_mm[:, :1] * along + hand.at_mm[:, 1:] * np.cross(outwards, along)
    normal = _unit(outwards + moved / HEAD_MM)
    across = _unit(along - normal * (normal * along).sum(axis=1, keepdims=True))
    tangent = np.tan(np.radians(hand.tilt_deg + rng.normal(0, POSE_DEG, (lines, 2))))
    beam = _unit(-normal + tangent[:, :1] * across + tangent[:, 1:] * np.cross(-normal, across))
    side = _unit(across - beam * (beam * across).sum(axis=1, keepdims=True))
    away = hand.depth_mm + np.where(hand.kind == "air", rng.uniform(3, 30, lines), 0)
    origin = np.array(CENTRE_MM) + HEAD_MM * normal - beam * away[:, None] + rng.normal(0, POSE_MM, (lines, 3))
    return rigid(np.stack([side, np.cross(beam, side), beam], axis=2), origin)
