"""The hand of a recording whose trigger comes late: course, beam on the bone, what is under it, poses.

It dwells on a few places, where it lands askew, finds the echo and holds, or makes one glide. Bone is a sphere, a different one
under each place; depth and tilt are those of the ray that meets it. latency_plan.py says what else a recording is made of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from Testing.Studies.simulators.latency_plan import DEEPEST_MM, Array, Bools, Setup, Words

Rows = npt.NDArray[np.int64]

SQUARE_DEG = 3.0  # tilted from here on
LEAST_LINES, USUAL_LINES, GLIDE_LINES = 8, 98, 83  # of a recording; of a session of four places; of a glide
LINES_A_LOSS = 27.0  # the tracker loses the probe once in so many lines, where it does
OFF_MM = 0.08  # noise of the tracker
ORIGIN_MM = 90.0  # the head's surface from the Reference's origin


def wander(rng: np.random.Generator, count: int, lasts: float, spread: float, columns: int = 1) -> Array:
    """A slow wander (count, columns) that is alike over `lasts` lines."""
    keeps = np.exp(-1 / lasts)
    steps = rng.normal(0, spread, (count, columns))
    steps[1:] *= np.sqrt(1 - keeps**2)
    return np.asarray(lfilter([1.0], [1.0, -keeps], steps, axis=0))


def unit(vectors: Array) -> Array:
    """Of length 1 (n, 3)."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the probe is, line by line, and how its beam meets the bone: a sphere around the origin of its place."""

    state: Words  # (n,) air, edge (lands or lifts), on
    place: Rows  # (n,)
    aside_mm: Array  # (n, 2) on the skin
    tilt_deg: Array  # (n, 2) of the probe to the skin
    pressed: Array  # (n,) of the scalp's thickness
    thick_mm: Array  # (n,) of the scalp
    lifted_mm: Array  # (n,)
    head_mm: Array  # (n,) radius of the bone
    skin_mm: Array  # (n, 3)
    along: Array  # (n, 3) the beam
    side: Array  # (n, 3) the probe's first axis
    depth_mm: Array  # (n,) along the beam to the bone
    askew_deg: Array  # (n,) of the beam to the bone's normal

    @property
    def on(self) -> Bools:
        return np.asarray(self.state == "on")

    @property
    def square(self) -> Bools:
        return np.asarray(self.askew_deg <= SQUARE_DEG)


def draw_hand(rng: np.random.Generator, setup: Setup, frames: int) -> Hand:
    """The whole recording: a shorter one goes to fewer places and stays less long, or glides less far."""
    state, place = _draw_course(rng, setup, max(frames, LEAST_LINES))
    count = len(place)
    aside, tilt, thick = np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count)
    pressed, lifted, head = np.zeros(count), np.zeros(count), np.zeros(count)
    for number in range(int(place[-1]) + 1):
        rows = np.flatnonzero(place == number)
        head[rows] = rng.uniform(60, 120)
        pressed[rows] = np.clip(0.05 + wander(rng, len(rows), 12, 0.03)[:, 0], -0.02, 0.14)
        if setup.sweeps:
            aside[rows], tilt[rows], thick[rows] = _draw_glide(rng, setup, len(rows))
        else:
            aside[rows], tilt[rows], thick[rows] = _draw_dwell(rng, setup.places_mm[number], len(rows))
        in_air = rows[state[rows] == "air"]
        lifted[in_air] = rng.uniform(3, 30)
        tilt[in_air, 0] += rng.normal(0, 5)
    pressed_mm = np.asarray(np.maximum(thick * (1 - pressed), setup.least_mm))
    meets = _meet(aside / head[:, None], np.tan(np.radians(tilt)), pressed_mm, head)
    return Hand(state, place, aside, tilt, pressed, pressed_mm, lifted, head, *meets)


def _draw_course(rng: np.random.Generator, setup: Setup, count: int) -> tuple[Words, Rows]:
    """State and place of each line (n,). Landing and lifting take their time; the rest is as long as the recording allows."""
    if setup.without == "air":
        return np.full(count, "air"), np.zeros(count, dtype=np.int64)
    if setup.sweeps:
        before, on, after = int(rng.integers(3, 9)), int(rng.integers(50, 90)), int(rng.integers(2, 7))
        course = [("air", 0, before), ("edge", 0, 2), ("on", 0, on), ("edge", 0, 2), ("air", 0, after)]
    else:
        visited = round(len(setup.places_mm) * count / USUAL_LINES)
        course = []
        for number in range(min(max(1, visited), len(setup.places_mm))):
            if number or rng.random() < 0.6:
                course.append(("air", number, int(rng.integers(2, 7))))
            course.append(("edge", number, int(rng.integers(1, 3))))
            course += [("on", number, int(rng.integers(12, 26))), ("edge", number, 1)]
    states, places, usual = (np.array(column) for column in zip(*course))
    edge = states == "edge"
    share = (count - usual[edge].sum()) / usual[~edge].sum()
    ends = np.floor(np.cumsum(np.where(edge, usual, usual * share)) + 0.5).astype(int)
    ends[-1] = count
    lengths = np.diff(ends, prepend=0)
    return np.repeat(states, lengths), np.repeat(places, lengths)


def _draw_glide(rng: np.random.Generator, setup: Setup, count: int) -> tuple[Array, Array, Array]:
    """Way on the skin (n, 2), tilt (n, 2) and thickness (n,) of one glide."""
    whole_mm = rng.uniform(20, 50)
    far_mm = whole_mm * min(1.0, count / GLIDE_LINES)
    aside = np.concatenate([wander(rng, count, 10, 0.3), wander(rng, count, 15, 0.6)], axis=1)
    aside[:, 0] += far_mm * (np.arange(count) / count - 0.5)
    along = aside[:, 0] / whole_mm
    slow, fast = rng.uniform(0, 2 * np.pi, 2)
    swells = 0.7 * np.sin(2.5 * along + slow) + 0.2 * np.sin(7 * along + fast)
    thick = np.clip(setup.places_mm[0] + setup.varies_mm * swells, setup.least_mm, DEEPEST_MM)
    return aside, wander(rng, count, 14, 1.6, 2) + wander(rng, count, 2, 0.35, 2), thick


def _draw_dwell(rng: np.random.Generator, place_mm: float, count: int) -> tuple[Array, Array, Array]:
    """Way on the skin (n, 2), tilt (n, 2) and thickness (n,) on a place: the probe lands askew, in two of three, and is held."""
    aside = wander(rng, count, 8, 0.4, 2)
    lands_deg = rng.uniform(1.5, 9) * np.exp(-np.arange(count) / rng.uniform(2.5, 7)) * rng.choice([0, 1, 1])
    to, stays_to = rng.uniform(0, 2 * np.pi, 2)
    stays_deg = rng.uniform(0, 2.2)
    tilt = wander(rng, count, 6, 0.5, 2) + wander(rng, count, 1.5, 0.25, 2)
    tilt += lands_deg[:, None] * np.array([np.cos(to), np.sin(to)])
    tilt += stays_deg * np.array([np.cos(stays_to), np.sin(stays_to)])
    return aside, tilt, place_mm + aside @ rng.normal(0, 0.05, 2)


def _meet(angle: Array, slope: Array, thick_mm: Array, head_mm: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Point on the skin, beam, first axis of the probe (n, 3); depth of the bone along the beam, the beam's tilt to it."""
    (sine, beside), (cosine, level) = np.sin(angle.T), np.cos(angle.T)
    normal = np.stack([sine * level, beside, cosine * level], axis=1)
    first = np.stack([cosine, np.zeros(len(sine)), -sine], axis=1)
    along = unit(slope[:, :1] * first + slope[:, 1:] * np.cross(normal, first) - normal)
    skin = normal * (head_mm + thick_mm)[:, None]
    nearest = -(skin * along).sum(axis=1)
    depth = nearest - np.sqrt(np.maximum(nearest**2 - (head_mm + thick_mm) ** 2 + head_mm**2, 0))
    hit = skin + along * depth[:, None]
    askew = np.degrees(np.arccos(np.clip(-(hit * along).sum(axis=1) / head_mm, -1, 1)))
    side = unit(first - (first * along).sum(axis=1, keepdims=True) * along)
    return skin, along, side, depth, askew


@dataclass(frozen=True, eq=False)
class Ground:
    """What is under the probe (n,)."""

    kind: Words  # as in World
    soft: Bools  # no bone there
    wet: Bools  # sound passes

    @property
    def bone(self) -> Bools:
        """Where bone answers."""
        return self.wet & ~self.soft


def draw_ground(rng: np.random.Generator, setup: Setup, hand: Hand) -> Ground:
    """Bone, tissue without it, a burr hole, air, or a film of it."""
    count, on = len(hand.place), hand.on
    kind = np.where(hand.square, "bone", "tilted").astype("U8")
    soft = np.full(count, setup.without == "soft") | (hand.place == setup.soft_place)
    kind[soft] = "soft"
    for state in ("air", "edge"):
        kind[hand.state == state] = state
    if setup.hole and rng.random() < count / GLIDE_LINES:
        radius = setup.transducer.disc_mm / 2
        hole_mm = radius + rng.uniform(2.5, 5)
        centre_mm = rng.uniform(-0.2, 0.2) * np.ptp(hand.aside_mm[:, 0])
        away_mm = np.hypot(hand.aside_mm[:, 0] - centre_mm, hand.aside_mm[:, 1])
        soft |= away_mm < hole_mm
        kind[on & (away_mm < hole_mm - radius - 0.3)] = "hole"
        kind[on & (np.abs(away_mm - hole_mm) <= radius + 0.3)] = "rim"
    film = np.zeros(count, dtype=bool)
    if setup.bubbles:
        for first in rng.choice(count, max(1, count // 25), replace=False):
            film[first : first + int(rng.integers(1, 5))] = True
    film &= on
    kind[film] = "airfilm"
    return Ground(kind, soft, (hand.state != "air") & ~film)


def draw_poses(rng: np.random.Generator, setup: Setup, hand: Hand) -> Array:
    """ProbeToReference of every line (n, 4, 4); each place is elsewhere on the head."""
    poses = np.tile(np.eye(4), (len(hand.place), 1, 1))
    poses[:, :3, :3] = np.stack([hand.side, np.cross(hand.along, hand.side), hand.along], axis=2)
    poses[:, :3, 3] = hand.skin_mm - hand.along * (setup.delay.length_mm + hand.lifted_mm)[:, None]
    for number in range(int(hand.place[-1]) + 1):
        rows = np.flatnonzero(hand.place == number)
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        turn[:, 0] *= np.linalg.det(turn)
        to_head = np.eye(4)
        to_head[:3, :3] = turn
        to_head[:3, 3] = turn[:, 2] * (ORIGIN_MM - hand.head_mm[rows[0]])
        poses[rows] = to_head @ poses[rows]
    poses[:, :3, 3] += rng.normal(0, OFF_MM, (len(poses), 3))
    return np.asarray(poses)


def draw_statuses(rng: np.random.Generator, setup: Setup, count: int) -> tuple[str, ...]:
    """The tracker's word on each line; in some recordings it loses the probe for a few lines."""
    lost = np.zeros(count, dtype=bool)
    if setup.loses_pose:
        for first in rng.choice(count, max(1, round(count / LINES_A_LOSS)), replace=True):
            lost[first : first + int(rng.integers(1, 6))] = True
    words = rng.choice(["INVALID", "MISSING", "OUT_OF_VIEW"], count)
    return tuple(str(word) if gone else "OK" for gone, word in zip(lost, words))
