"""What a recording of a flat disc held on the scalp is made of: set-up, hand, skull, poses and tracker.

The probe is chosen to suit the scalp: what tissue takes from its centre frequency on the way to bone and back stays within a
limit. On each place the hand comes out of the air, lands askew, rights the probe and rests with a wander and a tremor, unless it
is lazy, slips, or meets hair; or it sweeps on, where it may cross a burr hole. The point of the bone that the beam meets is
drawn, on a sphere, with the thickness of the scalp over it as the hand presses it; the skin follows from them.
piston_lines.py makes the lines of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition
from CranioNavLib.rigid import rigid, rigid_from_vector
from scipy.signal import lfilter

from Testing.Studies.simulators.units import InMicroseconds

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]
Words = npt.NDArray[np.str_]

DELAYS = ((1616.0, 0.04), (2170.0, -0.05), (2340.0, -0.20), (2460.0, -0.17), (2670.0, -0.32))  # m/s; reflection of a wetted face
RATES_MHZ = np.array([25, 32, 40, 50, 60, 62.5, 64, 80, 100, 125])
LEAST_SAMPLES = 3.2  # a cycle
LEAST_MM, MOST_MM = 2.0, 15.0  # of scalp
MOST_LOSS_DB, TISSUE_LOSS_DB = 45.0, 30.0  # both ways, at the centre frequency: to bone; to the deepest of tissue without bone
LEAST_LINES, PLACE_LINES, SWEEP_LINES = 8, 24.0, 84.0  # of a recording; usual ones of a place and of a sweep
LEAST_OF_PLACE, MOST_OF_PLACE, MOST_PLACES = 14, 36, 5
FIRMEST, LOOSEST = 0.12, -0.02  # by how much the hand presses the skin
HEAD_MM = 85.0  # from the middle of the head to its bone
EDGE_IN_MM, EDGE_OUT_MM = 2.5, 2.0  # the beam is partly over a burr hole's edge
LIFT_MM = (5.0, 30.0)
OFF_MM, OFF_DEG = 0.08, 0.08  # noise of the tracker
LOST = ("MISSING", "OUT_OF_VIEW", "INVALID")


@dataclass(frozen=True, eq=False)
class Setup(InMicroseconds):
    """What all lines of a recording share."""

    acquisition: Acquisition
    pulse: str
    order: float  # of its gamma envelope: the larger, the more alike rise and fall are
    bandwidth: float  # at -6 dB, of the centre
    phase: float
    aperture_mm: float  # of the disc as bone sees it: focus, curvature and roughness widen the lobe
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    snr_db: float  # of bone met squarely at the deepest place; more, where fainter things must stay visible
    snr_of: str
    without: str  # a recording without bone: tissue, air, gel, cable
    sweeps: bool
    sweep_mm: float
    typical_mm: float  # thickness of the scalp
    face_r: float  # reflection of the delay line's wetted face; 0: no delay line
    late: float  # the delay line's time over the stated one
    warming: float  # change of it over the recording
    rate_hz: float  # of the lines
    lazy: float  # chance that the hand rests askew on a place
    slips: float
    hair: float
    bits: int  # of the converter; more are taken where they would hide the noise
    overdriven: bool  # bone clips

    @property
    def mm_per_us(self) -> float:
        """Depth that a microsecond later comes from."""
        return self.speed_m_s * 0.5e-3

    @property
    def deepest_mm(self) -> float:
        return min(MOST_MM, 1.25 * self.typical_mm)


@dataclass(frozen=True, eq=False)
class World(Setup):
    """The set-up, and what became of each of the n lines."""

    kind: Words  # (n,) bone, tilted, steep, faint, clipped, landing, hole-edge; air, hair, soft, hole, gel, cable: no bone
    ignore: Bools  # (n,) judged by nobody: half in contact, over a hole's edge, clipped, or square and yet faint
    skin_us: Array  # (n,) when the echo of the delay line's end comes


def draw_setup(rng: np.random.Generator) -> Setup:
    """A set-up; the probe suits the scalp."""
    without = str(rng.choice(["", "tissue", "air", "gel", "cable"], p=[0.86, 0.07, 0.02, 0.03, 0.02]))
    typical, attenuation, centre = _draw_probe(rng, without)
    speed = float(rng.uniform(1450, 1630))
    length, delay_speed, reflection = _draw_delay_line(rng, min(MOST_MM, 1.25 * typical) / speed)
    sampling = float(rng.choice(RATES_MHZ[LEAST_SAMPLES * centre <= RATES_MHZ]))
    return Setup(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, length, delay_speed),
        pulse="gamma",
        order=float(rng.uniform(3, 5)),
        bandwidth=float(rng.uniform(0.5, 0.8)),
        phase=float(rng.uniform(-np.pi, np.pi)),
        aperture_mm=float(5 * (5 / centre) ** rng.uniform(0.5, 1) * rng.uniform(0.45, 1)),
        speed_m_s=speed,
        attenuation=attenuation,
        snr_db=float(rng.uniform(14, 40)),
        snr_of="deepest",
        without=without,
        sweeps=bool(rng.random() < 0.27),
        sweep_mm=float(rng.uniform(20, 45)),
        typical_mm=typical,
        face_r=reflection,
        late=float(rng.uniform(-0.008, 0.008)),
        warming=float(rng.uniform(-0.002, 0.002)),
        rate_hz=float(rng.uniform(20, 60)),
        lazy=float(rng.choice([0, 0.3], p=[0.8, 0.2])),
        slips=float(rng.choice([0, 0.4], p=[0.75, 0.25])),
        hair=float(rng.choice([0, 0.5], p=[0.75, 0.25])),
        bits=int(rng.choice([10, 12, 12, 14])),
        overdriven=bool(not without and rng.random() < 0.08),
    )


def _draw_probe(rng: np.random.Generator, without: str) -> tuple[float, float, float]:
    """Thickness of the scalp in mm, its attenuation, and the frequency in MHz that is chosen for it."""
    tissue = without == "tissue"
    while True:
        typical = float(np.exp(rng.uniform(np.log(2.2), np.log(14.5))))
        attenuation = float(rng.uniform(0.3, 1.2 if tissue else 2.6))
        centre = float(np.exp(rng.uniform(np.log(3), np.log(10))))
        reach_mm = MOST_MM if tissue else min(MOST_MM, 1.25 * typical)
        if 0.2 * attenuation * centre * reach_mm < (TISSUE_LOSS_DB if tissue else MOST_LOSS_DB):
            return typical, attenuation, centre


def _draw_delay_line(rng: np.random.Generator, deepest_over_speed: float) -> tuple[float, float, float]:
    """Length in mm, speed in m/s and reflection of its end: its second echo comes after the deepest bone; zeros: none."""
    if rng.random() >= 0.55:
        return 0.0, 0.0, 0.0
    speed, reflection = DELAYS[rng.integers(len(DELAYS))]
    length = max(8.0, deepest_over_speed * 1.08 * speed * rng.uniform(1.05, 1.5))
    return float(length), speed, float(reflection * rng.uniform(0.8, 1.2))


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the probe is in each of n lines, and what lies under it."""

    kind: Words  # (n,) air, landing (and lifting off), on, hair; gel, cable
    place: Rows  # (n,)
    tilt: Array  # (n, 2) rad, off the perpendicular of the bone
    hole: Rows  # (n,) 0: none, 1: its edge, 2: in it
    soft: Bools  # (n,) a place without bone
    thick_mm: Array  # (places,) of the scalp
    depth_mm: Array  # (n,) along the beam, or where bone would be
    square_mm: Array  # (n,) from the probe's centre to the nearest point of the bone
    skin_to_reference: Array  # (n, 4, 4) the probe's face; +z is the beam

    @property
    def touching(self) -> Bools:
        return np.isin(self.kind, ["on", "landing"])

    @property
    def angle(self) -> Array:
        """Between the beam and the perpendicular (n,), rad."""
        return np.asarray(np.hypot(self.tilt[:, 0], self.tilt[:, 1]))

    @property
    def places(self) -> int:
        return len(self.thick_mm)


@dataclass(frozen=True, eq=False)
class Stretch:
    """Some lines in a row: what the hand does, tilt (n, 2) in deg, way along the head and aside (n, 2) in mm."""

    kind: list[str]
    tilt: Array
    way: Array


def wander(rng: np.random.Generator, steps: float, spread: float, shape: tuple[int, int]) -> Array:
    """Ornstein-Uhlenbeck wander down the rows: its spread, and after how many steps it has forgotten where it was."""
    keeps = np.exp(-1 / steps)
    pushes = rng.normal(0, spread, shape)
    pushes[1:] *= np.sqrt(1 - keeps**2)
    return np.asarray(lfilter([1.0], [1.0, -keeps], pushes, axis=0))


def _tremor(rng: np.random.Generator, lines: int, rate_hz: float, height: float) -> Array:
    time = np.arange(lines)[:, None] / rate_hz
    shake = np.sin(2 * np.pi * (rng.uniform(7, 11) * time + rng.random(2)))
    return np.asarray(height * shake * (1 + 0.3 * rng.normal(size=(lines, 1))))


def _in_air(rng: np.random.Generator, setup: Setup, most: int, pace: float, least: int = 1) -> Stretch:
    """Lines in the air, of `most` when there is time; who has less of it is not longer there."""
    lines = max(1, round(int(rng.integers(least, most + 1)) * min(1.0, pace)))
    return Stretch(["air"] * lines, wander(rng, 0.3 * setup.rate_hz, 6.0, (lines, 2)), np.zeros((lines, 2)))


def _glide(rng: np.random.Generator, setup: Setup, frames: int) -> list[Stretch]:
    """A sweep; who has less time goes faster, over a shorter way."""
    pace = frames / SWEEP_LINES
    before = _in_air(rng, setup, 5, pace, 2)
    lines = max(6, round(int(rng.integers(60, 95)) * pace))
    tilt = wander(rng, 0.8 * setup.rate_hz, rng.uniform(1.0, 2.2), (lines, 2))
    tilt += _tremor(rng, lines, setup.rate_hz, rng.uniform(0.1, 0.3))
    way = np.cumsum(rng.normal(0, 0.05, (lines, 2)), axis=0)
    way[:, 0] += np.linspace(-0.5, 0.5, lines) * setup.sweep_mm * min(1.0, np.sqrt(pace))
    kind = ["landing"] + ["on"] * (lines - 2) + ["landing"]
    return [before, Stretch(kind, tilt, way), _in_air(rng, setup, 5, pace, 2)]


def _dwell(rng: np.random.Generator, setup: Setup, pace: float) -> Stretch:
    """One place: the hand lands askew, rights the probe and rests; who has less time does it all faster."""
    lines = max(6, round(int(rng.integers(14, 28)) * pace))
    time = np.arange(lines)[:, None] / (setup.rate_hz * min(1.0, pace))
    toward, from_ = ((np.cos(turn), np.sin(turn)) for turn in rng.uniform(0, 2 * np.pi, 2))
    rest = rng.uniform(3, 7) if rng.random() < setup.lazy else rng.uniform(0, 1.8)
    tilt = rest * np.array([toward]) + rng.uniform(2, 9) * np.array([from_]) * np.exp(-time / rng.uniform(0.06, 0.2))
    tilt += wander(rng, 0.3 * setup.rate_hz, rng.uniform(0.2, 0.6), (lines, 2))
    tilt += _tremor(rng, lines, setup.rate_hz, rng.uniform(0.1, 0.35))
    if rng.random() < setup.slips:
        some = min(4, max(1, round(4 * pace)))
        first = int(rng.integers(2, lines - some))
        tilt[first : first + some] += rng.uniform(9, 20) * np.array(from_)
    kind = np.full(lines, "on", dtype="<U8")
    kind[: int(rng.integers(1, 3))] = "landing"
    kind[-1] = "landing"
    if rng.random() < setup.hair:
        some = min(3, max(1, round(3 * pace)))
        first = int(rng.integers(2, lines - some - 1))
        kind[first : first + some] = "hair"
    return Stretch(list(kind), tilt, np.cumsum(rng.normal(0, 0.04, (lines, 2)), axis=0))


def _draw_places(rng: np.random.Generator, frames: int) -> int:
    """How many places are dwelt on: as many as leave each the time it usually takes."""
    least = int(np.clip(np.ceil(frames / MOST_OF_PLACE), 1, MOST_PLACES))
    most = int(np.clip(frames // LEAST_OF_PLACE, least, MOST_PLACES))
    return int(rng.integers(least, most + 1))


def draw_hand(rng: np.random.Generator, setup: Setup, frames: int) -> Hand:
    """The whole recording, of about `frames` lines; a shorter one goes to fewer places."""
    frames = max(frames, LEAST_LINES)
    if setup.sweeps:
        places, stretches = 1, _glide(rng, setup, frames)
        owners = [0] * len(stretches)
    else:
        places = _draw_places(rng, frames)
        pace = frames / places / PLACE_LINES
        stretches, owners = [], []
        for number in range(places):
            stretches += [_in_air(rng, setup, 5, pace), _dwell(rng, setup, pace)]
            owners += [number] * 2
        stretches.append(_in_air(rng, setup, 4, pace))
        owners.append(places - 1)
    kind = np.array([word for one in stretches for word in one.kind], dtype="<U9")
    if setup.without == "air":
        kind[:] = "air"
    place = np.repeat(owners, [len(one.kind) for one in stretches]).astype(np.int64)
    tilt = np.radians(np.concatenate([one.tilt for one in stretches]))
    way = np.concatenate([one.way for one in stretches])
    thick = np.full(places, setup.typical_mm)
    if not setup.sweeps:
        thick = np.clip(thick * rng.uniform(0.75, 1.25, places), LEAST_MM, MOST_MM)
    depth, square, poses = _meet(rng, setup, kind, place, tilt, way, thick)
    hole, soft = _draw_gaps(rng, setup, frames, place, way)
    if setup.without in ("gel", "cable"):
        kind[:] = setup.without
    return Hand(kind, place, tilt, hole, soft, thick, depth, square, poses)


def _draw_gaps(rng: np.random.Generator, setup: Setup, frames: int, place: Rows, way: Array) -> tuple[Rows, Bools]:
    """Where a sweep crosses a burr hole (n,), 0: not, 1: its edge, 2: inside; which lines are at a place without bone (n,)."""
    hole, soft = np.zeros(len(place), dtype=np.int64), np.zeros(len(place), dtype=bool)
    if setup.without:
        return hole, soft
    shorter = min(1.0, np.sqrt(frames / SWEEP_LINES))  # who goes over less of the head meets fewer holes
    places = int(place.max()) + 1
    if setup.sweeps and rng.random() < 0.6 * shorter:
        radius = rng.uniform(5.5, 8)
        off = np.hypot(way[:, 0] - rng.uniform(-6, 6) * shorter, way[:, 1])
        hole[off < radius + EDGE_OUT_MM] = 1
        hole[off < radius - EDGE_IN_MM] = 2
    elif not setup.sweeps and rng.random() < (0.3 if places > 2 else 0.12 * (places - 1)):
        soft = place == rng.integers(places)
    return hole, soft


def _meet(
    rng: np.random.Generator, setup: Setup, kind: Words, place: Rows, tilt: Array, way: Array, thick_mm: Array
) -> tuple[Array, Array, Array]:
    """Depth along the beam (n,), distance of the bone's nearest point (n,), the face's pose (n, 4, 4); each place is a sphere."""
    depth, square, poses = np.empty(len(place)), np.empty(len(place)), np.empty((len(place), 4, 4))
    for number, thick in enumerate(thick_mm):
        rows = np.flatnonzero(place == number)
        press = 0.04 + wander(rng, 0.5 * setup.rate_hz, 0.03, (len(rows), 1))[:, 0]
        above = thick * (1 - np.clip(press, LOOSEST, FIRMEST))
        if setup.sweeps:
            swell = np.sin(2 * np.pi * (way[rows, 0] / rng.uniform(25, 60) + rng.random()))
            above = above * (1 + rng.uniform(0.05, 0.2) * swell)
        depth[rows] = np.clip(above, LEAST_MM - 0.05, MOST_MM) / np.cos(np.minimum(np.hypot(*tilt[rows].T), 0.3))
        radius, lift = rng.uniform(60, 110), rng.uniform(*LIFT_MM)
        square[rows], beam, across, skin = _over_sphere(rng, radius, tilt[rows], way[rows], depth[rows])
        skin -= beam * np.where(kind[rows] == "air", lift, 0.0)[:, None]
        poses[rows] = rigid(np.stack([across, np.cross(beam, across), beam], axis=2), skin)
    return depth, square, poses


def _over_sphere(
    rng: np.random.Generator, radius: float, tilt: Array, way: Array, depth: Array
) -> tuple[Array, Array, Array, Array]:
    """Distance of a sphere's nearest point (n,), the beam, a direction across it, and the point of the skin, each (n, 3).

    The beam meets the sphere, which touches the head's radius somewhere, `way` from there, at `tilt` to its perpendicular.
    """
    middle = rng.normal(size=3)
    middle /= np.linalg.norm(middle)
    aside = np.cross(middle, [0.0, 0.0, 1.0] if abs(middle[2]) < 0.9 else [1.0, 0.0, 0.0])
    aside /= np.linalg.norm(aside)
    third = np.cross(middle, aside)
    along, off = (way / radius).T[:, :, None]
    normal = np.cos(along) * (np.cos(off) * middle + np.sin(off) * third) + np.sin(along) * aside
    azimuth = np.arctan2(tilt[:, 1], tilt[:, 0])[:, None]
    lean = np.cos(azimuth) * aside + np.sin(azimuth) * third
    lean -= np.sum(lean * normal, axis=1, keepdims=True) * normal
    lean /= np.linalg.norm(lean, axis=1, keepdims=True)
    angle = np.hypot(tilt[:, 0], tilt[:, 1])[:, None]
    beam = np.sin(angle) * lean - np.cos(angle) * normal
    centre = middle * (HEAD_MM - radius)
    skin = centre + radius * normal - beam * depth[:, None]
    across = np.cross(beam, third)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.linalg.norm(skin - centre, axis=1) - radius, beam, across, skin


def draw_statuses(rng: np.random.Generator, lines: int) -> tuple[str, ...]:
    """What the tracker says of each line: it loses the probe in bursts."""
    status = ["OK"] * lines
    if rng.random() < 0.25:
        for _ in range(int(rng.integers(1, 4))):
            first, word = int(rng.integers(lines)), str(rng.choice(LOST))
            length = max(1, round(int(rng.integers(1, 8)) * min(1.0, lines / SWEEP_LINES)))
            status[first : first + length] = [word] * len(status[first : first + length])
    return tuple(status)


def draw_poses(rng: np.random.Generator, setup: Setup, hand: Hand) -> Array:
    """ProbeToReference of every line (n, 4, 4) as tracked: its origin is the transducer, behind the delay line."""
    poses = hand.skin_to_reference.copy()
    count = len(poses)
    poses[:, :3, 3] -= poses[:, :3, 2] * setup.acquisition.forerun_length_mm
    poses[:, :3, 3] += rng.normal(0, OFF_MM, (count, 3))
    turned = rigid_from_vector(np.radians(rng.normal(0, OFF_DEG, (count, 3))), np.zeros((count, 3)))
    poses[:, :3, :3] = turned[:, :3, :3] @ poses[:, :3, :3]
    return poses


def draw_timestamps(rng: np.random.Generator, setup: Setup, hand: Hand) -> Array:
    """Seconds (n,); the way to the next place takes longer."""
    moves = np.diff(hand.place, prepend=0) > 0
    gaps = rng.uniform(0.9, 1.1, len(moves)) / setup.rate_hz + rng.uniform(0.8, 2, len(moves)) * moves
    return np.asarray(1 + np.cumsum(gaps))
