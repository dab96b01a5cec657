"""What a recording of strokes and dwells is made of: the set-up, the hand line by line, and the poses that agree with it.

The hand strokes along the skull two or three times, or dwells on a few places, where it sets the probe down askew and aligns it.
It comes from the air, wets down, may run into hair, a bubble or a defect of the skull, and lifts off. A shorter recording is
a part of such a session, begun and ended at some time. stroke_lines.py makes the lines of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.signal
from CranioNavLib.recording import Acquisition
from CranioNavLib.rigid import rigid

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]
Names = npt.NDArray[np.str_]

RATES_MHZ = np.array([25.0, 31.25, 40.0, 50.0, 60.0, 80.0, 100.0, 125.0])
LEAST_SAMPLES = 3.2  # a cycle
MOST_LOSS_DB, MOST_APART_DB = 48.0, 18.0  # two ways to bone: at the deepest place; between the deepest and the shallowest
DEEPEST_MM = 15.3  # of bone, along the beam
LEAST_LINES = 8
STROKE_LINES, DWELL_LINES = 28, 21  # of a stroke and of a dwell, without approach and lift-off
SESSION_LINES = 95  # typical; so many lines lose their pose 0.7 times
RUNS_LOST = 0.7
ORIGIN_MM, AXIS = 0.12, 0.002  # noise of the tracker: of the origin, of the beam's direction
HEAD_AT_MM = np.array([10.0, -20.0, -900.0])  # from the reference


@dataclass(frozen=True)
class Material:
    """What delay lines are made of."""

    speed_m_s: float
    impedance: float  # MRayl
    loss: float  # dB/cm/MHz


MATERIALS = {
    "aqualene": Material(1616.0, 1.49, 0.56),
    "tpx": Material(2170.0, 1.79, 1.06),
    "polystyrene": Material(2340.0, 2.47, 0.15),
    "pmma": Material(2670.0, 3.15, 0.30),
}


@dataclass(frozen=True, eq=False)
class World:
    """What all lines of a recording share."""

    acquisition: Acquisition
    pulse: str
    bandwidth: float  # at -6 dB, of the centre
    skew: float  # the envelope's fall over its rise
    phase: float
    centre_mhz: float  # of the pulse; the stated frequency is a little off
    speed_m_s: float  # of groups at the pulse's centre
    attenuation: float  # dB/cm/MHz
    snr_db: float  # of bone met squarely in the weakest place, over the RMS noise
    snr_of: str
    place_mm: Array  # (P,) depth of bone in each place, before the hand presses
    without: str  # a recording without bone: soft, air, unplugged
    sweeps: bool
    material: str  # of the delay line; "": none
    late: float  # the delay line's time over the stated one, less 1
    warming: float  # by so much more at the end of the session
    back_r: float  # reflection of the transducer at the delay line's rear
    face_r: float  # reflection of the transducer's own face, without a delay line
    lobe_deg: float  # the bone's echo has lost 6 dB
    floor: float  # its diffuse echo over its specular one
    rough_mm: float
    speckle: float
    reach_mm: float  # of tissue that the lines cover
    hot: bool  # the gain is too high
    spikes: bool
    tone: bool
    junk: int  # samples at the beginning that mean nothing

    @property
    def delay_us(self) -> float:
        """There and back in the delay line, as stated."""
        stated = self.acquisition
        return 2e3 * stated.forerun_length_mm / (stated.forerun_speed_m_s or 1.0)

    @property
    def delay_loss(self) -> float:
        """dB/MHz, there and back in the delay line."""
        return 0.2 * self.acquisition.forerun_length_mm * MATERIALS[self.material].loss if self.material else 0.0


@dataclass(frozen=True, eq=False)
class Hand:
    """What the hand does and meets in each of n lines."""

    state: Names  # bone; edge of a defect; soft; halfwet; gap (hair or a bubble); air; unplugged
    place: Rows
    solid: Bools  # of a place with bone
    tilt: Array  # (n, 2) deg, about two axes
    depth_mm: Array  # of bone along the beam, or where it would be
    pressed: Array  # the scalp's thickness over that at rest
    glide_mm: Array  # along the skull
    progress: Array  # from 0 at the session's beginning to 1 at its end

    @property
    def angle_deg(self) -> Array:
        """Between the beam and the perpendicular on the bone."""
        return np.hypot(*self.tilt.T)


def decibel(level: npt.ArrayLike) -> Array:
    """Height over 1."""
    return np.asarray(10 ** (np.asarray(level, dtype=float) / 20))


def wander(rng: np.random.Generator, lines: int, columns: int, keeps: float) -> Array:
    """Processes (lines, columns) of variance 1 that keep so much of themselves from line to line."""
    steps = rng.standard_normal((lines, columns))
    steps[1:] *= np.sqrt(1 - keeps**2)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -keeps], steps, axis=0))


def draw_world(rng: np.random.Generator, frames: int) -> World:
    """A set-up whose session takes about `frames` lines or more."""
    without = str(rng.choice(["air", "soft", "unplugged"], p=[0.35, 0.45, 0.2])) if rng.random() < 0.12 else ""
    stated_mhz, speed = rng.uniform(3, 10), rng.uniform(1450, 1630)
    sampling = float(rng.choice(RATES_MHZ[LEAST_SAMPLES * stated_mhz <= RATES_MHZ]))
    sweeps = bool(rng.random() < 0.4)
    drawn = rng.integers(2, 4) if sweeps else rng.integers(3, 6)
    needed = np.ceil(0.8 * frames / (STROKE_LINES if sweeps else DWELL_LINES))
    attenuation, place_mm = _draw_depths(rng, int(max(drawn, needed)), stated_mhz)
    material, length = _draw_delay_line(rng, speed)
    forerun_speed = MATERIALS[material].speed_m_s if material else 0.0
    lobe_deg = 1.2 * 25 / (stated_mhz * rng.uniform(3, 6)) * rng.uniform(1, 2)
    return World(
        acquisition=Acquisition(sampling * 1e6, stated_mhz * 1e6, length, forerun_speed),
        pulse="asymmetric",
        bandwidth=float(rng.uniform(0.45, 0.8)),
        skew=float(rng.uniform(1, 1.7)),
        phase=float(rng.uniform(0, 2 * np.pi)),
        centre_mhz=float(stated_mhz * rng.uniform(0.95, 1.05)),
        speed_m_s=float(speed),
        attenuation=attenuation,
        snr_db=float(rng.uniform(26, 40) if without == "soft" else rng.uniform(12, 40)),
        snr_of="weakest place",
        place_mm=place_mm,
        without=without,
        sweeps=sweeps,
        material=material,
        late=float(rng.uniform(-0.01, 0.01)),
        warming=float(rng.uniform(-0.002, 0.002)),
        back_r=float(rng.uniform(0.1, 0.4)),
        face_r=float(rng.uniform(0.2, 0.5)),
        lobe_deg=float(np.clip(lobe_deg, 1.2, 3.5)),
        floor=float(decibel(-rng.uniform(20, 29))),
        rough_mm=float(rng.uniform(0.02, 0.1)),
        speckle=float(decibel(-rng.uniform(38, 50))),
        reach_mm=float(rng.uniform(20, 26)),
        hot=bool(rng.random() < 0.1),
        spikes=bool(rng.random() < 0.12),
        tone=bool(rng.random() < 0.1),
        junk=int(rng.integers(3, 9)) if rng.random() < 0.1 else 0,
    )


def _draw_depths(rng: np.random.Generator, places: int, stated_mhz: float) -> tuple[float, Array]:
    """Attenuation, and depths of bone at which no echo is hopeless; formalin attenuates most."""
    if rng.random() < 0.2:
        attenuation = float(np.clip(rng.normal(2.4, 0.15), 2, 2.6))
    else:
        attenuation = float(np.exp(rng.uniform(np.log(0.3), np.log(2.6))))
    while True:
        thin = rng.random(places) < 0.3
        place_mm = 1.03 * np.where(thin, rng.uniform(2, 4.5, places), rng.uniform(4, 15, places))
        loss_db = 0.2 * place_mm * attenuation * stated_mhz
        if loss_db.max() < MOST_LOSS_DB and np.ptp(loss_db) < MOST_APART_DB:
            return attenuation, place_mm
        if rng.random() < 0.02:
            attenuation = max(0.3, 0.9 * attenuation)


def _draw_delay_line(rng: np.random.Generator, speed_m_s: float) -> tuple[str, float]:
    """Material and length in mm; of a short one, the second echo comes at depths where bone may be."""
    if rng.random() >= 0.6:
        return "", 0.0
    material = str(rng.choice(list(MATERIALS)))
    second_mm = rng.uniform(8, 15) if rng.random() < 0.3 else rng.uniform(16, 22)  # depth in tissue of the second echo
    return material, float(round(second_mm * MATERIALS[material].speed_m_s / speed_m_s, 1))


def draw_hand(rng: np.random.Generator, world: World, frames: int) -> Hand:
    """At most `frames` lines of the session, from some line on."""
    visits = [_draw_states(rng, world) for _ in world.place_mm]
    state = np.concatenate(visits)
    place = np.repeat(np.arange(len(visits)), [len(visit) for visit in visits])
    solid = np.array([bool((visit == "bone").any()) for visit in visits])[place]
    moves = [_draw_moves(rng, world, len(visit)) for visit in visits]
    tilt, pressed, glide_mm = (np.concatenate(parts) for parts in zip(*moves))
    along_beam = np.cos(np.radians(np.hypot(*tilt.T)))
    depth_mm = np.minimum(world.place_mm[place] * pressed / along_beam, DEEPEST_MM)
    count = max(frames, LEAST_LINES)
    first = int(rng.integers(0, max(len(state) - count, 0) + 1))
    arrays = (state, place, solid, tilt, depth_mm, pressed, glide_mm, np.linspace(0, 1, len(state)))
    return Hand(*(values[first : first + count] for values in arrays))


def _draw_states(rng: np.random.Generator, world: World) -> Names:
    """What one stroke or dwell meets in each of its lines."""
    lines = int(rng.integers(22, 34) if world.sweeps else rng.integers(16, 26))
    if world.without:
        return np.full(lines, world.without, dtype="<U9")
    state = np.full(lines, "bone", dtype="<U9")
    if rng.random() < 0.1:
        state[:] = "soft"  # a burr hole, neck, cheek
    elif world.sweeps and rng.random() < 0.3:
        first = int(rng.integers(5, lines - 11))
        last = first + int(rng.integers(4, 7))
        state[first:last] = "soft"
        state[[first - 2, first - 1, last, last + 1]] = "edge"
    if rng.random() < 0.12:
        first = int(rng.integers(3, lines - 7))
        last = first + int(rng.integers(2, 5))
        state[first:last] = "gap"
        state[[first - 1, last]] = "halfwet"
    before = np.full(int(rng.integers(1, 5)), "air")
    after = np.full(int(rng.integers(0, 3)), "air")
    return np.concatenate([before, ["halfwet"], state, ["halfwet"], after])


def _draw_moves(rng: np.random.Generator, world: World, lines: int) -> tuple[Array, Array, Array]:
    """Tilt (n, 2) in deg, pressed thickness (n,) over that at rest, and mm along the skull (n,) of one stroke or dwell."""
    number = np.arange(lines)
    tremor = wander(rng, lines, 2, 0.85)
    if world.sweeps:
        tilt = tremor * 1.7 + rng.normal(0, 0.8, 2)
    else:  # set down askew, then aligned
        side = rng.uniform(0, 2 * np.pi)
        askew = rng.uniform(2, 9) * np.exp(-number / rng.uniform(3, 9))
        tilt = askew[:, None] * [np.cos(side), np.sin(side)] + tremor * rng.uniform(0.3, 0.9) + rng.normal(0, 0.6, 2)
    contact = np.sin(np.pi * np.clip((number - 3) / (lines - 6), 0, 1))
    pressed = 1 - rng.uniform(0.02, 0.12) * contact + 0.004 * wander(rng, lines, 1, 0.8)[:, 0]
    if not world.sweeps:
        return tilt, pressed, 0.1 * wander(rng, lines, 1, 0.9)[:, 0]
    glide_mm = number * rng.uniform(0.3, 1.0)
    swells = 1 + rng.uniform(0.02, 0.12) * np.sin(glide_mm / rng.uniform(5, 12) + rng.uniform(0, 6))
    return tilt, pressed * swells, glide_mm


def draw_poses(rng: np.random.Generator, world: World, hand: Hand) -> Array:
    """ProbeToReference (n, 4, 4): the bone stays where it is, the probe moves on it, behind its delay line."""
    lines, places = len(hand.place), len(world.place_mm)
    radius = rng.uniform(75, 100)
    normals = rng.standard_normal((places, 3))
    normals[:, 2] = np.abs(normals[:, 2])
    normals = _unit(normals)
    ahead = _unit(np.cross(normals, [0.3, 0.9, 0.2]))
    round_ = (hand.glide_mm / radius)[:, None]
    normal = normals[hand.place] * np.cos(round_) + ahead[hand.place] * np.sin(round_)
    along = ahead[hand.place] * np.cos(round_) - normals[hand.place] * np.sin(round_)
    aside = np.cross(normal, along)
    angle = np.radians(hand.angle_deg)[:, None]
    toward = hand.tilt / np.maximum(hand.angle_deg, 1e-9)[:, None]
    leaning = toward[:, :1] * along + toward[:, 1:] * aside
    beam = _unit(np.sin(angle) * leaning - np.cos(angle) * normal + rng.normal(0, AXIS, (lines, 3)))
    across = _unit(np.cross(aside, beam))
    rotation = np.stack([across, np.cross(beam, across), beam], axis=2)
    lifted = np.where(hand.state == "air", rng.uniform(2, 15, lines), 0.0)
    back = hand.depth_mm + lifted + world.acquisition.forerun_length_mm
    origin = radius * normal - beam * back[:, None] + rng.normal(0, ORIGIN_MM, (lines, 3)) + HEAD_AT_MM
    return rigid(rotation, origin)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def draw_statuses(rng: np.random.Generator, lines: int) -> tuple[str, ...]:
    """Of every line's pose: a tool is lost for a few lines at a time."""
    statuses = np.full(lines, "OK", dtype="<U11")
    for _ in range(int(rng.poisson(RUNS_LOST * lines / SESSION_LINES))):
        first = int(rng.integers(0, lines))
        lost = statuses[first : first + int(rng.integers(1, 6))]
        lost[:] = rng.choice(["INVALID", "MISSING", "OUT_OF_VIEW"], len(lost))
    return tuple(str(status) for status in statuses)


def draw_times(rng: np.random.Generator, hand: Hand) -> Array:
    """When each line came (n,), s; from place to place it takes a while."""
    lines = len(hand.place)
    steps = rng.uniform(0.9, 1.1, lines) / rng.uniform(20, 50)
    steps[1:] += (np.diff(hand.place) > 0) * rng.uniform(1, 3)
    return np.cumsum(steps)
