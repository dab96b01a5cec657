"""What a recording of range_lines.py is drawn from: the instrument and the scalp, the hand that goes over the head, the poses.

Every quantity of the instrument and of the scalp is drawn evenly over the whole range it may have, independently of the others; a
set is drawn again only where no instrument could read the bone. Some recordings have no bone at all, by a fixed share.
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
Draws = dict[str, float]

USUAL_RATES = (25, 30, 40, 50, 60, 62.5, 64, 80, 100, 125)  # MHz
DEPTH_MM = (2.0, 15.0)
MATERIALS = ((1616, 1.49, 4.0), (2170, 1.79, 6.0), (2340, 2.47, 2.0), (2460, 2.30, 4.0), (2670, 3.15, 2.0))
# of delay lines: m/s, MRayl, dB/cm there and back
TISSUE_MRAYL = 1.63
MOST_LOSS_DB, MOST_SHIFT = 45.0, 0.45  # of the bone's echo; of its centre frequency: beyond, no instrument reads it
CONTROLS = ("soft",) * 4 + ("air",) * 2 + ("cable",) + ("",) * 53  # of 60 recordings those wholly without bone
HEAD_MM = 85.0
USUAL_LINES = 40  # shorter recordings are of a hand that spends less time on each place
LEAST_LINES = 8


@dataclass(frozen=True, eq=False)
class World(InMicroseconds, ThroughScalp):
    """What all lines of a recording share. Times in us, frequencies in MHz."""

    acquisition: Acquisition
    pulse: str
    bandwidth: float  # at -6 dB, of the centre
    sigma_mhz: float  # of the pulse's spectrum
    wiring: int  # the transducer's polarity
    phase: float
    bend: float  # third-order phase
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    snr_db: float  # median over the lines within 3 deg
    snr_of: str
    depth_mm: float  # typical
    loss_db: float  # two ways to that depth, at the centre frequency
    without: str  # a recording without bone: soft, air, cable
    face_r: float  # reflection of the delay line's wet face; 0: no delay line
    face_loss: float  # height left by the way through the delay line, there and back
    short: bool  # the delay line's multiple falls among the depths
    tolerance: float  # of the delay line's time against the stated
    warming: float  # its change over the recording
    jitter_us: float  # of the trigger
    behind_mm: float  # of tissue that the lines cover
    disc_mm: float  # effective diameter of the transducer
    rough: float  # the bone's diffuse echo over its specular one
    static: bool  # an echo that stands still
    hums: bool
    spikes: bool
    hot: bool  # the gain is too high
    bits: int


def decibel(level: float | Array) -> float | Array:
    """Height over 1."""
    return 10 ** (level / 20)


def _draw_ranges(rng: np.random.Generator) -> Draws:
    """One even draw over all ranges."""
    drawn = {
        "speed": float(rng.uniform(1450, 1630)),
        "centre": float(rng.uniform(3, 10)),
        "bandwidth": float(rng.uniform(0.35, 0.8)),
        "attenuation": float(rng.uniform(0.3, 2.6)),
        "depth": float(rng.uniform(*DEPTH_MM)),
        "snr": float(rng.uniform(12, 40)),
        "sampling": float(rng.choice(USUAL_RATES) if rng.random() < 0.6 else rng.uniform(25, 125)),
    }
    drawn["loss"] = drawn["attenuation"] * drawn["centre"] * drawn["depth"] * 0.2
    drawn["sigma"] = drawn["bandwidth"] * drawn["centre"] / 2 / np.sqrt(2 * np.log(2))
    return drawn


def _is_readable(drawn: Draws) -> bool:
    """Whether an instrument could read the bone at all."""
    neper_mhz = drawn["attenuation"] * drawn["depth"] * 0.2 / 8.686
    least_sampling = 2.3 * drawn["centre"] * (1 + 0.6 * drawn["bandwidth"])
    return (
        drawn["loss"] <= MOST_LOSS_DB
        and drawn["sigma"] ** 2 * neper_mhz <= MOST_SHIFT * drawn["centre"]
        and drawn["sampling"] >= least_sampling
    )


def _draw_delay_line(rng: np.random.Generator, drawn: Draws) -> tuple[float, float, float, float, bool]:
    """Length in mm, speed, reflection of the wet face, height after the way, and whether it is short.

    The face must be seen through the noise when wet: otherwise nobody could know where the skin is.
    """
    noise = 0.5 * decibel(-0.85 * drawn["loss"] - drawn["snr"])

    def reflection(mrayl: float) -> float:
        return (TISSUE_MRAYL - mrayl) / (TISSUE_MRAYL + mrayl)

    seen = [material for material in MATERIALS if abs(reflection(material[1])) / noise > 2.5] or [MATERIALS[-1]]
    speed, mrayl, loss = seen[rng.integers(len(seen))]
    short = bool(rng.random() < 0.25)
    beyond_all_depths = 15.5 * speed / drawn["speed"]
    length = round(beyond_all_depths * float(rng.uniform(0.45, 0.9) if short else rng.uniform(1.02, 1.4)), 1)
    return length, float(speed), reflection(mrayl), float(decibel(-loss * length / 10)), short


def draw_world(rng: np.random.Generator) -> World:
    """A set-up, evenly from all ranges."""
    drawn = _draw_ranges(rng)
    while not _is_readable(drawn):
        drawn = _draw_ranges(rng)
    without = CONTROLS[rng.integers(len(CONTROLS))]
    if without:
        drawn["snr"] = max(drawn["snr"], float(rng.uniform(12, 40)))
    delay = _draw_delay_line(rng, drawn) if rng.random() < 0.6 else (0.0, 0.0, 0.0, 0.0, False)
    jitter = float(rng.uniform(0.1, 0.5)) / drawn["sampling"]
    return World(
        acquisition=Acquisition(drawn["sampling"] * 1e6, drawn["centre"] * 1e6, delay[0], delay[1]),
        pulse="gauss",
        bandwidth=drawn["bandwidth"],
        sigma_mhz=drawn["sigma"],
        wiring=int(rng.choice([-1, 1])),
        phase=float(rng.uniform(0, 2 * np.pi)),
        bend=float(rng.uniform(0, 0.08)),
        speed_m_s=drawn["speed"],
        attenuation=drawn["attenuation"],
        snr_db=drawn["snr"],
        snr_of="recording",
        depth_mm=drawn["depth"],
        loss_db=drawn["loss"],
        without=without,
        face_r=delay[2],
        face_loss=delay[3],
        short=delay[4],
        tolerance=float(rng.uniform(-0.008, 0.008)),
        warming=float(rng.uniform(-0.004, 0.004)),
        jitter_us=jitter if rng.random() < 0.3 else 0.0,
        behind_mm=float(rng.uniform(22, 32)),
        disc_mm=float(rng.uniform(0.45, 1)) * 25 / drawn["centre"],  # 5 mm at 5 MHz lose 6 dB at 1.2 deg; focusing: smaller
        rough=float(decibel(rng.uniform(-30, -20))),
        static=bool(rng.random() < 0.3 and not without),  # without bone nobody could tell it from bone
        hums=bool(rng.random() < 0.15),
        spikes=bool(rng.random() < 0.25),
        hot=bool(rng.random() < 0.06 and not without),
        bits=int(rng.choice([10, 12, 14, 16])),
    )


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the hand goes, line by line, and what lies under it; every array (n,)."""

    kind: npt.NDArray[np.str_]  # bone, edge (of the bone), soft (no bone), transition (to or from the air), air, cable
    place: npt.NDArray[np.int64]
    coupling_db: Array
    tilt_x_deg: Array
    tilt_y_deg: Array
    depth_mm: Array  # NaN: no bone
    along_mm: Array  # how far the hand has gone along the skin

    @property
    def tilt_deg(self) -> Array:
        """Angle to the perpendicular."""
        return np.hypot(self.tilt_x_deg, self.tilt_y_deg)

    @property
    def bone(self) -> Bools:
        """Where bone answers."""
        return np.isin(self.kind, ["bone", "transition", "edge"]) & np.isfinite(self.depth_mm)

    @property
    def soft(self) -> Bools:
        """Where tissue goes on without end."""
        return np.isin(self.kind, ["soft", "edge"])

    @property
    def wet(self) -> Bools:
        """Where the probe touches the skin."""
        return ~np.isin(self.kind, ["air", "cable"])

    @property
    def coupling(self) -> Array:
        """What comes of an echo from the tissue."""
        return np.where(self.wet, decibel(self.coupling_db), 0.0)

    @property
    def places(self) -> int:
        """How many places the recording has."""
        return int(self.place.max()) + 1


def wander(rng: np.random.Generator, lines: int, deviation: float, keeps: float) -> Array:
    """A walk of a standard deviation, each step of which keeps a part of the one before (lines,)."""
    walk = rng.normal(0, deviation, lines)
    for line in range(1, lines):
        walk[line] = keeps * walk[line - 1] + np.sqrt(1 - keeps**2) * walk[line]
    return walk


def _segment(kind: str | npt.NDArray[np.str_], place: int, lines: int, **given: float | Array) -> dict[str, npt.NDArray]:
    """Lines of one kind on one place; what is not given is 0, and the depth none."""
    values = {"coupling_db": 0.0, "tilt_x_deg": 0.0, "tilt_y_deg": 0.0, "depth_mm": np.nan, "along_mm": 0.0} | given
    arrays = {name: np.broadcast_to(np.asarray(value, dtype=float), lines) for name, value in values.items()}
    return {"kind": np.broadcast_to(kind, lines).astype("U10"), "place": np.full(lines, place), **arrays}


def _glide(rng: np.random.Generator, world: World, lines: int, pace: float) -> dict[str, Array]:
    """The hand moves on while the bone comes nearer and goes away."""
    time = np.arange(lines) / pace
    return {
        "tilt_x_deg": wander(rng, lines, 1.6, 0.9),
        "tilt_y_deg": wander(rng, lines, 1.6, 0.9),
        "along_mm": np.cumsum(np.full(lines, rng.uniform(0.2, 0.6))),
        "depth_mm": 0.15 * world.depth_mm * np.sin(2 * np.pi * time / rng.uniform(30, 90) + rng.uniform(0, 6)),
    }


def _dwell(rng: np.random.Generator, world: World, lines: int, pace: float) -> dict[str, Array]:
    """The hand searches the perpendicular, then holds it with tremor, and presses the tissue thinner."""
    time = np.arange(lines) / pace
    start, side = rng.uniform(2, 8), rng.uniform(0, 2 * np.pi)
    off = start * np.exp(-time / rng.uniform(2, 6)) + rng.uniform(0, 1.5)
    return {
        "tilt_x_deg": off * np.cos(side) + wander(rng, lines, 0.5, 0.7),
        "tilt_y_deg": off * np.sin(side) + wander(rng, lines, 0.5, 0.7),
        "along_mm": wander(rng, lines, 0.4, 0.97),
        "depth_mm": -world.depth_mm * rng.uniform(0, 0.12) * (1 - np.exp(-time / 8)),
    }


def _contact(rng: np.random.Generator, world: World, what: str, lines: int, pace: float) -> dict[str, Array]:
    """What the hand does on one place; one place in ten is badly coupled (hair)."""
    moves = (_glide if what == "glide" else _dwell)(rng, world, lines, pace)
    moves["depth_mm"] += world.depth_mm * rng.uniform(0.75, 1.25) + wander(rng, lines, 0.02 * world.depth_mm, 0.9)
    moves["depth_mm"] = np.clip(moves["depth_mm"], *DEPTH_MM)
    hair = rng.uniform(4, 12) if rng.random() < 0.1 else 0.0
    moves["coupling_db"] = wander(rng, lines, 1.0, 0.9) - hair
    return moves


def _without_bone(rng: np.random.Generator, kind: str, place: int, lines: int) -> dict[str, npt.NDArray]:
    """One stay of a recording that has no bone."""
    return _segment(
        kind,
        place,
        lines,
        along_mm=wander(rng, lines, 1.0, 0.97),
        coupling_db=wander(rng, lines, 1.0, 0.9),
        tilt_x_deg=wander(rng, lines, 2.0, 0.9),
        tilt_y_deg=wander(rng, lines, 2.0, 0.9),
    )


def _draw_what(rng: np.random.Generator, soft: bool, rim: bool) -> str:
    """What the hand does next."""
    chance = rng.random()
    if chance < 0.35:
        return "glide"
    if soft and chance > 0.75:
        return "soft"
    return "rim" if rim and chance > 0.6 else "dwell"


def _lift(rng: np.random.Generator, place: int, pace: float, before_mm: float, after_mm: float) -> list[dict[str, npt.NDArray]]:
    """The probe leaves the skin and comes down again."""
    in_air = max(round(float(rng.integers(2, 7)) * pace), 1)
    return [
        _segment("transition", place, 1, coupling_db=-rng.uniform(6, 30), depth_mm=before_mm),
        _segment("air", place, in_air),
        _segment("transition", place, 1, coupling_db=-rng.uniform(6, 30), depth_mm=after_mm),
    ]


def draw_hand(rng: np.random.Generator, world: World, frames: int) -> Hand:
    """The whole recording, place after place."""
    frames = max(frames, LEAST_LINES)
    pace = float(np.clip(frames / USUAL_LINES, 0.4, 1))
    soft, rim, lifts = rng.random() < 0.35, rng.random() < 0.15, rng.random() < 0.6
    parts: list[dict[str, npt.NDArray]] = []
    place = done = 0
    while done < frames:
        if world.without:
            new = [_without_bone(rng, world.without, place, round(float(rng.integers(15, 30)) * pace))]
        else:
            what = _draw_what(rng, soft and place > 0, rim)
            lines = rng.integers(10, 26) if what in ("dwell", "soft") else rng.integers(16, 36)
            moves = _contact(rng, world, what, round(float(lines) * pace), pace)
            lift = lifts and place > 0
            new = _lift(rng, place - 1, pace, parts[-1]["depth_mm"][-1], moves["depth_mm"][0]) if lift else []
            new.append(_on_place(what, place, moves))
        parts += new
        place += 1
        done += sum(len(part["place"]) for part in new)
    return Hand(**{name: np.concatenate([part[name] for part in parts])[:frames] for name in parts[0]})


def _on_place(what: str, place: int, moves: dict[str, Array]) -> dict[str, npt.NDArray]:
    """Lines of one place: with bone, without, or off the rim of the bone, where a few lines see half of it."""
    lines = len(moves["depth_mm"])
    kind = np.full(lines, "soft" if what == "soft" else "bone", dtype="U10")
    if what == "rim":
        kind[lines // 2 :] = "edge"
        kind[lines // 2 + 3 :] = "soft"
    depth = np.where(kind == "soft", np.nan, moves["depth_mm"])
    return _segment(kind, place, lines, **{**moves, "depth_mm": depth})


def draw_poses(rng: np.random.Generator, world: World, hand: Hand) -> Array:
    """ProbeToReference of every line (n, 4, 4): over a round head, the origin at the transducer, behind the delay line."""
    lines = len(hand.place)
    outward = rng.normal(size=(hand.places, 3))
    outward[:, 2] = np.abs(outward[:, 2])
    normal = _unit(outward)[hand.place]
    side = _unit(np.cross(normal, [0, 1, 0.01]))
    spot = _unit(normal + side * hand.along_mm[:, None] / HEAD_MM)
    side = _unit(side - spot * (side * spot).sum(axis=1)[:, None])
    tilt = np.radians(hand.tilt_deg)[:, None]
    other = np.cross(spot, side)
    aside = (side * hand.tilt_x_deg[:, None] + other * hand.tilt_y_deg[:, None]) / np.maximum(hand.tilt_deg, 1e-9)[:, None]
    beam = _unit(-spot * np.cos(tilt) + aside * np.sin(tilt) + rng.normal(0, 0.001, (lines, 3)))
    across = _unit(side - beam * (side * beam).sum(axis=1)[:, None])
    lifted = np.where(hand.wet, 0.0, rng.uniform(3, 20, lines))
    reach = world.acquisition.forerun_length_mm + np.where(hand.bone, hand.depth_mm, world.depth_mm) + lifted
    origin = HEAD_MM * spot - beam * reach[:, None] + rng.normal(0, 0.08, (lines, 3))
    return rigid(np.stack([across, np.cross(beam, across), beam], axis=2), origin)


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def draw_statuses(rng: np.random.Generator, lines: int) -> tuple[str, ...]:
    """Status of every pose; a third of the recordings lose a few in a row."""
    statuses = ["OK"] * lines
    for _ in range(rng.integers(1, 4) if rng.random() < 0.35 else 0):
        start, lasts = int(rng.integers(lines)), int(rng.integers(1, 5))
        for line in range(start, min(start + lasts, lines)):
            statuses[line] = str(rng.choice(["MISSING", "INVALID", "OUT_OF_VIEW"]))
    return tuple(statuses)
