"""What a recording over a skull in relief is made of: probe, tissue, receiver's noise, and the hand, line by line.

The hand dwells on places, where most often it comes in oblique and ends near the perpendicular, or sweeps across the head. It
lifts between places, meets hair, a soft place or a craniotomy. relief_lines.py makes the lines of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition
from CranioNavLib.rigid import rigid

from Testing.Studies.simulators.units import InMicroseconds

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

CENTRES_MHZ = [3.0, 3.5, 4.0, 5.0, 5.0, 6.0, 7.5, 10.0]
CENTRE_RANGE_MHZ = (3.0, 10.0)
RATES_MHZ = np.array([25, 31.25, 40, 50, 60, 62.5, 64, 80, 100, 125])
LEAST_SAMPLES = 3.3  # a cycle
DEEPEST_MM, SHALLOWEST_MM = 15.0, 2.0
MOST_LOSS_DB = 45.0  # two ways to the bone: nobody takes a probe that loses more
USUAL_LINES, PLACE_LINES, SWEEP_LINES = 83.0, 18.5, 77.0  # of a recording in dwells; of a place; of a sweep
LEAST_LINES = 8
FEWEST, MOST = 0.7, 1.4  # lines, of what is asked for
HEAD_MM = 85.0  # radius of the skull, for the poses
ORIGIN_MM, BEAM_DEG = 0.1, 0.1  # what the tracker adds
SQUARE_DEG = 3.0  # met squarely
LOST = ["MISSING", "INVALID", "OUT_OF_VIEW"]


@dataclass(frozen=True)
class Material:
    """What delay lines are made of."""

    speed_m_s: float
    impedance_mrayl: float
    loss_db_cm: float  # at 5 MHz


MATERIALS = {
    "aqualene": Material(1616.0, 1.49, 2.8),
    "tpx": Material(2170.0, 1.79, 5.3),
    "polystyrene": Material(2340.0, 2.47, 0.9),
    "hdpe": Material(2460.0, 2.30, 3.0),
    "pmma": Material(2670.0, 3.15, 3.0),
}


@dataclass(frozen=True)
class DelayLine:
    """A delay line as it is, not as it is stated."""

    material: str
    length_mm: float
    speed_m_s: float  # at the temperature of the first line
    warming: float  # of the speed, from the first line to the last
    trail_us: float  # a faint echo behind that of the face
    trail: float  # its height; 0: none


@dataclass(frozen=True)
class Setup(InMicroseconds):
    """What all lines of a recording share."""

    acquisition: Acquisition
    pulse: str
    bandwidth: float  # at -6 dB, of the centre
    speed_m_s: float  # at the centre frequency
    attenuation: float  # dB/cm/MHz
    snr_db: float  # median of the lines that meet bone squarely
    snr_of: str
    without: str  # a recording without bone: air, soft, gel
    sweeps: bool
    formalin: bool  # fixed tissue, which takes much of the sound
    depth_mm: float  # typical
    varies: float  # the places' depths differ by this share
    beam_mm: float  # width of the footprint at half height, both ways
    delay_line: DelayLine | None

    @property
    def us_mm(self) -> float:
        """Time that a millimetre of tissue takes, there and back."""
        return 2e3 / self.speed_m_s

    @property
    def moves(self) -> bool:
        """Whether the hand goes across the head in one sweep, with bone below."""
        return self.sweeps and not self.without

    def face_us(self, lines: int) -> Array:
        """When the delay line's face answers (lines,), after the transmitted pulse."""
        line = self.delay_line
        if line is None:
            return np.zeros(lines)
        return np.asarray(2e3 * line.length_mm / (line.speed_m_s * (1 + line.warming * np.linspace(0, 1, lines))))


@dataclass(frozen=True, eq=False)
class World(Setup):
    """The set-up, and what each of the n lines is."""

    kind: npt.NDArray[np.str_]  # (n,) bone, bone-oblique, bone-faint, clipped, edge, touch; air, soft, gel, defect, hair: no bone
    ignore: Bools  # (n,) judged by nobody: contact in part, rim of a craniotomy, bone clipped or too faint
    skin_us: Array  # (n,) when the skin answers


def decibel(level: npt.ArrayLike) -> Array:
    """Height over 1."""
    return np.asarray(10 ** (np.asarray(level, dtype=float) / 20))


def draw_setup(rng: np.random.Generator) -> Setup:
    """Device, probe and tissue of one recording."""
    centre = float(np.clip(rng.choice(CENTRES_MHZ) * rng.uniform(0.97, 1.03), *CENTRE_RANGE_MHZ))
    sampling = float(rng.choice(RATES_MHZ[LEAST_SAMPLES * centre <= RATES_MHZ]))
    speed = float(rng.uniform(1450, 1630))
    chance = rng.random()
    without = "air" if chance < 0.045 else "soft" if chance < 0.105 else "gel" if chance < 0.135 else ""
    formalin = bool(rng.random() < 0.22)
    attenuation = float(rng.uniform(2.1, 2.6) if formalin else rng.uniform(0.3, 2.1))
    if without == "soft":  # where nothing comes back from the depth, nobody could tell that bone is missing
        attenuation = min(attenuation, 7 / centre)
    loss_db_mm = 0.2 * attenuation * centre
    deepest = max(min(DEEPEST_MM, MOST_LOSS_DB / loss_db_mm), 3.5)
    depth = float(rng.uniform(2.2, 4.2) if rng.random() < 0.2 else rng.uniform(3.0, deepest))
    varies = min(0.3, 9.0 / (loss_db_mm * depth))
    line = _draw_delay_line(rng, speed, depth * (1 + varies)) if rng.random() < 0.6 else None
    length, stated = (line.length_mm, MATERIALS[line.material].speed_m_s) if line else (0.0, 0.0)
    return Setup(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, length, stated),
        pulse="resonant",
        bandwidth=float(rng.uniform(0.45, 0.8)),
        speed_m_s=speed,
        attenuation=attenuation,
        snr_db=float(rng.uniform(28, 40) if without == "soft" else rng.uniform(14, 38)),
        snr_of="recording",
        without=without,
        sweeps=bool(rng.random() < 0.35),
        formalin=formalin,
        depth_mm=depth,
        varies=varies,
        beam_mm=float(rng.uniform(1.0, 2.2) * np.sqrt(5 / centre)),
        delay_line=line,
    )


def _draw_delay_line(rng: np.random.Generator, speed_m_s: float, deepest_mm: float) -> DelayLine:
    """A delay line whose second echo comes after the bone; its temperature, and so its speed, is not what is stated."""
    material = str(rng.choice(list(MATERIALS)))
    stated = MATERIALS[material].speed_m_s
    reach = min(DEEPEST_MM, 1.1 * deepest_mm) if rng.random() < 0.4 else DEEPEST_MM
    trails = rng.random() < 0.3
    return DelayLine(
        material=material,
        length_mm=float(np.round((reach + rng.uniform(1, 4)) * stated / speed_m_s, 1)),
        speed_m_s=stated * (1 + float(rng.uniform(-0.006, 0.006))),
        warming=float(rng.uniform(-0.004, 0.004)),
        trail_us=float(rng.uniform(0.8, 3.0)),
        trail=float(decibel(rng.uniform(-44, -34))) if trails else 0.0,
    )


def wander(rng: np.random.Generator, lines: int, step_s: float, lasts_s: float, spread: float) -> Array:
    """What a hand adds to where it means to be (lines,): an Ornstein-Uhlenbeck path."""
    keeps = float(np.exp(-step_s / lasts_s))
    steps = rng.normal(0, spread * np.sqrt(1 - keeps**2), lines).tolist()
    path = [float(rng.normal(0, spread))]
    for step in steps[1:]:
        path.append(keeps * path[-1] + step)
    return np.array(path)


@dataclass(frozen=True, eq=False)
class Hand:
    """What the probe does, line by line."""

    kind: npt.NDArray[np.str_]  # (n,) bone, soft, gel, air, touch (contact in part), hair, defect (of the bone)
    place: Rows
    moved_mm: Array  # (n, 2) on the bone
    lean_deg: Array  # (n, 2) about both axes
    press: Array  # (n,) from 0 to 1
    step_s: float  # from line to line

    @property
    def places(self) -> int:
        return int(self.place.max()) + 1

    @property
    def tilt_deg(self) -> Array:
        """Between the beam and the perpendicular (n,)."""
        slope = np.tan(np.radians(self.lean_deg))
        return np.asarray(np.degrees(np.arctan(np.hypot(slope[:, 0], slope[:, 1]))))

    @property
    def touching(self) -> Bools:
        """Full contact."""
        return np.isin(self.kind, ["bone", "soft", "gel", "defect"])


class _Script:
    """Stretches of lines, one after the other."""

    def __init__(self) -> None:
        self.kinds: list[str] = []
        self.places: list[int] = []
        self.parts: list[Array] = []

    def add(self, kind: str, place: int, lines: int, *columns: npt.ArrayLike) -> None:
        """`lines` lines of (moved 2, lean 2, press)."""
        self.kinds += [kind] * lines
        self.places += [place] * lines
        self.parts.append(np.stack([np.broadcast_to(np.asarray(column, dtype=float), lines) for column in columns], axis=1))

    def off(self, kind: str, place: int, lines: int, lean_deg: float = 0.0) -> None:
        """Lines in which the probe is not set down."""
        self.add(kind, place, lines, 0.0, 0.0, lean_deg, 0.0, 0.0)

    def hand(self, step_s: float) -> Hand:
        columns = np.concatenate(self.parts)
        kind = np.array(self.kinds, dtype="<U12")
        return Hand(kind, np.array(self.places, dtype=np.int64), columns[:, :2], columns[:, 2:4], columns[:, 4], step_s)


def draw_hand(rng: np.random.Generator, setup: Setup, frames: int) -> Hand:
    """About `frames` lines, at least LEAST_LINES: who has less time goes to fewer places, or sweeps over less."""
    script, step_s = _Script(), 1 / float(rng.uniform(20, 50))
    frames = max(frames, LEAST_LINES)
    if setup.moves:
        _sweep(rng, script, step_s, frames)
    else:
        _dwell(rng, setup, script, step_s, frames)
    hand = script.hand(step_s)
    if not setup.without and rng.random() < 0.25 * min(1.0, frames / USUAL_LINES):
        _put_hair(rng, hand)
    return hand


def _sweep(rng: np.random.Generator, script: _Script, step_s: float, frames: int) -> None:
    """Down from the air, across the bone, and up."""
    share = frames / SWEEP_LINES
    before, after = (max(1, round(float(rng.integers(*few)) * min(share, 1.0))) for few in ((2, 6), (1, 5)))
    others = before + after + 2
    least = max(FEWEST * frames, LEAST_LINES) - others
    lines = max(int(np.ceil(np.clip(rng.integers(45, 95) * share, least, MOST * frames - others))), 3)
    script.off("air", 0, before, float(rng.normal(0, 4)))
    script.off("touch", 0, 1)
    along = np.linspace(0, rng.uniform(12, 40) * min(share, 1.0), lines)
    aside = wander(rng, lines, step_s, 1.0, 0.5)
    lean = [rng.normal(0, 0.8) + wander(rng, lines, step_s, 0.7, 1.8) for _ in range(2)]
    press = np.clip(0.5 + wander(rng, lines, step_s, 1.0, 0.2), 0, 1)
    script.add("bone", 0, lines, along, aside, lean[0], lean[1], press)
    script.off("touch", 0, 1)
    script.off("air", 0, after, float(rng.normal(0, 4)))


def _dwell(rng: np.random.Generator, setup: Setup, script: _Script, step_s: float, frames: int) -> None:
    """Places, each held for a while; between them the probe is lifted, unless it lies in gel or in air throughout."""
    places = max(1, round(frames * float(rng.integers(3, 7)) / USUAL_LINES))
    dark = setup.attenuation * setup.centre_mhz >= 9  # where depth is dark nobody can tell soft from bone
    chance = 0.3 * min(1.0, frames / USUAL_LINES)
    soft = int(rng.integers(1, places)) if places > 1 and rng.random() < chance and not dark else -1
    lifts = setup.without in ("", "soft")
    lifted = rng.integers(1, 4, places) if lifts else np.zeros(places, dtype=np.int64)
    others = int(lifted.sum()) + (2 * places if lifts else 0)
    held = rng.integers(11, 20, places)
    wanted = np.clip(held.sum() + others, max(FEWEST * frames, LEAST_LINES), MOST * frames) - others
    held = np.ceil(held * (wanted / held.sum())).astype(np.int64) if wanted != held.sum() else held
    for place in range(places):
        kind = "soft" if place == soft else setup.without or "bone"
        if lifts:
            script.off("air", place, int(lifted[place]), float(rng.normal(0, 5)))
            script.off("touch", place, 1)
        _hold(rng, script, kind, place, int(held[place]), step_s)
        if lifts:
            script.off("touch", place, 1)


def _hold(rng: np.random.Generator, script: _Script, kind: str, place: int, lines: int, step_s: float) -> None:
    """A stay on one place: guided to the perpendicular, or oblique throughout."""
    time = np.arange(lines) * step_s
    if rng.random() < 0.72:
        goal, start, lasts_s = rng.normal(0, 0.9, 2), rng.normal(0, 3.5, 2), rng.uniform(0.05, 0.2)
    else:
        around, lean = rng.uniform(0, 2 * np.pi), rng.uniform(3, 9)
        goal = start = lean * np.array([np.cos(around), np.sin(around)])
        lasts_s = 0.2
    comes = np.exp(-time / lasts_s)
    leans = [goal[axis] + (start[axis] - goal[axis]) * comes + wander(rng, lines, step_s, 0.25, 0.5) for axis in range(2)]
    creeps = rng.normal(0, 1.2, 2)  # mm/s: the skin gives
    moved = [creeps[axis] * time + wander(rng, lines, step_s, 0.3, 0.2) for axis in range(2)]
    press = np.clip(1 - np.exp(-time / 0.3) + wander(rng, lines, step_s, 0.5, 0.1), 0, 1)
    script.add(kind, place, lines, moved[0], moved[1], leans[0], leans[1], press)


def _put_hair(rng: np.random.Generator, hand: Hand) -> None:
    """Put hair or a bubble under the face for a few lines; before and after them contact is partial."""
    count = len(hand.kind)
    first = min(5, count // 4)
    at = int(rng.integers(first, max(count - 12, first + 1)))
    rows = np.arange(at, min(at + int(rng.integers(3, 8)), count - 1))
    rows = rows[hand.kind[rows] == "bone"]
    if len(rows) == 0:
        return
    hand.kind[rows] = "hair"
    for beside in (rows[0] - 1, rows[-1] + 1):
        if hand.kind[beside] == "bone":
            hand.kind[beside] = "touch"


@dataclass(frozen=True, eq=False)
class Ground:
    """The bone below the hand."""

    depth_mm: Array  # (n,) of the mean surface, along the beam
    pressed: Array  # (n,) share of the scalp's thickness that pressing leaves
    edge: Bools  # (n,) the beam meets the rim of a craniotomy
    round_mm: Array  # (places,) radius of the bone's curvature


def draw_ground(rng: np.random.Generator, setup: Setup, hand: Hand) -> Ground:
    """Depth of the bone; where a craniotomy lies under a sweep, the hand's kind becomes a defect."""
    places, place, along = hand.places, hand.place, hand.moved_mm[:, 0]
    rest = np.clip(setup.depth_mm * (1 + rng.uniform(-setup.varies, setup.varies, places)), 2.2, DEEPEST_MM)
    thickens = rng.normal(0, 0.012, (places, 2)) * rest[:, None]  # along the head, mm/mm
    swells, period = rng.uniform(0, 0.06, places) * rest, rng.uniform(12, 30, places)
    most = 0.2 * rest[place]
    depth = rest[place] + np.clip((thickens[place] * hand.moved_mm).sum(axis=1), -most, most)
    depth += swells[place] * np.sin(2 * np.pi * along / period[place])
    pressed = 1 - rng.uniform(0.02, 0.13, places)[place] * hand.press
    edge = np.zeros(len(place), dtype=bool)
    if setup.moves and rng.random() < 0.25:
        start = rng.uniform(0.2, 0.6) * along.max()
        end = start + rng.uniform(5, 12)
        bone = hand.kind == "bone"
        edge = bone & (np.minimum(np.abs(along - start), np.abs(along - end)) < 1.5 * setup.beam_mm)
        hand.kind[bone & (along > start) & (along < end)] = "defect"
    return Ground(np.clip(depth * pressed, SHALLOWEST_MM, DEEPEST_MM), pressed, edge, rng.uniform(45, 140, places))


def draw_statuses(rng: np.random.Generator, lines: int) -> tuple[str, ...]:
    """What the tracker says of each line: in some recordings it loses the probe, now and then and once for longer."""
    seen = np.ones(lines, dtype=bool)
    if rng.random() < 0.3:
        seen &= rng.random(lines) > 0.04
        at = int(rng.integers(0, lines - 6))
        seen[at : at + int(rng.integers(1, 6))] = False
    return tuple("OK" if one else str(rng.choice(LOST)) for one in seen)


def draw_poses(rng: np.random.Generator, setup: Setup, hand: Hand, depth_mm: Array) -> Array:
    """ProbeToReference of every line (n, 4, 4): the origin is the transducer's face, behind the delay line."""
    lines, place = len(hand.kind), hand.place
    up = rng.normal(size=(hand.places, 3))
    up[:, 2] = np.abs(up[:, 2]) + 0.4
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    ahead = np.cross(up, [0.3, 0.9, 0.1])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    aside = np.cross(up, ahead)
    moved = hand.moved_mm / HEAD_MM
    normal = _unit(up[place] + ahead[place] * moved[:, :1] + aside[place] * moved[:, 1:])
    slope = np.tan(np.radians(hand.lean_deg + rng.normal(0, BEAM_DEG, (lines, 2))))
    beam = _unit(-normal + ahead[place] * slope[:, :1] + aside[place] * slope[:, 1:])
    across = _unit(ahead[place] - beam * (ahead[place] * beam).sum(axis=1, keepdims=True))
    rotation = np.stack([across, np.cross(beam, across), beam], axis=2)
    lifted = np.where(hand.touching | np.isin(hand.kind, ["touch", "hair"]), 0.0, rng.uniform(2, 30, lines))
    far = depth_mm + setup.acquisition.forerun_length_mm + lifted
    return rigid(rotation, normal * HEAD_MM - beam * far[:, None] + rng.normal(0, ORIGIN_MM, (lines, 3)))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
