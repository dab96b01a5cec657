"""What a hand-held scan over a head is made of: acquisition, tissue, the hand's way, the probe, and the tracker's poses.

The hand dwells on a few places, where it lands askew and turns in, or glides over one region and the next; between places it is
in air. An operator takes a frequency that gets to the bone and back. What is drawn here, scan_lines.py turns into lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition
from CranioNavLib.rigid import rigid
from scipy.signal import lfilter

from Testing.Studies.simulators.units import ThroughScalp

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

# speed of sound in m/s, reflection at soft tissue
MATERIALS = {
    "aqualene": (1616.0, 0.04),
    "tpx": (2170.0, -0.05),
    "polystyrene": (2340.0, -0.20),
    "hdpe": (2460.0, -0.17),
    "pmma": (2670.0, -0.32),
}
RATES_MHZ = np.array([25, 31.25, 40, 50, 60, 62.5, 80, 100, 125])
LEAST_SAMPLES = 3.0  # a cycle
MOST_LOSS_DB = 40.0  # to the bone and back: an operator picks a probe that manages
DEPTHS_MM = ((2.2, 3.8), (3.5, 8.0), (7.5, 14.0))
DEPTHS_SHARE = (0.15, 0.55, 0.30)
THINNEST_MM, THICKEST_MM = 2.0, 15.0
USUAL_LINES, PLACE_LINES = 83.0, 28.0  # of a recording, of a place, when there is time
LEAST_PLACE, TIGHT_PLACE = 8, 16  # lines of contact on a place; lines a place when time is short
EDGE, GAP = 0.02, 0.97  # share of the beam that looks into a hole: judged by nobody in between
ROUND_MM = 90.0  # radius of the head along the way over it
POSE_MM, POSE_DEG = 0.08, 0.1  # what the tracker adds


@dataclass(frozen=True, eq=False)
class Setup(ThroughScalp):
    """What is drawn before the hand moves."""

    without: str  # a recording without bone: soft, air, gel
    sweeps: bool
    pulse: str
    centre_mhz: float
    sampling_mhz: float
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    snr_db: float  # of bone met squarely, over the noise's RMS
    snr_of: str
    depth_mm: float  # typical
    line_s: float

    @property
    def loss_db_mm(self) -> float:
        """Of the centre frequency, there and back, a millimetre of depth."""
        return 0.2 * self.attenuation * self.centre_mhz

    def echo_us(self, depth_mm: Array) -> Array:
        """How long after the skin an echo comes."""
        return np.asarray(2 * depth_mm / self.mm_us)


def draw_setup(rng: np.random.Generator) -> Setup:
    """Tissue and acquisition of a recording."""
    without = str(rng.choice(["", "soft", "air", "gel"], p=[0.88, 0.06, 0.03, 0.03]))
    sweeps = bool(rng.random() >= 0.6)
    speed = float(rng.uniform(1450, 1630))
    while True:
        centre = float(np.exp(rng.uniform(np.log(3), np.log(10))))
        strong = rng.random() < 0.3
        attenuation = float(rng.uniform(2.2, 2.6) if strong else np.exp(rng.uniform(np.log(0.3), np.log(2.6))))
        sampling = float(rng.choice(RATES_MHZ))
        depth = float(rng.uniform(*DEPTHS_MM[rng.choice(len(DEPTHS_MM), p=DEPTHS_SHARE)]))
        if sampling >= LEAST_SAMPLES * centre and attenuation * centre * 0.2 * depth * 1.15 < MOST_LOSS_DB:
            break
    return Setup(
        without=without,
        sweeps=sweeps,
        pulse="gauss",
        centre_mhz=centre,
        sampling_mhz=sampling,
        speed_m_s=speed,
        attenuation=attenuation,
        snr_db=float(rng.uniform(13, 40)),
        snr_of="square",
        depth_mm=depth,
        line_s=float(1 / (rng.uniform(20, 50) if sweeps else rng.uniform(15, 30))),
    )


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the probe is, line by line, and how deep the bone lies there."""

    place: Rows  # (n,)
    along_mm: Array  # (n,) on the path
    aside_mm: Array  # (n,) off the path
    tilt_deg: Array  # (n, 2) about both axes
    coupling: Array  # (n,) 1: all of the face is wet; 0: in air
    depth_mm: Array  # (n,) of the bone along the beam, or where it would be

    @property
    def angle_deg(self) -> Array:
        """Between beam and perpendicular (n,)."""
        return np.asarray(np.degrees(np.arctan(np.hypot(*np.tan(np.radians(self.tilt_deg)).T))))

    @property
    def contact(self) -> Bools:
        return self.coupling > 0


@dataclass(frozen=True, eq=False)
class _Part:
    """A stretch of the hand's way; every array (n,)."""

    along: Array
    aside: Array
    tilt_x: Array
    tilt_y: Array
    coupling: Array
    place: Rows
    pressed: Array  # from 0 to 1


def wander(rng: np.random.Generator, count: int, step_s: float, lasting_s: float) -> Array:
    """A stationary Ornstein-Uhlenbeck walk of variance 1 (count,)."""
    keeps = np.exp(-step_s / lasting_s)
    pushes = rng.normal(size=count)
    pushes[1:] *= np.sqrt(1 - keeps**2)
    return np.asarray(lfilter([1.0], [1.0, -keeps], pushes))


def smooth(rng: np.random.Generator, along_mm: Array, alike_mm: float, count: int = 1, waves: int = 24) -> Array:
    """Smooth random functions of the path, of variance 1 (count, n), that stay alike over `alike_mm`."""
    turns = rng.normal(0, 1 / alike_mm, (count, 1, waves))
    starts = rng.uniform(0, 2 * np.pi, (count, 1, waves))
    return np.asarray(np.cos(along_mm[None, :, None] * turns + starts).sum(axis=-1) * np.sqrt(2 / waves))


def draw_hand(rng: np.random.Generator, setup: Setup, frames: int) -> Hand:
    """The whole way, of about `frames` lines; who has less time goes to fewer places."""
    drawn = int(rng.integers(1, 4) if setup.sweeps else rng.integers(2, 5))
    places = min(drawn, max(1, frames // TIGHT_PLACE))
    hurry = min(1.0, frames / places / PLACE_LINES)
    lifted = [max(1, round(int(rng.integers(2, 7)) * hurry)) for _ in range(places)]
    count = max(LEAST_PLACE, (frames - sum(lifted)) // places)
    parts: list[_Part] = []
    start_mm = 0.0
    for place, in_air in enumerate(lifted):
        down = _contact(rng, setup, place, count, start_mm)
        parts += [down, _air(rng, down, in_air)]
        start_mm = float(down.along[-1] + rng.uniform(25, 60))
    way = _Part(*(np.concatenate([getattr(part, name) for part in parts]) for name in _Part.__dataclass_fields__))
    coupling = _wetted(rng, setup, way)
    tilt = np.stack([way.tilt_x, way.tilt_y], axis=1)
    return Hand(way.place, way.along, way.aside, tilt, coupling, _draw_depth(rng, setup, way))


def _contact(rng: np.random.Generator, setup: Setup, place: int, count: int, start_mm: float) -> _Part:
    """One place: lands, and turns in or glides on; tremor of 8 to 11 Hz throughout."""
    step = setup.line_s
    time = np.arange(count) * step
    if setup.sweeps:
        spread, unrest = rng.uniform(0.8, 2.2), 0.3
        tilts = [spread * wander(rng, count, step, 0.7) for _ in range(2)]
        pace = np.clip(1 + 0.3 * wander(rng, count, step, 0.5), 0.2, 2) * rng.uniform(8, 40)
        along = start_mm + np.cumsum(pace) * step
        aside = 2.0 * wander(rng, count, step, 2.0)
    else:
        unrest = 0.35
        rest = rng.uniform(4, 8) if rng.random() < 0.15 else rng.uniform(0, 2.3)  # some never get to the perpendicular
        off = rest + rng.uniform(1, 9) * np.exp(-time / rng.uniform(0.1, 0.35))
        towards = rng.uniform(0, 2 * np.pi) + 0.4 * wander(rng, count, step, 2.0)
        tilts = [off * np.cos(towards), off * np.sin(towards)]
        along = start_mm + 0.5 * wander(rng, count, step, 1.0)
        aside = 0.5 * wander(rng, count, step, 1.0)
    for tilt in tilts:
        tremor = np.sin(2 * np.pi * rng.uniform(8, 11) * time + rng.uniform(0, 6))
        tilt += unrest * wander(rng, count, step, 0.15) + 0.15 * tremor
    coupling = np.ones(count)
    landing = int(rng.integers(1, 4))
    coupling[:landing] = np.linspace(rng.uniform(0.1, 0.4), 0.9, landing)
    coupling[-1] = rng.uniform(0.2, 0.9)
    pressed = np.clip(0.5 + 0.35 * wander(rng, count, step, 0.8), 0, 1)
    return _Part(along, aside, tilts[0], tilts[1], coupling, np.full(count, place), pressed)


def _air(rng: np.random.Generator, left: _Part, count: int) -> _Part:
    """The hand lifted off after `left`."""
    return _Part(
        along=left.along[-1] + np.linspace(0, 3, count),
        aside=np.full(count, left.aside[-1]),
        tilt_x=left.tilt_x[-1] + rng.normal(0, 2, count),
        tilt_y=left.tilt_y[-1] + rng.normal(0, 2, count),
        coupling=np.zeros(count),
        place=np.full(count, left.place[0]),
        pressed=np.full(count, 0.5),
    )


def _wetted(rng: np.random.Generator, setup: Setup, way: _Part) -> Array:
    """Coupling (n,); in hair and with air bubbles it comes and goes."""
    if setup.without == "air":
        return np.zeros_like(way.coupling)
    if rng.random() >= 0.15:
        return way.coupling
    lost = 0.45 * np.abs(smooth(rng, way.along, 2.0)[0]) + 0.3 * rng.random(len(way.along)) ** 3
    return np.asarray(way.coupling * np.clip(1.25 - lost, 0.03, 1))


def _draw_depth(rng: np.random.Generator, setup: Setup, way: _Part) -> Array:
    """Depth of the bone (n,): from place to place, along the path, and under the hand's pressure."""
    spread = np.exp(rng.normal(0, 0.12, int(way.place.max()) + 1))
    typical = np.clip(setup.depth_mm * spread, 2.1, 14.6)[way.place]
    gives = rng.uniform(0.02, 0.08)
    depth = typical * (1 + 0.06 * smooth(rng, way.along, 12.0)[0]) * (1 + gives * (0.5 - way.pressed))
    return np.asarray(np.clip(depth, THINNEST_MM, THICKEST_MM))


@dataclass(frozen=True, eq=False)
class Probe:
    """Transducer and delay line."""

    material: str  # of the delay line; "": none
    length_mm: float
    line_m_s: float  # as stated: the delay line's speed
    off: float  # by so much of itself the echo of the delay line's face comes later than stated
    warming: float  # by so much more it does in the last line, and less in the first
    face_r: float  # reflection at soft tissue; without a delay line, of the transducer
    back_r: float  # of the delay line's end at the transducer
    jitter_us: float
    waist_mm: float  # radius of the beam where it is narrowest, at 1/e of the field
    waist_at_mm: float  # from the transducer, as a way in tissue
    bandwidth: float  # at half height, of the centre
    phase: float
    ring: float  # height of the pulse's second half
    ring_us: float
    ring_phase: float

    def face_us(self, count: int) -> Array:
        """When the echo of the face comes in each line (count,): it warms up."""
        if not self.material:
            return np.zeros(count)
        stated = 2e3 * self.length_mm / self.line_m_s
        return np.asarray(stated * (1 + self.off + self.warming * np.linspace(0, 1, count)))


def draw_probe(rng: np.random.Generator, setup: Setup, deepest_mm: float) -> Probe:
    """A probe for bone that lies at most so deep."""
    centre = setup.centre_mhz
    disc = np.clip(5 * (5 / centre) ** 0.7, 2.8, 6.5) * rng.uniform(0.85, 1.15)
    bandwidth = float(rng.uniform(0.45, 0.8))
    material, length, speed = "", 0.0, 0.0
    face, back, jitter = float(rng.uniform(0.2, 0.5)), 0.0, 1e-3
    if rng.random() < 0.6:
        material = str(rng.choice(list(MATERIALS)))
        speed, face = MATERIALS[material]
        # as the rule wants it, or (a quarter) shorter: then its second echo lies among the depths
        share = rng.uniform(1.1, 1.5) if rng.random() < 0.75 else rng.uniform(0.6, 0.95)
        length = max(float(np.round(deepest_mm * speed / setup.speed_m_s * share, 1)), 6.0)
        back, jitter = float(rng.uniform(0.2, 0.45)), float(rng.choice([1e-3, 8e-3]))
    return Probe(
        material=material,
        length_mm=length,
        line_m_s=speed,
        off=float(rng.uniform(-0.006, 0.004)),
        warming=float(rng.uniform(-0.002, 0.002)),
        face_r=face,
        back_r=back,
        jitter_us=jitter,
        waist_mm=float(disc * rng.uniform(0.25, 0.5)),  # focused, or a flat disc
        waist_at_mm=float(length * speed / setup.speed_m_s + rng.uniform(5, 15)),
        bandwidth=bandwidth,
        phase=float(rng.uniform(0, 2 * np.pi)),
        ring=float(rng.uniform(0, 0.25)),
        ring_us=float(rng.uniform(0.6, 1.0) / (bandwidth * centre)),
        ring_phase=float(rng.uniform(0, 6)),
    )


@dataclass(frozen=True, eq=False)
class World(Setup):
    """What was drawn for a recording, and what each of its n lines shows."""

    probe: Probe
    bits: int
    kind: npt.NDArray[np.str_]  # (n,) bone, tilted, partial, edge; without bone: gap, air, soft, gel
    ignore: Bools  # (n,) judged by nobody: at the rim of a hole


def acquisition_of(setup: Setup, probe: Probe) -> Acquisition:
    """As the recording states it."""
    return Acquisition(setup.sampling_mhz * 1e6, setup.centre_mhz * 1e6, probe.length_mm, probe.line_m_s)


def kinds(setup: Setup, hand: Hand, missing: Array) -> npt.NDArray[np.str_]:
    """What each line shows (n,), where `missing` of its beam looks into a hole."""
    kind = np.full(len(missing), "bone", dtype="U8")
    kind[hand.angle_deg > 3] = "tilted"
    kind[hand.coupling <= 0.5] = "partial"
    kind[missing > EDGE] = "edge"
    kind[missing > GAP] = "gap"
    if setup.without:
        kind[:] = setup.without
    kind[~hand.contact] = "air"
    return kind


def draw_statuses(rng: np.random.Generator, count: int) -> tuple[str, ...]:
    """The tracker's word on each line; in some recordings somebody steps between camera and probe."""
    lost = rng.random(count) <= 0.02
    if rng.random() < 0.15:
        first = int(rng.integers(count))
        lasts = max(1, round(int(rng.integers(3, 12)) * min(1.0, count / USUAL_LINES)))
        lost[first : first + lasts] = True
    return tuple(str(rng.choice(["MISSING", "INVALID", "OUT_OF_VIEW"])) if gone else "OK" for gone in lost)


def _unit(vectors: npt.NDArray[np.floating]) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def draw_poses(rng: np.random.Generator, hand: Hand, length_mm: float) -> Array:
    """ProbeToReference of every line (n, 4, 4), on an ellipsoid of bone: the origin is the transducer, behind the delay line."""
    count = len(hand.place)
    axes = np.array([rng.uniform(68, 80), rng.uniform(85, 100), rng.uniform(75, 90)])
    polar, azimuth = rng.uniform(0.5, 1.2), rng.uniform(0, 2 * np.pi)
    around = azimuth + hand.along_mm / ROUND_MM / np.sin(polar)
    down = polar + hand.aside_mm / ROUND_MM
    bone = axes * np.stack([np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down)], axis=1)
    normal = _unit(bone / axes**2)
    first = _unit(np.cross(normal, [0.0, 0.0, 1.0]))
    second = np.cross(first, normal)
    slope = np.tan(np.radians(hand.tilt_deg)) + np.radians(POSE_DEG) * rng.normal(size=(count, 2))
    beam = _unit(slope[:, :1] * first + slope[:, 1:] * second - normal)
    side = _unit(first - (first * beam).sum(axis=1, keepdims=True) * beam)
    lifted = np.where(hand.contact, 0.0, rng.uniform(3, 20, count))
    origin = bone - (hand.depth_mm + length_mm + lifted)[:, None] * beam
    origin += rng.normal(0, 60, 3) + rng.normal(0, POSE_MM, (count, 3))
    return np.asarray(rigid(np.stack([side, np.cross(beam, side), beam], axis=2), origin))
