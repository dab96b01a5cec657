"""Simulated A-lines as they come at a patient's bed, where the probe was chosen for the patient and the hand makes a story of it.

What the other families lack: a Gaussian pulse that rings on, narrower; a delay line whose face reflects so poorly that speckle
interferes with its echo, or one so short that the face's second echo lies among the tissue; a disc's directivity at every
frequency, by which the echo of a tilted bone breaks up; bone that scatters from many points which move with the hand; burr holes
and necks where the speckle goes on; hair under which the coupling comes and goes; codes that are justified to the left.
All echoes are laid down in the spectrum: pulse, attenuation of the way, delay (bedside_band.py). What happens is drawn in
bedside_plan.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.bedside_band import Band, Echo, Spectra
from Testing.Studies.simulators.bedside_plan import (
    Array,
    Bedside,
    Bools,
    Stand,
    Way,
    db,
    draw_bedside,
    draw_stand,
    draw_way,
    wander,
)
from Testing.Studies.simulators.line_truth import Truth

BONE_R = 0.6
BONE_MM_US, BONE_LOSS_DB = 2.9, 0.6  # speed in bone; lost there and back, a mm and MHz
LEAST_US = 12.0  # of a line
SCATTERERS, DIPLOE = 10, 12
LAYERS = 4  # at most, over each other
SOFT_MM, SEEN_MM = 12.0, 14.0  # how deep one looks where there is no bone; and sees something
MOST_BITS = 16


@dataclass(frozen=True, eq=False)
class Scene:
    """One recording under way: what is where, and when it answers."""

    world: Bedside
    way: Way
    stand: Stand
    band: Band
    samples: int
    bone: Bools  # (n,)
    line_us: Array  # (n,) there and back in the delay line
    late_us: Array  # (n,) the trigger
    bone_us: Array  # (n,) from the probe's face; NaN without
    bone_height: Array  # (n,) met squarely, before attenuation

    @property
    def face_us(self) -> Array:
        return self.line_us + self.late_us

    @property
    def through(self) -> float:
        """What passes the face twice."""
        return 1 - self.world.face_r**2

    @property
    def mm_us(self) -> float:
        return self.world.speed_m_s / 1e3

    @property
    def line_loss(self) -> float:
        """What comes back through the delay line."""
        acquisition = self.world.acquisition
        return float(db(-self.world.line_db * acquisition.transducer_hz / 5e6 * acquisition.forerun_length_mm / 10 * 2))

    def upright(self, depth_mm: float) -> Spectra:
        """Echo of a bone met squarely in a depth (1, bins)."""
        return np.asarray(BONE_R * self.through * self.band.pulse * self.band.attenuated(depth_mm), dtype=np.complex64)

    def height(self, depth_mm: float) -> float:
        """Its envelope's peak."""
        return float(self.band.peak(self.upright(depth_mm))[0])


def simulate(rng: np.random.Generator, frames: int, world: Bedside | None = None) -> tuple[Recording, Truth, Bedside]:
    """A recording of about so many lines, and the truth about it."""
    world = world or draw_bedside(rng, frames)
    scene = _scene(rng, world, draw_way(rng, world, frames))
    band, lines = scene.band, len(scene.bone)
    mirror = band.directivity(np.where(scene.bone, scene.stand.tilt_deg, 0.0))
    bone = _bone(rng, scene, mirror)
    noise = _noise_density(rng, scene)
    spectra = np.zeros_like(bone)
    if world.whole != "cable":
        spectra = bone + _behind(rng, scene, mirror) + _layers(rng, scene) + _speckle(rng, scene) + _probe(scene, mirror)
    if world.artefact:  # the end of the damping phase: the same time in every line
        typical = world.artefact * scene.height(float(np.median(world.thick_mm)))
        spectra = spectra + band.sum_of([(world.artefact_us, typical, 0.0)])
    present = rng.random(lines) > world.drop
    lost = rng.choice(["MISSING", "OUT_OF_VIEW", "INVALID"], lines)
    spacing = np.maximum(rng.normal(1, 0.02, lines), 0.8) / world.rate_hz
    numbered = not world.sweeps and world.whole not in ("air", "cable")
    recording = Recording(
        lines=_receive(rng, scene, spectra * band.pulse, noise),
        acquisition=world.acquisition,
        probe_to_reference=np.where(present[:, None, None], scene.stand.probe_to_reference, np.nan),
        statuses=tuple("OK" if seen else str(why) for seen, why in zip(present, lost)),
        timestamps_s=rng.uniform(0, 30) + np.cumsum(spacing),
        palpation_points=scene.way.place if numbered else np.full(lines, -1),
    )
    received = band.matched(bone * band.pulse, np.where(scene.bone, scene.stand.depth_mm, 5.0)) / noise
    snr = np.where(scene.bone, 20 * np.log10(np.maximum(received, 1e-6)), -np.inf)
    depth, tilt = (np.where(scene.bone, values, np.nan) for values in (scene.stand.depth_mm, scene.stand.tilt_deg))
    return recording, Truth(depth, tilt, world.speed_m_s, snr), world


def _scene(rng: np.random.Generator, world: Bedside, way: Way) -> Scene:
    """Where the bone is, and when it answers; the lines end behind the deepest of it."""
    stand = draw_stand(rng, world, way)
    lines, bone, speed = len(way.place), way.kind == "bone", world.speed_m_s / 1e3
    line_us: Array = np.zeros(lines)
    if world.acquisition.forerun_length_mm:
        warm = world.warming * (1 - 0.5 * np.exp(-np.arange(lines) / (2.0 * world.rate_hz)))
        line_us = 2e3 * world.acquisition.forerun_length_mm / world.acquisition.forerun_speed_m_s * (1 + warm)
    deepest = max(np.max(stand.depth_mm[bone], initial=0.0), SOFT_MM if world.whole else 0.0)
    mhz = world.acquisition.sampling_hz * 1e-6
    samples = max(int((line_us.max() + 2 * (deepest + world.behind_mm) / speed) * mhz) + 1, int(LEAST_US * mhz))
    shortened = np.cos(np.radians(stand.tilt_deg))  # a tilted mirror's nearest part answers a flat disc earlier
    way_mm = stand.depth_mm * (shortened if world.focus_deg else shortened**2)
    return Scene(
        world=world,
        way=way,
        stand=stand,
        band=Band(world, lines, samples),
        samples=samples,
        bone=bone,
        line_us=line_us,
        late_us=rng.normal(0, world.jitter_ns * 1e-3, lines),
        bone_us=np.where(bone, 2 * way_mm / speed, np.nan),
        bone_height=BONE_R * db(np.clip(wander(rng, lines, 0.8, 15.0)[:, 0], -2, 2)),
    )


def _bone(rng: np.random.Generator, scene: Scene, mirror: Array) -> Spectra:
    """The bone's specular echo, and its diffuse one: points that lie beside the axis, and so move with the tilt."""
    world, band = scene.world, scene.band
    arrival, loss = scene.face_us + scene.bone_us, band.loss_db(scene.stand.depth_mm)
    tilt = np.where(scene.bone, scene.stand.tilt_deg, 0.0)
    height = scene.bone_height * scene.through * scene.way.coupling
    strength = wander(rng, band.lines, 1.0, world.keeps_lines, SCATTERERS)
    beside_mm = rng.uniform(-1, 1, SCATTERERS) * max(0.6, 0.25 * world.disc_mm)
    deeper_mm = rng.normal(0, world.roughness_mm, SCATTERERS)
    spread = height * world.diffuse / np.sqrt(SCATTERERS) * np.exp(-((tilt / 15) ** 2))
    points = [
        (
            arrival + 2 * (beside_mm[one] * np.sin(np.radians(tilt)) + deeper_mm[one]) / scene.mm_us,
            spread * strength[:, one],
            loss,
        )
        for one in range(SCATTERERS)
    ]
    specular = band.sum_of([(arrival, height, loss)]) * mirror
    return np.asarray(specular + band.sum_of(points), dtype=np.complex64)


def _behind(rng: np.random.Generator, scene: Scene, mirror: Array) -> Spectra:
    """What comes after the bone: its inner table, what scatters between the tables, and what went the way again."""
    world, band, coupling = scene.world, scene.band, scene.way.coupling
    arrival, depth, height = scene.face_us + scene.bone_us, scene.stand.depth_mm, scene.bone_height
    loss = band.loss_db(depth)
    once = height * scene.through * coupling

    def inside(into_mm: float, strength: Array) -> Echo:
        return arrival + 2 * into_mm / BONE_MM_US, once * strength, loss + BONE_LOSS_DB * into_mm

    into_mm = rng.uniform(0.15, 1.0, DIPLOE) * world.skull_mm
    strength = wander(rng, band.lines, 0.5, world.keeps_lines, DIPLOE) * db(world.inner_db - 8)
    diploe = [inside(into_mm[one], strength[:, one]) for one in range(DIPLOE)]
    inner = inside(world.skull_mm, -db(world.inner_db))
    top = -world.face_r if world.acquisition.forerun_length_mm else world.back
    again = [
        (
            scene.face_us + times * scene.bone_us,
            height**times * top ** (times - 1) * coupling**times * scene.through,
            band.loss_db(times * depth),
        )
        for times in (2, 3)
    ]
    twice = band.directivity(np.where(scene.bone, 2 * scene.stand.tilt_deg, 0.0))
    spectra = band.sum_of(diploe) + mirror * (band.sum_of([inner]) + twice * band.sum_of(again))
    return np.asarray(spectra, dtype=np.complex64)


def _layers_of(rng: np.random.Generator, soft: bool, thick_mm: float) -> list[tuple[float, float]]:
    """Interfaces of one place: their depth over the tissue's thickness, and dB against bone."""
    if soft:
        return [(rng.uniform(1.5, 11) / thick_mm, rng.uniform(-25, -13)) for _ in range(rng.integers(2, LAYERS + 1))]
    layers = [(rng.uniform(0.22, 0.4), rng.uniform(-24, -10))]  # skin to fat
    if thick_mm > 3:  # the galea, just before the bone
        layers.append((1 - min(rng.uniform(0.7, 1.8) / thick_mm, 0.4), rng.uniform(-26, -14)))
    if thick_mm > 7:  # temporal fascia, or fat to muscle
        layers.append((rng.uniform(0.45, 0.75), rng.uniform(-24, -13)))
    return layers


def _layers(rng: np.random.Generator, scene: Scene) -> Spectra:
    """Interfaces with an undulation of their own, less directive than bone; behind a hole in the bone the dura."""
    world, way, band = scene.world, scene.way, scene.band
    depth = np.where(scene.bone, scene.stand.depth_mm, np.array(world.thick_mm)[way.place])
    soft = world.whole == "soft"
    share, height = np.full((2, len(world.thick_mm), LAYERS), np.nan)
    for place, thick in enumerate(world.thick_mm):
        layers = _layers_of(rng, soft, thick)
        share[place, : len(layers)], level = np.transpose(layers)
        height[place, : len(layers)] = BONE_R * db(level) * rng.choice([-1, 1], len(layers))
    total = np.zeros((band.lines, len(band.frequency)), dtype=np.complex64)
    for layer in range(LAYERS):
        if np.isnan(share[:, layer]).all():
            break
        layer_mm = share[way.place, layer] * (np.array(world.thick_mm)[way.place] if soft else depth)
        layer_mm = layer_mm * (1 + wander(rng, band.lines, 0.01, 20.0)[:, 0])
        own_deg = np.linalg.norm(0.8 * way.tilt_deg + wander(rng, band.lines, 1.2, 12.0, 2), axis=1)
        strength = np.where(way.contact, height[way.place, layer] * way.coupling * scene.through, 0.0)
        echo = band.sum_of([(scene.face_us + 2 * layer_mm / scene.mm_us, strength, band.loss_db(layer_mm))])
        total += echo * (0.8 * band.directivity(0.6 * own_deg) + 0.2).astype(np.float32)
    open_bone = way.kind == "hole"
    if open_bone.any():
        dura_mm = depth + rng.uniform(0.5, 2.0) + wander(rng, band.lines, 0.15, 15.0)[:, 0]
        strength = BONE_R * db(rng.uniform(-28, -20)) * way.coupling * open_bone
        echo = band.sum_of([(scene.face_us + 2 * dura_mm / scene.mm_us, strength, band.loss_db(dura_mm))])
        total += echo * (0.6 * band.directivity(np.linalg.norm(way.tilt_deg, axis=1)) + 0.4).astype(np.float32)
    return total


def _speckle(rng: np.random.Generator, scene: Scene) -> Spectra:
    """What scatters from the face to the bone, or to the line's end: slabs of a millimetre, attenuated each its way."""
    world, band = scene.world, scene.band
    ends_mm = np.where(scene.way.contact, np.inf, 0.0)
    ends_mm = np.where(scene.bone, scene.stand.depth_mm * np.cos(np.radians(scene.stand.tilt_deg)), ends_mm)
    total = np.zeros((band.lines, len(band.frequency)), dtype=np.complex64)
    field = rng.standard_normal((band.lines, band.coarse), dtype=np.float32)
    keeps = np.float32(np.exp(-1 / world.keeps_lines))
    fresh = np.float32(np.sqrt(1 - keeps**2))
    for row in range(1, band.lines):
        field[row] *= fresh
        field[row] += keeps * field[row - 1]
    time_us = np.arange(band.coarse) * (band.slower / band.mhz)
    depth_mm = (time_us - scene.face_us[:, None]) * (scene.mm_us / 2)
    field *= (depth_mm >= 0) & (depth_mm < ends_mm[:, None])
    reach_mm = min((scene.samples / band.mhz - scene.line_us.min()) * scene.mm_us / 2, float(ends_mm.max()))
    bins = slice(band.first, band.first + len(band.frequency))
    slab = np.floor(depth_mm).astype(np.int16)
    for number in range(int(np.ceil(reach_mm))):
        echoes = scipy.fft.rfft(field * (slab == number), axis=1)[:, bins]
        left = band.attenuated(number + 0.5) * (2.0 if number < 2 else 1.0)  # the skin scatters more
        total += echoes * left.astype(np.float32)
    gain = np.sqrt(2 * np.sum(np.abs(band.pulse) ** 2) / band.size)  # of the pulse, for a reflectivity without memory
    level = BONE_R * world.speckle / (gain * np.sqrt(2)) * np.sqrt(band.size / band.coarse)
    return np.asarray(total * (level * scene.way.coupling * scene.through)[:, None], dtype=np.complex64)


def _probe(scene: Scene, mirror: Array) -> Spectra:
    """The main bang, and the delay line's face with its multiples, one of them by way of the bone; or the ring-down."""
    world, way, band = scene.world, scene.way, scene.band
    line_us, late_us = scene.line_us, scene.late_us
    if world.acquisition.forerun_length_mm:
        again = world.back * scene.line_loss
        face = np.where(way.contact, way.coupling * world.face_r - 0.9 * (1 - way.coupling), -0.97)
        echoes: list[Echo] = [(late_us, 0.5 / scene.line_loss, 0.0)]
        echoes += [(times * line_us + late_us, face**times * again ** (times - 1), 0.0) for times in (1, 2, 3)]
        height = 2 * face * again * scene.bone_height * scene.through * way.coupling
        cross = band.sum_of([(2 * line_us + late_us + scene.bone_us, height, band.loss_db(scene.stand.depth_mm))])
        return np.asarray(band.sum_of(echoes) + cross * mirror, dtype=np.complex64)
    damping = np.where(way.contact, 1.0, 1.5)
    echoes = [(late_us, 8.0, 0.0)]
    for number in range(1, 14):
        sign = 1 if number % 2 else -1
        echoes.append((late_us + number * 0.45 / band.centre, sign * 1.2 * np.exp(-number / 1.1) * damping, 0.0))
    return band.sum_of(echoes)


def _noise_density(rng: np.random.Generator, scene: Scene) -> float:
    """The noise: so much under an upright bone in the deepest place; where there is no bone one sees the tissue over it."""
    world, band = scene.world, scene.band
    deepest = max(world.thick_mm)
    noise = float(band.matched(scene.upright(deepest), deepest)[0] / db(world.snr_db))
    if world.whole == "soft":
        seen_mm = SEEN_MM
    elif (scene.way.kind == "hole").any():
        seen_mm = deepest + 1.5
    else:
        return noise
    speckle = band.matched(scene.upright(seen_mm), seen_mm)[0] * world.speckle / np.sqrt(2)
    allowed = float(speckle / db(rng.uniform(4, 12)))
    return allowed if world.whole else min(noise, allowed)


def _receive(rng: np.random.Generator, scene: Scene, spectra: Spectra, noise: float) -> npt.NDArray[np.int16]:
    """Noise, spikes, base line, and codes."""
    world, band = scene.world, scene.band
    frequency = np.arange(band.size // 2 + 1) * band.step_mhz
    colour = band.noise_colour(frequency)
    whole = rng.standard_normal((band.lines, 2 * len(frequency)), dtype=np.float32).view(np.complex64)
    whole *= (noise * np.sqrt(band.size / 2) * colour).astype(np.float32)
    whole[:, band.first : band.first + len(band.frequency)] += spectra
    rf = scipy.fft.irfft(whole, band.size, axis=1)[:, : scene.samples]
    unrest = noise * float(np.sqrt(np.mean(colour**2)))
    if world.spikes:
        _add_spikes(rng, rf, unrest)
    if world.whole:
        full = 0.35 * np.percentile(np.abs(rf[:, int(1.5 * band.mhz) :]), 99.9)
    else:
        full = scene.height(min(world.thick_mm)) * world.headroom
    full = max(float(full), 5 * unrest)
    drift = world.drift * np.exp(-np.arange(scene.samples) / (8 * band.mhz)) + world.offset
    rf += (full * drift).astype(np.float32)
    rf += (full * 0.01 * wander(rng, band.lines, 1.0, 20.0)).astype(np.float32)
    bits = world.bits
    while full / 2 ** (bits - 1) > unrest and bits < MOST_BITS:  # nobody records with the noise below one step
        bits += 2
    codes = 2 ** (bits - 1)
    rf *= np.float32(codes / full)
    shift = 2 ** (MOST_BITS - bits) if world.left_justified else 1
    return (np.clip(np.rint(rf), -codes, codes - 1) * shift).astype(np.int16)


def _add_spikes(rng: np.random.Generator, rf: npt.NDArray[np.float32], unrest: float) -> None:
    """Some of the lines get a few short discharges."""
    for row in np.flatnonzero(rng.random(len(rf)) < 0.12):
        for sample in rng.integers(0, rf.shape[1] - 2, rng.integers(1, 4)):
            height = unrest * rng.uniform(8, 40)
            rf[row, sample] += height * rng.choice([-1, 1])
            rf[row, sample + 1] -= 0.5 * height
