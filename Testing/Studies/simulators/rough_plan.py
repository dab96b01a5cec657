"""What a recording of rough bone under four tilted layers is made of: probe, scalp, delay line, and the hand, line by line.

The hand dwells on a few places with a tremor; for some lines it loses the bone or the contact. rough_lines.py makes the lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition

from Testing.Studies.simulators.units import InMicroseconds

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

RATES_MHZ = [25, 31.25, 40, 50, 60, 64, 80, 100, 125]
LEAST_SAMPLES = 2.7  # a cycle
SHALLOWEST_MM, DEEPEST_MM = 2.0, 15.0
MOST_LOSS_DB = 45.0  # two ways to the bone
NEPERS = np.log(10) / 200  # a mm, of a dB/cm
MUSCLE_FROM_MM = 7.0
USUAL_LINES = 50  # of which a recording has 40 to 60, in 2 to 4 places
LEAST_LINES = 8
STEP_S = 0.033
TREMOR_HZ = np.array([0.2, 0.5, 1.1, 2.3, 5.0, 8.0])
TREMOR_DEG, TREMOR_MM = 0.25, 0.15
STEEPEST_DEG = 8.0
APART_MM = 20.0  # of places, on the relief of the surfaces
RELIEF_WAVES = 24
SCATTERERS, SCATTERERS_MM = 12, 2.5  # in a layer at least; and that many times as many a mm
DEEP_SCATTERERS, DEEP_MM = 160, 14.0  # where tissue goes on
JITTER_MM = 0.06  # of the tracked probe


@dataclass(frozen=True, eq=False)
class Relief:
    """A stationary random surface: a sum of waves."""

    waves: Array  # (RELIEF_WAVES, 2) rad/mm
    phases: Array  # (RELIEF_WAVES,)
    height_mm: float  # of each

    def heights(self, at_mm: Array, under_mm: Array) -> Array:
        """Height (n, g) at points `under_mm` (g, 2) of the face, which stands at `at_mm` (n, 2)."""
        there = np.exp(1j * (at_mm @ self.waves.T + self.phases))
        beside = np.exp(1j * (self.waves @ under_mm.T))
        return np.asarray(self.height_mm * (there @ beside).real)


def draw_relief(rng: np.random.Generator, rms_mm: float, alike_mm: float) -> Relief:
    """A surface of so much roughness, whose heights are alike over so far."""
    waves = rng.normal(0, 1 / alike_mm, (RELIEF_WAVES, 2))
    return Relief(waves, rng.uniform(0, 2 * np.pi, RELIEF_WAVES), rms_mm * np.sqrt(2 / RELIEF_WAVES))


@dataclass(frozen=True, eq=False)
class Layers:
    """Skin, fat, galea and what lies under it: loose tissue, or muscle. Each is an array (4,)."""

    share: Array  # of the scalp's thickness
    impedance: Array  # MRayl
    mm_us: Array
    nepers: Array  # a mm and a MHz, one way
    speckle: Array  # over that of the recording
    scatterers: Array  # a mm of scalp


# share, impedance, speed and attenuation over the scalp's, speckle
SCALP = [(0.30, 1.75, 1.03, 1.0, 0.9), (0.40, 1.44, 0.96, 0.8, 0.6), (0.12, 1.74, 1.04, 1.3, 0.4), (0.18, 1.60, 1.0, 1.0, 0.3)]
TEMPLE = [(0.14, 1.75, 1.04, 1.0, 0.9), (0.18, 1.42, 0.95, 0.7, 0.6), (0.06, 1.74, 1.04, 1.2, 0.4), (0.62, 1.67, 1.0, 1.1, 0.8)]


def _draw_layers(rng: np.random.Generator, muscle: bool, speed_m_s: float, attenuation: float) -> Layers:
    """Layers whose mean speed and attenuation are the scalp's."""
    usual_share, impedance, speed, loss, speckle = np.array(TEMPLE if muscle else SCALP).T
    share = usual_share * rng.uniform(0.75, 1.25, 4)
    share /= share.sum()
    return Layers(
        share=share,
        impedance=impedance * rng.normal(1, 0.012, 4),
        mm_us=speed * (1e-3 * speed_m_s) * (share / speed).sum(),
        nepers=NEPERS * attenuation * loss / (loss * share).sum(),
        speckle=speckle,
        scatterers=SCATTERERS * SCATTERERS_MM * usual_share,
    )


@dataclass(frozen=True)
class Material:
    """What delay lines are made of."""

    speed_m_s: float
    impedance: float  # MRayl
    attenuation: float  # dB/cm/MHz


MATERIALS = [
    Material(1616.0, 1.49, 0.56),
    Material(2170.0, 1.79, 1.06),
    Material(2340.0, 2.47, 0.1),
    Material(2670.0, 3.15, 0.4),
]


@dataclass(frozen=True, eq=False)
class Setup(InMicroseconds):
    """What all lines of a recording share."""

    acquisition: Acquisition
    pulse: str
    bandwidth: float  # at -6 dB, of the centre
    phase: float
    speed_m_s: float  # of the scalp, as it was meant; the truth is what the layers amount to
    attenuation: float  # dB/cm/MHz, of the scalp
    snr_db: float  # of the median line that meets bone squarely
    snr_of: str
    without: str  # a recording without bone: tissue, air, empty
    depth_mm: float  # of the bone, about
    muscle: bool
    layers: Layers
    bone_impedance: float
    round_mm: float  # radius of the skull
    disc_mm: float  # radius of the face
    relief: tuple[Relief, ...]  # of the interfaces from the skin inwards; the last is the bone's
    speckle: float
    delay: Material | None
    slower: float  # the delay line's time over the stated one
    reach_mm: float  # of tissue that the lines cover
    bits: int
    fill: float  # of full scale, of the largest bone echo

    @property
    def stated_face_us(self) -> float:
        """When the face answers, as the header has it."""
        acquisition = self.acquisition
        if not acquisition.forerun_length_mm:
            return 0.0
        return 2e3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s

    @property
    def delay_nepers(self) -> float:
        """Loss a MHz in the delay line, there and back; half of what the material is said to lose."""
        return self.acquisition.forerun_length_mm * NEPERS * self.delay.attenuation if self.delay else 0.0


def draw_setup(rng: np.random.Generator) -> Setup:
    """Probe, tissue and receiver of one recording."""
    centre, attenuation, depth = _draw_reach(rng)
    speed = float(rng.uniform(1450, 1630))
    muscle = bool(depth > MUSCLE_FROM_MM and rng.random() < 0.6)
    delay, length = None, 0.0
    if rng.random() < 0.5:  # the second echo of its face comes after the bone
        delay = MATERIALS[int(rng.integers(len(MATERIALS)))]
        length = round(1.1 * 1.15 * depth * delay.speed_m_s / speed + float(rng.uniform(1, 5)), 1)
    relief = [draw_relief(rng, 0.03, 1.5) for _ in range(3)]
    relief.append(draw_relief(rng, float(rng.uniform(0.01, 0.05)), float(rng.uniform(0.8, 2.0))))
    sampling = max(float(rng.choice(RATES_MHZ)), LEAST_SAMPLES * centre)
    return Setup(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, length, delay.speed_m_s if delay else 0.0),
        pulse="gauss",
        bandwidth=float(rng.uniform(0.45, 0.8)),
        phase=float(rng.uniform(-0.6, 0.6)),
        speed_m_s=speed,
        attenuation=attenuation,
        snr_db=float(rng.uniform(12, 40)),
        snr_of="median",
        without="" if rng.random() < 0.85 else str(rng.choice(["tissue", "air", "empty"])),
        depth_mm=depth,
        muscle=muscle,
        layers=_draw_layers(rng, muscle, speed, attenuation),
        bone_impedance=float(rng.uniform(5.2, 7.8)),
        round_mm=float(rng.uniform(60, 95)),
        disc_mm=float(rng.uniform(2.5, 3.0)),
        relief=tuple(relief),
        speckle=float(10 ** (rng.uniform(-42, -30) / 20)),
        delay=delay,
        slower=float(rng.normal(0, 0.0025)),
        reach_mm=float(rng.uniform(21, 30)),
        bits=int(rng.choice([10, 12, 14])),
        fill=float(rng.uniform(0.1, 1.1)),
    )


def _draw_reach(rng: np.random.Generator) -> tuple[float, float, float]:
    """Centre (MHz), attenuation (dB/cm/MHz) and depth (mm) at which bone is still heard."""
    while True:
        centre, attenuation, depth = rng.uniform(3, 10), rng.uniform(0.3, 2.6), rng.uniform(SHALLOWEST_MM, DEEPEST_MM)
        if 0.2 * attenuation * centre * depth <= MOST_LOSS_DB:
            return float(centre), float(attenuation), float(depth)


@dataclass(frozen=True, eq=False)
class Places:
    """P places of the head, with what scatters in each of the four layers, m at most."""

    depth_mm: Array  # (P,)
    lean_deg: Array  # (P, 2) of the probe, about both axes
    slant: Array  # (P, 3) rad, of the interfaces between the layers
    slant_around: Array  # (P, 3)
    scatterer_at: Array  # (P, 4, m) from 0 to 1, in the layer
    scatterer: Array  # (P, 4, m) its height; 0: none
    deep_mm: Array  # (P, DEEP_SCATTERERS) where there is no bone, behind the depth at which it would be
    deep: Array  # (P, DEEP_SCATTERERS)


def draw_places(rng: np.random.Generator, setup: Setup, count: int) -> Places:
    """So many places, most of which are met squarely."""
    depth = np.clip(setup.depth_mm * rng.uniform(0.9, 1.1, count), SHALLOWEST_MM, DEEPEST_MM)
    lean = np.where(rng.random(count) < 0.6, rng.uniform(0, 2.8, count), rng.uniform(2.5, STEEPEST_DEG, count))
    around = rng.uniform(0, 2 * np.pi, count)
    held = np.maximum(SCATTERERS, np.outer(depth, setup.layers.scatterers)).astype(int)  # (P, 4)
    most = int(held.max())
    there = np.arange(most) < held[:, :, None]
    return Places(
        depth_mm=depth,
        lean_deg=np.stack([lean * np.cos(around), lean * np.sin(around)], axis=1),
        slant=rng.normal(0, np.radians(2.0), (count, 3)),
        slant_around=rng.uniform(0, 2 * np.pi, (count, 3)),
        scatterer_at=rng.random((count, 4, most)),
        scatterer=rng.normal(size=(count, 4, most)) * there,
        deep_mm=rng.uniform(0, DEEP_MM, (count, DEEP_SCATTERERS)),
        deep=rng.normal(size=(count, DEEP_SCATTERERS)),
    )


@dataclass(frozen=True, eq=False)
class Hand:
    """What the probe does, line by line."""

    kind: npt.NDArray[np.str_]  # (n,) bone; without bone: tissue, air, empty (the probe does not even fire)
    place: Rows
    moved_mm: Array  # (n, 2) on the place
    lean: Array  # (n, 2) rad, of the beam against the bone: its size and its direction
    depth_mm: Array  # (n,) of the mean surface of the bone
    face_us: Array  # (n,) when the delay line's face answers
    time_s: Array  # (n,)

    @property
    def contact(self) -> Bools:
        return np.isin(self.kind, ["bone", "tissue"])

    @property
    def on_relief_mm(self) -> Array:
        """Where the beam stands on the relief of the surfaces (n, 2)."""
        return np.asarray(self.moved_mm + APART_MM * self.place[:, None])


def draw_hand(rng: np.random.Generator, setup: Setup, frames: int) -> tuple[Hand, Places]:
    """About `frames` lines, at least LEAST_LINES: who has less time goes to fewer places."""
    count = max(LEAST_LINES, round(frames * float(rng.integers(40, 61)) / USUAL_LINES))
    share = count / USUAL_LINES
    held = max(1, _scaled(rng, int(rng.integers(2, 5)), share))
    places = draw_places(rng, setup, held)
    place = np.minimum(np.arange(count) * held // count, held - 1)
    time = STEP_S * np.arange(count, dtype=np.float64)
    phases = rng.uniform(0, 2 * np.pi, (2, len(TREMOR_HZ)))
    swings = np.sin(2 * np.pi * TREMOR_HZ * time[:, None, None] + phases) / np.arange(1, len(TREMOR_HZ) + 1)
    tremor = swings.sum(axis=2)  # (n, 2)
    lean = places.lean_deg[place] + TREMOR_DEG * tremor
    size = np.radians(np.minimum(np.hypot(lean[:, 0], lean[:, 1]), STEEPEST_DEG))
    drift = 1 + setup.slower + 4e-4 * np.sin(0.3 * time)
    hand = Hand(
        kind=_draw_kinds(rng, setup, count, share),
        place=place,
        moved_mm=TREMOR_MM * tremor[:, ::-1],
        lean=np.stack([size, np.arctan2(lean[:, 1], lean[:, 0])], axis=1),
        depth_mm=places.depth_mm[place] * (1 + 0.01 * np.sin(0.6 * time + place)),
        face_us=setup.stated_face_us * drift,
        time_s=time,
    )
    return hand, places


def _scaled(rng: np.random.Generator, usual: int, share: float) -> int:
    """So many, for a recording that is `share` of the usual length: on average right."""
    return int(np.floor(usual * share + rng.random()))


def _draw_kinds(rng: np.random.Generator, setup: Setup, count: int, share: float) -> npt.NDArray[np.str_]:
    """What is under the probe in each line: bone but for a few stretches of lines."""
    kind = np.full(count, setup.without or "bone", dtype="<U6")
    if setup.without:
        return kind
    for _ in range(_scaled(rng, int(rng.integers(0, 4)), share)):
        first = int(rng.integers(0, count - 6))
        kind[first : first + int(rng.integers(2, 7))] = rng.choice(["tissue", "air", "empty"])
    return kind


def draw_poses(rng: np.random.Generator, setup: Setup, hand: Hand) -> Array:
    """Probe to reference (n, 4, 4), as a tracker has it: over a round skull about the origin."""
    polar, around = 0.3 * hand.place + 0.2, 1.7 * hand.place + rng.uniform(0, 2 * np.pi)
    outward = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=1)
    first = _unit(np.cross(outward, [0.2, 0.1, 0.97]))
    second = np.cross(outward, first)
    moved = hand.moved_mm / setup.round_mm
    normal = _unit(outward + moved[:, :1] * first + moved[:, 1:] * second)
    size, way = hand.lean[:, :1], hand.lean[:, 1:]
    beam = _unit(-np.cos(size) * normal + np.sin(size) * (np.cos(way) * first + np.sin(way) * second))
    across = _unit(np.cross(beam, [0.0, 1.0, 0.1]))
    poses = np.tile(np.eye(4), (len(hand.place), 1, 1))
    poses[:, :3, 0] = across
    poses[:, :3, 1] = np.cross(beam, across)
    poses[:, :3, 2] = beam
    reach = hand.depth_mm + setup.acquisition.forerun_length_mm
    poses[:, :3, 3] = setup.round_mm * normal - beam * reach[:, None] + rng.normal(0, JITTER_MM, (len(beam), 3))
    return poses


def _unit(vectors: npt.NDArray[np.floating]) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
