"""What a session over a head of spheres is made of: what goes together, the pulse, the reflections, the receiver.

Depths, tissue, transducer and delay line are drawn until they go together: the way to the deepest place and back loses no more
than a person would put up with, so that deep places, lossy tissue and high frequencies do not meet. sphere_hand.py says where the
hand goes, sphere_lines.py makes the lines of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition

from Testing.Studies.simulators.units import InMicroseconds, ThroughScalp

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]
Words = npt.NDArray[np.str_]

RATES_MHZ = np.array([25.0, 40.0, 50.0, 60.0, 64.0, 80.0, 100.0, 125.0])
SAMPLES_A_CYCLE = 3.8  # at least
MOST_LOSS_DB = 38.0  # there and back, at the centre frequency: tissue to the deepest place, and the delay line
REGIONS_MM = np.array([(2.0, 4.0), (4, 7), (4, 7), (5, 9), (6, 15), (11, 15)])  # thin, forehead, vertex, occiput, temple, thick
PLACES, GLIDES = (4, 8), 3  # of a whole session
BITS = np.array([10, 12, 14, 16])
WITHOUT = ("air", "soft", "gel", "cable")  # cable: nothing is connected
SOFT_LOSS_DB = 8.0  # a cm at the centre frequency: in more, tissue without bone could not be seen to go on


@dataclass(frozen=True)
class DelayLine:
    """What is between transducer and skin; of length 0 without one."""

    material: str
    length_mm: float
    speed_m_s: float  # as stated
    impedance: float  # MRayl
    attenuation: float  # dB/cm/MHz
    short: bool  # its second echo comes among the depths


NO_DELAY = DelayLine("", 0.0, 0.0, 0.0, 0.0, False)
MATERIALS = (  # m/s, MRayl, dB/cm/MHz
    ("aqualene", 1616.0, 1.49, 0.56),
    ("tpx", 2170.0, 1.79, 1.06),
    ("polystyrene", 2340.0, 2.47, 0.10),
    ("hdpe", 2460.0, 2.30, 0.45),
    ("pmma", 2670.0, 3.15, 0.20),
)


@dataclass(frozen=True)
class Fit(InMicroseconds, ThroughScalp):
    """What has to go together: the head, the transducer and the delay line."""

    acquisition: Acquisition
    delay: DelayLine
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    formalin: bool
    sweeps: bool
    depths_mm: tuple[float, ...]  # of the places of a whole session

    @property
    def loss_db_mm(self) -> float:
        """Of a millimetre there and back, at the centre frequency."""
        return 0.2 * self.attenuation * self.centre_mhz

    @property
    def delay_db(self) -> float:
        """What the delay line takes there and back, at the centre frequency."""
        return 0.2 * self.delay.attenuation * self.centre_mhz * self.delay.length_mm

    @property
    def typical_mm(self) -> float:
        """Between the session's median and its deepest place."""
        return float(np.median(self.depths_mm) + max(self.depths_mm)) / 2


@dataclass(frozen=True)
class Setup(Fit):
    """What all lines of a recording share. Heights are over a total reflection met squarely, before any loss."""

    without: str  # a recording without bone: one of WITHOUT, or nothing
    pulse: str
    true_mhz: float  # the centre of what the transducer sends; the header states another one
    bandwidth: float  # at -6 dB of amplitude, of the stated centre
    phase: float
    ring: float  # height of the second ring
    ring_cycles: float  # when it comes
    ring_turn: float  # its phase, in turns
    lobe_mm: float  # the element, less where bone is rough and curved: so wide an aperture answers tilt
    skin_impedance: float  # MRayl
    back_r: float  # reflection of the transducer itself
    bone_r: float
    diffuse: float  # what the rough bone scatters
    speckle: float  # of the tissue over bone
    snr_db: float  # of bone met squarely at the typical depth
    snr_of: str
    bits: int
    saturated: bool
    fill: float  # of the converter, by bone met squarely at the typical depth
    depth_gain: float  # share of the tissue's loss that the receiver gives back; 0: none
    pickup: bool  # a switching supply
    spikes: bool

    @property
    def spread_mhz(self) -> float:
        """Standard deviation of the pulse's spectrum."""
        return self.bandwidth * self.centre_mhz / 2.355

    @property
    def pulse_mm(self) -> float:
        """Length of the pulse in depth, at -6 dB."""
        return 2.355 / (2 * np.pi * self.spread_mhz) * self.mm_us / 2

    @property
    def face_r(self) -> float:
        """Reflection of the delay line's face on the skin: never so faint that it could not be seen; 0 without a delay line."""
        if not self.delay.length_mm:
            return 0.0
        reflection = reflected(self.delay.impedance, self.skin_impedance)
        return float(np.copysign(max(abs(reflection), 0.05), reflection))


@dataclass(frozen=True, eq=False)
class World(Setup):
    """The set-up, and what was under the probe in each of the n lines."""

    kind: Words  # (n,) bone, landing (half wetted), lifted, soft, gel (a film of it, air behind), air, cable


def decibel(level: npt.ArrayLike) -> Array:
    """Height over 1."""
    return np.asarray(10 ** (np.asarray(level, dtype=float) / 20))


def reflected(before: float, behind: float) -> float:
    """Reflection where one impedance meets another."""
    return (behind - before) / (behind + before)


def _draw_delay(rng: np.random.Generator, speed_m_s: float, deepest_mm: float) -> DelayLine:
    """A delay line whose second echo falls behind the deepest place, or for one in four among the depths."""
    material, delay_m_s, impedance, attenuation = MATERIALS[rng.integers(len(MATERIALS))]
    short = bool(rng.random() < 0.25)
    share = rng.uniform(0.5, 0.9) if short else rng.uniform(1, 1.2)
    length = round(float((deepest_mm + 1.5) * delay_m_s / speed_m_s * share), 1)
    return DelayLine(material, length, delay_m_s, impedance, attenuation, short)


def draw_fit(rng: np.random.Generator) -> Fit:
    """Head, transducer and delay line, drawn again until they go together."""
    centre = round(float(np.exp(rng.uniform(np.log(3), np.log(10)))), 2)
    formalin, delayed = bool(rng.random() < 0.2), bool(rng.random() < 0.6)
    while True:
        speed, attenuation = float(rng.uniform(1450, 1630)), float(rng.uniform(0.3, 2.6))
        if formalin:
            speed, attenuation = float(np.clip(rng.normal(1525, 17), 1450, 1630)), float(rng.uniform(1.9, 2.6))
        sweeps = bool(rng.random() < 0.3)
        places = GLIDES if sweeps else int(rng.integers(*PLACES))
        low, high = REGIONS_MM[rng.integers(len(REGIONS_MM), size=places)].T
        depths = tuple(float(depth) for depth in rng.uniform(low, high))
        sampling = float(RATES_MHZ[rng.integers(len(RATES_MHZ))])
        delay = _draw_delay(rng, speed, max(depths)) if delayed else NO_DELAY
        acquisition = Acquisition(sampling * 1e6, centre * 1e6, delay.length_mm, delay.speed_m_s)
        fit = Fit(acquisition, delay, speed, attenuation, formalin, sweeps, depths)
        lost_db = fit.loss_db_mm * max(depths) + fit.delay_db
        if sampling >= SAMPLES_A_CYCLE * centre and lost_db <= MOST_LOSS_DB:
            return fit


def draw_setup(rng: np.random.Generator) -> Setup:
    """What goes together, and the pulse, the reflections and the receiver of it."""
    fit = draw_fit(rng)
    without = str(rng.choice(WITHOUT)) if rng.random() < 0.12 else ""
    while without == "soft" and not shows_soft(fit):
        fit = draw_fit(rng)
    saturated = bool(rng.random() < 0.06)
    element_mm = np.clip(5 * (5 / fit.centre_mhz) ** 0.7, 2.5, 7)
    return Setup(
        **vars(fit),
        without=without,
        pulse="gauss",
        true_mhz=fit.centre_mhz * float(rng.uniform(0.94, 1.05)),
        bandwidth=float(rng.uniform(0.5, 0.85)),
        phase=float(rng.uniform(0, 2 * np.pi)),
        ring=float(rng.uniform(0.05, 0.18)),
        ring_cycles=float(rng.uniform(1.5, 2.5)),
        ring_turn=float(rng.random()),
        lobe_mm=float(element_mm * rng.uniform(0.5, 0.9)),
        skin_impedance=float(rng.uniform(1.63, 1.95)),
        back_r=float(rng.uniform(0.25, 0.5)),
        bone_r=float(rng.uniform(0.5, 0.65)),
        diffuse=float(decibel(rng.uniform(-28, -15))),
        speckle=float(decibel(rng.uniform(-42, -30))),
        snr_db=float(rng.uniform(16, 42)),
        snr_of="square",
        bits=int(rng.choice(BITS)),
        saturated=saturated,
        fill=float(rng.uniform(1.3, 2) if saturated else rng.uniform(0.06, 0.45)),
        depth_gain=float(rng.uniform(0.3, 0.7)) if rng.random() < 0.4 else 0.0,
        pickup=bool(rng.random() < 0.3),
        spikes=bool(rng.random() < 0.15),
    )


def shows_soft(fit: Fit) -> bool:
    """Whether tissue without bone could be seen to go on."""
    return fit.attenuation * fit.centre_mhz <= SOFT_LOSS_DB
