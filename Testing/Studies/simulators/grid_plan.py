"""What a recording that lies anywhere in the stated ranges is made of: the set-up, and the hand over a spherical skull.

Every quantity comes evenly from its whole range, whatever the others are. The hand dwells on four places, where it sets the probe
down askew and puts it straight, or sweeps over the head. Depth and tilt of a line come from where the beam meets the sphere.
grid_lines.py makes the lines of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition
from CranioNavLib.rigid import rigid

from Testing.Studies.simulators.units import InMicroseconds, ThroughScalp

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

DEPTH_MM = (2.0, 15.0)
MOST_LOSS_DB = 50.0  # two ways to the bone, at the centre frequency: beyond, nobody sees bone
RATES_MHZ = np.array([25.0, 40.0, 50.0, 60.0, 80.0, 100.0, 125.0])
LEAST_SAMPLES = 3.2  # a cycle: the band must fit below the highest frequency
HEAD_MM = 85.0  # radius of the skull
LEAST_LINES, PLACE_LINES, USUAL_PLACES = 8, 20, 4  # of a recording; of a place; of a recording of 80 lines
APART_MM = 40.0  # from place to place
ASKEW_DEG, STRAIGHTENS = 3.5, 5.0  # how far off the probe is set down about each axis; lines until it is put straight
SWELLS, PRESSED = 0.12, 0.04  # of the scalp's thickness: from place to place, and under the hand
PRESS_LINES = 23.0  # between two times that the hand presses
ORIGIN_MM = 0.08  # what the tracker adds


@dataclass(frozen=True)
class Material:
    """What delay lines are made of."""

    speed_m_s: float
    loss_db_cm: float
    reflection: float  # of the face that touches the skin
    length_mm: float  # from here on the second echo comes after all depths


MATERIALS = {
    "aqualene": Material(1616.0, 2.8, 0.04, 17.0),
    "tpx": Material(2170.0, 5.3, -0.05, 23.0),
    "rexolite": Material(2340.0, 1.0, -0.20, 25.0),
    "pmma": Material(2670.0, 1.5, -0.32, 28.0),
}


@dataclass(frozen=True, eq=False)
class Setup(InMicroseconds, ThroughScalp):
    """What all lines of a recording share."""

    acquisition: Acquisition
    pulse: str
    bandwidth: float  # at -6 dB, of the centre
    phase: float
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    snr_db: float  # of bone met squarely in the recording's median depth; half the height of its envelope over the RMS noise
    snr_of: str
    depth_mm: float  # typical
    without: str  # a recording without bone: soft, air, cable
    sweeps: bool
    material: str  # of the delay line; "": none
    short: bool  # the delay line's multiples fall among the depths
    face_r: float  # reflection of the delay line's wet face; 0: no delay line
    face_loss: float  # height left by the way through the delay line, there and back
    blanked: bool  # the receiver is deaf to the transmitted pulse
    half_deg: float  # the bone's echo has lost 6 dB
    floor: float  # its diffuse echo over its specular one
    speckle: float  # RMS over an echo of height 1


@dataclass(frozen=True, eq=False)
class World(Setup):
    """The set-up, and what an acceptance test asks of each of the n lines."""

    kind: npt.NDArray[np.str_]  # (n,) bone, weak, tilted, multiple (hides the bone); air, soft, cable: no bone
    ignore: Bools  # (n,) judged by nobody: at a change of kind, or with a spike on the bone's echo
    must: Bools  # (n,) bone so plain that nine of ten such lines must be accepted


def decibel(level: float) -> float:
    """Height over 1."""
    return float(10 ** (level / 20))


def draw_setup(rng: np.random.Generator) -> Setup:
    """A set-up, evenly from all ranges."""
    centre, attenuation = float(rng.uniform(3, 10)), float(rng.uniform(0.3, 2.6))
    depth = min(float(rng.uniform(*DEPTH_MM)), 5 * MOST_LOSS_DB / (attenuation * centre))
    without, sweeps = _draw_course(rng)
    material, short, length = _draw_delay_line(rng)
    made = MATERIALS.get(material, Material(0.0, 0.0, 0.0, 0.0))
    sampling = float(rng.choice(RATES_MHZ[LEAST_SAMPLES * centre <= RATES_MHZ]))
    face_loss = decibel(-made.loss_db_cm * 2 * length / 10)
    disc_mm, rough_deg = rng.uniform(3, 6), rng.uniform(1, 2)
    return Setup(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, length, made.speed_m_s),
        pulse="gauss",
        bandwidth=float(rng.uniform(0.4, 0.8)),
        phase=float(rng.uniform(0, 2 * np.pi)),
        speed_m_s=float(rng.uniform(1450, 1630)),
        attenuation=attenuation,
        snr_db=float(rng.uniform(12, 40)),
        snr_of="recording",
        depth_mm=depth,
        without=without,
        sweeps=sweeps,
        material=material,
        short=short,
        face_r=made.reflection,
        face_loss=face_loss,
        blanked=bool(rng.random() < 0.3),
        half_deg=float(np.hypot(1.2 * (5 / disc_mm) * (5 / centre), rough_deg)),
        floor=decibel(rng.uniform(-24, -16)),
        speckle=decibel(rng.uniform(-40, -28)),
    )


def _draw_course(rng: np.random.Generator) -> tuple[str, bool]:
    """What a recording lacks bone for, if it does, and whether the hand sweeps."""
    chance = rng.random()
    without = "soft" if chance < 0.10 else "air" if chance < 0.14 else "cable" if chance < 0.16 else ""
    return without, bool(chance > 0.72)


def _draw_delay_line(rng: np.random.Generator) -> tuple[str, bool, float]:
    """Material, whether it is short, and length in mm."""
    chance = rng.random()
    material = str(rng.choice(list(MATERIALS)))
    if chance <= 0.4:
        return "", False, 0.0
    short = bool(chance > 0.85)
    share = rng.uniform(0.35, 0.6) if short else rng.uniform(1.0, 1.15)
    return material, short, float(MATERIALS[material].length_mm * share)


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the probe is, line by line, and what lies under it; every array (n,) or (n, 3)."""

    kind: npt.NDArray[np.str_]  # bone, soft (skin without bone), air, cable (pulled)
    place: Rows
    depth_mm: Array  # of the bone along the beam, or where it would be
    angle_deg: Array  # between the beam and the perpendicular on the bone
    skin_mm: Array  # where the beam enters
    beam: Array  # its direction

    @property
    def bone(self) -> Bools:
        """Where bone answers."""
        return np.asarray(self.kind == "bone")

    @property
    def wet(self) -> Bools:
        """Where the probe touches the skin."""
        return np.isin(self.kind, ["bone", "soft"])

    @property
    def places(self) -> int:
        """How many places the recording has."""
        return int(self.place.max()) + 1

    @property
    def turns(self) -> Bools:
        """Both lines at a change of kind."""
        changed = self.kind[1:] != self.kind[:-1]
        return np.asarray(np.append(changed, False) | np.append(False, changed))


def draw_hand(rng: np.random.Generator, setup: Setup, frames: int) -> Hand:
    """The whole recording; a shorter one goes to fewer places."""
    frames = max(frames, LEAST_LINES)
    stretches = np.array_split(np.arange(frames), max(1, round(frames / PLACE_LINES)))
    sizes = [len(stretch) for stretch in stretches]
    place = np.zeros(frames, dtype=np.int64) if setup.sweeps else np.repeat(np.arange(len(sizes)), sizes)
    since = np.concatenate([np.arange(size) for size in sizes])
    if setup.sweeps:
        along = np.cumsum(np.full(frames, rng.uniform(0.3, 0.8)))
    else:
        along = place * APART_MM + np.cumsum(rng.normal(0, 0.1, frames))
    tilt = _draw_tilts(rng, setup, since)
    thick = _draw_thickness(rng, setup, along)
    return Hand(_draw_kinds(rng, setup, stretches), place, *_meet(along, tilt, thick))


def _draw_tilts(rng: np.random.Generator, setup: Setup, since: Rows) -> Array:
    """Tilt about both axes (n, 2), deg: set down askew, put straight, and unrest throughout; a sweep has the unrest alone."""
    spread, lasts = (rng.uniform(1.2, 2.5), 8.0) if setup.sweeps else (rng.uniform(0.6, 1.6), 4.0)
    keeps = np.exp(-1 / lasts)
    steps = rng.normal(0, spread * np.sqrt(1 - keeps**2), (len(since), 2))
    tilt = np.zeros((len(since), 2))
    start: Array = np.zeros(2)
    unrest: Array = np.zeros(2)
    for row, number in enumerate(since):
        if number == 0 and not setup.sweeps:
            start, unrest = rng.normal(0, ASKEW_DEG, 2), np.zeros(2)
        unrest = keeps * unrest + steps[row]
        tilt[row] = unrest + start * np.exp(-number / STRAIGHTENS)
    return tilt


def _draw_thickness(rng: np.random.Generator, setup: Setup, along: Array) -> Array:
    """Thickness of the scalp (n,), mm, as anatomy and the hand's pressure have it."""
    phase, period = rng.uniform(0, 2 * np.pi), rng.uniform(25, 60)
    thick = setup.depth_mm * (1 + SWELLS * np.sin(2 * np.pi * along / period + phase))
    thick *= 1 - PRESSED * np.sin(2 * np.pi * np.arange(len(along)) / PRESS_LINES) ** 2
    return np.clip(thick, *DEPTH_MM)


def _draw_kinds(rng: np.random.Generator, setup: Setup, stretches: list[Rows]) -> npt.NDArray[np.str_]:
    """What is under the probe in each line: it comes down from the air or slips off the bone now and then."""
    lines = sum(len(stretch) for stretch in stretches)
    if setup.without:
        return np.full(lines, setup.without, dtype="<U8")
    kind = np.full(lines, "bone", dtype="<U8")
    for stretch in stretches:
        if rng.random() < 0.3:
            share = min(1.0, len(stretch) / PLACE_LINES)  # who has less time on a place comes down faster
            kind[stretch[: max(1, round(int(rng.integers(3, 7)) * share))]] = "air"
    if rng.random() < 0.15 * min(1.0, len(stretches) / USUAL_PLACES):
        kind[stretches[rng.integers(len(stretches))]] = "soft"  # below the skull's edge
    return kind


def _meet(along: Array, tilt: Array, thick: Array) -> tuple[Array, Array, Array, Array]:
    """Depth along the beam, angle to the perpendicular, skin point and beam of each line, over a sphere."""
    round_, zero = along / HEAD_MM, np.zeros(len(along))
    normal = np.stack([np.cos(round_), np.sin(round_), zero], axis=1)
    ahead = np.stack([-np.sin(round_), np.cos(round_), zero], axis=1)
    aside = np.array([0.0, 0.0, 1.0])
    lean = np.tan(np.radians(tilt))
    beam = -normal + lean[:, :1] * ahead + lean[:, 1:] * aside
    beam /= np.linalg.norm(beam, axis=1, keepdims=True)
    skin = normal * (HEAD_MM + thick)[:, None]
    nearest = -(skin * beam).sum(axis=1)
    depth = nearest - np.sqrt(nearest**2 - (skin**2).sum(axis=1) + HEAD_MM**2)
    hit = skin + depth[:, None] * beam
    angle = np.degrees(np.arccos(np.clip(-(hit * beam).sum(axis=1) / HEAD_MM, -1, 1)))
    return depth, angle, skin, beam


def draw_poses(rng: np.random.Generator, setup: Setup, hand: Hand) -> Array:
    """ProbeToReference of every line (n, 4, 4): the origin is the transducer's face, behind the delay line."""
    across = np.cross([0.0, 0.0, 1.0], hand.beam)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rotation = np.stack([across, np.cross(hand.beam, across), hand.beam], axis=2)
    origin = hand.skin_mm - setup.acquisition.forerun_length_mm * hand.beam
    return rigid(rotation, origin + rng.normal(0, ORIGIN_MM, origin.shape))
