"""What a recording with a single-element transducer is made of: set-up, what the hand does, the ground under it, the poses.

The hand dwells on places, sweeps over them, or takes a single line of each. What lies under a place is drawn by its region of the
head; a user takes a transducer that still hears the deepest of them, so thick scalp, loss and frequency do not come together.
sparse_lines.py makes the lines of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition
from CranioNavLib.rigid import rigid
from scipy.signal import lfilter

from Testing.Studies.simulators.units import InMicroseconds

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]
Words = npt.NDArray[np.str_]

RATES_MHZ = np.array([25.0, 31.25, 40.0, 50.0, 60.0, 64.0, 80.0, 100.0, 125.0])
SAMPLES_A_CYCLE = 3.3  # at least
DELAYS = np.array(  # m/s, reflection of the wetted face, dB/cm at 5 MHz: Aqualene, TPX, polystyrene, PMMA
    [(1616, 0.04, 2.8), (2170, -0.05, 5.3), (2340, -0.20, 1.0), (2670, -0.32, 3.0)]
)
LEAST_FACE_R = 0.04
REGIONS_MM = np.array([(4, 6.5), (3, 7), (5, 9), (5, 8), (6, 15), (2, 3.5), (2, 15)])  # forehead, parietal, ..., thin, any
REGION_SHARES = np.array([0.11, 0.23, 0.17, 0.08, 0.24, 0.14, 0.03])
ANY_REGION = 6
MOST_LOSS_DB, APART_DB = 42.0, 24.0  # two ways, at the centre frequency: the deepest place; between the places
SHALLOWEST_MM, DEEPEST_MM, LEAST_WAVES = 2.0, 15.3, 4.0
DRAWS = 16  # of the ground at a time, until a user's transducer gets through
HEAD_MM = np.array([72.0, 92.0, 80.0])
LEAST_LINES, USUAL_LINES = 8, 80
NOT_ON_SKIN = ("air", "water", "unplugged")


@dataclass(frozen=True)
class DelayLine:
    """What is between transducer and skin; of length 0 without one."""

    length_mm: float
    speed_m_s: float  # the true one
    face_r: float  # reflection of its wetted face
    attenuation: float  # dB/cm/MHz
    short: bool  # its second echo comes among the depths


NO_DELAY = DelayLine(0.0, 1.0, 0.0, 0.0, False)


@dataclass(frozen=True)
class Setup(InMicroseconds):
    """What all lines of a recording share. Heights are over a total reflection at the face."""

    acquisition: Acquisition
    delay: DelayLine
    style: str  # of the hand: dwell, sweep, sparse (one line a place)
    without: str  # a recording without bone: air, soft, water (no reflector in it), unplugged
    pulse: str
    bandwidth: float  # at -6 dB of amplitude, of the centre, before the pulse's decay is stretched
    decay: float  # of the envelope over its attack
    phase: float
    speed_m_s: float
    snr_db: float  # of bone met squarely at the median place
    snr_of: str
    window_mm: float  # of tissue that the lines cover
    element_mm: float
    aperture_mm: float  # what its lobe comes from; a focused element's is smaller
    back_r: float  # reflection of the element itself
    rate_hz: float  # of the lines
    strong_galea: bool
    saturated: bool
    spikes: bool
    loses_probe: bool
    bits: int  # of the converter, unless its noise is too small for them

    @property
    def us_mm(self) -> float:
        """Time of a millimetre of scalp, there and back."""
        return 2e3 / self.speed_m_s

    @property
    def wave_mm(self) -> float:
        return self.speed_m_s * 1e-3 / self.centre_mhz

    @property
    def beam_mm(self) -> float:
        """Width at -6 dB, at the bone."""
        return 0.25 * self.element_mm + 0.2

    @property
    def attack_us(self) -> float:
        """Standard deviation of the rising half of the pulse's envelope."""
        return 0.9 * 0.375 / (self.bandwidth * self.centre_mhz)

    @property
    def pulse_mm(self) -> float:
        """Length of the pulse in depth."""
        return 2.2 * self.attack_us * (1 + self.decay) / self.us_mm


@dataclass(frozen=True, eq=False)
class World(Setup):
    """The set-up, the scalp's loss, and what each of the n lines is to a judge."""

    attenuation: float  # dB/cm/MHz
    kind: Words  # (n,) bone, also -spike, -tilted, -weak, -masked, -saturated, -on-multiple; or what the hand's state is
    ignore: Bools  # (n,) judged by nobody: at an edge, under hair, on a multiple of the delay line
    demanded: Bools  # (n,) an expert would read them
    skin_us: Array  # (n,) when the skin answers: with the delay line's drift and the trigger's jitter


def wander(rng: np.random.Generator, count: int, step_s: float, lasts_s: float, spread: float) -> Array:
    """A hand's slow wander (count,): Ornstein-Uhlenbeck."""
    steps = rng.normal(0, spread, count)
    if count == 1:
        return steps
    keeps = np.exp(-step_s / lasts_s)
    steps[1:] *= np.sqrt(1 - keeps**2)
    return np.asarray(lfilter([1.0], [1.0, -keeps], steps))


def _draw_delay(rng: np.random.Generator, speed_m_s: float) -> tuple[DelayLine, float]:
    """A delay line and its stated speed of sound. Three in four are so long that their second echo falls behind all bone."""
    stated_m_s, mean_r, loss = DELAYS[rng.integers(len(DELAYS))]
    face_r = np.sign(mean_r) * max(abs(mean_r + rng.normal(0, 0.02)), LEAST_FACE_R)
    short = bool(rng.random() > 0.75)
    tissue_mm = rng.uniform(0.4, 0.95) * 15 if short else rng.uniform(1.05, 1.3) * 15.5
    length = round(float(tissue_mm * stated_m_s / speed_m_s), 1)
    warmth = 1 + rng.uniform(-0.008, 0.008)
    return DelayLine(length, float(stated_m_s * warmth), float(face_r), float(loss) / 5, short), float(stated_m_s)


def draw_setup(rng: np.random.Generator) -> Setup:
    """A set-up: transducer, delay line, receiver, and the manner of the hand."""
    speed = float(rng.uniform(1450, 1630))
    centre = float(3 * (10 / 3) ** rng.random())
    sampling = float(rng.choice(RATES_MHZ[SAMPLES_A_CYCLE * centre <= RATES_MHZ]))
    element = float(np.clip(speed * 1e-3 / centre * rng.uniform(11, 18), 2.5, 6.5))
    focused = rng.random() < 0.5
    delay, stated = _draw_delay(rng, speed) if rng.random() < 0.5 else (NO_DELAY, 0.0)
    return Setup(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, delay.length_mm, stated),
        delay=delay,
        style=str(rng.choice(["dwell", "sweep", "sparse"], p=[0.65, 0.2, 0.15])),
        without=str(rng.choice(["", "air", "soft", "water", "unplugged"], p=[0.85, 0.04, 0.06, 0.025, 0.025])),
        pulse="skewed",
        bandwidth=float(rng.uniform(0.5, 0.8)),
        decay=float(rng.uniform(1, 1.45)),
        phase=float(rng.uniform(0, 2 * np.pi)),
        speed_m_s=speed,
        snr_db=float(rng.uniform(13, 40)),
        snr_of="square",
        window_mm=float(rng.uniform(22, 38)),
        element_mm=element,
        aperture_mm=element * float(rng.uniform(0.4, 0.65) if focused else 1.0),
        back_r=float(rng.uniform(0.2, 0.45)),
        rate_hz=float(rng.uniform(10, 40)),
        strong_galea=bool(rng.random() < 0.2),
        saturated=bool(rng.random() < 0.1),
        spikes=bool(rng.random() < 0.2),
        loses_probe=bool(rng.random() < 0.4),
        bits=int(rng.choice([10, 12, 14, 16])),
    )


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the probe is, line by line."""

    place: Rows  # (n,)
    state: Words  # (n,) bone, soft, hair (or a bubble under the probe), edge (half in contact), air, water, unplugged
    along_mm: Array  # (n,) over the skin, from the middle of the place
    aside_mm: Array  # (n,)
    tilt_deg: Array  # (n, 2)
    slack: Array  # (n,) how much less than firmly it is pressed on

    @property
    def touches(self) -> Bools:
        return np.isin(self.state, ["bone", "soft"])


def draw_hand(rng: np.random.Generator, setup: Setup, frames: int) -> Hand:
    """The whole recording: a shorter one goes to fewer places, and the last is left early."""
    count = max(frames, LEAST_LINES)
    places: list[int] = []
    states: list[str] = []
    motions: list[Array] = []
    number, seen_soft = 0, False
    while len(states) < count:
        motion = _draw_stay(rng, setup)
        soft = number > 0 and not seen_soft and bool(rng.random() < 0.08)
        seen_soft |= soft
        stay = _draw_states(rng, len(motion), soft)
        if (setup.style != "sparse" or rng.random() < 0.12) and rng.random() < 0.6:  # lifted to the next place
            lifted = ["edge"] + ["air"] * int(rng.integers(2, 8)) + ["edge"]
            stay += lifted
            motion = np.concatenate([motion, np.zeros((len(lifted), motion.shape[1]))])
        places += [number] * len(stay)
        states += stay
        motions.append(motion)
        number += 1
    state = np.full(count, setup.without) if setup.without else np.array(states[:count])
    columns = np.concatenate(motions)[:count].T
    return Hand(np.array(places[:count]), state, columns[0], columns[1], columns[2:4].T, columns[4])


def _draw_stay(rng: np.random.Generator, setup: Setup) -> Array:
    """One place, or one sweep (n, 5): along, aside, tilt about two axes, slack."""
    count = {"dwell": int(rng.integers(8, 26)), "sweep": int(rng.integers(25, 60)), "sparse": 1}[setup.style]
    step = 1 / setup.rate_hz
    time = np.arange(count) * step
    unrest = float(rng.uniform(0.15, 0.5))
    over = _draw_search(rng, setup, time) + wander(rng, count, step, 0.5, 0.5) + _draw_tremor(rng, time, unrest)
    across = wander(rng, count, step, 0.5, 0.8) + _draw_tremor(rng, time, unrest)
    along, aside = wander(rng, count, step, 0.7, 0.35), wander(rng, count, step, 0.7, 0.35)
    if setup.style == "sweep":
        over = over + wander(rng, count, step, 0.8, 1.2)
        along = along + rng.uniform(8, 30) * time
    slack = wander(rng, count, step, 1.0, 0.06)
    if rng.random() < 0.4:  # pressed on more and more
        slack = slack + 0.25 * np.exp(-time / 0.3)
    angle = rng.uniform(0, 2 * np.pi)
    first = np.cos(angle) * over - np.sin(angle) * across
    second = np.sin(angle) * over + np.cos(angle) * across
    return np.stack([along, aside, first, second, slack], axis=1)


def _draw_search(rng: np.random.Generator, setup: Setup, time_s: Array) -> Array:
    """The tilt the hand means to hold (n,): steady, from far off at first, or rocking to and fro."""
    off = np.full(len(time_s), abs(rng.normal()) * 1.3)
    manner = rng.random()
    if manner < 0.5:
        return off
    if manner < 0.85:
        if setup.style == "sparse":
            return off
        return np.asarray(off + rng.uniform(4, 12) * np.exp(-time_s / rng.uniform(0.15, 0.5)))
    return np.asarray(off + rng.uniform(3, 9) * np.sin(2 * np.pi * rng.uniform(0.4, 1.2) * time_s + rng.uniform(0, 2 * np.pi)))


def _draw_tremor(rng: np.random.Generator, time_s: Array, spread: float) -> Array:
    """Physiological tremor (n,), whose strength comes and goes."""
    shake = np.sin(2 * np.pi * rng.uniform(7, 11) * time_s + rng.uniform(0, 2 * np.pi))
    swell = 1 + 0.3 * np.sin(2 * np.pi * 0.8 * time_s + rng.uniform(0, 2 * np.pi))
    return np.asarray(spread * np.sqrt(2) * shake * swell)


def _draw_states(rng: np.random.Generator, count: int, soft: bool) -> list[str]:
    """What the probe meets on a place: bone or tissue without end; hair or a bubble comes between for some lines."""
    states = ["soft" if soft else "bone"] * count
    if not soft and count > 6 and rng.random() < 0.08:
        first = int(rng.integers(1, count - 4))
        last = min(first + int(rng.integers(3, 6)), count)
        states[first:last] = ["hair"] * (last - first)
        states[first - 1] = "edge"
        if last < count:
            states[last] = "edge"
    return states


@dataclass(frozen=True, eq=False)
class Ground:
    """Scalp and bone of the k places."""

    attenuation: float  # dB/cm/MHz
    depth_mm: Array  # (k,)
    bone_r: Array  # (k,)
    radius_mm: Array  # (k,) of the bone
    diffuse: Array  # (k,) what its facets scatter, over its reflection
    rough_mm: Array  # (k,)
    position_mm: Array  # (k, 3)
    axes: Array  # (k, 3, 3) columns: along, aside, outward


def draw_ground(rng: np.random.Generator, setup: Setup, places: int) -> Ground:
    """What is under the places, none of them too deep for the transducer."""
    attenuation, depth = _draw_scalp(rng, setup, places)
    azimuth, polar = rng.uniform(0, 2 * np.pi, places), np.arccos(rng.uniform(0.05, 0.95, places))
    towards = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
    return Ground(
        attenuation=attenuation,
        depth_mm=depth,
        bone_r=rng.uniform(0.5, 0.65, places),
        radius_mm=rng.uniform(55, 120, places),
        diffuse=10 ** (rng.uniform(-31, -21, places) / 20),
        rough_mm=rng.uniform(0, 0.1, places),
        position_mm=towards * HEAD_MM + rng.normal(0, 40, 3),
        axes=_frames(unit(towards / HEAD_MM), rng.uniform(0, 2 * np.pi, places)),
    )


def _draw_scalp(rng: np.random.Generator, setup: Setup, places: int) -> tuple[float, Array]:
    """Its loss and its thickness at every place (k,): drawn again until the transducer gets through."""
    while True:
        low, middle, high = rng.uniform(0.3, 1.2, DRAWS), rng.uniform(0.7, 2.6, DRAWS), rng.normal(2.3, 0.3, DRAWS)
        which = rng.choice(3, DRAWS, p=[0.4, 0.4, 0.2])
        attenuation = np.clip(np.choose(which, [low, middle, high]), 0.3, 2.6)
        region = rng.choice(len(REGIONS_MM), (DRAWS, places), p=REGION_SHARES / REGION_SHARES.sum())
        region[rng.random(DRAWS) < 0.35] = ANY_REGION
        depth = rng.uniform(REGIONS_MM[region, 0], REGIONS_MM[region, 1])
        depth = np.maximum(depth, max(2.1, 4.2 * setup.wave_mm))  # nearer than four wavelengths nobody reads
        loss_db_mm = 0.2 * attenuation * setup.centre_mhz
        heard = (loss_db_mm * depth.max(axis=1) <= MOST_LOSS_DB) & (loss_db_mm * np.ptp(depth, axis=1) <= APART_DB)
        if heard.any():
            chosen = int(heard.argmax())
            return float(attenuation[chosen]), depth[chosen]


@dataclass(frozen=True, eq=False)
class Beam:
    """How the beam of each line meets the bone."""

    square_mm: Array  # (n,) of scalp between the skin and the nearest bone
    depth_mm: Array  # (n,) of the bone along the beam
    tilt_rad: Array  # (n,)


def draw_beam(rng: np.random.Generator, setup: Setup, hand: Hand, ground: Ground) -> Beam:
    """The thickness changes as the hand moves over the place, and as it presses."""
    places, place = len(ground.depth_mm), hand.place
    slope, start = rng.normal(0, 0.015, places)[place], rng.uniform(0, 2 * np.pi, places)[place]
    wave = (rng.uniform(0, 0.5, places) * ground.depth_mm / 6)[place]
    thickness = ground.depth_mm[place] + slope * hand.along_mm
    thickness += wave * (np.sin(hand.along_mm / 12 + start) - np.sin(start))
    thickness += hand.slack * np.minimum(ground.depth_mm / 5, 1.5)[place]
    square = np.clip(thickness, max(SHALLOWEST_MM, LEAST_WAVES * setup.wave_mm), DEEPEST_MM)
    tilt = np.radians(np.hypot(*hand.tilt_deg.T))
    depth = square / np.cos(tilt) + (square * np.tan(tilt)) ** 2 / (2 * ground.radius_mm[place])
    return Beam(square, depth, tilt)


def draw_poses(rng: np.random.Generator, setup: Setup, hand: Hand, ground: Ground, beam: Beam) -> Array:
    """ProbeToReference of every line (n, 4, 4): the origin is the element's face, behind delay line and skin."""
    radius = ground.radius_mm[hand.place][:, None]
    along, aside, outward = np.moveaxis(ground.axes[hand.place], 2, 0)
    normal = unit(outward + hand.along_mm[:, None] / radius * along + hand.aside_mm[:, None] / radius * aside)
    first = unit(along - (along * normal).sum(axis=1, keepdims=True) * normal)
    second = np.cross(normal, first)
    foot = ground.position_mm[hand.place] + radius * (normal - outward)
    leaning = hand.tilt_deg / np.maximum(np.hypot(*hand.tilt_deg.T), 1e-9)[:, None]
    leaning *= np.tan(beam.tilt_rad)[:, None]
    direction = unit(leaning[:, :1] * first + leaning[:, 1:] * second - normal)
    lifted = np.isin(hand.state, NOT_ON_SKIN) * rng.uniform(5, 40, len(normal))
    origin = foot + normal * (beam.square_mm + lifted)[:, None] - direction * setup.delay.length_mm
    turned = unit(direction + rng.normal(0, np.radians(rng.uniform(0.03, 0.15)), direction.shape))
    rotation = _frames(turned, np.full(len(turned), rng.uniform(0, 2 * np.pi)))
    return np.asarray(rigid(rotation, origin + rng.normal(0, rng.uniform(0.03, 0.12), origin.shape)))


def draw_statuses(rng: np.random.Generator, setup: Setup, count: int) -> tuple[str, ...]:
    """The tracker's word on each line; in some recordings it loses the probe for a few lines."""
    statuses = np.full(count, "OK", dtype="U12")
    if setup.loses_probe:
        for _ in range(max(1, round(int(rng.integers(1, 4)) * min(1.0, count / USUAL_LINES)))):
            first = int(rng.integers(0, count))
            statuses[first : first + int(rng.integers(1, 6))] = rng.choice(["MISSING", "INVALID", "OUT_OF_VIEW"])
    return tuple(str(status) for status in statuses)


def _frames(third: Array, twist: Array) -> Array:
    """Rotations (n, 3, 3) whose third axis is given (n, 3), twisted about it (n,)."""
    side = np.where(np.abs(third[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = unit(np.cross(side, third))
    second = np.cross(third, first)
    cosine, sine = np.cos(twist)[:, None], np.sin(twist)[:, None]
    return np.stack([cosine * first + sine * second, cosine * second - sine * first, third], axis=2)


def unit(vectors: Array) -> Array:
    """Of length 1 (n, 3)."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
