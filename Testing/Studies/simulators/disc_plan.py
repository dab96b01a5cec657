"""What a session with a disc transducer is made of: tissue, transducer and receiver, the hand on the head, the poses.

A user takes a lower frequency where the scalp is thick or fixed in formalin, so depth follows frequency and attenuation. The hand
dwells on a few places, each found from a tilt of some degrees, or sweeps; it lifts off between places or glides off the skull.
disc_lines.py makes the lines of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition
from CranioNavLib.rigid import rigid
from scipy.signal import lfilter

from Testing.Studies.simulators.units import InMicroseconds, ThroughScalp

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

SHALLOWEST_MM, DEEPEST_MM = 2.0, 15.0
MOST_LOSS_DB, SOFT_LOSS_DB = 45.0, 30.0  # two ways, at the centre frequency: to the bone; where there is none
APART_DB, APART_MM = 8.0, 4.0  # the places of a recording differ by so much from its typical depth
RATES_MHZ = np.array([25.0, 30.0, 40.0, 50.0, 60.0, 64.0, 80.0, 100.0, 125.0])
SAMPLES_A_CYCLE = 4.0  # at least
DELAYS = np.array([(1616, 1.49), (2170, 1.79), (2340, 2.47), (2460, 2.30), (2670, 3.15)])  # m/s, MRayl: from Aqualene to PMMA
FACE_DB = 18.0  # the delay line's echo stands so far over the noise: it is the time zero
LEAST_CODES = 0.7  # of noise: otherwise a converter of more bits is taken
LEAST_LINES = 8
OFF_MM, OFF_DEG = 0.1, 0.08  # noise of the tracker
LIFTED_MM = 4.0


@dataclass(frozen=True)
class DelayLine:
    """What is between transducer and skin; of length 0 without one."""

    length_mm: float
    speed_m_s: float
    face_r: float  # reflection of its wetted face
    short: bool  # its second echo comes among the depths
    late: float  # its time over the stated one, less 1


NO_DELAY = DelayLine(0.0, 0.0, 0.0, False, 0.0)


@dataclass(frozen=True)
class Setup(InMicroseconds, ThroughScalp):
    """What all lines of a recording share. Heights are over bone met squarely at the surface."""

    acquisition: Acquisition
    delay: DelayLine
    without: str  # a recording without bone: soft, air, gel (nothing behind it), noise (no transducer)
    pulse: str  # gauss, or tailed: rings once more
    bandwidth: float  # at -6 dB of amplitude, of the centre
    phase: float
    chirp: float  # phase at one standard deviation from the centre
    tail: float  # height of the second ring; 0: none
    tail_cycles: float  # when it comes
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    formalin: bool
    snr_db: float  # of bone met squarely in the recording's median depth
    snr_of: str
    depth_mm: float  # typical
    least_mm: float
    most_mm: float
    sweeps: bool
    places: int  # of a session of the usual length
    usual_lines: int  # that length
    rate_hz: float  # of the lines
    leaves: bool  # glides off the skull at the end
    disc_mm: float  # the aperture's radius
    back_r: float  # reflection of the transducer itself
    bone_r: float
    rough_mm: float
    diffuse: float  # what the rough bone scatters
    head_mm: float  # radius of the bone
    speckle: float
    bang: float  # the transmitted pulse over the typical bone
    ring_us: float
    spikes: bool
    saturated: bool
    fill: float  # of the converter, by the typical bone
    bits: int
    left: bool  # codes are moved up to 16 bits

    @property
    def wave_mm(self) -> float:
        return self.mm_us / self.centre_mhz

    @property
    def loss_db_mm(self) -> float:
        """Of a millimetre there and back, at the centre frequency."""
        return 0.2 * self.attenuation * self.centre_mhz

    @property
    def spread_mhz(self) -> float:
        """Standard deviation of the pulse's spectrum."""
        return self.bandwidth * self.centre_mhz / 2 / 1.1774

    @property
    def lobe_rad(self) -> float:
        """The tilt at which the disc has lost 6 dB of a flat mirror."""
        return 0.35 * self.wave_mm / (2 * self.disc_mm)


@dataclass(frozen=True, eq=False)
class World(Setup):
    """The set-up, and what each of the n lines is to a judge."""

    kind: npt.NDArray[np.str_]  # (n,) bone, and with -tilted, -weak, -clipped, -under-multiple; edge, soft, air, gel, noise
    ignore: Bools  # (n,) judged by nobody: at an edge, clipped, or under the delay line's second echo


def decibel(level: npt.ArrayLike) -> Array:
    """Height over 1."""
    return np.asarray(10 ** (np.asarray(level, dtype=float) / 20))


def wander(rng: np.random.Generator, count: int, step_s: float, lasts_s: float, spread: float, columns: int = 1) -> Array:
    """A hand's slow wander (count, columns): Ornstein-Uhlenbeck."""
    keeps = np.exp(-step_s / lasts_s)
    steps = rng.normal(0, spread, (count, columns))
    steps[1:] *= np.sqrt(1 - keeps**2)
    return np.asarray(lfilter([1.0], [1.0, -keeps], steps, axis=0))


def _draw_delay(rng: np.random.Generator, speed_m_s: float, bone_r: float, typical_db: float) -> DelayLine:
    """A delay line, whose echo stands out of the noise when bone's would be `typical_db` over it but for the tissue's loss."""
    tissue = rng.uniform(1.55, 1.8)
    reflection = (tissue - DELAYS[:, 1]) / (tissue + DELAYS[:, 1])
    over_noise_db = 20 * np.log10(np.abs(reflection) / bone_r) + typical_db
    seen = np.flatnonzero(over_noise_db > FACE_DB)
    if not len(seen):
        seen = np.array([np.abs(reflection).argmax()])
    made = int(rng.choice(seen))
    delay_m_s = float(DELAYS[made, 0] * rng.uniform(0.99, 1.01))
    short = bool(rng.random() < 0.2)
    tissue_mm = rng.uniform(5, 14) if short else rng.uniform(16, 19)
    length = float(tissue_mm * delay_m_s / speed_m_s)
    return DelayLine(length, delay_m_s, float(reflection[made]), short, float(rng.uniform(-0.005, 0.005)))


def _draw_converter(rng: np.random.Generator, without: str, snr_db: float) -> tuple[bool, float, int]:
    """Whether it clips, how far the typical bone fills it, and its bits."""
    saturated = not without and bool(rng.random() < 0.05)
    fill = float(rng.uniform(1.3, 2.5) if saturated else rng.uniform(0.08, 0.6))
    bits = int(rng.choice([10, 12, 14]))
    while fill * 2 ** (bits - 1) / float(decibel(snr_db)) < LEAST_CODES and bits < 16:
        bits += 1
    return saturated, fill, bits


def draw_setup(rng: np.random.Generator) -> Setup:
    """A set-up: tissue, transducer, receiver, and what the hand is about to do."""
    without = str(rng.choice(["", "soft", "air", "gel", "noise"], p=[0.80, 0.10, 0.04, 0.03, 0.03]))
    centre = float(np.exp(rng.uniform(np.log(3), np.log(10))))
    sampling = float(rng.choice(RATES_MHZ[SAMPLES_A_CYCLE * centre <= RATES_MHZ]))
    formalin = bool(rng.random() < 0.2)
    attenuation = float(rng.uniform(1.9, 2.6) if formalin else rng.uniform(0.3, 2.0))
    speed = float(rng.uniform(1508, 1542) if formalin else rng.uniform(1450, 1630))
    leaves = not without and bool(rng.random() < 0.2)
    shows_soft = without == "soft" or leaves
    snr, bone_r = float(rng.uniform(24, 42) if shows_soft else rng.uniform(19, 44)), float(rng.uniform(0.5, 0.65))
    loss_db_mm = 0.2 * attenuation * centre
    delayed = bool(rng.random() < 0.6)
    least = SHALLOWEST_MM if delayed else max(SHALLOWEST_MM, 0.5e-3 * speed * (0.3 + 5 / centre))  # or it rings on there
    most = max(min(DEEPEST_MM, (SOFT_LOSS_DB if without == "soft" else MOST_LOSS_DB) / loss_db_mm), least + 0.8)
    depth = float(rng.uniform(least, most))
    delay = _draw_delay(rng, speed, bone_r, snr + loss_db_mm * depth) if delayed else NO_DELAY
    sweeps, tailed = bool(rng.random() < 0.3), bool(rng.random() < 0.4)
    saturated, fill, bits = _draw_converter(rng, without, snr)
    return Setup(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, delay.length_mm, delay.speed_m_s),
        delay=delay,
        without=without,
        pulse="tailed" if tailed else "gauss",
        bandwidth=float(rng.uniform(0.45, 0.85)),
        phase=float(rng.uniform(0, 2 * np.pi)),
        chirp=float(rng.uniform(-0.4, 0.4)),
        tail=float(decibel(rng.uniform(-24, -16))) if tailed else 0.0,
        tail_cycles=float(rng.uniform(1.3, 2.2)),
        speed_m_s=speed,
        attenuation=attenuation,
        formalin=formalin,
        snr_db=snr,
        snr_of="square",
        depth_mm=depth,
        least_mm=least,
        most_mm=most,
        sweeps=sweeps,
        places=int(rng.integers(2, 5) if sweeps else rng.integers(1, 6)),
        usual_lines=int(rng.integers(40, 121)),
        rate_hz=float(rng.choice([20.0, 30.0, 50.0])),
        leaves=leaves,
        disc_mm=0.5 * speed * 1e-3 / centre * float(rng.uniform(8, 13)),
        back_r=float(rng.uniform(0.25, 0.55)),
        bone_r=bone_r,
        rough_mm=float(rng.uniform(0, 0.015)),
        diffuse=float(decibel(rng.uniform(-28, -21))),
        head_mm=float(rng.uniform(65, 110)),
        speckle=float(decibel(rng.uniform(-31, -24) if shows_soft else rng.uniform(-36, -26))),
        bang=float(decibel(rng.uniform(20, 36))),
        ring_us=float(rng.uniform(0.5, 0.85)) / centre,
        spikes=bool(rng.random() < 0.12),
        saturated=saturated,
        fill=fill,
        bits=bits,
        left=bool(rng.random() < 0.5),
    )


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the probe is, line by line."""

    place: Rows  # (n,)
    depth_mm: Array  # (n,) of the bone along the beam, or where it would be
    towards: Array  # (n, 3) from the head's centre
    tilt_deg: Array  # (n, 2)
    contact: Bools  # (n,)
    over_skull: Bools  # (n,)
    edge: Bools  # (n,) beside a change of the two

    @property
    def bone(self) -> Bools:
        """Where bone answers."""
        return self.contact & self.over_skull


def draw_hand(rng: np.random.Generator, setup: Setup, frames: int) -> Hand:
    """The whole recording: a shorter one goes to fewer places, or less far."""
    count, step = max(frames, LEAST_LINES), 1 / setup.rate_hz
    places = setup.places * count / setup.usual_lines
    if not setup.sweeps:
        places = max(1.0, float(round(places)))
    along = np.arange(count) / count * places
    place = along.astype(int)
    depth, towards = _draw_way(rng, setup, place, max(places * (setup.places - 1) / setup.places, 0.0))
    depth *= 1 - np.abs(wander(rng, count, step, 1.0, 0.05)[:, 0])  # pressed
    tilt = _draw_tilts(rng, setup, place, (along - place) * count / places * step)
    contact, over_skull, edge = _draw_lifts(rng, setup, place)
    return Hand(place, np.clip(depth, setup.least_mm, DEEPEST_MM), towards, tilt, contact, over_skull, edge)


def _draw_way(rng: np.random.Generator, setup: Setup, place: Rows, far: float) -> tuple[Array, Array]:
    """Depth (n,) and direction from the head's centre (n, 3): of the places, or swept from one to the next, `far` of them."""
    nodes = max(int(place[-1]) + 1, int(np.ceil(far)) + 1)
    half = min(APART_DB / setup.loss_db_mm, APART_MM)
    depths = np.clip(setup.depth_mm + rng.uniform(-half, half, nodes), setup.least_mm, setup.most_mm)
    middle = rng.normal(size=3)
    middle /= np.linalg.norm(middle)
    directions = unit(middle + rng.normal(0, 0.08 if setup.sweeps else 0.45, (nodes, 3)))
    if not setup.sweeps:
        return depths[place].copy(), directions[place]
    swept = np.linspace(0, far, len(place))
    columns = [np.interp(swept, range(nodes), column) for column in (depths, *directions.T)]
    return columns[0], np.stack(columns[1:], axis=1)


def _draw_tilts(rng: np.random.Generator, setup: Setup, place: Rows, since_s: Array) -> Array:
    """Tilt about both axes (n, 2): unrest, what the hand thinks is square, and the search for it on each place."""
    count, places = len(place), int(place[-1]) + 1
    unrest = wander(rng, count, 1 / setup.rate_hz, 0.35, rng.uniform(0.8, 2.0), 2)
    tilt = unrest + rng.normal(0, 0.8, (places, 2))[place]
    if setup.sweeps:
        return np.asarray(tilt)
    angle, first_deg = rng.uniform(0, 2 * np.pi, places)[place], rng.uniform(2, 9, places)[place]
    searching = first_deg * np.exp(-since_s / 0.25)
    return np.asarray(tilt + searching[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _draw_lifts(rng: np.random.Generator, setup: Setup, place: Rows) -> tuple[Bools, Bools, Bools]:
    """Where the probe touches the skin and is over the skull, and the lines beside a change (n,) each."""
    count = len(place)
    contact, over_skull, edge = np.ones(count, dtype=bool), np.ones(count, dtype=bool), np.zeros(count, dtype=bool)

    def end(what: Bools, first: int, last: int, beside: int) -> None:
        what[max(first, 0) : last] = False
        for change in (first, last):
            if 0 < change < count:
                edge[max(0, change - beside) : change + beside] = True

    if setup.without:
        over_skull[:] = False
        contact[:] = setup.without in ("soft", "gel")
        return contact, over_skull, edge
    if not setup.sweeps:
        for start in np.flatnonzero(np.diff(place)) + 1:
            if rng.random() < 0.7:
                end(contact, int(start - rng.integers(1, 4)), int(start + rng.integers(2, 5)), 1)
    if rng.random() < 0.25 * min(1.0, count / setup.usual_lines):  # once more, anywhere
        start = int(rng.integers(0, max(count - 12, 1)))
        end(contact, start, start + int(rng.integers(4, 12)), 1)
    if setup.leaves:
        end(over_skull, count - int(count * rng.uniform(0.12, 0.3)), count, 2)
    return contact, over_skull, edge


@dataclass(frozen=True, eq=False)
class Beam:
    """How the beam meets the bone, a sphere (n, 3); its first axis across the beam is that of the tilt's second."""

    bone_mm: Array
    along: Array
    aside: Array
    tilt_rad: Array  # (n,) to the normal


def draw_beam(rng: np.random.Generator, setup: Setup, hand: Hand) -> Beam:
    """The hand wanders over the place, too."""
    count = len(hand.place)
    aside_mm = wander(rng, count, 1 / setup.rate_hz, 0.5, 0.35, 3) + np.cumsum(rng.normal(0, 0.05, (count, 3)), axis=0)
    normal = unit(hand.towards + aside_mm / setup.head_mm)
    first = unit(np.cross(normal, [0.3, 0.5, 0.81]))
    second = np.cross(normal, first)
    slope = np.tan(np.radians(hand.tilt_deg))
    along = unit(slope[:, :1] * first + slope[:, 1:] * second - normal)
    tilt = np.arccos(np.clip(-(along * normal).sum(axis=1), -1, 1))
    return Beam(normal * setup.head_mm, along, second, tilt)


def draw_poses(rng: np.random.Generator, setup: Setup, hand: Hand, beam: Beam) -> Array:
    """ProbeToReference of every line (n, 4, 4): the delay line and the tissue are between origin and bone."""
    far = setup.delay.length_mm + hand.depth_mm + np.where(hand.contact, 0.0, LIFTED_MM)
    side = unit(np.cross(beam.aside, beam.along))
    rotation = np.stack([side, np.cross(beam.along, side), beam.along], axis=2)
    x, y, z = np.radians(rng.normal(0, OFF_DEG, (3, len(far))))
    none = np.zeros(len(far))
    turn = np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1).reshape(-1, 3, 3)
    left, _, right = np.linalg.svd((np.eye(3) + turn) @ rotation)
    origin = beam.bone_mm - beam.along * far[:, None]
    return np.asarray(rigid(left @ right, origin + rng.normal(0, OFF_MM, origin.shape)))


def draw_statuses(rng: np.random.Generator, setup: Setup, count: int) -> tuple[str, ...]:
    """The tracker's word on each line; in some recordings it loses the probe for a few lines."""
    statuses = np.full(count, "OK", dtype="U12")
    if rng.random() < 0.4:
        for _ in range(max(1, round(int(rng.integers(1, 4)) * min(1.0, count / setup.usual_lines)))):
            first = int(rng.integers(0, count))
            statuses[first : first + int(rng.integers(1, 7))] = rng.choice(["MISSING", "INVALID", "OUT_OF_VIEW"])
    return tuple(str(status) for status in statuses)


def unit(vectors: Array) -> Array:
    """Of length 1 (n, 3)."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
