"""What a recording whose trigger comes late is made of: tissue, probe, skull and receiver.

Ranges are wide and drawn independently, but for what an operator would keep to: the loss to the bone stays below 42 dB, and
without a delay line nobody reads bone while the probe rings. The hand is in latency_hand.py; latency_lines.py makes the lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition

from Testing.Studies.simulators.units import ThroughScalp

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Words = npt.NDArray[np.str_]

SHALLOWEST_MM, DEEPEST_MM = 2.0, 15.0
MOST_LOSS_DB, APART_DB, APART_MM = 42.0, 7.0, 4.0  # two ways to the bone; how much places differ from a recording's typical depth
BLIND_CYCLES = 7.5  # without a delay line the probe rings for so long
RATES_MHZ = np.array([25, 31.25, 40, 50, 60, 62.5, 64, 80, 100, 125])
SAMPLES_A_CYCLE = 2.8  # at least
DELAYS = {  # m/s, MRayl, dB/cm at 5 MHz
    "aqualene": (1616.0, 1.49, 2.8),
    "tpx": (2170.0, 1.79, 5.3),
    "ps": (2340.0, 2.47, 1.0),
    "hdpe": (2460.0, 2.30, 4.0),
    "pmma": (2670.0, 3.15, 3.0),
}
LEAST_FACE_R = 0.04


@dataclass(frozen=True)
class Transducer:
    """A disc, and the pulse of both ways."""

    centre_mhz: float  # not quite the stated one
    bandwidth: float  # at -6 dB, of the centre
    fall: float  # how much longer it falls than it rises
    phase: float
    disc_mm: float  # diameter
    taper: float  # of the disc's sensitivity: the power of 1 - r^2


@dataclass(frozen=True)
class DelayLine:
    """What is between transducer and skin; of length 0 without one."""

    material: str
    length_mm: float
    speed_m_s: float  # as stated
    loss_db_cm: float  # at 5 MHz, one way
    face_r: float  # reflection of the wet face
    back_r: float  # of the transducer itself
    latency_us: float  # of the trigger
    slower: float  # its time over the stated one, less 1
    warms: float  # what is added to that in the course of the recording
    short: bool  # its second echo may come among the depths
    static: bool  # its edges answer


@dataclass(frozen=True)
class Skull:
    """Bone of a recording."""

    reflection: float
    diffuse: float  # what the rough bone scatters
    rough_mm: float
    thick_mm: float
    attenuation: float  # dB/cm/MHz
    diploe: float  # what it scatters, over the bone's echo
    again: float  # reflection at which the echo turns back to the bone


@dataclass(frozen=True)
class Setup(ThroughScalp):
    """What all lines of a recording share."""

    acquisition: Acquisition
    transducer: Transducer
    delay: DelayLine
    skull: Skull
    without: str  # a recording without bone: air, soft
    pulse: str
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    formalin: bool
    snr_db: float  # four of five lines that meet bone squarely have more; less noise where the delay line's echo would drown
    snr_of: str
    sweeps: bool
    places_mm: tuple[float, ...]  # the scalp's thickness on the places of a session of the usual length
    varies_mm: float  # of the thickness along a glide
    least_mm: float  # of the thickness
    soft_place: int  # the place without bone; -1: none
    hole: bool  # the glide may pass over a burr hole
    bubbles: bool
    speckle: float
    gain_db: float  # at 18 mm over the gain at the skin
    spikes: bool
    tone: bool
    loses_pose: bool

    @property
    def sampling_mhz(self) -> float:
        return self.acquisition.sampling_hz * 1e-6

    @property
    def delay_us(self) -> float:
        """There and back through the delay line, as stated."""
        return 2e3 * self.delay.length_mm / (self.delay.speed_m_s or 1.0)


@dataclass(frozen=True, eq=False)
class World(Setup):
    """The set-up, and what each of the n lines is to a judge."""

    bits: int
    kind: Words  # (n,) bone, tilted; air, airfilm, soft, hole: no bone; edge: lands or lifts; rim: of the hole
    clash: Words  # (n,) what the bone's echo is lost in: multiple, ringing, weak
    ignore: Bools  # (n,) judged by nobody: edge, rim, or lost in something
    must: Bools  # (n,) bone so plain that a detector must find it


def decibel(level: npt.ArrayLike) -> Array:
    """Height over 1."""
    return np.asarray(10 ** (np.asarray(level, dtype=float) / 20))


def draw_setup(rng: np.random.Generator) -> Setup:
    """Tissue, probe, receiver, and what the hand is about to do."""
    without = str(rng.choice(["", "air", "soft"], p=[0.88, 0.04, 0.08]))
    sweeps = bool(rng.random() < 0.25)
    stated = float(rng.choice([3.0, 3.5, 5.0, 5.0, 7.5, 10.0, round(rng.uniform(3, 10), 2)]))
    sampling = float(rng.choice(RATES_MHZ[SAMPLES_A_CYCLE * stated <= RATES_MHZ]))
    speed = float(rng.uniform(1450, 1630))
    formalin = bool(rng.random() < 0.3)
    attenuation = float(rng.uniform(2.2, 2.6) if formalin else np.exp(rng.uniform(np.log(0.3), np.log(2.2))))
    material = str(rng.choice(["", *DELAYS], p=[0.4, 0.12, 0.12, 0.14, 0.1, 0.12]))
    blind_mm = 0.0 if material else BLIND_CYCLES / stated * speed * 1e-3 / 2
    least, loss_db_mm = max(SHALLOWEST_MM, blind_mm), 0.2 * attenuation * stated
    places_mm, half_mm = _draw_thicknesses(rng, least, loss_db_mm)
    delay = _draw_delay(rng, material, speed, max(places_mm))
    dwells_on_bone = not sweeps and not without
    return Setup(
        acquisition=Acquisition(sampling * 1e6, stated * 1e6, delay.length_mm, delay.speed_m_s),
        transducer=_draw_transducer(rng, stated),
        delay=delay,
        skull=_draw_skull(rng, delay),
        without=without,
        pulse="skewed",
        speed_m_s=speed,
        attenuation=attenuation,
        formalin=formalin,
        snr_db=float(rng.uniform(14, 34)),
        snr_of="fifth",
        sweeps=sweeps,
        places_mm=places_mm,
        varies_mm=min(2.5, half_mm, 0.35 * places_mm[0]),
        least_mm=least,
        soft_place=int(rng.integers(len(places_mm))) if dwells_on_bone and rng.random() < 0.3 else -1,
        hole=sweeps and not without and bool(rng.random() < 0.35),
        bubbles=bool(rng.random() < 0.2),
        speckle=float(decibel(-rng.uniform(34, 48))),
        gain_db=float(rng.uniform(8, 25)) if rng.random() < 0.2 else 0.0,
        spikes=bool(rng.random() < 0.12),
        tone=bool(rng.random() < 0.1),
        loses_pose=bool(rng.random() < 0.2),
    )


def _draw_thicknesses(rng: np.random.Generator, least_mm: float, loss_db_mm: float) -> tuple[tuple[float, ...], float]:
    """The scalp on three to five places, and by how much they may differ: nobody takes 10 MHz for a thick, fixed scalp."""
    most = min(max(MOST_LOSS_DB / loss_db_mm, least_mm + 2.5), DEEPEST_MM)
    middle = least_mm + (most - least_mm) * rng.beta(1.1, 1.5)
    half = min(APART_MM, APART_DB / loss_db_mm)
    drawn = rng.uniform(middle - half, middle + half, int(rng.integers(3, 6)))
    return tuple(float(thick) for thick in np.clip(drawn, least_mm + 0.3, most)), half


def _draw_transducer(rng: np.random.Generator, stated_mhz: float) -> Transducer:
    return Transducer(
        centre_mhz=stated_mhz * float(rng.uniform(0.94, 1.06)),
        bandwidth=float(rng.uniform(0.45, 0.75)),
        fall=float(rng.uniform(1.1, 1.7)),
        phase=float(rng.uniform(0, 2 * np.pi)),
        disc_mm=5.0 * (5.0 / stated_mhz) ** 0.7 * float(rng.uniform(0.9, 1.1)),
        taper=float(rng.uniform(0.5, 1.3)),
    )


def _draw_delay(rng: np.random.Generator, material: str, speed_m_s: float, deepest_mm: float) -> DelayLine:
    """A delay line, mostly so long that its second echo comes behind the deepest bone; its echo tells how late it is."""
    if not material:
        return DelayLine("", 0.0, 0.0, 0.0, float(rng.uniform(0.1, 0.3)), 0.0, 0.0, 0.0, 0.0, short=False, static=False)
    delay_m_s, impedance, loss_db_cm = DELAYS[material]
    short = bool(rng.random() < 0.15)
    tissue_mm = 16.0 if rng.random() < 0.6 else deepest_mm + 3.5
    longer = rng.uniform(0.6, 0.8) if short else rng.uniform(1.0, 1.15)
    skin = rng.uniform(1.6, 1.75)
    face_r = float((skin - impedance) / (skin + impedance))
    return DelayLine(
        material=material,
        length_mm=float(np.clip(round(tissue_mm * delay_m_s / speed_m_s * longer, 1), 5, 30)),
        speed_m_s=delay_m_s,
        loss_db_cm=loss_db_cm,
        face_r=float(np.copysign(max(abs(face_r), LEAST_FACE_R), face_r)),
        back_r=float(rng.uniform(0.1, 0.4)),
        latency_us=float(rng.uniform(-0.15, 0.15)),
        slower=float(rng.uniform(-0.012, 0.012)),
        warms=float(rng.uniform(-0.006, 0.006)),
        short=short,
        static=bool(rng.random() < 0.3),
    )


def _draw_skull(rng: np.random.Generator, delay: DelayLine) -> Skull:
    return Skull(
        reflection=float(rng.uniform(0.52, 0.66)),
        diffuse=float(decibel(-rng.uniform(14, 24))),
        rough_mm=float(rng.uniform(0.01, 0.035)),
        thick_mm=float(rng.uniform(2.5, 8)),
        attenuation=float(rng.uniform(2, 7)),
        diploe=float(decibel(-rng.uniform(24, 34))),
        again=delay.face_r if delay.length_mm else -float(rng.uniform(0.15, 0.4)),
    )
