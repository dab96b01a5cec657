"""What a recording of Kirchhoff sums is drawn from: the probe, its delay line, the receiver, and the places of the head.

The ranges are those of the literature and of what people do; where bone could not be read through the tissue, a thinner place is
drawn instead. kirchhoff_hand.py moves the probe, kirchhoff_lines.py makes the lines.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

# Delay lines: speed m/s, reflection at the skin, attenuation dB/cm/MHz, highest nominal frequency MHz
MATERIALS = {
    "aqualene": (1616.0, 0.04, 0.56, 99.0),
    "pmp": (2170.0, -0.05, 1.06, 6.0),
    "polystyrene": (2340.0, -0.20, 0.25, 99.0),
    "pmma": (2670.0, -0.32, 0.6, 7.0),
}
WITHOUT = ("air", "soft", "gel")  # recordings without bone, evenly
WITHOUT_SHARE, DWELLS_SHARE = 0.15, 0.60  # the rest of the recordings are sweeps
MOST_LOSS_DB = 40.0  # there and back at the nominal frequency: nobody reads bone through more
READ_MM = 15.0  # what a delay line is made for
RELIEF_WAVES = 20  # that the bone's roughness is made of


def nepers(decibels_cm_mhz: float) -> float:
    """Loss of amplitude there and back, per mm of depth and Hz."""
    return decibels_cm_mhz * 0.2e-6 / 8.686


@dataclass(frozen=True)
class Forerun:
    """The delay line as it is; the header states its nominal speed. Without one the time is 0."""

    time_s: float = 0.0  # by the header, there and back
    faster: float = 0.0  # its true speed over the nominal one, minus 1
    drift: float = 0.0  # the same, gained over the recording
    face: float = 0.0  # reflection at the skin
    attenuation: float = 0.0  # dB/cm/MHz


@dataclass(frozen=True, eq=False)
class World:
    """What all lines of a recording share, and what may be asked of them."""

    acquisition: Acquisition
    forerun: Forerun
    pulse: str
    bandwidth: float
    fall: float  # how much longer than its rise
    tail: float  # of the pulse, over its peak
    phase: float
    attenuation: float  # dB/cm/MHz
    speed_m_s: float
    snr_db: float
    snr_of: str
    depth_mm: float  # of the bone, about
    speckle_db: float  # over a perfect reflector
    footprint_mm: float  # across
    back: float  # reflection at the transducer
    behind_mm: float  # of tissue that the lines cover
    skull_attenuation: float  # dB/cm/MHz
    without: str  # why a recording has no bone; empty: it has
    sweeps: bool
    hole: bool  # somewhere the bone is missing
    steep: bool  # somewhere the hand leans over
    rate_hz: float
    fill: float  # the bone's echo over the converter's range
    bits: int
    must: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n,) lines a detector has to accept
    ignore: Bools = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n,) at a hole's edge: no judge could say


def _draw_forerun(rng: np.random.Generator, centre_hz: float, speed: float) -> tuple[Forerun, float, float]:
    """The delay line, and the length and speed that the header states (0: none)."""
    if rng.random() >= 0.55:
        return Forerun(), 0.0, 0.0
    fit = [name for name, values in MATERIALS.items() if centre_hz <= values[3] * 1e6]
    nominal, face, loss, _ = MATERIALS[str(rng.choice(fit))]
    fitting = READ_MM * nominal / speed * rng.uniform(1.02, 1.2)  # its second echo comes after all that is read
    stub = rng.uniform(9, 14)  # its multiples fall into the scalp
    length = round(float(fitting if rng.random() < 0.75 else stub), 1)
    line = Forerun(2e-3 * length / nominal, float(rng.uniform(-0.01, 0.01)), float(rng.uniform(-0.002, 0.002)), face, loss)
    return line, length, nominal


def draw_world(rng: np.random.Generator) -> World:
    """A set-up somebody would use, and how the recording goes."""
    centre = 3e6 * (10 / 3) ** rng.random()
    sampling = 25e6 * 5 ** rng.random()
    if sampling < 3 * centre:
        sampling = 3 * centre * (125e6 / (3 * centre)) ** rng.random()
    speed, attenuation = float(rng.uniform(1450, 1630)), float(rng.uniform(0.3, 2.6))
    depth, most = float(rng.uniform(2.2, 14.8)), MOST_LOSS_DB / (attenuation * centre * 0.2e-6)
    if depth > most:
        depth = float(rng.uniform(2.2, max(most, 2.6)))
    course = rng.random()
    forerun, length, nominal = _draw_forerun(rng, centre, speed)
    hot = rng.random() < 0.10  # a gain at which bone is clipped
    return World(
        acquisition=Acquisition(sampling, centre, length, nominal),
        forerun=forerun,
        pulse="asymmetric",
        bandwidth=float(rng.uniform(0.5, 0.8)),
        fall=float(rng.uniform(1, 1.4)),
        tail=float(rng.uniform(0.005, 0.03)),
        phase=float(rng.choice([0, np.pi / 2, -np.pi / 2, rng.uniform(-3, 3)])),
        attenuation=attenuation,
        speed_m_s=speed,
        snr_db=float(rng.uniform(12, 40)),
        snr_of="median",
        depth_mm=depth,
        speckle_db=float(rng.uniform(-45, -30)),
        footprint_mm=2 * float(np.sqrt(speed / centre * 1e3 * rng.uniform(12, 20))),  # unfocused disc: near field 12-20 mm
        back=float(rng.uniform(0.1, 0.35) if length else rng.uniform(-0.3, 0.3)),
        behind_mm=float(rng.uniform(20, 28)),
        skull_attenuation=float(rng.uniform(3, 8)),
        without=WITHOUT[int(course / WITHOUT_SHARE * len(WITHOUT))] if course < WITHOUT_SHARE else "",
        sweeps=bool(course > DWELLS_SHARE),
        hole=bool(rng.random() < 0.20),
        steep=bool(rng.random() < 0.20),
        rate_hz=float(rng.uniform(20, 60)),
        fill=float(rng.uniform(0.7, 1.5) if hot else rng.uniform(0.2, 0.6)),
        bits=int(rng.choice([10, 12, 14])),
    )


@dataclass(frozen=True, eq=False)
class Places:
    """P places of the head: layers and roughness that stay where they are while the probe moves over them."""

    radius_mm: Array  # (P,) of the bone's curvature
    normal: Array  # (P, 3) outwards
    bone: Array  # (P,) its reflection
    table_mm: Array  # (P,) thickness of the bone
    waves: Array  # (P, 2, RELIEF_WAVES) rad/mm of the roughness
    phases: Array  # (P, RELIEF_WAVES)
    relief_mm: Array  # (P,) height of each wave
    layer_share: Array  # (P, L) depth of the layers, of the drawn depth of the bone; NaN: none
    layer: Array  # (P, L) their reflection
    slant_deg: Array  # (P, L, 2) against the bone
    dura_mm: Array  # (P,) behind the bone's outer face, where bone is missing
    dura: Array  # (P,) its reflection


def _draw_layers(rng: np.random.Generator, world: World) -> list[tuple[float, float]]:
    """Depth, as a share of the bone's, and reflection of skin to fat, galea, a fascia in the temple, or of soft tissue."""
    depth = world.depth_mm
    if world.without == "soft":
        depths = np.sort(rng.uniform(1.2, 22, rng.integers(4, 8)))
        return [(float(one / depth), float(rng.uniform(0.02, 0.09) * rng.choice([-1, 1]))) for one in depths]
    skin = rng.uniform(1.1, 1.9)
    layers = [(skin / depth if depth > skin + 1.2 else 0.4, -rng.uniform(0.02, 0.09))]
    layers.append((1 - rng.uniform(0.7, 2) / depth if depth > 3.5 else 0.72, rng.uniform(0.02, 0.09)))
    if depth > 7:
        layers.append((rng.uniform(0.35, 0.7), rng.uniform(0.02, 0.07) * rng.choice([-1, 1])))
    return [(float(share), float(height)) for share, height in layers]


def draw_places(rng: np.random.Generator, world: World, count: int) -> Places:
    """So many places, all on the same head."""
    layers = [_draw_layers(rng, world) for _ in range(count)]
    most = max(len(one) for one in layers)
    padded = np.array([one + [(np.nan, 0.0)] * (most - len(one)) for one in layers])
    wave, way = 2 * np.pi / rng.uniform(0.6, 3, (count, RELIEF_WAVES)), rng.uniform(0, 2 * np.pi, (count, RELIEF_WAVES))
    polar, around = np.arccos(rng.uniform(0.1, 1, count)), rng.uniform(0, 2 * np.pi, count)
    return Places(
        radius_mm=rng.uniform(45, 110, count),
        normal=np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=1),
        bone=rng.uniform(0.5, 0.65, count),
        table_mm=rng.uniform(3.5, 7, count),
        waves=np.stack([wave * np.cos(way), wave * np.sin(way)], axis=1),
        phases=rng.uniform(0, 2 * np.pi, (count, RELIEF_WAVES)),
        relief_mm=rng.uniform(0.005, 0.05, count) * np.sqrt(2 / RELIEF_WAVES),
        layer_share=padded[:, :, 0],
        layer=padded[:, :, 1],
        slant_deg=rng.normal(0, 2, (count, most, 2)),
        dura_mm=rng.uniform(4, 7, count),
        dura=rng.uniform(0.02, 0.05, count),
    )
