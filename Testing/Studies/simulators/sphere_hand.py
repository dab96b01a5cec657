"""What the hand does in a session over a head of spheres, place by place, and where that puts the probe.

It starts askew, settles, and trembles; at some places it stays askew. Between the places it lifts the probe. A recording is a
stretch of the session, from one of its places on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from CranioNavLib.rigid import rigid
from scipy.signal import lfilter

from Testing.Studies.simulators.sphere_plan import Array, Bools, Rows, Setup, Words, shows_soft

WITHOUT_MM = 5.0  # where bone would be
LEAST_MM, LEAST_BONE_MM, MOST_MM = 1.0, 1.9, 15.0
MOST_TILT_DEG = 18.0
ASKEW = (4.0, 9.0)  # degrees, of a hand that does not find the normal
LIFTED_DEG = (5.0, 8.0)
LEAST_LINES = 8
HEAD_MM = 85.0
OFF_MM, OFF_RAD = 0.08, 0.001  # noise of the tracker


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the probe is, line by line, and what the places are."""

    kind: Words  # (n,) as in the World
    place: Rows  # (n,)
    along_mm: Array  # (n,) over the skin, from the middle of the place
    tilt_deg: Array  # (n, 2)
    square_mm: Array  # (n,) of tissue between the skin and the nearest bone
    depth_mm: Array  # (n,) of the bone along the beam
    incidence_rad: Array  # (n,) of the beam on the bone
    lifted_mm: Array  # (n,) over the skin
    timestamps_s: Array  # (n,)
    place_kind: Words  # (k,) bone, soft, gel, air, cable
    place_mm: Array  # (k,) of tissue before it is pressed
    radius_mm: Array  # (k,) of the bone

    @property
    def landing(self) -> Bools:
        return np.asarray(self.kind == "landing")

    @property
    def bone(self) -> Bools:
        return np.isin(self.kind, ["bone", "landing"])

    @property
    def soft(self) -> Bools:
        return np.asarray(self.kind == "soft")

    @property
    def gel(self) -> Bools:
        return np.asarray(self.kind == "gel")

    @property
    def on_skin(self) -> Bools:
        return np.asarray(self.bone | self.soft)


def draw_hand(rng: np.random.Generator, setup: Setup, frames: int) -> Hand:
    """A stretch of the session, from one of its places on; a longer one goes round again."""
    count = max(frames, LEAST_LINES)
    plan = _draw_plan(rng, setup)
    first, step_s = int(rng.integers(len(plan))), 1 / float(rng.uniform(15, 40))
    kinds: list[str] = []
    places: list[int] = []
    stays: list[Array] = []
    visited: list[tuple[str, float, float]] = []
    while len(kinds) < count:
        what, place_mm = plan[(first + len(visited)) % len(plan)]
        radius_mm = float(rng.uniform(60, 120))
        stay, stay_kinds = _draw_stay(rng, setup, what, place_mm, radius_mm, step_s)
        places += [len(visited)] * len(stay_kinds)
        kinds += stay_kinds
        stays.append(stay)
        visited.append((what, place_mm, radius_mm))
    place = np.array(places[:count])
    along, first_deg, second_deg, square, depth, incidence, lifted = np.concatenate(stays)[:count].T
    passing = step_s * rng.uniform(0.95, 1.05, count) + 0.8 * (np.diff(place, prepend=0) > 0)
    what_each, mm_each, radius_each = zip(*visited)
    return Hand(
        kind=np.array(kinds[:count], dtype="U8"),
        place=place,
        along_mm=along,
        tilt_deg=np.stack([first_deg, second_deg], axis=1),
        square_mm=square,
        depth_mm=depth,
        incidence_rad=incidence,
        lifted_mm=lifted,
        timestamps_s=1 + np.cumsum(passing),
        place_kind=np.array(what_each),
        place_mm=np.array(mm_each),
        radius_mm=np.array(radius_each),
    )


def _draw_plan(rng: np.random.Generator, setup: Setup) -> list[tuple[str, float]]:
    """What is met, and how deep, at the places of a whole session: bone, and at some soft tissue without bone, or gel in air."""
    if setup.without:
        return [(setup.without, WITHOUT_MM)]
    plan = [("bone", depth) for depth in setup.depths_mm]
    if rng.random() < 0.35:
        plan.insert(int(rng.integers(1, len(plan) + 1)), ("soft" if shows_soft(setup) else "gel", WITHOUT_MM))
    if rng.random() < 0.3:
        plan.insert(int(rng.integers(1, len(plan) + 1)), ("gel", WITHOUT_MM))
    return plan


def _draw_stay(
    rng: np.random.Generator, setup: Setup, what: str, place_mm: float, radius_mm: float, step_s: float
) -> tuple[Array, list[str]]:
    """One place or glide (n, 7), with the lines lifted to the next: along, two tilts, square, depth, incidence, lifted; kinds."""
    glides = setup.sweeps and what == "bone"
    if glides:
        count = int(rng.integers(25, 36))
    else:
        count = int(rng.integers(8, 17) if what == "bone" or setup.without else rng.integers(4, 9))
    lifted = 0 if setup.without else int(rng.integers(1, 4))
    time = np.arange(count) * step_s
    tilt = _draw_tilt(rng, time, step_s, glides)
    along = wander(rng, count, step_s, 0.5, 0.4) + (rng.uniform(8, 30) * time if glides else 0)
    breath = 0.3 * np.sin(2 * np.pi * 0.4 * time + rng.uniform(0, 2 * np.pi))
    pressure = np.clip(0.5 + wander(rng, count, step_s, 0.5, 0.3) + breath, 0, 1)
    square = place_mm * (1 - rng.uniform(0, 0.12) * pressure)
    if glides:
        square += rng.uniform(-0.06, 0.06) * along + 0.2 * np.sin(along / rng.uniform(4, 9))
    square = np.clip(square, LEAST_BONE_MM if what == "bone" else LEAST_MM, MOST_MM)
    angle = np.radians(np.minimum(np.hypot(*tilt), MOST_TILT_DEG))
    out_mm, aside_mm = (radius_mm + square) * np.cos(angle), (radius_mm + square) * np.sin(angle)
    depth = out_mm - np.sqrt(radius_mm**2 - aside_mm**2)
    incidence = np.arcsin(aside_mm / radius_mm)
    stay = np.stack([along, *tilt, square, depth, incidence, np.zeros(count)], axis=1)
    away = np.tile([along[-1], *LIFTED_DEG, place_mm, place_mm, np.radians(np.hypot(*LIFTED_DEG)), 0.0], (lifted, 1))
    away[:, -1] = rng.uniform(8, 40, lifted)
    kinds = [what] * count
    if what == "bone":
        kinds[0] = kinds[-1] = "landing"
    return np.concatenate([stay, away]), kinds + ["lifted"] * lifted


def _draw_tilt(rng: np.random.Generator, time_s: Array, step_s: float, glides: bool) -> Array:
    """Tilt about two axes (2, n): askew at first, then at rest about where the hand takes the normal to be; and it trembles."""
    count = len(time_s)
    rest_deg = rng.uniform(*ASKEW) if rng.random() < 0.15 else abs(rng.normal(0, 1.2))
    resting, starting = rng.uniform(0, 2 * np.pi, 2)
    start_deg = rng.rayleigh(4) * np.exp(-time_s / rng.uniform(0.15, 0.5))
    tremor_hz = rng.uniform(7, 11)
    axes = []
    for turn in (np.cos, np.sin):
        tremor = rng.uniform(0.1, 0.4) * np.sin(2 * np.pi * tremor_hz * time_s + rng.uniform(0, 2 * np.pi))
        unrest = wander(rng, count, step_s, 0.4, 1.5 if glides else 0.5)
        axes.append(rest_deg * turn(resting) + start_deg * turn(starting) + unrest + tremor)
    return np.stack(axes)


def wander(rng: np.random.Generator, count: int, step_s: float, lasts_s: float, spread: float) -> Array:
    """A hand's slow wander (count,): Ornstein-Uhlenbeck."""
    keeps = np.exp(-step_s / lasts_s)
    steps = rng.normal(0, spread, count)
    steps[1:] *= np.sqrt(1 - keeps**2)
    return np.asarray(lfilter([1.0], [1.0, -keeps], steps))


def draw_poses(rng: np.random.Generator, setup: Setup, hand: Hand) -> Array:
    """ProbeToReference of every line (n, 4, 4): the places lie on the upper half of the head."""
    places, count = len(hand.radius_mm), len(hand.place)
    upwards = rng.normal(size=(places, 3))
    upwards[:, 2] = np.abs(upwards[:, 2])
    middle = _unit(upwards)
    ahead = _unit(np.cross(middle, rng.normal(size=(places, 3))))
    radius, around = hand.radius_mm[hand.place][:, None], middle[hand.place]
    gone = (hand.along_mm[:, None]) / radius
    normal = around * np.cos(gone) + ahead[hand.place] * np.sin(gone)
    along = ahead[hand.place] * np.cos(gone) - around * np.sin(gone)
    aside = np.cross(normal, along)
    tip = around * (HEAD_MM - radius) + normal * (radius + (hand.square_mm + hand.lifted_mm)[:, None])
    tilt_deg = np.hypot(*hand.tilt_deg.T)[:, None]
    angle = np.radians(np.minimum(tilt_deg, MOST_TILT_DEG))
    towards = hand.tilt_deg / np.maximum(tilt_deg, 1e-9) * np.sin(angle)
    beam = -normal * np.cos(angle) + along * towards[:, :1] + aside * towards[:, 1:]
    beam = _unit(beam + rng.normal(0, OFF_RAD, (count, 3)))
    right = _unit(along - beam * (along * beam).sum(axis=1, keepdims=True))
    rotation = np.stack([right, np.cross(beam, right), beam], axis=2)
    return np.asarray(rigid(rotation, tip - beam * setup.delay.length_mm + rng.normal(0, OFF_MM, (count, 3))))


def draw_statuses(rng: np.random.Generator, count: int) -> tuple[str, ...]:
    """The tracker's word on each line."""
    lost = rng.random(count) < 0.03
    words = np.where(lost, rng.choice(["INVALID", "MISSING", "OUT_OF_VIEW"], count), "OK")
    return tuple(str(word) for word in words)


def _unit(vectors: Array) -> Array:
    """Of length 1 (n, 3)."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
