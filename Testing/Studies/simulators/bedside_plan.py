"""What happens at a patient's bed: the probe that was chosen, the places, the hand, and the bone under it.

The probe suits the job: the deeper the bone and the more the tissue takes, the lower its frequency. The hand comes through the
air, lands half coupled, comes upright, trembles and lifts, or glides. The bone is a sphere under each place, so that depth, tilt
and pose belong together. bedside_lines.py makes the lines of it.
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

DEPTH_MM = (2.0, 15.0)
# of the delay line: m/s, its reflection to tissue, dB/cm at 5 MHz: aqualene, TPX, polystyrene, PMMA
MATERIALS = ((1616.0, 0.04, 2.8), (2170.0, -0.05, 5.3), (2340.0, -0.20, 1.5), (2670.0, -0.32, 3.0))
MOST_LOSS_DB = 42.0  # there and back at the centre frequency: nobody takes a probe that loses more
MOST_PLACES, LINES_EACH = 4, 26.0  # of a recording; of a place, with the way to it
HOLE_SHARE, HOLE_LINES = 0.09, 20  # of the places; who has fewer lines to spend does not go to a hole as well
TRACKER_MM, TRACKER_RAD = 0.12, 0.0025
HEAD_MM = 85.0


@dataclass(frozen=True)
class Bedside:
    """What all lines of a recording share. Heights are over the transmitted pulse totally reflected at the probe's face."""

    acquisition: Acquisition
    pulse: str  # ringing: a Gaussian one with a tail
    bandwidth: float  # at -6 dB, of the centre
    ring: float  # the tail over the pulse
    phase: float
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    snr_db: float  # of an upright bone in the deepest place, behind the filter matched to its echo
    snr_of: str
    rate_hz: float  # of lines
    whole: str  # a recording without bone: soft, air, cable
    sweeps: bool  # one glide instead of places
    thick_mm: tuple[float, ...]  # of the tissue in each place
    hole: int  # the place over a hole in the bone; -1: none
    crosses_hole: bool  # the glide
    undulation: float  # of the thickness along the skin
    disc_mm: float
    focus_deg: float  # bone's echo has lost 3 dB at half of it; 0: a flat disc
    diffuse: float  # bone's diffuse echo over its specular one
    roughness_mm: float
    skull_mm: float
    inner_db: float  # inner table under bone
    speckle: float  # over bone's echo
    keeps_lines: float  # the speckle and the hand's pressure on it stay alike for so many lines
    jitter_ns: float
    behind_mm: float  # seen behind the deepest bone
    back: float  # what the transducer's end throws back into the delay line, or the tissue
    face_r: float  # reflection of the delay line's face to tissue
    line_db: float  # lost in the delay line at 5 MHz, a cm
    warming: float  # of the delay line's time
    artefact: float  # a constant echo, over bone's
    artefact_us: float
    headroom: float  # of the converter over bone's largest echo
    spikes: bool
    offset: float  # of the base line, and of its drift, over the converter's range
    drift: float
    bits: int
    left_justified: bool
    drop: float  # share of the poses that are missing


def db(level: npt.ArrayLike) -> Array:
    """The ratio of amplitudes that so many decibels are."""
    return np.asarray(10.0 ** (np.asarray(level) / 20))


def wander(rng: np.random.Generator, count: int, spread: float, keeps: float, columns: int = 1) -> Array:
    """Slow unrest (count, columns) of standard deviation `spread` that is forgotten after `keeps` lines."""
    memory = float(np.exp(-1 / keeps))
    steps = rng.normal(0, spread, (count, columns))
    steps[1:] *= np.sqrt(1 - memory**2)
    return np.asarray(lfilter([1.0], [1.0, -memory], steps, axis=0))


def _places(rng: np.random.Generator, frames: int, sweeps: bool) -> tuple[tuple[float, ...], int]:
    """Thickness of the tissue in each place, and which of them is over a hole (-1: none)."""
    typical = rng.uniform(2.3, 14.5)
    count = 1 if sweeps else int(np.clip(np.rint(frames / LINES_EACH * rng.uniform(0.8, 1.4)), 1, MOST_PLACES))
    wants_hole = not sweeps and frames >= HOLE_LINES and rng.random() < HOLE_SHARE * max(count, 2)
    count = max(count, 2) if wants_hole else count  # who goes to a hole goes beside it too
    thick = np.clip(typical * rng.uniform(0.8, 1.12, count), *DEPTH_MM)
    return tuple(float(one) for one in thick), int(rng.integers(count)) if wants_hole else -1


def draw_bedside(rng: np.random.Generator, frames: int) -> Bedside:
    """A patient, a probe, and what is wanted of them in about so many lines."""
    sweeps = rng.random() < 0.3
    whole = str(rng.choice(["soft", "air", "cable", ""], p=[4 / 60, 2 / 60, 1 / 60, 53 / 60]))
    thick, hole = _places(rng, frames, sweeps)
    crosses = bool(rng.random() < 0.3)
    attenuation, speed = float(rng.uniform(0.3, 2.6)), float(rng.uniform(1450, 1630))
    forerun = bool(rng.random() < 0.5)
    highest = min(10.0, MOST_LOSS_DB / (0.2 * attenuation * max(thick)))
    lowest = 3.0 if forerun or min(thick) > 4 else 5.0  # a thin scalp without a delay line: not with a long pulse
    centre = round(lowest + (max(highest, lowest) - lowest) * rng.random(), 1)
    rates = np.array([25, 40, 50, 60, 62.5, 80, 100, 125])
    sampling = float(rng.choice(rates[rates >= 3.5 * centre]))
    material_m_s, face_r, line_db = MATERIALS[rng.integers(len(MATERIALS))]
    reach = max(max(thick) * 1.1, 12.0 if whole else 0.0) * material_m_s / speed
    short = rng.random() < 0.25  # the face's second echo lies among the tissue
    length = round(2 * max(reach * (rng.uniform(0.6, 0.95) if short else rng.uniform(1.05, 1.4)), 6.0)) / 2
    opened = crosses if sweeps else hole >= 0  # there one sees the tissue go on behind the hole
    return Bedside(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, length if forerun else 0.0, material_m_s if forerun else 0.0),
        pulse="ringing",
        bandwidth=float(rng.uniform(0.45, 0.8)),
        ring=float(rng.uniform(0, 0.22)),
        phase=float(rng.uniform(0, 2 * np.pi)),
        speed_m_s=speed,
        attenuation=attenuation,
        snr_db=float(rng.uniform(15, 40)),
        snr_of="deepest",
        rate_hz=float(rng.choice([10, 15, 20, 30])),
        whole=whole,
        sweeps=sweeps,
        thick_mm=thick,
        hole=hole,
        crosses_hole=crosses,
        undulation=float(rng.uniform(0.03, 0.12)),
        disc_mm=float(rng.uniform(8, 15)) * speed / 1e3 / centre,
        focus_deg=float(rng.uniform(2.5, 4.5)) if rng.random() < 0.5 else 0.0,
        diffuse=float(db(rng.uniform(-30, -20))),
        roughness_mm=float(rng.uniform(0.005, 0.025)),
        skull_mm=float(rng.uniform(3, 7)),
        inner_db=float(rng.uniform(-18, -8)),
        speckle=float(db(rng.uniform(-34, -28) if opened else rng.uniform(-44, -30))),
        keeps_lines=float(rng.uniform(1, 3) if sweeps else rng.uniform(6, 25)),
        jitter_ns=float(rng.uniform(0, 8)),
        behind_mm=float(rng.uniform(6, 16)),
        back=float(rng.uniform(0.25, 0.5)),
        face_r=face_r if forerun else 0.0,
        line_db=line_db,
        warming=float(rng.uniform(-0.004, 0.004)),
        artefact=float(db(rng.uniform(-20, -10))) if rng.random() < 0.15 and not forerun else 0.0,
        artefact_us=float(rng.uniform(4, 9)),
        headroom=float(rng.uniform(1.4, 5) if rng.random() > 0.05 else rng.uniform(0.3, 0.7)),
        spikes=bool(rng.random() < 0.2),
        offset=float(rng.uniform(-0.08, 0.08)),
        drift=float(rng.uniform(-0.1, 0.1)),
        bits=int(rng.choice([10, 12, 14])),
        left_justified=bool(rng.random() < 0.5),
        drop=float(rng.choice([0, 0.02, 0.08])),
    )  # fmt: skip


@dataclass(frozen=True)
class Stay:
    """A stretch of lines in one manner."""

    kind: str  # bone, hole, soft, air, cable
    lines: int
    place: int
    from_deg: float = 0.0  # how askew the hand starts
    rest_deg: float = 0.0  # and stays, or glides
    hair: bool = False


@dataclass(frozen=True, eq=False)
class Way:
    """The hand's story line by line."""

    kind: npt.NDArray[np.str_]  # (n,) bone, hole, soft, air, cable
    place: npt.NDArray[np.int64]  # (n,)
    contact: Bools  # (n,)
    coupling: Array  # (n,) what comes of an echo
    tilt_deg: Array  # (n, 2) of the probe to the skin's normal
    along_mm: Array  # (n,) on the skin


def _stays(rng: np.random.Generator, world: Bedside) -> list[Stay]:
    """The story as somebody with time would have it."""

    def air(place: int) -> Stay:
        return Stay("air", int(rng.integers(3, 8)), place)

    if world.whole in ("air", "cable"):
        return [Stay(world.whole, 55, 0)]
    if world.sweeps:
        glide = Stay(world.whole or "bone", int(rng.integers(45, 90)), 0, rest_deg=float(rng.uniform(0, 2)))
        return [air(0), glide, air(0)]
    stays = []
    for place in range(len(world.thick_mm)):
        if place == 0 or rng.random() < 0.8:
            stays.append(air(place))
        lines = int(rng.integers(15, 31))
        if world.whole or place == world.hole:
            stays.append(Stay(world.whole or "hole", lines, place, rng.uniform(1, 5), rng.uniform(0, 1)))
        elif rng.random() < 0.12:  # held askew throughout
            stays.append(Stay("bone", lines, place, 9.0, rng.uniform(4, 9)))
        else:
            stays.append(Stay("bone", lines, place, rng.uniform(2, 9), rng.uniform(0, 1.3), bool(rng.random() < 0.08)))
    return [*stays, air(0)]


def draw_way(rng: np.random.Generator, world: Bedside, frames: int) -> Way:
    """The whole story in about so many lines: with less time everything is shorter, the coming upright too."""
    stays = _stays(rng, world)
    scale = frames / sum(stay.lines for stay in stays)
    sizes = [max(int(np.rint(stay.lines * scale)), 1 if stay.kind == "air" else 4) for stay in stays]
    kinds, tilts, couplings, alongs = [], [], [], []
    for stay, size in zip(stays, sizes):
        kind, tilt = np.full(size, stay.kind, dtype="U8"), np.zeros((size, 2))
        coupling, along = np.ones(size), np.zeros(size)
        if stay.kind not in ("air", "cable"):
            tilt = _hand(rng, world, stay, size, min(scale, 1.0))
            coupling = _coupling(rng, world, stay, size)
            glide = rng.uniform(8, 22) * np.arange(size) / world.rate_hz if world.sweeps else 0.0
            along = glide + wander(rng, size, 0.25, world.rate_hz * 0.5)[:, 0]
            if world.sweeps and stay.kind == "bone" and world.crosses_hole:
                start, width = rng.uniform(0.25, 0.6) * along[-1], rng.uniform(9, 14)
                kind[(along > start) & (along < start + width)] = "hole"
        for parts, part in ((kinds, kind), (tilts, tilt), (couplings, coupling), (alongs, along)):
            parts.append(part)
    kind = np.concatenate(kinds)
    contact = (kind != "air") & (kind != "cable")
    place = np.repeat([stay.place for stay in stays], sizes)
    return Way(kind, place, contact, np.concatenate(couplings), np.concatenate(tilts), np.concatenate(alongs))


def _hand(rng: np.random.Generator, world: Bedside, stay: Stay, size: int, hurry: float) -> Array:
    """Tilt (size, 2) of the probe: it comes upright and trembles, or wanders while it glides."""
    side = rng.uniform(0, 2 * np.pi)
    askew = np.array([np.cos(side), np.sin(side)])
    rate = world.rate_hz
    if world.sweeps:
        return stay.rest_deg * askew + wander(rng, size, rng.uniform(0.8, 1.8), rate * 0.6, 2)
    fade = np.exp(-np.arange(size) / (rate * rng.uniform(0.2, 0.5) * hurry))
    lean = stay.rest_deg + max(stay.from_deg - stay.rest_deg, 0.0) * fade
    tremor = wander(rng, size, rng.uniform(0.25, 0.6), rate * 0.15, 2)
    return np.asarray(lean[:, None] * askew + tremor + wander(rng, size, 0.4, rate * 0.8, 2))


def _coupling(rng: np.random.Generator, world: Bedside, stay: Stay, size: int) -> Array:
    """What comes of an echo (size,): hair or a bubble in the gel comes and goes; the probe lands and lifts half coupled."""
    coupling = np.clip(0.93 + wander(rng, size, 0.05, world.rate_hz * 0.5)[:, 0], 0.7, 1)
    if stay.hair:
        coupling *= np.clip(0.5 + wander(rng, size, 0.3, 4.0)[:, 0], 0.12, 1)
    coupling[[0, -1]] *= rng.uniform(0.15, 0.7, 2)
    return np.asarray(coupling)


@dataclass(frozen=True, eq=False)
class Stand:
    """How the probe stands to the bone."""

    probe_to_reference: Array  # (n, 4, 4) as a tracker gives it
    depth_mm: Array  # (n,) along the beam; NaN without contact
    tilt_deg: Array  # (n,) to the bone's normal; NaN without contact


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def draw_stand(rng: np.random.Generator, world: Bedside, way: Way) -> Stand:
    """Poses, depth along the beam and tilt: under each place the bone is a sphere, the probe stands on the skin above it."""
    count, frames = len(world.thick_mm), len(way.place)
    up = rng.normal(size=(count, 3))
    up[:, 2] = np.abs(up[:, 2])
    up = _unit(up)
    ahead = _unit(np.cross(up, [0.3, 0.9, 0.1]))
    aside = np.cross(up, ahead)[way.place]
    radius, phase, period = (rng.uniform(*span, count)[way.place] for span in ((60, 95), (0, 6.28), (25, 60)))
    up, ahead = up[way.place], ahead[way.place]
    turned = (way.along_mm / radius)[:, None]
    normal = np.cos(turned) * up + np.sin(turned) * ahead
    ahead = np.cos(turned) * ahead - np.sin(turned) * up
    pressed = np.clip(wander(rng, frames, 0.03, world.rate_hz)[:, 0], -0.08, 0.08)
    uneven = world.undulation * np.sin(2 * np.pi * way.along_mm / period + phase)
    thick = np.clip(np.array(world.thick_mm)[way.place] * (1 + pressed + uneven), *DEPTH_MM)
    lift = np.where(way.contact, 0.0, rng.uniform(8, 40, frames))
    centre = up * (HEAD_MM - radius)[:, None]
    origin = centre + (radius + thick + lift)[:, None] * normal
    lean = np.tan(np.radians(way.tilt_deg))
    beam = _unit(lean[:, :1] * ahead + lean[:, 1:] * aside - normal)
    from_centre = origin - centre
    along = np.einsum("ni,ni->n", beam, from_centre)
    inside = along**2 - (np.einsum("ni,ni->n", from_centre, from_centre) - radius**2)
    depth = np.where(way.contact, -along - np.sqrt(np.maximum(inside, 0)), np.nan)
    struck = from_centre + depth[:, None] * beam
    tilt = np.degrees(np.arccos(np.clip(-np.einsum("ni,ni->n", beam, struck) / radius, -1, 1)))
    seen = _unit(beam + rng.normal(0, TRACKER_RAD, (frames, 3)))
    first = _unit(np.cross(aside, seen))
    rotation = np.stack([first, np.cross(seen, first), seen], axis=2)
    return Stand(rigid(rotation, origin + rng.normal(0, TRACKER_MM, (frames, 3))), depth, tilt)
