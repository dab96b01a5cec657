"""Simulated A-lines of rough bone under four tilted layers, every echo built by frequency.

What the other families lack: every interface is a sum over the parts of the disc, rough, convex and tilted by itself, so that a
tilt has its null at one frequency and not at another; the beam is refracted from layer to layer, each with an impedance, speed
and attenuation of its own, and what it loses on the way takes the high frequencies first, until a wide pulse arrives well below
the centre it left with. The true depth and tilt are those of the plane that fits the rough bone under the disc, the true speed
what the layers amount to; behind bone comes its marrow. What a recording is drawn from is in rough_plan.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording
from scipy.interpolate import CubicSpline

from Testing.Studies.simulators.echo_spectra import echo_spectra, short_peaks
from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.rough_plan import (
    NEPERS,
    Array,
    Bools,
    Hand,
    Places,
    Setup,
    draw_hand,
    draw_poses,
    draw_setup,
)

Floats = npt.NDArray[np.float32]
Spectra = npt.NDArray[np.complex64]  # (n, k) over the pulse's band

LOWEST, HIGHEST = 0.15, 2.3  # of the pulse, over the centre
NOISE_LOWEST, NOISE_HIGHEST = 0.3, 2.0
FAINT = 3e-6  # of the pulse's spectrum, over its height: higher frequencies are left out; the tissue takes more of them
GUARD_US = 8.0  # behind the lines, where the last echo may end
SURFACE_STEP_MHZ, SURFACE_BLOCK = 0.12, 10  # from a frequency at which a surface is summed to the next
ECHO_US = 8.0  # longer than an echo of bone
ACROSS = 11  # parts of the disc, across
APODISED = 0.8  # of the disc's radius: its edge answers less
AIR_R, SKIN_R, BACK_R = -0.98, 0.12, 0.15  # of a face without delay line: skin's and the element's reflection
DELAY_BACK_R = 0.35  # of the element behind a delay line
MULTIPLES = 5
BANG, BANG_CYCLES, RING, RING_CYCLES = 6.0, 1.3, 0.03, 12.0  # the transmitted pulse, and what rings on in a delay line
LAYER_ROUNDER = 1.05  # radius of the interfaces over the skull's
SCATTERERS_MOVE = 0.02  # share of a layer that its scatterers move, a mm of the probe
DEEP_SPECKLE = 0.8
MARROW, MARROW_ECHOES, MARROW_MM, MARROW_DB, BONE_MM_US = 0.15, 10, (0.5, 6.0), 8.0, 2.9
USUAL_BONE_R = 0.55
SQUARE_DEG = 3.0
LEAST_NOISE_CODES = 0.7


@dataclass(frozen=True, eq=False)
class World(Setup):
    """The set-up, and what is under the probe in each line."""

    kind: npt.NDArray[np.str_]  # (n,) bone; without bone: tissue, air, empty (the probe does not even fire)
    skin_us: Array  # (n,) when the skin answers


class Band:
    """The pulse and its frequencies."""

    def __init__(self, setup: Setup) -> None:
        rate, centre = setup.sampling_mhz, setup.centre_mhz
        self.samples = int((setup.stated_face_us + setup.reach_mm * 2e3 / setup.speed_m_s) * rate)
        self.size = scipy.fft.next_fast_len(self.samples + int(GUARD_US * rate), real=True)
        self.last_us = self.samples / rate + 0.5 * GUARD_US
        self.step_mhz = rate / self.size
        self.every_mhz = np.arange(self.size // 2 + 1) * self.step_mhz
        width = setup.bandwidth * centre / (2 * np.sqrt(2 * np.log(2)))
        highest = min(HIGHEST * centre, centre + width * np.sqrt(-2 * np.log(FAINT)))
        used = np.flatnonzero((self.every_mhz > LOWEST * centre) & (self.every_mhz < highest))
        self.bins = slice(int(used[0]), int(used[-1]) + 1)
        self.mhz = self.every_mhz[self.bins]
        level = np.exp(-0.5 * ((self.mhz - centre) / width) ** 2)
        unit = 0.5 * self.size / level.sum()  # the envelope's peak is 1, at time zero
        self.pulse = (unit * level * np.exp(1j * setup.phase)).astype(np.complex64)
        self.noise = (self.every_mhz > NOISE_LOWEST * centre) & (self.every_mhz < NOISE_HIGHEST * centre)

    def echoes(self, time_us: Array, height: npt.NDArray[np.generic], lost: npt.ArrayLike) -> Spectra:
        """Sum of echoes (n, m) over the pulse; those that come after the line's end are left out."""
        heard = np.where(time_us < self.last_us, height, 0)
        return echo_spectra(
            time_us, heard, np.broadcast_to(np.asarray(lost, dtype=float), time_us.shape), self.mhz, self.step_mhz
        )

    def surface(self, delay_us: Array, share: float) -> Spectra:
        """Answer of a surface (n, k) whose parts (n, g) are delayed against the axis: so little that few frequencies tell it."""
        every = max(1, int(SURFACE_STEP_MHZ / self.step_mhz))
        few = self.mhz[0] + np.arange(-(-(len(self.mhz) - 1) // every) + 1) * (every * self.step_mhz)
        parts = np.full(delay_us.shape, share, dtype=np.float32)
        told = echo_spectra(delay_us, parts, np.zeros(delay_us.shape), few, every * self.step_mhz, SURFACE_BLOCK)
        return np.asarray(CubicSpline(few, told, axis=1)(self.mhz), dtype=np.complex64)

    def peaks(self, spectra: Spectra) -> Array:
        """Height of the envelope of bone's echoes at time zero, whose spectra over the pulse are given (n,)."""
        every = max(1, int(1 / (self.step_mhz * ECHO_US)))
        return short_peaks(spectra * self.pulse, every, self.size)


class Disc:
    """The face, in parts that each surface is summed over."""

    def __init__(self, setup: Setup) -> None:
        across = (np.arange(ACROSS) + 0.5) / ACROSS * 2 - 1
        grid = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
        self.parts_mm = APODISED * setup.disc_mm * grid[(grid**2).sum(axis=1) <= 1]  # (g, 2)
        self.share = 1 / len(self.parts_mm)

    def deeper_mm(self, tilt: Array, around: Array, round_mm: float, relief: Array) -> Array:
        """How much deeper a surface is under each part (n, g) than under the axis; tilted (n,), convex, and rough (n, g)."""
        way = np.stack([np.cos(around), np.sin(around)], axis=1) @ self.parts_mm.T
        sagitta = (self.parts_mm**2).sum(axis=1) / (2 * round_mm)
        return np.asarray(np.tan(tilt)[:, None] * way + sagitta + relief)

    def plane(self, relief: Array) -> tuple[Array, Array]:
        """Height (n,) and slope (n, 2) of the plane that fits a relief (n, g) best; the parts lie symmetrically."""
        return relief.mean(axis=1), relief @ self.parts_mm / (self.parts_mm[:, 0] ** 2).sum()


@dataclass(frozen=True, eq=False)
class Scene:
    """A recording being made."""

    setup: Setup
    places: Places
    hand: Hand
    band: Band
    disc: Disc

    @property
    def delayed(self) -> bool:
        return self.setup.delay is not None

    @property
    def face_r(self) -> Array:
        """Reflection at the face (n,)."""
        skin = SKIN_R
        if self.setup.delay is not None:
            first, second = self.setup.delay.impedance, float(self.setup.layers.impedance[0])
            skin = (second - first) / (second + first)
        return np.where(self.hand.kind == "air", AIR_R, skin)

    @property
    def back_r(self) -> float:
        return DELAY_BACK_R if self.delayed else BACK_R


@dataclass(frozen=True, eq=False)
class Layer:
    """What the beam meets of one layer, in the n lines with contact."""

    start_us: Array  # (n,)
    mm: Array  # (n,) of the way through it
    lost: Array  # (n,) neper a MHz, there and back to its start
    passed: float  # of an echo's height, there and back through the interfaces before it
    reflection: float  # at its end
    end_us: Array
    end_lost: Array
    angle: Array  # (n,) by which refraction has turned the beam at its end


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, World]:
    """A recording of about `frames` lines, the truth about it, and what it was drawn from."""
    setup = setup or draw_setup(rng)
    hand, places = draw_hand(rng, setup, frames)
    scene = Scene(setup, places, hand, Band(setup), Disc(setup))
    count = len(hand.kind)
    bone = hand.kind == "bone"
    depth, tilt, peak, speed = np.full(count, np.nan), np.degrees(hand.lean[:, 0]), np.zeros(count), setup.speed_m_s
    spectra = _face(scene)
    if hand.contact.any():
        rows = np.flatnonzero(hand.contact)
        layers = _trace(scene, rows)
        spectra[rows] += _scalp(scene, rows, layers)
        _add_deep(scene, rows, layers[-1], spectra)
        if bone.any():
            deepest = layers[-1]
            in_bone = bone[rows]
            found = _bone(scene, rng, np.flatnonzero(bone), deepest, in_bone)
            spectra[bone] += found.spectra
            depth[bone], tilt[bone], peak[bone] = found.depth_mm, found.tilt_deg, found.peak
            way_us = (deepest.end_us - hand.face_us[rows])[in_bone]
            speed = float(np.mean(2e3 * hand.depth_mm[bone] / way_us))
    largest, noise = _levels(scene, peak[bone], tilt[bone])
    lines = _convert(rng, setup, _received(scene, rng, spectra, noise), largest, noise)
    recording = Recording(
        lines=lines,
        acquisition=setup.acquisition,
        probe_to_reference=draw_poses(rng, setup, hand),
        statuses=("OK",) * count,
        timestamps_s=10 + hand.time_s + rng.normal(0, 0.001, count),
        palpation_points=hand.place,
    )
    snr_db = np.where(bone, 20 * np.log10(np.maximum(peak, 1e-12) / noise), -np.inf)
    return recording, Truth(depth, tilt, speed, snr_db), World(**vars(setup), kind=hand.kind, skin_us=hand.face_us)


def _face(scene: Scene) -> Spectra:
    """Echo of the delay line's face and its multiples (n, k); without one, nothing that the transmitted pulse would not hide."""
    hand, band = scene.hand, scene.band
    if not scene.delayed:
        return np.zeros((len(hand.kind), len(band.mhz)), dtype=np.complex64)
    number = np.arange(MULTIPLES)
    face_r = scene.face_r[:, None]
    height = face_r * (face_r * scene.back_r) ** number * (hand.kind != "empty")[:, None]
    return band.echoes(hand.face_us[:, None] * (number + 1), height, scene.setup.delay_nepers * (number + 1))


def _trace(scene: Scene, rows: npt.NDArray[np.int64]) -> list[Layer]:
    """The way of the beam through the four layers, which the tilted interfaces between them turn."""
    setup, layers, place = scene.setup, scene.setup.layers, scene.hand.place[rows]
    start_us, angle = scene.hand.face_us[rows], np.zeros(len(rows))
    lost = np.full(len(rows), setup.delay_nepers)
    passed = float(1 - scene.face_r[rows[0]] ** 2) if scene.delayed else 1.0
    impedance = np.append(layers.impedance, setup.bone_impedance)
    found = []
    for number in range(4):
        mm = layers.share[number] * scene.hand.depth_mm[rows] / np.cos(angle)
        end_us = start_us + 2 * mm / layers.mm_us[number]
        end_lost = lost + 2 * layers.nepers[number] * mm
        reflection = float((impedance[number + 1] - impedance[number]) / (impedance[number + 1] + impedance[number]))
        found.append(Layer(start_us, mm, lost, passed, reflection, end_us, end_lost, angle))
        if number < 3:
            across = np.cos(scene.places.slant_around[place, number] - scene.hand.lean[rows, 1])
            meets = angle + scene.places.slant[place, number] * across
            bends = np.sin(meets) * layers.mm_us[number + 1] / layers.mm_us[number]
            angle = angle + np.arcsin(np.clip(bends, -1, 1)) - meets
        start_us, lost, passed = end_us, end_lost, passed * (1 - reflection**2)
    return found


def _scalp(scene: Scene, rows: npt.NDArray[np.int64], layers: list[Layer]) -> Spectra:
    """What scatters in the layers, and the interfaces between them (n, k)."""
    setup, places, place = scene.setup, scene.places, scene.hand.place[rows]
    times, heights, losses = [], [], []
    shift = SCATTERERS_MOVE * scene.hand.moved_mm[rows, :1]
    for number, layer in enumerate(layers):
        used = (places.scatterer[:, number] != 0).any(axis=0)
        mm = layer.mm[:, None] * ((places.scatterer_at[place, number][:, used] + shift) % 1)
        times.append(layer.start_us[:, None] + 2 * mm / setup.layers.mm_us[number])
        heights.append(layer.passed * setup.speckle * setup.layers.speckle[number] * places.scatterer[place, number][:, used])
        losses.append(layer.lost[:, None] + 2 * setup.layers.nepers[number] * mm)
    spectra = scene.band.echoes(*(np.concatenate(parts, axis=1) for parts in (times, heights, losses)))
    for number, layer in enumerate(layers[:3]):
        relief = setup.relief[number].heights(scene.hand.on_relief_mm[rows], scene.disc.parts_mm)
        slant, around = np.abs(places.slant[place, number]), places.slant_around[place, number]
        deeper = scene.disc.deeper_mm(slant, around, LAYER_ROUNDER * setup.round_mm, relief)
        answer = scene.band.surface(2 * deeper / setup.layers.mm_us[number], scene.disc.share)
        height = np.full((len(rows), 1), layer.passed * layer.reflection)
        spectra += answer * scene.band.echoes(layer.end_us[:, None], height, layer.end_lost[:, None])
    return spectra


def _add_deep(scene: Scene, rows: npt.NDArray[np.int64], deepest: Layer, spectra: Spectra) -> None:
    """Put in the tissue that goes on where there is no bone."""
    setup, places = scene.setup, scene.places
    soft = scene.hand.kind[rows] == "tissue"
    if not soft.any():
        return
    place = scene.hand.place[rows[soft]]
    mm = places.deep_mm[place]
    time_us = deepest.end_us[soft, None] + 2e3 * mm / setup.speed_m_s
    lost = deepest.end_lost[soft, None] + 2 * NEPERS * setup.attenuation * mm
    height = deepest.passed * setup.speckle * DEEP_SPECKLE * places.deep[place]
    spectra[rows[soft]] += scene.band.echoes(time_us, height, lost)


@dataclass(frozen=True, eq=False)
class Bone:
    """Bone in the b lines that have it."""

    spectra: Spectra
    peak: Array  # (b,) of its first echo
    depth_mm: Array
    tilt_deg: Array


def _bone(scene: Scene, rng: np.random.Generator, rows: npt.NDArray[np.int64], deepest: Layer, bone: Bools) -> Bone:
    """Bone's echo, the marrow's behind it, and what goes again between bone and face."""
    setup, hand, disc, band = scene.setup, scene.hand, scene.disc, scene.band
    size, around = hand.lean[rows].T
    relief = setup.relief[3].heights(hand.on_relief_mm[rows], disc.parts_mm)
    meets = np.maximum(size - deepest.angle[bone], 0)  # the refracted beam
    deeper = disc.deeper_mm(meets, around, setup.round_mm, relief)
    answer = band.surface(2 * deeper / setup.layers.mm_us[3], disc.share)
    arrives, lost = deepest.end_us[bone, None], deepest.end_lost[bone, None]
    height = np.full(arrives.shape, deepest.passed * deepest.reflection)
    first = answer * (height * np.exp(-lost * band.mhz)).astype(np.float32)
    marrow_mm = rng.uniform(*MARROW_MM, (len(rows), MARROW_ECHOES))
    marrow = MARROW * rng.normal(size=marrow_mm.shape)
    once = band.echoes(
        np.concatenate([arrives, arrives + 2 * marrow_mm / BONE_MM_US], axis=1),
        height * np.concatenate([np.ones_like(arrives), marrow], axis=1),
        lost + 2 * NEPERS * MARROW_DB * np.concatenate([np.zeros_like(arrives), marrow_mm], axis=1),
    )
    again = band.echoes(
        2 * arrives - hand.face_us[rows, None], -height * deepest.reflection * scene.back_r, 2 * lost - setup.delay_nepers
    )
    higher, slope = disc.plane(relief)
    slope[:, 0] += np.tan(size) * np.cos(around)
    slope[:, 1] += np.tan(size) * np.sin(around)
    tilt_deg = np.degrees(np.hypot(slope[:, 0], slope[:, 1]))
    return Bone(answer * (once + answer * again), band.peaks(first), hand.depth_mm[rows] + higher, tilt_deg)


def _levels(scene: Scene, peak: Array, tilt_deg: Array) -> tuple[float, float]:
    """The largest bone echo, and the noise's standard deviation; without bone, as beside the bone that is looked for."""
    setup = scene.setup
    if len(peak) == 0:
        left = np.exp(-2 * NEPERS * setup.attenuation * setup.centre_mhz * setup.depth_mm)
        fired = scene.delayed and setup.without != "empty"
        in_delay = np.exp(-setup.delay_nepers * 0.5 * (scene.band.mhz[0] + scene.band.mhz[-1])) if fired else 0.5
        largest = float(USUAL_BONE_R * left * in_delay)
        return largest, 0.5 * largest / 10 ** (setup.snr_db / 20)
    largest = float(peak.max())
    square = tilt_deg <= SQUARE_DEG
    heard = float(np.median(peak[square])) if square.any() else 0.5 * largest
    return largest, heard / 10 ** (setup.snr_db / 20)


def _received(scene: Scene, rng: np.random.Generator, spectra: Spectra, noise: float) -> Floats:
    """Lines (n, samples): the transmitted pulse, all echoes, and the receiver's noise."""
    band, setup = scene.band, scene.setup
    whole = np.zeros((len(spectra), len(band.every_mhz)), dtype=np.complex64)
    normal = rng.standard_normal((len(spectra), 2 * int(band.noise.sum())), dtype=np.float32)
    whole[:, band.noise] = normal.view(np.complex64) * np.float32(0.5 * band.size * noise / np.sqrt(band.noise.sum()))
    whole[:, band.bins] += spectra * band.pulse
    lines = scipy.fft.irfft(whole, band.size, axis=1)[:, : band.samples]
    cycles = np.arange(band.samples) / setup.sampling_mhz * setup.centre_mhz
    bang = BANG * np.exp(-cycles / BANG_CYCLES) * np.cos(2 * np.pi * cycles)
    if scene.delayed:
        bang += RING * np.exp(-cycles / RING_CYCLES) * np.cos(2 * np.pi * cycles + 1)
    lines[scene.hand.kind != "empty"] += bang.astype(np.float32)
    return np.asarray(lines)


def _convert(rng: np.random.Generator, setup: Setup, lines: Floats, largest: float, noise: float) -> npt.NDArray[np.int16]:
    """The lines as codes; the converter clips, and the gain leaves some noise to be seen."""
    full_scale = 2 ** (setup.bits - 1)
    codes = max(setup.fill * full_scale / largest, LEAST_NOISE_CODES / noise)
    return np.asarray(np.clip(np.rint(lines * np.float32(codes)), -full_scale, full_scale - 1), dtype=np.int16)
