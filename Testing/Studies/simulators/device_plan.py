"""What a recording of device_lines.py is drawn from: transducer, delay line, board, tissue; and how the hand goes.

The hand dwells on a place, sweeps, or sweeps over a burr hole or beyond the bone's edge. For a few lines at a time it lifts off,
wets a part of the face only, stands on hair, or the pulser is off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition

from Testing.Studies.simulators.units import InMicroseconds

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Words = npt.NDArray[np.str_]

SHALLOWEST_MM, DEEPEST_MM = 2.0, 15.0
MOST_LOSS_DB = 40.0  # there and back at the stated frequency: a board of 10 bits sees no more
RATES_MHZ = (25.0, 40.0, 59.925, 60.0, 63.75, 100.0, 125.0)
COMMON_RATE_MHZ, SAMPLES_A_CYCLE = 60.0, 3.0  # the rate taken where the drawn one has too few samples
DELAYS = ((1616.0, 0.05), (2170.0, -0.06), (2340.0, -0.2), (2460.0, -0.17), (2670.0, -0.32))  # m/s, reflection of the wet face
SHELF_MM = (12.0, 15.0, 20.0, 25.0)  # lengths that delay lines are sold in
BARE_FACE_R = -0.15  # of the transducer itself, from the tissue's side
TOUCHED = ("bone", "hole", "tissue", "water")  # kinds of line whose face is wet
LOST_WORDS = ("MISSING", "OUT_OF_VIEW", "INVALID")

LEAST_LINES = 8
USUAL_LINES = (40, 60)  # of a recording: a shorter one has fewer mishaps, and passes a hole faster
MISHAP_LINES = 7  # the longest
BEAM_MM = 1.5  # to each side
HEAD_MM = 80.0  # radius of the bone
ORIGIN_MM = np.array([30.0, -20.0, 110.0])  # the head's centre in the Reference frame
OFF_MM = 0.05  # noise of the tracker


@dataclass(frozen=True)
class Setup(InMicroseconds):
    """What all lines of a recording share."""

    acquisition: Acquisition
    face_r: float  # of the wet delay line; 0: no delay line
    style: str  # dwell, sweep, burr, edge
    without: str  # a recording without bone: air, tissue, water, empty (pulser off)
    pulse: str
    off_centre: float  # the pulse's frequency over the stated one, less 1
    bandwidth: float
    order: int  # of the pulse's rise: 1 is abrupt
    phase: float
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    about_mm: float  # depth of the bone
    reach_mm: float  # the lines end so deep
    snr_db: float  # of bone met squarely through a wet face at `about_mm`
    snr_of: str
    bone_r: float
    lobe_deg: float  # tilt that takes half of the echo
    floor: float  # what rough bone scatters, over a mirror's echo
    speckle: float

    @property
    def mm_us(self) -> float:
        """Depth in the tissue a microsecond."""
        return self.speed_m_s * 5e-4

    @property
    def delay_us(self) -> float:
        """There and back through the delay line, as stated."""
        return 2e3 * self.acquisition.forerun_length_mm / (self.acquisition.forerun_speed_m_s or 1.0)

    @property
    def entering(self) -> float:
        """What comes through the face, there and back."""
        return 1 - self.face_r**2


@dataclass(frozen=True, eq=False)
class World(Setup):
    """The set-up, and what each of the n lines is."""

    late_us: float  # the pulser fires at time zero; envelopes peak so much later
    kind: Words  # (n,) bone; hole, tissue, water, air, empty: no bone
    wet: Array  # (n,) share of the face that is
    hair_db: Array  # (n,) what hair and bubbles take
    gain_db: Array  # (n,) turned by the operator, stated nowhere
    ignore: Bools  # (n,) judged by nobody: the beam straddles an edge, or the face is hardly wet
    must: Bools  # (n,) an answer is owed: bone met squarely through a wet face


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the probe is and what it meets, line by line (n,)."""

    way_mm: Array
    depth_mm: Array  # of the bone, or where it would be
    tilt_deg: Array
    covered: Array  # share of the beam that bone is under
    kind: Words
    wet: Array
    hair_db: Array
    gain_db: Array

    @property
    def bone(self) -> Bools:
        return np.asarray(self.kind == "bone")

    @property
    def touching(self) -> Bools:
        return np.isin(self.kind, TOUCHED)

    @property
    def ignore(self) -> Bools:
        """The beam straddles an edge, or so little of the face is wet that an echo is neither owed nor forbidden."""
        straddles = (self.covered > 0) & (self.covered < 1)
        return np.asarray(straddles | (self.bone & (self.wet < 0.35)))

    @property
    def must(self) -> Bools:
        clear = (self.wet > 0.35) & (self.hair_db == 0) & (self.tilt_deg <= 3)
        return np.asarray(self.bone & clear & ~self.ignore)


def decibel(level: npt.ArrayLike) -> Array:
    """Height over 1."""
    return np.asarray(10 ** (np.asarray(level, dtype=float) / 20))


def draw_setup(rng: np.random.Generator) -> Setup:
    """Transducer and tissue over their whole ranges, as long as the bone's echo is not lost on the way."""
    while True:
        stated, attenuation, about = rng.uniform(3, 10), rng.uniform(0.3, 2.6), rng.uniform(SHALLOWEST_MM, DEEPEST_MM)
        if 0.2 * attenuation * stated * about <= MOST_LOSS_DB:
            break
    speed = float(rng.uniform(1450, 1630))
    sampling = float(rng.choice(RATES_MHZ))
    if sampling < SAMPLES_A_CYCLE * stated:
        sampling = COMMON_RATE_MHZ
    length_mm, delay_m_s, face_r = _draw_delay(rng, float(about), speed)
    return Setup(
        acquisition=Acquisition(sampling * 1e6, float(stated) * 1e6, length_mm, delay_m_s),
        face_r=face_r,
        style=str(rng.choice(["dwell", "sweep", "burr", "edge"], p=[0.4, 0.2, 0.25, 0.15])),
        without="" if rng.random() < 0.8 else str(rng.choice(["air", "tissue", "water", "empty"])),
        pulse="causal",
        off_centre=float(rng.uniform(-0.08, 0.08)),
        bandwidth=float(rng.uniform(0.45, 0.75)),
        order=int(rng.choice([1, 2])),
        phase=float(rng.uniform(0, 2 * np.pi)),
        speed_m_s=speed,
        attenuation=float(attenuation),
        about_mm=float(about),
        reach_mm=float(rng.uniform(20, 30)),
        snr_db=float(rng.uniform(12, 40)),
        snr_of="square",
        bone_r=float(rng.uniform(0.5, 0.65)),
        lobe_deg=float(rng.uniform(1.8, 3.5)),
        floor=float(decibel(rng.uniform(-28, -20))),
        speckle=float(decibel(rng.uniform(-40, -28))),
    )


def _draw_delay(rng: np.random.Generator, about_mm: float, speed_m_s: float) -> tuple[float, float, float]:
    """Length, speed and reflection of the delay line: half of the owners kept to the rule for its length, half took one that
    was on the shelf."""
    if rng.random() >= 0.5:
        return 0.0, 0.0, 0.0
    delay_m_s, face_r = DELAYS[rng.integers(len(DELAYS))]
    by_rule_mm = 1.15 * about_mm * delay_m_s / speed_m_s + rng.uniform(1, 4)
    length_mm = by_rule_mm if rng.random() < 0.5 else rng.choice(SHELF_MM)
    return round(float(length_mm), 2), delay_m_s, face_r


def draw_hand(rng: np.random.Generator, setup: Setup, frames: int) -> Hand:
    """The whole recording, of `frames` lines, at least LEAST_LINES."""
    count = max(frames, LEAST_LINES)
    way = _draw_way(rng, setup, count)
    swells, length_mm, start = 0.12 * setup.about_mm, rng.uniform(15, 40), rng.uniform(0, 2 * np.pi)
    depth = setup.about_mm + swells * (np.sin(2 * np.pi * way / length_mm + start) - np.sin(start))
    covered = _draw_covered(rng, setup, way)
    kind, wet, hair = _draw_mishaps(rng, count)
    kind = np.where((kind == "") & (covered == 0), "hole", np.where(kind == "", "bone", kind))
    if setup.without:
        covered, kind, wet, hair = np.ones(count), np.full(count, setup.without), np.ones(count), np.zeros(count)
    return Hand(
        way_mm=way,
        depth_mm=np.clip(depth, SHALLOWEST_MM, DEEPEST_MM),
        tilt_deg=_draw_tilt(rng, count),
        covered=covered,
        kind=kind,
        wet=wet,
        hair_db=hair,
        gain_db=_draw_gain(rng, count),
    )


def _draw_way(rng: np.random.Generator, setup: Setup, count: int) -> Array:
    """Way along the skin (n,). A hole is passed wholly: with fewer lines the hand goes faster."""
    step_mm = 0.08 if setup.style == "dwell" else rng.uniform(0.4, 0.9)
    if setup.style == "burr":
        step_mm *= max(1.0, USUAL_LINES[0] / count)
    way = np.cumsum(np.abs(rng.normal(step_mm, 0.3 * step_mm, count)))
    return np.asarray(way - way[0])


def _draw_covered(rng: np.random.Generator, setup: Setup, way_mm: Array) -> Array:
    """Share of the beam that bone is under (n,)."""
    if setup.style == "burr":
        centre_mm, radius_mm = rng.uniform(0.3, 0.7) * way_mm[-1], rng.uniform(5, 8)
        inside_mm = np.abs(way_mm - centre_mm) - radius_mm
    elif setup.style == "edge":
        inside_mm = rng.uniform(0.45, 0.8) * way_mm[-1] - way_mm
    else:
        return np.ones(len(way_mm))
    return np.asarray(np.clip((inside_mm + BEAM_MM) / (2 * BEAM_MM), 0, 1))


def _draw_mishaps(rng: np.random.Generator, count: int) -> tuple[Words, Array, Array]:
    """Kind ("": as the ground is), wetted share, and what hair takes (n,), where the contact goes wrong for a few lines."""
    kind, wet, hair = np.full(count, "", dtype="U6"), np.ones(count), np.zeros(count)
    share = count / float(np.clip(count, *USUAL_LINES))
    for _ in range(int(rng.integers(0, 4) * share + rng.random())):
        first = int(rng.integers(0, count - MISHAP_LINES))
        rows = slice(first, first + int(rng.integers(2, MISHAP_LINES + 1)))
        mishap = str(rng.choice(["air", "empty", "partial", "hair", "tissue"]))
        if mishap == "partial":
            wet[rows] = rng.uniform(0.15, 1)
        elif mishap == "hair":
            hair[rows] = rng.uniform(15, 30)
        else:
            kind[rows] = mishap
    return kind, wet, hair


def _draw_tilt(rng: np.random.Generator, count: int) -> Array:
    """Tilt (n,) of the beam to the bone, which wanders slowly: some hold the probe well, some badly."""
    held_deg = rng.choice([rng.uniform(0, 2.5), rng.uniform(0, 4), rng.uniform(2, 8)])
    wander = np.convolve(rng.normal(0, 1, count + 14), np.ones(15) / 4, "valid")
    return np.asarray(np.clip(held_deg + 0.8 * wander, 0, 8))


def _draw_gain(rng: np.random.Generator, count: int) -> Array:
    """Gain (n,) in dB: in some recordings the operator turns it once."""
    gain_db, margin = np.zeros(count), min(8, count // 4)
    if rng.random() < 0.35:
        gain_db[int(rng.integers(margin, count - margin)) :] = rng.choice([-12, -6, 6, 12])
    return gain_db


def draw_poses(rng: np.random.Generator, setup: Setup, hand: Hand) -> Array:
    """ProbeToReference (n, 4, 4): a way over a nearly flat part of the skull."""
    angle, tilt = hand.way_mm / HEAD_MM, np.radians(hand.tilt_deg)[:, None]
    towards = rng.uniform(0, 2 * np.pi)
    zero = np.zeros_like(angle)
    outward = np.stack([np.sin(angle), zero, np.cos(angle)], axis=1)
    onward = np.stack([np.cos(angle), zero, -np.sin(angle)], axis=1)
    across = np.array([0.0, 1.0, 0.0])
    beam = np.sin(tilt) * (np.cos(towards) * onward + np.sin(towards) * across) - np.cos(tilt) * outward
    side = np.cross(across, beam)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    poses = np.tile(np.eye(4), (len(angle), 1, 1))
    poses[:, :3, :3] = turn @ np.stack([side, np.cross(beam, side), beam], axis=2)
    before_mm = (hand.depth_mm + setup.acquisition.forerun_length_mm)[:, None]
    poses[:, :3, 3] = (HEAD_MM * outward - beam * before_mm) @ turn.T + ORIGIN_MM + rng.normal(0, OFF_MM, (len(angle), 3))
    return poses


def draw_statuses(rng: np.random.Generator, count: int) -> tuple[str, ...]:
    """The tracker's word on each line; now and then it loses the probe."""
    lost, word = rng.random(count) < 0.03, str(rng.choice(LOST_WORDS))
    return tuple(word if gone else "OK" for gone in lost)
