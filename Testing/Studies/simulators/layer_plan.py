"""What recordings over layered tissue are drawn from: transducer, head, delay line, and where the hand goes. See layer_lines.py.

Units are mm, microseconds and MHz, so that speeds are in mm/us.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import rigid
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

NEPER = np.log(10) / 20  # a decibel
SAMPLINGS_MHZ = np.array([25, 30, 40, 50, 60, 62.5, 64, 80, 100, 125])
MOST_LOSS_DB = 48.0  # to the bone and back: nobody works beyond
DEPTH_MM = (2.0, 15.0)
SWEEP_LINES, STAY_LINES, PLACE_LINES = 71, 18, 23  # of a usual recording: in a sweep; at rest on a place; with what is around it
LEAST_PLACE_LINES = 9
SWEEP_MM = 52.0  # a usual one
LEAST_HOLE_MM = 20.0  # of a sweep that passes a hole


@dataclass(frozen=True)
class Tissue:
    """One kind of tissue of the scalp."""

    speed: float  # mm/us, before the layers are fitted to the speed of the head
    loss: float  # over the mean of the tissues
    impedance: tuple[float, float]  # MRayl, from and to
    speckle_db: float  # over skin's


@dataclass(frozen=True)
class Material:
    """What a delay line is made of."""

    speed: float  # mm/us
    impedance: float  # MRayl
    attenuation: float  # dB/cm/MHz
    per_kelvin: float  # change of the speed


TISSUES = {
    "skin": Tissue(1.60, 1.3, (1.60, 1.76), 0),
    "fat": Tissue(1.45, 0.8, (1.36, 1.46), -6),
    "galea": Tissue(1.61, 1.6, (1.68, 1.82), -2),
    "loose": Tissue(1.50, 0.7, (1.48, 1.56), -9),
    "muscle": Tissue(1.58, 1.1, (1.62, 1.70), -5),
    "periosteum": Tissue(1.60, 1.6, (1.68, 1.80), -2),
}
MATERIALS = {
    "aqualene": Material(1.616, 1.49, 0.56, -2.5e-3),
    "tpx": Material(2.17, 1.79, 1.06, -4e-3),
    "polystyrene": Material(2.34, 2.47, 0.36, -2.2e-3),
    "pmma": Material(2.67, 3.15, 0.5, -2.5e-3),
}
# Region: least and largest thickness of its soft tissue in mm, and how often it is visited
REGIONS = {"thin": (2, 4, 1.0), "forehead": (3, 6, 1.5), "vertex": (4, 8, 1.5), "occiput": (6, 10, 2.0), "temple": (7, 15, 2.5)}


@dataclass(frozen=True)
class Transducer:
    """Pulser, transducer and receiver of a recording."""

    nominal_mhz: float
    centre_mhz: float  # real transducers are not quite what the label says
    sampling_mhz: float
    qualities: tuple[float, float]  # of the two staggered resonators; of the third
    skew: float  # by which the two are apart
    pulser_us: float  # length of the rectangle that drives it
    ring: tuple[float, float, float, float]  # a weak mode that rings on: height, quality, frequency over the centre, phase
    backing: tuple[float, float]  # echo from the rear: height, us
    disc_mm: float
    flatness: float  # 1: flat disc on a flat mirror; below: weak lens, curved skull
    face_r: float  # reflection of its face, seen from the medium
    sign: int


@dataclass(frozen=True)
class Head:
    """What all places of a recording share."""

    speed: float  # mm/us
    attenuation: float  # dB/cm/MHz
    most_mm: float  # thickest tissue that is worked on
    without: str  # a recording without bone: air, soft, unplugged
    speckle: float  # of skin, over a perfect mirror
    diffuse: float  # facets of the bone, over its specular echo
    hair: bool  # or bubbles: part of the face hears air
    sweeps: bool  # the probe glides; else it rests on places


@dataclass(frozen=True)
class Forerun:
    """The delay line as it really is; the header says `length_mm` and the speed of the material in the books."""

    material: Material
    length_mm: float
    true_length_mm: float
    true_speed: float  # mm/us, before it warms
    warming_k: tuple[float, float, float]  # offset, rise, and in how many lines

    def delay_us(self, lines: int) -> Array:
        """There and back in each line (n,)."""
        offset, rise, lasts = self.warming_k
        temperature = offset + rise * (1 - np.exp(-np.arange(lines) / lasts))
        return np.asarray(2 * self.true_length_mm / (self.true_speed + self.material.per_kelvin * temperature))


@dataclass(frozen=True, eq=False)
class Stack:
    """The soft layers of a place, from the skin down."""

    share: Array  # (K,) of the thickness
    thickness_mm: Array  # (n, K)
    speed: Array  # (K,) mm/us; the mean slowness is that of the head
    attenuation: Array  # (K,) dB/cm/MHz
    impedance: Array  # (K,) MRayl
    speckle: Array  # (K,) over skin's


@dataclass(frozen=True, eq=False)
class Stay:
    """Lines that follow each other on one place, or in the air."""

    kind: str  # air, lift, bone, soft
    place: int
    thickness_mm: Array  # (n,)
    x_mm: Array  # (n,) along the skin
    y_mm: Array  # (n,) across
    tilt_deg: Array  # (n, 2)
    hole: Bools  # (n,)
    stack: Stack | None = None

    def __len__(self) -> int:
        return len(self.x_mm)

    @property
    def angle_deg(self) -> Array:
        """Angle to the perpendicular (n,)."""
        return np.asarray(np.hypot(*self.tilt_deg.T))


def wander(rng: np.random.Generator, lines: int, deviation: float, lasts: float) -> Array:
    """Stationary unrest of first order (n,): the hand's tremor and drift."""
    keeps = np.exp(-1 / lasts)
    steps = rng.normal(size=lines) * deviation
    steps[1:] *= np.sqrt(1 - keeps**2)
    return np.asarray(lfilter([1.0], [1.0, -keeps], steps))


def over_places(rng: np.random.Generator, x_mm: Array, scale_mm: float, deviation: float, count: int = 1) -> Array:
    """Random functions of the place (n, count) that are smooth over `scale_mm`."""
    grid = np.arange(x_mm.min() - 3 * scale_mm, x_mm.max() + 3 * scale_mm, scale_mm / 4)
    values = gaussian_filter1d(rng.normal(size=(len(grid) + 40, count)), 4, axis=0)[20:-20] * (deviation / 0.266)
    return np.stack([np.interp(x_mm, grid, column) for column in values.T], axis=1)


def draw_transducer(rng: np.random.Generator) -> Transducer:
    """A transducer of 3 to 10 MHz, sampled at 3.5 times that or more."""
    nominal = float(np.round(np.exp(rng.uniform(np.log(3), np.log(10))), 2))
    return Transducer(
        nominal_mhz=nominal,
        centre_mhz=nominal * float(1 + rng.choice([0.025, 0.06]) * rng.uniform(-1, 1)),
        sampling_mhz=float(rng.choice(SAMPLINGS_MHZ[3.5 * nominal <= SAMPLINGS_MHZ])),
        qualities=(float(rng.uniform(1.25, 2.3)), float(rng.uniform(1.0, 1.8))),
        skew=float(rng.uniform(-0.12, 0.12)),
        pulser_us=float(rng.uniform(0.38, 0.58)) / nominal,
        ring=(
            float(10 ** (-rng.uniform(20, 30) / 20)),
            float(rng.uniform(5, 9)),
            float(rng.uniform(0.8, 1.2)),
            float(rng.uniform(0, 2 * np.pi)),
        ),
        backing=(float(10 ** (-rng.uniform(40, 50) / 20)), float(rng.uniform(2, 5))) if rng.random() < 0.3 else (0.0, 1.0),
        disc_mm=float(5 * (5 / nominal) ** 0.6 * rng.uniform(0.8, 1.1)),
        flatness=float(rng.uniform(0.5, 1.0)),
        face_r=float(rng.uniform(0.25, 0.55) * rng.choice([-1, 1])),
        sign=int(rng.choice([-1, 1])),
    )


def draw_head(rng: np.random.Generator, nominal_mhz: float) -> Head:
    """A head, fixed in formalin one time in five, and how it is gone about."""
    fixed = rng.random() < 0.2
    speed = float(np.clip(rng.normal(1.525, 0.017), 1.45, 1.63) if fixed else rng.uniform(1.45, 1.63))
    attenuation = float(rng.uniform(2.1, 2.6) if fixed else rng.uniform(0.3, 2.6))
    while attenuation * nominal_mhz * 0.2 * 5 > MOST_LOSS_DB:
        attenuation *= 0.9
    without = str(rng.choice(["", "air", "soft", "unplugged"], p=[0.90, 0.03, 0.05, 0.02]))
    return Head(
        speed=speed,
        attenuation=attenuation,
        most_mm=min(DEPTH_MM[1], MOST_LOSS_DB / (0.2 * attenuation * nominal_mhz)),
        without=without,
        speckle=float(10 ** (-rng.uniform(38, 52) / 20)),
        diffuse=float(10 ** (-rng.uniform(24, 34) / 20)),
        hair=bool(rng.random() < 0.25),
        sweeps=bool(without != "unplugged" and rng.random() < 0.35),
    )


def draw_forerun(rng: np.random.Generator, head: Head, deepest_mm: float) -> Forerun | None:
    """A delay line longer than the way to the bone, one time in five shorter: its second echo is then in the tissue; or none."""
    name = str(rng.choice(["", *MATERIALS], p=[0.40, 0.12, 0.10, 0.26, 0.12]))
    if not name:
        return None
    material = MATERIALS[name]
    margin = rng.uniform(1.02, 1.3) if rng.random() < 0.8 else rng.uniform(0.55, 0.95)
    length = round(max(8.0, deepest_mm * float(margin) * material.speed / head.speed), 1)
    return Forerun(
        material=material,
        length_mm=length,
        true_length_mm=length * float(1 + rng.normal(0, 0.002)),
        true_speed=material.speed * float(1 + rng.normal(0, 0.004)),
        warming_k=(float(rng.uniform(-3, 3)), float(rng.uniform(0, 10)), float(rng.uniform(20, 80))),
    )


def draw_stays(rng: np.random.Generator, head: Head, frames: int) -> list[Stay]:
    """The recording as the hand goes: air, a touch, the place, air again; places are fewer and stays shorter for few lines."""
    stays = []
    for kind, place, lines in _schedule(rng, head, frames):
        if kind in ("air", "lift"):
            still = np.zeros(lines)
            stays.append(Stay(kind, place, still + 5.0, still, still, np.zeros((lines, 2)), np.zeros(lines, dtype=bool)))
        else:
            stays.append(_draw_stay(rng, head, kind, place, lines))
    return stays


def _schedule(rng: np.random.Generator, head: Head, frames: int) -> list[tuple[str, int, int]]:
    """Kind, place and number of lines of each stay, altogether about `frames` lines."""
    usual = 1 if head.sweeps else int(rng.integers(3, 6))
    fewer = min(1.0, np.sqrt(frames / (SWEEP_LINES if head.sweeps else PLACE_LINES * usual)))
    places = int(np.clip(round(usual * fewer), 1, max(1, frames // LEAST_PLACE_LINES)))
    plan: list[tuple[str, int, int]] = []
    for place in range(places):
        plan.append(("air", 0, int(rng.integers(2, 7))))
        if head.without in ("air", "unplugged"):
            if place == 0:
                plan.append(("air", 0, 50))
            continue
        cheek = not head.without and not head.sweeps and place == places - 1 and rng.random() < 0.3 * places / usual
        kind = "soft" if head.without == "soft" or cheek else "bone"
        lines = int(rng.integers(45, 85) if head.sweeps else rng.integers(12, 24))
        plan += [("lift", place, 1), (kind, place, lines)]
    plan.append(("air", 0, int(rng.integers(1, 4))))
    touches = sum(kind == "lift" for kind, _, _ in plan)
    scale = (frames - touches) / (sum(lines for _, _, lines in plan) - touches)
    sizes = [1 if kind == "lift" else max(1, int(lines * scale + rng.random())) for kind, _, lines in plan]
    longest = int(np.argmax(sizes))
    sizes[longest] = max(sizes[longest] + frames - sum(sizes), 4)
    return [(kind, place, size) for (kind, place, _), size in zip(plan, sizes)]


def _draw_stay(rng: np.random.Generator, head: Head, kind: str, place: int, lines: int) -> Stay:
    """Thickness, way and tilt of the lines of a place, and the layers under it."""
    fit = [name for name, (least, _, _) in REGIONS.items() if least < head.most_mm - 1]
    weights = np.array([REGIONS[name][2] for name in fit])
    region = str(rng.choice(fit, p=weights / weights.sum()))
    least, most, _ = REGIONS[region]
    usual = rng.uniform(max(DEPTH_MM[0], least), min(most, head.most_mm))
    pace = 1.0 if head.sweeps else min(1.0, lines / STAY_LINES)  # fewer lines show the same movement
    number = np.arange(lines) / pace
    pressed = np.clip(1 - np.exp(-number / 5) + wander(rng, lines, 0.12, 6), 0, 1.3)
    thickness = usual * (1 - rng.uniform(0.02, 0.12) * pressed)
    if head.sweeps:
        x_mm = np.cumsum(np.abs(rng.normal(rng.uniform(0.4, 1.2), 0.15, lines)))
        thickness += over_places(rng, x_mm, 15, 0.12)[:, 0] * usual
        tilt = np.stack([wander(rng, lines, rng.uniform(0.8, 2.2), 8) for _ in range(2)], axis=1)
    else:
        x_mm = wander(rng, lines, 0.4, 8)
        thickness += x_mm * rng.uniform(-0.06, 0.06)
        tilt = _turned_upright(rng, number)
    y_mm = wander(rng, lines, 0.3, 8)
    thickness = np.clip(thickness, DEPTH_MM[0], min(DEPTH_MM[1], 1.15 * head.most_mm))
    hole = np.zeros(lines, dtype=bool)
    far = np.ptp(x_mm)
    if kind == "bone" and head.sweeps and rng.random() < 0.25 * min(1.0, far / SWEEP_MM) and far > LEAST_HOLE_MM:
        hole = np.abs(x_mm - x_mm[0] - far * rng.uniform(0.25, 0.75)) < rng.uniform(5, 9)
    stack = _draw_stack(rng, head, "soft" if kind == "soft" else region, x_mm, thickness)
    if kind == "bone":
        thickness = stack.thickness_mm.sum(axis=1)
    return Stay(kind, place, thickness, x_mm, y_mm, tilt, hole, stack)


def _turned_upright(rng: np.random.Generator, number: Array) -> Array:
    """Tilt (n, 2) of a probe that comes down tilted and is turned upright; on one place in six it stays tilted."""
    start, end = (side / np.hypot(*side) for side in rng.normal(size=(2, 2)))
    rest = rng.uniform(4, 11) if rng.random() < 1 / 6 else abs(rng.normal(0, 1.0))
    fall = rng.uniform(1, 8) * np.exp(-number / rng.uniform(2, 6))
    unrest = np.stack([wander(rng, len(number), 0.35, 3) for _ in range(2)], axis=1)
    return np.asarray(fall[:, None] * start + rest * end + unrest)


def _layers(rng: np.random.Generator, where: str, thickness_mm: float) -> dict[str, list[str] | Array]:
    """Names of the layers of a region and their thicknesses in mm; in cheek and neck fat and muscle all the way."""
    thick = thickness_mm
    if where == "soft":
        names = ["skin", "fat", "galea", "muscle", "loose", "muscle", "galea", "muscle"]
        ranges = [(1.2, 2.2), (1, 6), (0.3, 0.8), (3, 12), (0.3, 2), (3, 10), (0.3, 0.8), (60, 60)]
    elif where == "temple":
        names = ["skin", "fat", "galea", "muscle", "periosteum"]
        ranges = [(0.15 * thick, 0.25 * thick), (0.12 * thick, 0.22 * thick), (0.4, 0.8), (0.4 * thick, 0.6 * thick), (0.1, 0.3)]
    else:
        names = ["skin", "fat", "galea", "loose", "periosteum"]
        shares = [(0.28, 0.42), (0.28, 0.45), (0.12, 0.2), (0.05, 0.15)]
        ranges = [*((low * thick, high * thick) for low, high in shares), (0.1, 0.25)]
    layers = np.array([rng.uniform(*each) for each in ranges])
    if where != "soft":
        layers[0] = min(layers[0], 2.2 if where == "temple" else 2.5)
    return {"names": names, "layers": layers}


def _draw_stack(rng: np.random.Generator, head: Head, where: str, x_mm: Array, thickness: Array) -> Stack:
    """Layers of the given thickness (n,), or over 60 mm of cheek; their shares wander a little over the place."""
    drawn = _layers(rng, where, float(thickness.mean()))
    tissues, layers = [TISSUES[str(name)] for name in drawn["names"]], np.asarray(drawn["layers"])
    share = layers / layers.sum()
    near = np.minimum(layers, 10)
    weight = near / near.sum() if where == "soft" else share
    speed = np.array([one.speed for one in tissues]) * np.exp(rng.normal(0, 0.01, len(layers)))
    speed *= head.speed * (weight / speed).sum()
    attenuation = np.array([one.loss for one in tissues])
    attenuation *= head.attenuation / (weight * attenuation).sum()
    impedance = np.array([rng.uniform(*one.impedance) for one in tissues])
    speckle_db = np.array([one.speckle_db for one in tissues]) + rng.normal(0, 2, len(layers))
    if where == "soft":
        speckle_db = np.maximum(speckle_db, -5)
        thick = np.outer(thickness / thickness.max(), layers) * (1 + over_places(rng, x_mm, 6, 0.03))
    else:
        shares = share * np.exp(over_places(rng, x_mm, 8, 0.08, len(layers)))
        shares /= (shares / speed).sum(axis=1, keepdims=True) * head.speed  # the speed stays what was given
        thick = shares * thickness[:, None]
    return Stack(share, thick, speed, attenuation, impedance, 10 ** (speckle_db / 20))


def draw_poses(rng: np.random.Generator, stays: list[Stay], forerun_mm: float) -> Array:
    """ProbeToReference of every line on a round head; in the air the probe stays off its first place."""
    place = np.concatenate([np.full(len(stay), stay.place) for stay in stays])
    off = np.concatenate([np.full(len(stay), {"air": 15.0, "lift": 2.0}.get(stay.kind, 0.0)) for stay in stays])
    thickness, x_mm, y_mm = (np.concatenate([getattr(stay, name) for stay in stays]) for name in ("thickness_mm", "x_mm", "y_mm"))
    tilt = np.concatenate([stay.tilt_deg for stay in stays])
    centre, radius = rng.uniform(-40, 40, 3), rng.uniform(75, 95)
    count = int(place.max()) + 1
    normal = _unit(rng.normal(size=(count, 3)) * [1, 1, 0.5] + [0, 0, 1.3])[place]
    along = _unit(np.cross(normal, rng.normal(size=(count, 3))[place]))
    turn = (x_mm / radius)[:, None]
    normal, along = normal * np.cos(turn) + along * np.sin(turn), along * np.cos(turn) - normal * np.sin(turn)
    across = np.cross(normal, along)
    lean = np.tan(np.radians(tilt + rng.normal(0, 0.08, tilt.shape)))
    beam = _unit(-normal + lean[:, :1] * along + lean[:, 1:] * across)
    side = _unit(along - beam * (beam * along).sum(axis=1, keepdims=True))
    origin = centre + normal * (radius + thickness + off)[:, None] + across * y_mm[:, None] - beam * forerun_mm
    return rigid(np.stack([side, np.cross(beam, side), beam], axis=2), origin + rng.normal(0, 0.08, origin.shape))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
