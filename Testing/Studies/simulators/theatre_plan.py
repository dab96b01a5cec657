"""What a session in the operating theatre is made of: the probe and its receiver, the hand on the head, the poses.

The hand dwells on a few places, takes eighteen of them in bursts of a few lines, or sweeps over a region. Nobody takes 10 MHz
to a fixed, thick scalp, so probe and head are drawn together. theatre_lines.py makes the lines of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition
from CranioNavLib.rigid import rigid
from scipy.signal import lfilter

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

PLACES = {
    "forehead": (4, 6),
    "vertex": (4, 7),
    "temple": (6, 15),
    "occiput": (6, 9),
    "rim": (5, 8),
}  # mm of scalp on a usual head
HAIRY = ("vertex", "occiput", "temple")
BARE = ("air", "lost", "dry", "burr", "soft")  # kinds of lines without bone
DELAYS = ((1616.0, 0.04), (2170.0, -0.05), (2340.0, -0.20), (2460.0, -0.17), (2670.0, -0.32))  # m/s; reflection of a wetted face
RATES_MHZ = np.array([25, 31.25, 40, 50, 60, 62.5, 64, 80, 100, 125])
TYPICAL_MM, LEAST_MM, MOST_MM = 6.0, 2.0, 15.0
TYPICAL_LOSS_DB, SOFT_LOSS_DB, MOST_LOSS_DB = 36.0, 16.0, 44.0  # both ways: at the typical depth; without bone; at any place
USUAL_LINES = 80  # of a whole session: a shorter one lifts off and meets holes less often
HOLE_MM, RIM_MM = 7.0, 1.5  # radius of a burr hole; its edge
HEAD_MM = np.array([72.0, 92.0, 80.0])  # half axes
OFF_MM, OFF_DEG = 0.08, 0.12  # noise of the tracker
PLACES_AT_MOST = 18


@dataclass(frozen=True)
class Theatre:
    """What all lines of a recording share. Heights are over bone met squarely at the surface, or over the typical bone."""

    acquisition: Acquisition
    without: str  # a recording without bone: soft (neck, cheek), air, dry (hair without gel)
    mode: str  # dwell, eighteen, sweep
    scale: float  # of the scalp's thickness: children, swelling
    deepest_mm: float  # places are not palpated with this probe
    centre_mhz: float  # the true one
    pulse: str
    bandwidth: float  # at -6 dB, of the centre
    fall: float  # how much slower the pulse falls than it rises
    phase: float
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    snr_db: float  # of a perpendicular bone echo of the typical depth
    snr_of: str
    lobe_deg: float  # a mirror's echo has lost 6 dB
    beam_mm: float  # standard deviation of its amplitude at the bone
    rough_mm: float
    alike_mm: float  # the bone's roughness
    round_mm: float  # the bone's radius
    speckle: float
    face_r: float  # reflection of the delay line's wetted face
    back_r: float  # of the transducer's own
    late: float  # the delay line's time over the header's
    warming: float  # change of it over the recording
    dead_us: float  # until the bang has rung down
    recovery: float  # of the receiver after the bang; 0: at once
    recovery_us: float
    hum: float  # of a switching supply
    hum_mhz: float
    spikes: float  # share of the lines
    bits: int
    fill: float  # of the converter, by the typical echo
    offset: float  # of the converter
    wander: float
    rate_hz: float  # of the lines

    @property
    def sampling_mhz(self) -> float:
        return self.acquisition.sampling_hz * 1e-6

    @property
    def mm_per_us(self) -> float:
        """Depth a microsecond there and back."""
        return self.speed_m_s * 5e-4

    @property
    def entering(self) -> float:
        """What the delay line's face lets through, both ways."""
        return 1 - self.face_r**2

    def face_us(self, frames: int) -> Array:
        """When the skin answers, line by line; 0 without a delay line."""
        nominal = 2e3 * self.acquisition.forerun_length_mm / (self.acquisition.forerun_speed_m_s or 1.0)
        return np.asarray(nominal * (self.late + self.warming * np.linspace(0, 1, frames)))

    def noise(self, typical: float) -> float:
        """Standard deviation of the noise; on soft tissue the gain is such that its echoes at 10 mm are 8 dB over it."""
        if self.without == "soft":
            lost_db = 2.0 * self.attenuation * self.acquisition.transducer_hz * 1e-6
            return float(0.36 * self.speckle * 10 ** (-lost_db / 20))
        return typical * float(10 ** (-self.snr_db / 20))


def _maybe(rng: np.random.Generator, share: float, low: float, high: float) -> float:
    return float(rng.uniform(low, high)) if rng.random() < share else 0.0


def _draw_probe(rng: np.random.Generator, most_loss_db: float, depth_mm: float) -> tuple[float, float, float]:
    """Frequency and sampling (MHz) and attenuation of a probe and a scalp that a surgeon would bring together."""
    while True:
        centre, sampling = float(rng.uniform(3, 10)), float(rng.choice(RATES_MHZ))
        formalin = rng.random() < 0.35
        attenuation = float(rng.uniform(1.9, 2.6) if formalin else np.exp(rng.uniform(np.log(0.3), np.log(1.9))))
        if sampling >= 3.2 * centre and attenuation * centre * 0.2 * depth_mm <= most_loss_db:
            return centre, sampling, attenuation


def _draw_delay_line(rng: np.random.Generator, thin: bool, speed_m_s: float) -> tuple[float, float, float]:
    """Length (mm), speed (m/s) and reflection of a delay line; some are shorter than the rule. Zeros: none."""
    if rng.random() >= 0.5:
        return 0.0, 0.0, 0.0
    speed, reflection = DELAYS[rng.integers(len(DELAYS))]
    longer = rng.uniform(0.6, 0.9) if rng.random() < 0.15 else rng.uniform(1.05, 1.3)
    return float((9 if thin else 14) * speed / speed_m_s * longer), speed, reflection


def draw_theatre(rng: np.random.Generator) -> Theatre:
    """A set-up: probe, receiver, head."""
    without = str(rng.choice(["", "soft", "air", "dry"], p=[0.84, 0.10, 0.03, 0.03]))
    head = rng.choice(["normal", "thin", "thick"], p=[0.55, 0.25, 0.20])
    scale = {"normal": 1.0, "thin": float(rng.uniform(0.4, 0.6)), "thick": float(rng.uniform(1.3, 1.7))}[str(head)]
    loss_db = SOFT_LOSS_DB if without else TYPICAL_LOSS_DB
    nominal, sampling, attenuation = _draw_probe(rng, loss_db, TYPICAL_MM * scale)
    speed, lobe = float(rng.uniform(1450, 1630)), float(rng.uniform(1.6, 3.2))
    length, delay_speed, reflection = _draw_delay_line(rng, head == "thin", speed)
    overdriven = not without and rng.random() < 0.05
    fill = rng.uniform(1.2, 2.5) if overdriven else np.exp(rng.uniform(np.log(0.12), np.log(0.6)))
    return Theatre(
        acquisition=Acquisition(sampling * 1e6, nominal * 1e6, length, delay_speed),
        without=without,
        mode=str(rng.choice(["dwell", "eighteen", "sweep"], p=[0.5, 0.25, 0.25])),
        scale=scale,
        deepest_mm=min(MOST_MM, MOST_LOSS_DB / (attenuation * nominal * 0.2)),
        centre_mhz=nominal * float(rng.uniform(0.95, 1.05)),
        pulse="gauss",
        bandwidth=float(rng.uniform(0.45, 0.85)),
        fall=float(rng.uniform(1.0, 1.5)),
        phase=float(rng.uniform(0, 2 * np.pi)),
        speed_m_s=speed,
        attenuation=attenuation,
        snr_db=float(rng.uniform(14, 42)),
        snr_of="square",
        lobe_deg=lobe,
        beam_mm=float(1.177 * speed * 1e-3 / (4 * np.pi * nominal * np.sin(np.radians(lobe)))),
        rough_mm=float(rng.uniform(0.004, 0.025)) * min(1.0, 6 / nominal),
        alike_mm=float(rng.uniform(0.25, 0.7)),
        round_mm=float(rng.uniform(50, 100)),
        speckle=float(10 ** (rng.uniform(-40, -27) / 20)),
        face_r=reflection,
        back_r=float(rng.uniform(0.2, 0.5)),
        late=1 + float(rng.uniform(-0.01, 0.01)),
        warming=float(rng.uniform(-0.002, 0.002)),
        dead_us=max(float(rng.uniform(0.9, 1.8)), 4 / nominal),
        recovery=_maybe(rng, 0.4, 0.1, 0.6),
        recovery_us=float(rng.uniform(2, 8)),
        hum=_maybe(rng, 0.1, 0.02, 0.15),
        hum_mhz=float(rng.uniform(0.1, 0.25)) * nominal,
        spikes=0.12 if rng.random() < 0.1 else 0.0,
        bits=int(rng.choice([10, 12, 14, 16])),
        fill=float(fill),
        offset=float(rng.uniform(-0.06, 0.06)),
        wander=float(rng.uniform(0, 9)),
        rate_hz=float(rng.uniform(10, 25)),
    )


@dataclass(frozen=True, eq=False)
class Hand:
    """Where the hand is, line by line."""

    place: npt.NDArray[np.int64]  # (n,)
    kind: npt.NDArray[np.str_]  # (n,) one of PLACES, touch (half wetted), edge (of a hole), or one of BARE
    depth_mm: Array  # (n,) of the bone, or where it would be; NaN in air
    tilt_deg: Array  # (n, 2)
    aside_mm: Array  # (n, 2) from the middle of the place
    wet: Array  # (n,) share of the face
    lifted_mm: Array  # (n,)

    @property
    def bone(self) -> Bools:
        return ~np.isin(self.kind, BARE)

    @property
    def angle_deg(self) -> Array:
        """Angle to the perpendicular (n,)."""
        return np.linalg.norm(self.tilt_deg, axis=1)

    @property
    def about_mm(self) -> Array:
        """Depth, or a usual one in air (n,)."""
        return np.where(np.isfinite(self.depth_mm), self.depth_mm, TYPICAL_MM)


def joined(hands: list[Hand]) -> Hand:
    """One after the other."""
    return Hand(*(np.concatenate([getattr(hand, name) for hand in hands]) for name in Hand.__dataclass_fields__))


def wander(rng: np.random.Generator, count: int, step_s: float, lasting_s: float, spread: float) -> Array:
    """A stationary Ornstein-Uhlenbeck walk (count,)."""
    keeps = np.exp(-step_s / lasting_s)
    pushes = rng.normal(size=count) * spread
    pushes[1:] *= np.sqrt(1 - keeps**2)
    return np.asarray(lfilter([1.0], [1.0, -keeps], pushes))


def draw_hand(theatre: Theatre, rng: np.random.Generator, frames: int) -> Hand:
    """The whole session, of about `frames` lines."""
    if theatre.mode == "sweep":
        hand = _sweep(theatre, rng, frames)
    elif theatre.mode == "dwell":
        stay = int(rng.integers(14, 28))
        count = max(frames // stay, min(3, frames // 10), 1)
        hand = joined([_visit(theatre, rng, place, max(8, frames // count - 2)) for place in range(count)])
    else:
        count = int(np.clip(round(frames / 4.5), 3, PLACES_AT_MOST))
        hand = joined([_visit(theatre, rng, place, int(rng.integers(3, 6))) for place in range(count)])
    return _without_bone(theatre, rng, hand)


def _without_bone(theatre: Theatre, rng: np.random.Generator, hand: Hand) -> Hand:
    """The same hand where there is no bone, or no way to it."""
    count, down = len(hand.place), hand.kind != "air"
    wet, kind = hand.wet, np.where(down, theatre.without, "air") if theatre.without else hand.kind
    if theatre.without == "air":
        lifted = np.where(hand.lifted_mm > 0, hand.lifted_mm, 20.0)
        return Hand(hand.place, kind, np.full(count, np.nan), hand.tilt_deg, hand.aside_mm, np.zeros(count), lifted)
    if theatre.without == "dry":
        wet = np.where(down, rng.uniform(0, 0.015, count), 0.0)
    return Hand(hand.place, kind, hand.depth_mm, hand.tilt_deg, hand.aside_mm, wet, hand.lifted_mm)


def _air(rng: np.random.Generator, place: int, count: int) -> Hand:
    return Hand(
        place=np.full(count, place),
        kind=np.full(count, "air", dtype="U8"),
        depth_mm=np.full(count, np.nan),
        tilt_deg=rng.normal(size=(count, 2)) * 8,
        aside_mm=np.zeros((count, 2)),
        wet=np.zeros(count),
        lifted_mm=rng.uniform(4, 40, count),
    )


def _depth(theatre: Theatre, rng: np.random.Generator, name: str) -> float:
    return float(np.clip(rng.uniform(*PLACES[name]) * theatre.scale, LEAST_MM + 0.1, theatre.deepest_mm))


def _contact(
    theatre: Theatre,
    rng: np.random.Generator,
    place: int,
    kind: str,
    depth_mm: Array,
    tilt_deg: Array,
    aside_mm: Array,
    hairy: bool,
    touches: bool,
) -> Hand:
    """The face on the skin: pressed more and less, in gel or in hair, and off the skin for a moment on some places."""
    count, step = len(tilt_deg), 1 / theatre.rate_hz
    pressed = np.clip(0.5 + wander(rng, count, step, 0.8, 0.3), 0, 1)
    depth = np.clip(depth_mm * (1.06 - 0.12 * pressed), LEAST_MM, MOST_MM)
    if hairy:
        wet = np.clip(0.8 + wander(rng, count, step, 0.2, 0.12), 0.5, 1)
    else:
        wet = np.clip(0.97 + wander(rng, count, step, 0.5, 0.03), 0.85, 1)
    kinds = np.full(count, kind, dtype="U8")
    if touches:  # comes down and lifts off: half wetted
        wet[[0, -1]] *= rng.uniform(0.3, 0.9, 2)
        kinds[[0, -1]] = "touch"
    if count > 8 and rng.random() < 0.15:
        first = int(rng.integers(2, count - 5))
        last = first + int(rng.integers(1, 4))
        wet[first:last], kinds[first:last] = 0.0, "lost"
        wet[[first - 1, last]] *= 0.7
        kinds[[first - 1, last]] = "touch"
    return Hand(np.full(count, place), kinds, depth, tilt_deg, aside_mm, wet, np.zeros(count))


def holes_visible(theatre: Theatre) -> bool:
    """Whether the brain's echoes behind a burr hole are seen: otherwise nobody could tell the hole from a lost echo."""
    loss_db = theatre.attenuation * theatre.acquisition.transducer_hz * 1e-6 * 0.4
    return theatre.speckle * 10 ** (-loss_db / 20) > 0.5 * 10 ** (-theatre.snr_db / 20)


def _heading(angle: float) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


def _visit(theatre: Theatre, rng: np.random.Generator, place: int, count: int) -> Hand:
    """One place: the search for the perpendicular, which a burst comes after, and the hold with its tremor."""
    dwells, step = theatre.mode == "dwell", 1 / theatre.rate_hz
    name = str(rng.choice(list(PLACES)))
    time = np.arange(count) * step + (0.0 if dwells else rng.uniform(0.8, 2))
    start, held, tremor = rng.uniform(3, 10), abs(rng.normal()) * 1.2, rng.uniform(0.2, 0.6)
    searching = start * np.exp(-time / rng.uniform(0.3, 0.9))
    towards, aslant = rng.uniform(0, 2 * np.pi, 2)
    unrest = np.stack([wander(rng, count, step, 0.15, tremor) for _ in range(2)], axis=1)
    tilt = searching[:, None] * _heading(towards) + held * _heading(aslant) + unrest
    kind = "burr" if holes_visible(theatre) and rng.random() < 0.08 else name
    before = 0
    if dwells or rng.random() < 0.5:
        before = int(rng.integers(1, 4 if dwells else 2))
    hairy = name in HAIRY and rng.random() < 0.35
    aside = np.stack([wander(rng, count, step, 1.0, 0.3) for _ in range(2)], axis=1)
    depth = np.full(count, _depth(theatre, rng, name))
    return joined([_air(rng, place, before), _contact(theatre, rng, place, kind, depth, tilt, aside, hairy, dwells)])


def _sweep(theatre: Theatre, rng: np.random.Generator, frames: int) -> Hand:
    """Gliding over one region, mostly by the hand's feel; over an old burr hole on some."""
    step, part = 1 / theatre.rate_hz, frames / USUAL_LINES
    name = str(rng.choice(list(PLACES)))
    before, after = (max(1, round(part * int(rng.integers(*span)))) for span in ((2, 7), (1, 4)))
    count = max(8, frames - before - after)
    pace = np.clip(rng.uniform(8, 25) + wander(rng, count, step, 0.7, 5.0), 1, None)
    along = np.cumsum(pace) * step
    swing = 0.12 * np.sin(2 * np.pi * along / rng.uniform(40, 120) + rng.uniform(0, 6))
    depth = np.clip(_depth(theatre, rng, name) * (1 + swing), LEAST_MM + 0.1, theatre.deepest_mm)
    tilt = np.stack([wander(rng, count, step, 0.6, 1.9) for _ in range(2)], axis=1)
    aside = np.stack([along, wander(rng, count, step, 1.0, 1.5)], axis=1)
    hand = _contact(theatre, rng, 0, name, depth, tilt, aside, bool(rng.random() < 0.3), True)
    if holes_visible(theatre) and rng.random() < 0.4 * min(part, 1.0):
        rim = np.abs(along - rng.uniform(0.2, 0.7) * along[-1]) - HOLE_MM
        near, touching = RIM_MM + 2 * theatre.beam_mm, hand.kind != "lost"
        hand.kind[touching & (rim < near)] = "edge"
        hand.kind[touching & (rim < -near)] = "burr"
    return joined([_air(rng, 0, before), hand, _air(rng, 0, after)])


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _across(normal: Array, along: Array) -> Array:
    """The part of `along` in the plane of `normal`, of length 1 (n, 3)."""
    return _unit(along - normal * np.einsum("ni,ni->n", along, normal)[:, None])


def draw_poses(theatre: Theatre, rng: np.random.Generator, hand: Hand) -> Array:
    """ProbeToReference of every line (n, 4, 4): on an ellipsoid head, the delay line and the tissue between origin and bone."""
    count = len(hand.place)
    middles = rng.normal(size=(PLACES_AT_MOST, 3))
    middles[:, 2] = np.abs(middles[:, 2])
    bone = (_unit(middles) * HEAD_MM)[hand.place]
    normal = _unit(bone / HEAD_MM**2)
    first = _unit(np.cross(normal, [0.3, 0.8, 0.52]))
    bone = bone + hand.aside_mm[:, :1] * first + hand.aside_mm[:, 1:] * np.cross(normal, first)
    bone = bone / np.linalg.norm(bone / HEAD_MM, axis=1, keepdims=True)
    normal = _unit(bone / HEAD_MM**2)
    first = _across(normal, first)
    slope = np.tan(np.radians(hand.tilt_deg))
    beam = _unit(slope[:, :1] * first + slope[:, 1:] * np.cross(normal, first) - normal)
    far = hand.about_mm + theatre.acquisition.forerun_length_mm + hand.lifted_mm
    origin = bone - beam * far[:, None] + rng.normal(size=(count, 3)) * OFF_MM
    beam = _unit(beam + rng.normal(size=(count, 3)) * np.radians(OFF_DEG))
    side = _across(beam, first)
    head_to_reference = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    head_to_reference *= np.sign(np.linalg.det(head_to_reference))
    turned = head_to_reference @ np.stack([side, np.cross(beam, side), beam], axis=2)
    return np.asarray(rigid(turned, origin @ head_to_reference.T + rng.uniform(-100, 100, 3)))


def draw_status(rng: np.random.Generator, count: int) -> tuple[str, ...]:
    """The tracker's word on each line; in some recordings it loses the probe for a few lines."""
    statuses = np.full(count, "OK", dtype="U12")
    if rng.random() < 0.4:
        for _ in range(max(1, round(int(rng.integers(1, 4)) * count / USUAL_LINES))):
            first = int(rng.integers(count))
            statuses[first : first + int(rng.integers(1, 6))] = rng.choice(["MISSING", "OUT_OF_VIEW", "INVALID"])
    return tuple(str(status) for status in statuses)
