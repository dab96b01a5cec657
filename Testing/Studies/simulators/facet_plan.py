"""What a recording of faceted bone is drawn from: the probe, the tissue of each place, the order of the places.

The ranges are those of the literature; a set-up that loses more on the way to the bone than anybody would use is drawn anew.
facet_hand.py moves the probe over the places, facet_lines.py makes the lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Acquisition

Array = npt.NDArray[np.float64]

FORERUNS = ((1616.0, 1.49), (2170.0, 1.79), (2340.0, 2.47), (2460.0, 2.30), (2670.0, 3.15))  # m/s, MRayl
FORERUN_SHARES = (0.15, 0.2, 0.35, 0.1, 0.2)
TISSUE_MRAYL = 1.63
REGIONS_MM = ((3.5, 6.5), (3.5, 7.5), (5.0, 10.0), (6.0, 15.0), (2.0, 4.0))  # forehead, vertex, occiput, temple, thin scalp
REGION_SHARES = (0.25, 0.25, 0.2, 0.2, 0.1)
RATES_MHZ = np.array([25, 31.25, 40, 50, 60, 62.5, 80, 100, 125])
MOST_LOSS_DB = 33.0  # there and back at the nominal frequency: nobody uses a probe that loses more
WITHOUT = ("", "soft", "water", "air", "noise")  # recordings without bone; noise: the cable is out
WITHOUT_SHARES = (52 / 60, 4 / 60, 2 / 60, 1 / 60, 1 / 60)
ROUGH_STEP_MM, ROUGH_SIZE = 0.15, 160  # grid of the bone's roughness
PLACE_LINES, AIR_LINES = (14, 31), (4, 9)  # of a place, and of the lift after it, before they are scaled to the lines asked for
LEAST_LINES = 12  # of a place: fewer are no search for the perpendicular


def ratio(decibels: npt.ArrayLike) -> Array:
    """Amplitude over another from decibels."""
    return np.asarray(10 ** (np.asarray(decibels, dtype=float) / 20))


@dataclass(frozen=True)
class Shape:
    """The pulse there and back: an asymmetric Gaussian band, a constant phase, a small echo of the backing."""

    centre_hz: float
    below_hz: float  # standard deviation of the band below its centre
    above_hz: float
    phase: float
    backing: float
    backing_cycles: float


@dataclass(frozen=True)
class Forerun:
    """The delay line as it is; its header says the nominal speed. Without one the time is 0 and the face reflects nothing."""

    time_s: float = 0.0
    warming_s: float = 0.0  # over the recording, on the skin
    face: float = 0.0  # reflection of its end in contact
    short: bool = False  # its second echo falls into the tissue


@dataclass(frozen=True)
class World:
    """What all lines of a recording share."""

    acquisition: Acquisition
    shape: Shape
    forerun: Forerun
    pulse: str
    attenuation: float  # dB/cm/MHz
    speed_m_s: float
    snr_db: float
    snr_of: str  # median: of the lines within 3 degrees
    thick_mm: float  # typical depth of the bone
    back: float  # reflection of the transducer's face
    dead_s: float  # ring-down
    highpass_hz: float
    lowpass_hz: float
    focused: bool
    footprint_mm: float  # its radius
    taper: float  # of the footprint's weight to its edge
    near_mm: float  # length of weak diffraction
    behind_mm: float  # the lines cover
    without: str
    sweeps: bool
    rate_hz: float
    hair: bool
    lifts: bool
    hole: bool
    speckle: float  # rms against a perfect mirror
    gel_mm: float  # film left on the face in air; 0: none

    @property
    def least_mm(self) -> float:
        """Bone nearer than this is lost in the ring-down of a probe without forerun."""
        return 0.0 if self.forerun.time_s else 1.7 * self.dead_s * self.speed_m_s / 2e-3


def _draw_tissue(rng: np.random.Generator, nominal_mhz: float) -> tuple[float, float, float, float]:
    """Speed, attenuation, depth, and the frequency a user would take for them: lower where too little comes back."""
    formalin = rng.random() < 0.25
    speed = float(np.clip(rng.normal(1525, 17), 1450, 1630)) if formalin else float(rng.uniform(1450, 1630))
    region = REGIONS_MM[rng.choice(len(REGIONS_MM), p=REGION_SHARES)]
    while True:
        fixed = float(np.clip(rng.normal(2.59, 0.6), 1.2, 2.6))
        attenuation = fixed if formalin else float(np.exp(rng.uniform(np.log(0.3), np.log(2.6))))
        thick = float(rng.uniform(*region))
        if 0.2 * attenuation * nominal_mhz * thick < MOST_LOSS_DB:
            return speed, attenuation, thick, nominal_mhz
        if rng.random() < 0.2:
            nominal_mhz = max(3.0, nominal_mhz * 0.85)


def _draw_forerun(rng: np.random.Generator, speed: float) -> tuple[Forerun, float, float]:
    """The delay line, and the length and speed that the header states (0: none)."""
    if rng.random() >= 0.55:
        return Forerun(), 0.0, 0.0
    nominal, impedance = FORERUNS[rng.choice(len(FORERUNS), p=FORERUN_SHARES)]
    short = rng.random() < 0.2
    covers = rng.uniform(6, 14) if short else 17.0  # mm of tissue before its second echo
    length = round(covers * nominal / speed * rng.uniform(1.02, 1.2), 1)
    face = (TISSUE_MRAYL - impedance) / (TISSUE_MRAYL + impedance) * rng.uniform(0.85, 1.15)
    time = 2e-3 * length / (nominal * (1 + rng.normal(0, 0.006)))
    return Forerun(time, float(rng.normal(0, 15e-9)), float(face), bool(short)), float(length), nominal


def _draw_shape(rng: np.random.Generator, nominal: float) -> Shape:
    centre, band = nominal * float(rng.uniform(0.95, 1.05)), float(rng.uniform(0.45, 0.85))
    sigma = band * centre / 2.355
    return Shape(
        centre_hz=centre,
        below_hz=sigma * float(rng.uniform(0.85, 1)),
        above_hz=sigma * float(rng.uniform(1, 1.15)),
        phase=float(rng.uniform(0, 2 * np.pi)),
        backing=float(rng.uniform(0.02, 0.07)),
        backing_cycles=1.5 * float(rng.uniform(1.2, 2.5)),
    )


def draw_world(rng: np.random.Generator) -> World:
    """A set-up somebody would use, and how the recording goes."""
    nominal_mhz = float(rng.uniform(3, 10))
    sampling = float(rng.choice(RATES_MHZ[3.3 * nominal_mhz <= RATES_MHZ])) * 1e6
    speed, attenuation, thick, nominal_mhz = _draw_tissue(rng, nominal_mhz)
    nominal = nominal_mhz * 1e6
    forerun, length, nominal_speed = _draw_forerun(rng, speed)
    dead = float(rng.uniform(0.9, 1.8)) * 1e-6 * np.sqrt(5e6 / nominal)
    aperture = float(np.clip(25 / nominal_mhz * rng.uniform(0.7, 1.1), 2.2, 7))
    focused = bool(rng.random() < 0.45)
    without = str(rng.choice(WITHOUT, p=WITHOUT_SHARES))
    hole = bool(rng.random() < 0.18 and not without)
    return World(
        acquisition=Acquisition(sampling, nominal, length, nominal_speed),
        shape=_draw_shape(rng, nominal),
        forerun=forerun,
        pulse="asymmetric",
        attenuation=attenuation,
        speed_m_s=speed,
        snr_db=float(rng.uniform(14, 40)),
        snr_of="median",
        thick_mm=thick if length else max(thick, 1.9 * dead * speed / 2e-3),
        back=float(rng.uniform(0.15, 0.4)),
        dead_s=float(dead),
        highpass_hz=float(rng.uniform(0.15, 0.35)) * nominal,
        lowpass_hz=min(float(rng.uniform(1.8, 2.6)) * nominal, 0.45 * sampling),
        focused=focused,
        footprint_mm=float(rng.uniform(0.6, 1.1)) if focused else aperture / 2,
        taper=float(rng.uniform(0.2, 1.2)),
        near_mm=5 * aperture**2 * nominal_mhz / 1.54 / 4,
        behind_mm=float(rng.uniform(24, 32)),
        without=without,
        sweeps=bool(rng.random() >= 0.6),
        rate_hz=float(rng.uniform(18, 50)),
        hair=bool(rng.random() < 0.12),
        lifts=bool(rng.random() < 0.4),
        hole=hole,
        speckle=float(ratio(rng.uniform(-43 if hole or without == "soft" else -50, -34))),
        gel_mm=float(rng.uniform(0.1, 0.5) * (rng.random() < 0.5)),
    )


@dataclass(frozen=True)
class Layer:
    """An interface in the soft tissue; a thin sheet has a second face of the other sign."""

    depth_mm: float
    height: float
    thick_mm: float  # 0: one face alone
    follows: float  # of the bone's tilt
    tilt_deg: tuple[float, float]  # its own
    phases: tuple[float, float]  # of its brightness along the head


@dataclass(frozen=True, eq=False)
class Place:
    """One place of the head: its curvature, and what stays with it whatever the hand does."""

    what: str  # bone, hole, soft, water
    thick_mm: float
    radii_mm: Array  # (2,)
    rough_mm: Array  # (ROUGH_SIZE, ROUGH_SIZE)
    layers: tuple[Layer, ...]
    level: tuple[float, float, float]  # of speckle in skin, fat, and what is deeper
    bone: float  # its reflection
    table_mm: float
    inner: float  # reflection of the inner table
    skull_m_s: float
    skull_attenuation: float  # dB/cm/MHz
    diploe: float
    periosteum: tuple[float, float]  # mm before the bone; echo


def _draw_rough(rng: np.random.Generator) -> Array:
    """Height of the bone over the mean surface, mm: 4 to 35 um, alike over 0.3 to 1.2 mm."""
    sigma = float(np.exp(rng.uniform(np.log(0.004), np.log(0.035))))
    alike = rng.uniform(0.3, 1.2) / ROUGH_STEP_MM
    along, across = np.fft.fftfreq(ROUGH_SIZE), np.fft.rfftfreq(ROUGH_SIZE)
    kept = np.outer(np.exp(-2 * (np.pi * alike * along) ** 2), np.exp(-2 * (np.pi * alike * across) ** 2)).astype(np.float32)
    field = rng.standard_normal((ROUGH_SIZE, ROUGH_SIZE), dtype=np.float32)
    rough = scipy.fft.irfft2(scipy.fft.rfft2(field) * kept, s=field.shape)
    return np.asarray(rough / rough.std() * sigma, dtype=float)


def _draw_layers(rng: np.random.Generator, what: str, thick: float, speckle: float) -> list[tuple[float, float, float, float]]:
    """Depth, height, thickness and following of the layers. Where bone is missing they stand little over the speckle."""

    def height() -> float:
        if what in ("soft", "hole"):
            return min(0.1, speckle * float(ratio(rng.uniform(5, 15))))
        return float(np.exp(rng.uniform(np.log(0.012), np.log(0.09))))

    def sign() -> float:
        return float(rng.choice([-1, 1]))

    layers = [(rng.uniform(1, 2.4), -height(), 0.0, 0.1)]  # the skin's inner side
    if thick > 3:
        layers.append((thick * rng.uniform(0.55, 0.82), height() * sign(), rng.uniform(0.25, 1), 0.5))
    if thick > 6:
        for _ in range(rng.integers(1, 4)):
            layers.append((thick * rng.uniform(0.25, 0.85), 0.7 * height() * sign(), rng.uniform(0, 0.6), 0.4))
    if what == "hole":  # dura
        layers.append((thick + rng.uniform(3.5, 7), speckle * float(ratio(rng.uniform(3, 9))), rng.uniform(0.3, 0.6), 0.9))
    if what == "soft":
        for _ in range(rng.integers(1, 5)):
            depth = rng.uniform(3, 22)
            most = speckle * float(ratio(9)) if depth > 8 else 1.0
            layers.append((depth, min(height(), most) * sign(), rng.uniform(0, 1), 0.4))
    if what == "bone":
        layers = [layer for layer in layers if layer[0] < thick * 0.9 - 0.3]
    return [] if what == "water" else layers


def draw_place(rng: np.random.Generator, world: World, what: str, thick: float) -> Place:
    """A place whose bone, if any, is `thick` under the skin."""
    layers = tuple(
        Layer(*layer, tuple(rng.normal(0, 1.2, 2)), tuple(rng.uniform(0, 2 * np.pi, 2)))  # type: ignore[arg-type]
        for layer in _draw_layers(rng, what, thick, world.speckle)
    )
    level = ratio([rng.uniform(0, 6), rng.uniform(-8, 0), rng.uniform(-4, 3)])
    return Place(
        what=what,
        thick_mm=thick,
        radii_mm=rng.uniform(50, 115, 2),
        rough_mm=_draw_rough(rng) if what == "bone" else np.zeros((0, 0)),
        layers=layers,
        level=tuple(level * world.speckle * (what != "water")),  # type: ignore[arg-type]
        bone=float(rng.uniform(0.5, 0.65)),
        table_mm=float(rng.uniform(1.2, 3)),
        inner=-float(rng.uniform(0.08, 0.3)),
        skull_m_s=float(rng.uniform(2750, 3100)),
        skull_attenuation=float(rng.uniform(3, 8)),
        diploe=float(ratio(rng.uniform(-44, -32))),
        periosteum=(float(rng.uniform(0.25, 0.8)), float(rng.uniform(0.01, 0.05))),
    )


@dataclass(frozen=True)
class Part:
    """A stretch of the recording: a place, or the probe in air."""

    place: Place
    lines: int
    kind: str  # bone, hair, hole, soft, water, air
    point: int


def draw_parts(rng: np.random.Generator, world: World, frames: int) -> list[Part]:
    """The places in their order, of `frames` lines together."""
    plan = _sweep(rng, world) if world.sweeps else _dwells(rng, world, frames)
    shares = np.array([size for _, size, _, _ in plan], dtype=float)
    ends = np.rint(np.cumsum(shares) / shares.sum() * frames).astype(int)
    sizes = np.diff(ends, prepend=0)
    in_air = draw_place(rng, world, "water", 5.0)
    return [Part(place or in_air, int(size), kind, point) for (place, _, kind, point), size in zip(plan, sizes) if size > 0]


Planned = tuple[Optional[Place], int, str, int]


def _dwells(rng: np.random.Generator, world: World, frames: int) -> list[Planned]:
    """Two to four places, as many as there is time for."""
    what = world.without if world.without in ("soft", "water") else "bone"
    count = min(int(rng.integers(2, 5)), max(1, frames // LEAST_LINES))
    hole = int(rng.integers(0, count)) if world.hole else -1
    plan: list[Planned] = []
    for number in range(count):
        thick = world.thick_mm * (rng.uniform(0.85, 1.15) if count > 1 else 1.0)
        thick = float(np.clip(thick, max(2.0, world.least_mm), 15))
        here = "hole" if number == hole else what
        hairy = world.hair and rng.random() < 0.5 and here == "bone"
        place = draw_place(rng, world, here, thick)
        plan.append((place, int(rng.integers(*PLACE_LINES)), "hair" if hairy else here, number + 1))
        if world.lifts and number < count - 1 and rng.random() < 0.8:
            plan.append((None, int(rng.integers(*AIR_LINES)), "air", number + 1))
    return plan


def _sweep(rng: np.random.Generator, world: World) -> list[Planned]:
    """One way over the head, with air before or after it."""
    what = world.without if world.without in ("soft", "water") else "bone"
    place = draw_place(rng, world, what, float(np.clip(world.thick_mm, 2.35, 12.7)))
    plan: list[Planned] = [(place, int(rng.integers(50, 121)), "hair" if world.hair and what == "bone" else what, -1)]
    if world.lifts:
        plan.insert(int(rng.integers(0, 2)), (None, int(rng.integers(5, 15)), "air", -1))
    return plan
