"""What a simulated palpation session is made of: the probe and the receiver, the places, the hand, the tissue under it.

The hand comes down on a place, searches the perpendicular, holds, and lifts again; or it glides over the head. The physics and
the ranges are those of the literature: materials of the delay line, thickness of the scalp, the lobe of a small disc on bone.
session_lines.py makes the lines of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition
from CranioNavLib.rigid import rigid, rigid_from_vector

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

DEPTH_MM = (2.0, 15.0)
FILM_MM = (0.4, 1.7)  # of gel, with air behind
BONE_R = 0.57  # amplitude that bone reflects under soft tissue
MATERIALS = ((1616.0, 0.05), (2170.0, -0.05), (2340.0, -0.20), (2460.0, -0.17), (2670.0, -0.316))  # m/s, reflection to tissue
LEAST_LINES, MOST_LINES, MOST_PLACES = 5, 20, 8  # of a place; of a recording
NEXT_MM = 6.0  # places are further apart


@dataclass(frozen=True)
class Session:
    """What all lines of a recording share. Levels are in dB over bone met squarely at the surface, unless said otherwise."""

    acquisition: Acquisition
    centre_mhz: float  # the true one
    pulse: str  # gauss; damped
    bandwidth: float  # at -6 dB, of the centre
    order: float  # of a damped pulse: t^order exp(-t / tau)
    onset: bool  # time zero is the onset of the transmitted pulse, not the peak of its envelope
    phase: float
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    snr_db: float  # of a perpendicular bone echo of the typical depth
    snr_of: str
    noise_band: float  # up to this many times the centre; 0: white
    lobe_deg: float  # bone's specular echo has lost 6 dB
    floor_db: float  # diffuse echo
    speckle_db: float
    speckle_keeps: float  # likeness to the line before
    layer_db: tuple[float, float, float]  # dermis to fat, fascia, galea
    layer_floor_db: float  # their diffuse echo under their specular one
    inner_db: float  # inner table under bone's echo
    skull_mm: float
    diploe_db: float  # what scatters between the tables
    again_db: float  # bone, face, bone: under bone's echo
    face_r: float  # reflection of the delay line's face in contact
    back: float  # what comes back from the transducer's end for the next multiple
    trail: tuple[tuple[float, float], ...]  # echoes behind the face's: us, under the face's
    late: float  # the delay line's time over the header's
    warming: float  # change of that time over the recording
    bang_db: float
    bang_us: float  # until the ring-down has fallen 40 dB under bone
    static: tuple[tuple[float, float, bool], ...]  # constant echoes: mm behind the face, dB against bone, with the delay line
    jitter_ns: float
    spikes: float  # a line
    hum: float  # over the noise
    drift: float
    bits: int
    fill: float  # of the converter, by the largest echo in the tissue
    typical_mm: float
    spread: float  # of the places' depths
    behind_mm: float  # seen behind the deepest bone
    without: str  # a recording without bone: tissue, air, nothing, film
    miss_share: float  # of the places
    glides: bool
    lifts: bool  # the poses show how the hand lifts
    numbered: bool  # the recording tells the points


def _maybe(rng: np.random.Generator, share: float, low: float, high: float, otherwise: float) -> float:
    return float(rng.uniform(low, high)) if rng.random() < share else otherwise


def _draw_device(rng: np.random.Generator) -> tuple[Acquisition, float, float]:
    """What the recording's header says, the tissue's speed of sound, and the reflection of the delay line's face."""
    nominal = float(rng.uniform(3, 10))
    rates = np.array([25, 30, 40, 50, 60, 62.5, 64, 80, 100, 125])
    sampling = float(rng.choice(rates[rates >= 2.6 * nominal]))
    speed = float(rng.uniform(1450, 1630))
    material, reflection = MATERIALS[rng.integers(len(MATERIALS))]
    forerun = rng.random() < 0.5
    length = float(rng.uniform(8, 30))
    line = (length, material) if forerun else (0.0, 0.0)
    return Acquisition(sampling * 1e6, nominal * 1e6, *line), speed, reflection


def draw_session(rng: np.random.Generator) -> Session:
    """A set-up; levels that are absent are -99 dB."""
    acquisition, speed, reflection = _draw_device(rng)
    forerun = acquisition.forerun_length_mm > 0
    typical = float(rng.uniform(*DEPTH_MM))
    without = str(rng.choice(["", "tissue", "air", "nothing", "film"], p=[0.86, 0.07, 0.03, 0.02, 0.02]))
    damped = rng.random() < 1 / 3
    static = [
        (float(rng.uniform(1.5, 17)), float(rng.uniform(-25, -5)), bool(forerun and rng.random() < 0.5))
        for _ in range(rng.integers(1, 4) if rng.random() < 0.3 else 0)
    ]
    trail = [(float(rng.uniform(0.8, 3)) * (one + 1), -float(rng.uniform(20, 35))) for one in range(rng.integers(0, 3))]
    return Session(
        acquisition=acquisition,
        centre_mhz=acquisition.transducer_hz * 1e-6 * float(rng.uniform(0.94, 1.06)),
        pulse="damped" if damped else "gauss",
        bandwidth=float(rng.uniform(0.4, 0.9)),
        order=float(rng.uniform(1, 3)),
        onset=bool(damped and rng.random() < 0.5),
        phase=float(rng.uniform(0, 2 * np.pi)),
        speed_m_s=speed,
        attenuation=float(rng.uniform(0.3, 2.6)),
        snr_db=float(rng.uniform(28 if without == "tissue" else 12, 40)),
        snr_of="square",
        noise_band=_maybe(rng, 0.35, 1.5, 3.0, 0.0),
        lobe_deg=float(rng.uniform(1, 4)),
        floor_db=float(rng.uniform(-30, -12)),
        speckle_db=float(rng.uniform(-45, -22)),
        speckle_keeps=float(rng.uniform(0.3, 0.98)),
        layer_db=(float(rng.uniform(-30, -10)), float(rng.uniform(-30, -10)), float(rng.uniform(-30, -8))),
        layer_floor_db=float(rng.uniform(-18, -9)),
        inner_db=_maybe(rng, 0.5, -28, -8, -99.0),
        skull_mm=float(rng.uniform(3, 8)),
        diploe_db=_maybe(rng, 0.3, -36, -16, -99),
        again_db=_maybe(rng, 0.5, -32, -8, -99.0),
        face_r=float(np.sign(reflection) * np.clip(abs(reflection) * 10 ** (rng.uniform(-3, 3) / 20), 0.05, 0.316)),
        back=float(rng.choice([-1, 1]) * rng.uniform(0.1, 0.6)),
        trail=tuple(trail),
        late=float(1 + rng.uniform(-0.015, 0.015)),
        warming=float(rng.uniform(-0.005, 0.005)),
        bang_db=float(rng.uniform(5, 32)),
        bang_us=float(rng.uniform(0.8, 3)),
        static=tuple(static),
        jitter_ns=float(rng.uniform(0, 10)),
        spikes=_maybe(rng, 0.25, 0, 0.6, 0.0),
        hum=_maybe(rng, 0.4, 0.5, 15, 0.0),
        drift=_maybe(rng, 0.4, 0.5, 15, 0.0),
        bits=int(rng.choice([8, 10, 12, 14])),
        fill=float(rng.uniform(0.4, 1.0) if rng.random() < 0.85 else rng.uniform(1.0, 2.0)),
        typical_mm=typical,
        spread=float(rng.uniform(0.05, 0.3)),
        behind_mm=float(rng.uniform(3, 15)),
        without=without,
        miss_share=float(rng.choice([0.0, 0.15, 0.3])),
        glides=bool(rng.random() < 0.2),
        lifts=bool(rng.random() < 0.5),
        numbered=bool(rng.random() < 0.35),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Way:
    """Where the hand goes, line by line, and what lies under it."""

    place: npt.NDArray[np.int64]  # (n,)
    kind: npt.NDArray[np.str_]  # (n,) bone, tissue, nothing, film: of gel, with air behind
    depth_mm: Array  # (n,) of the bone, or where it would be
    tilt_deg: Array  # (n, 2)
    contact: Array  # (n,) 1: full; 0: air
    loss_db: Array  # (n,) by hair or a dry patch
    layers_mm: Array  # (n, 4) NaN: none
    layers: Array  # (n, 4) their echoes over bone's
    film_mm: Array  # (n,) its thickness; NaN: none
    film_r: float  # reflection of the probe's face in the film

    @property
    def coupling(self) -> Array:
        """What comes of an echo from the tissue (n,)."""
        return np.asarray(self.contact * 10 ** (-self.loss_db / 20))

    @property
    def angle_deg(self) -> Array:
        """Angle to the perpendicular (n,)."""
        return np.linalg.norm(self.tilt_deg, axis=1)


def response(off_deg: Array, lobe_deg: npt.ArrayLike, floor_db: float) -> Array:
    """Echo of a specular face, rough in the fine, over that of one met squarely."""
    return np.asarray(np.hypot(np.exp(-np.log(2) * (off_deg / lobe_deg) ** 2), 10 ** (floor_db / 20)))


def draw_way(session: Session, rng: np.random.Generator, frames: int, skill: float = 1.0) -> Way:
    """The whole session; with more skill the hand tilts less."""
    sizes = np.array([frames] if session.glides else _sizes(rng, frames))
    place = np.repeat(np.arange(len(sizes)), sizes)
    depth, tilt, contact = _hand(session, rng, sizes, skill)
    missed = rng.random(len(sizes)) < session.miss_share
    if len(sizes) > 1:
        missed[rng.integers(len(sizes))] = False
    missing = missed[place]
    if session.glides and missing.any():  # a hole on the way, not the whole way
        start = int(rng.integers(frames))
        missing = (np.arange(frames) >= start) & (np.arange(frames) < start + max(frames // 5, 2))
    kind = np.where(missing, rng.choice(["tissue", "nothing", "film"], len(sizes), p=[0.65, 0.2, 0.15])[place], "bone")
    if session.without:
        kind = np.full(frames, "tissue" if session.without == "air" else session.without)
        contact = np.zeros(frames) if session.without == "air" else contact
    layers_mm, layers = _layers(session, rng, place, depth, tilt)
    layers_mm[:, 3] = np.where(kind == "tissue", layers_mm[:, 3], np.nan)
    layers_mm[(kind == "nothing") | (kind == "film")] = np.nan
    loss = _dry(rng, sizes)
    thickness = rng.uniform(*FILM_MM, len(sizes))[place] * (1 + rng.uniform(0, 0.02) * _tremor(rng, frames)[:, 0])
    film_mm = np.where(kind == "film", thickness, np.nan)
    film_r = session.face_r if session.acquisition.forerun_length_mm else float(rng.uniform(-0.5, 0.5))
    return Way(place, kind.astype(np.str_), depth, tilt, contact, loss, layers_mm, layers, film_mm, film_r)


def _sizes(rng: np.random.Generator, frames: int) -> list[int]:
    """How many lines each place gets."""
    most = min(MOST_PLACES, frames // LEAST_LINES)
    least = min(max(2, -(-frames // MOST_LINES)), max(most, 1))
    count = int(rng.integers(least, max(most, least) + 1))
    while True:
        sizes = LEAST_LINES + rng.multinomial(max(frames - count * LEAST_LINES, 0), rng.dirichlet(np.full(count, 4.0)))
        if frames < LEAST_LINES:
            return [frames]
        if sizes.max() <= MOST_LINES:
            return [int(size) for size in sizes]


def _vectors(rng: np.random.Generator, lengths: Array) -> Array:
    """Vectors (..., 2) of given lengths to any side."""
    angle = rng.uniform(0, 2 * np.pi, lengths.shape)
    return np.stack([lengths * np.cos(angle), lengths * np.sin(angle)], axis=-1)


def _since(sizes: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Number of each line within its place (n,)."""
    return np.asarray(np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes))


def _tremor(rng: np.random.Generator, frames: int) -> Array:
    """Unrest of the hand, of standard deviation 1 (n, 2)."""
    keeps, out = rng.uniform(0.3, 0.9), rng.normal(size=(frames, 2))
    for row in range(1, frames):
        out[row] = keeps * out[row - 1] + np.sqrt(1 - keeps**2) * out[row]
    return out


def _hand(session: Session, rng: np.random.Generator, sizes: npt.NDArray[np.int64], skill: float) -> tuple[Array, Array, Array]:
    """Depth (n,), tilt (n, 2) and contact (n,) while the hand comes down, searches, holds and lifts: on each place, or once."""
    count, frames = len(sizes), int(sizes.sum())
    place, number = np.repeat(np.arange(count), sizes), _since(sizes)

    def each(low: float, high: float) -> Array:
        return np.asarray(rng.uniform(low, high, count))

    before, half, after = (np.minimum(rng.integers(0, most + 1, count), sizes // 5) for most in (3, 2, 2))
    since = number - before[place]
    partly = 0.15 + 0.55 * (since + rng.random(frames)) / np.maximum(half, 1)[place]
    contact = np.where(since < 0, 0.0, np.where(since < half[place], partly, 1.0))
    contact[number >= (sizes - after)[place]] = 0.0
    since = np.maximum(since, 0)
    start, settled = _vectors(rng, each(3, 10)), _vectors(rng, each(0.5, 3) / skill)
    fade = np.exp(-since / (each(0.6, 2.5) / skill)[place])[:, None]
    rock = (
        np.sin(2 * np.pi * since / each(8, 25)[place] + each(0, 6)[place])[:, None] * _vectors(rng, each(0, 1.2) / skill)[place]
    )
    unrest = (each(0.05, 0.35) / skill)[place, None] * _tremor(rng, frames)
    tilt = settled[place] + (start - settled)[place] * fade + rock + unrest
    pressed = 1 - each(0, 0.08)[place] * (1 - np.exp(-since / each(2, 8)[place]))
    swing = each(0, 0.04)[place] * np.sin(2 * np.pi * since / each(10, 30)[place] + each(0, 6)[place])
    if session.glides:
        swing = swing + session.spread * np.sin(2 * np.pi * since / rng.uniform(40, 120) + rng.uniform(0, 6))
    base = np.clip(session.typical_mm * np.exp(rng.normal(0, session.spread, count)), DEPTH_MM[0] / 0.87, DEPTH_MM[1] / 1.05)
    depth = base[place] * (pressed + swing) + rng.normal(0, 0.005, frames)
    depth += max(DEPTH_MM[0] - depth.min(), 0.0)
    depth *= min(DEPTH_MM[1] / depth.max(), 1.0)
    return depth, tilt, contact


def _dry(rng: np.random.Generator, sizes: npt.NDArray[np.int64]) -> Array:
    """Decibels lost to hair or a dry patch, on some lines of some places (n,)."""
    count = len(sizes)
    place, number = np.repeat(np.arange(count), sizes), _since(sizes)
    first, lasts = rng.integers(0, sizes), rng.integers(1, 5, count)
    lost = np.where(rng.random(count) < 0.25, rng.uniform(3, 20, count), 0.0)[place]
    lost = np.maximum(lost * rng.uniform(0.6, 1, len(place)), np.minimum(lost, 3.0))
    return np.where((number >= first[place]) & (number < (first + lasts)[place]), lost, 0.0)


def _layers(
    session: Session, rng: np.random.Generator, place: npt.NDArray[np.int64], depth: Array, tilt: Array
) -> tuple[Array, Array]:
    """Depth and echo (n, 4) of dermis to fat, fascia, galea, and of one behind where bone is missing."""
    count = int(place[-1]) + 1
    first = depth[np.searchsorted(place, np.arange(count))]
    skin = rng.uniform(0.8, 2.5, count)
    share = np.where(first > 5, rng.uniform(0.35, 0.8, count), np.nan)
    galea = np.where(rng.random(count) < 0.75, rng.uniform(0.3, 2.5, count), np.nan)
    behind = rng.uniform(2, 9, count)
    at = np.stack([skin[place] * depth / first[place], share[place] * depth, depth - galea[place], depth + behind[place]], axis=1)
    tight = (at < 0.6) | ((at > depth[:, None] - 0.25) & (np.arange(4) < 3))
    usual = np.column_stack([np.tile(session.layer_db, (count, 1)), rng.uniform(-30, -14, count)])
    level = rng.choice([-1, 1], (count, 4)) * 10 ** (np.minimum(usual + rng.normal(0, 2, (count, 4)), -8.0) / 20)
    normal = _vectors(rng, np.abs(rng.normal(0, 2.0, (count, 4))))
    lobe = session.lobe_deg * rng.uniform(1, 2.5, (count, 4))
    off = np.linalg.norm(tilt[:, None] - normal[place], axis=2)
    return np.where(tight, np.nan, at), level[place] * response(off, lobe[place], session.layer_floor_db)


def draw_poses(session: Session, rng: np.random.Generator, way: Way) -> Array:
    """ProbeToReference of every line: the probe looks to the head, and lifts along its axis."""
    place = way.place
    count, frames = int(place[-1]) + 1, len(place)
    spots = rng.uniform(-80, 80, (count, 3))
    for one in range(1, count):
        while np.linalg.norm(spots[one] - spots[one - 1]) < NEXT_MM:
            spots[one] = rng.uniform(-80, 80, 3)
    origin = spots[place] + 0.08 * rng.normal(size=(frames, 3))
    if session.glides:
        heading = np.append(_vectors(rng, np.array(rng.uniform(0.3, 1.5))), 0.0)
        turn = np.linspace(0, rng.uniform(-1, 1), frames)[:, None]
        origin = origin + np.cumsum(np.cos(turn) * heading + np.sin(turn) * heading[[1, 0, 2]] * [1, -1, 1], axis=0)
    facing = rigid_from_vector(rng.uniform(-1.5, 1.5, (count, 3)), np.zeros((count, 3)))[place]
    local = rigid_from_vector(np.radians(np.pad(way.tilt_deg, ((0, 0), (0, 1)))), np.zeros((frames, 3)))
    turned = np.einsum("nij,njk->nik", facing, local)[:, :3, :3]
    if session.lifts and session.without != "air":
        away = np.where(way.contact == 0, rng.uniform(5, 30, frames), 0.0)
        origin = origin - away[:, None] * turned[:, :, 2]
    return rigid(turned, origin)
