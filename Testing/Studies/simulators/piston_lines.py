"""Simulated A-lines of a flat disc that answers a mirror as diffraction has it, in the hand of one who dwells or sweeps.

Other families weaken the echo of tilted bone by a lobe. Here each frequency has its own, 2 J1(x) / x of a disc, with zeros and
side lobes: a tilted echo is not only fainter, it is duller and longer. The mirror's echo comes from the nearest point of a
sphere, while a faint diffuse one comes from the footprint along the beam and stays when the mirror's is gone. The pulse has a
gamma envelope and any phase; layers answer at angles of their own, never louder than bone of their place; a film of gel on hair
reverberates at the face; and of each line the world says what an acceptance test takes it for.
Probe, hand, skull and poses are drawn in piston_plan.py; the pulse and the disc are in piston_pulse.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.piston_plan import (
    Array,
    Bools,
    Hand,
    Setup,
    Words,
    World,
    draw_hand,
    draw_poses,
    draw_setup,
    draw_statuses,
    draw_timestamps,
    wander,
)
from Testing.Studies.simulators.piston_pulse import Complex, Floats, Pulse

SLAB_MM = 3.0  # of tissue whose speckle is attenuated alike
SPOTS = 8  # of the rough bone in the footprint
MULTIPLES = 4
AIR_R = -0.95
BELOW_BONE = 0.7  # no layer answers louder, of bone of the same place
MOST_SNR_DB = 46.0  # of the weakest place: an instrument that shows still fainter things is not offered
SQUARE_DEG, TILTED_DEG, LEAST_SNR_DB = 3.0, 8.0, 12.0


@dataclass(frozen=True, eq=False)
class Scene:
    """What the probe meets in each of n lines; heights are over that of the echo of a perfect mirror at the face."""

    setup: Setup
    hand: Hand
    pulse: Pulse
    skin_us: Array  # (n,) with the trigger's jitter
    coupling: Array  # (n,) 0: not in contact
    bone_r: float  # amplitude that bone reflects
    bone: Array  # (n,) height of its echo before tilt and attenuation
    speckle: float  # RMS
    visible_mm: float  # to here tissue without bone must show
    noise: float  # RMS

    @property
    def bare(self) -> Bools:
        """Contact, and no bone below."""
        without = self.hand.soft | (self.hand.hole == 2) | (self.setup.without == "tissue")
        return np.asarray(self.hand.touching & without)

    @property
    def seen(self) -> Bools:
        """Bone is in the beam."""
        return self.hand.touching & ~self.bare

    @property
    def square_bone(self) -> Array:
        """Height of bone's echo, met squarely, at each place (places,)."""
        return self.bone_r * self.pulse.height(self.hand.thick_mm)

    def arrival_us(self, depth_mm: npt.ArrayLike) -> Array:
        """When echoes from depths (n,) come."""
        return np.asarray(self.skin_us + np.asarray(depth_mm) / self.setup.mm_per_us)


def _draw_scene(rng: np.random.Generator, setup: Setup, hand: Hand) -> Scene:
    """Delay line, contact and levels: the noise leaves visible what must be seen, or that is not there."""
    count, stated = len(hand.place), setup.acquisition
    late = 1 + setup.late + setup.warming * np.linspace(0, 1, count)
    skin_us = 2e3 * stated.forerun_length_mm / (stated.forerun_speed_m_s or 1.0) * late + rng.normal(0, 0.003, count)
    reach_mm = max(1.15 * setup.deepest_mm, 8.0) + rng.uniform(5, 12)
    pulse = Pulse(setup, int((skin_us.max() + reach_mm / setup.mm_per_us) * setup.sampling_mhz))
    bone_r = float(rng.uniform(0.52, 0.65))
    speckle = bone_r * float(10 ** (-rng.uniform(34, 44) / 20))
    visible_mm = max(10.0, setup.deepest_mm + (7 if hand.hole.any() else 2))
    faintest = speckle * float(pulse.height(visible_mm)) / 1.4
    gaps = bool(hand.hole.any() or hand.soft.any())
    if gaps and faintest < bone_r * pulse.height(hand.thick_mm).min() * 10 ** (-MOST_SNR_DB / 20):
        hand, gaps = replace(hand, hole=np.zeros_like(hand.hole), soft=np.zeros_like(hand.soft)), False
    noise = bone_r * float(pulse.height(hand.thick_mm.max())) * 10 ** (-setup.snr_db / 20)
    if gaps or setup.without == "tissue":
        noise = min(noise, faintest)
    if setup.face_r:
        noise = min(noise, abs(setup.face_r) / 6)  # the delay line's own echo stays readable in contact
    coupling = np.clip(1 + wander(rng, 0.5 * setup.rate_hz, 0.08, (count, 1))[:, 0], 0.7, 1.2)
    coupling *= np.where(hand.kind == "landing", rng.uniform(0.05, 0.8, count), 1.0) * hand.touching
    scene = Scene(setup, hand, pulse, skin_us, coupling, bone_r, np.zeros(count), speckle, visible_mm, noise)
    on_edge = np.where(hand.hole == 1, rng.random(count), 1.0)
    return replace(scene, bone=bone_r * coupling * scene.seen * on_edge)


def _bone(scene: Scene, rng: np.random.Generator) -> Complex:
    """The echo of bone, over the pulse (n, band): a mirror's from its nearest point, and rough spots' in the footprint."""
    setup, hand, pulse = scene.setup, scene.hand, scene.pulse
    mirror = pulse.series(scene.arrival_us(hand.square_mm), scene.bone, hand.depth_mm)
    mirror *= pulse.mirror(hand.angle, setup.aperture_mm)
    spread_mm = rng.uniform(0.25, 0.45) * setup.aperture_mm / 2
    spots = rng.normal(0, spread_mm, (hand.places, SPOTS, 2))[hand.place]
    spots += np.cumsum(rng.normal(0, 0.03 * spread_mm, spots.shape), axis=0)
    rough_mm = 0.03 * rng.normal(size=(hand.places, SPOTS))[hand.place]
    further_mm = np.clip(np.sum(spots * hand.tilt[:, None, :], axis=2) + rough_mm, -0.4, 0.4)
    diffuse = 1.4 * 10 ** (-rng.uniform(22, 32) / 20) / np.sqrt(SPOTS)
    height = scene.bone[:, None] * diffuse * rng.choice([-1, 1], (hand.places, SPOTS))[hand.place]
    depth = np.repeat(hand.depth_mm[:, None], SPOTS, axis=1)
    arrival = scene.skin_us[:, None] + (depth + further_mm) / setup.mm_per_us
    return np.asarray(mirror + pulse.series(arrival, height, depth))


def _bone_heights(scene: Scene, bone: Complex) -> Array:
    """Peak of the envelope of bone's echo (n,)."""
    pulse, every = scene.pulse, scene.pulse.sparse
    turns = scene.arrival_us(scene.hand.depth_mm)[:, None] * pulse.mhz[::every]
    around_zero = np.zeros_like(bone)
    around_zero[:, ::every] = bone[:, ::every] * np.exp(2j * np.pi * turns)
    return pulse.peaks(around_zero)


def _behind_bone(scene: Scene, rng: np.random.Generator) -> Complex:
    """Bone again by way of the probe's face, the inner table, and what is heard of the diploe for a while."""
    setup, hand, pulse = scene.setup, scene.hand, scene.pulse
    back = setup.face_r or rng.uniform(0.1, 0.35)
    again_us = scene.arrival_us(2 * hand.square_mm)
    total = pulse.series(again_us, -0.7 * scene.bone_r * back * scene.bone, 2 * hand.depth_mm)
    total *= pulse.mirror(2 * hand.angle, setup.aperture_mm)
    thick_mm = rng.uniform(2, 6, hand.places)[hand.place]  # of the outer table or the whole skull
    inner_us = scene.arrival_us(hand.square_mm) + 2e3 * thick_mm / rng.uniform(2700, 3200)
    inner = pulse.series(inner_us, -(10 ** (-rng.uniform(16, 34) / 20)) * scene.bone, hand.depth_mm)
    total += inner * pulse.mirror(hand.angle + 0.03, setup.aperture_mm)
    total += _diploe(scene, rng)
    return total


def _diploe(scene: Scene, rng: np.random.Generator) -> Complex:
    """Clutter that begins shortly after bone and dies away, over the pulse (n, band)."""
    pulse, mhz = scene.pulse, scene.setup.sampling_mhz
    bone_us = scene.arrival_us(scene.hand.depth_mm)
    fades_us, level = rng.uniform(1.0, 2.5), 10 ** (-rng.uniform(20, 34) / 20)
    first = int(bone_us.min() * mhz)
    last = min(pulse.size, int((bone_us.max() + 10 * fades_us) * mhz))
    after = (np.arange(first, last) / mhz - bone_us[:, None]).astype(np.float32)
    source = np.zeros((len(bone_us), pulse.size), dtype=np.float32)
    source[:, first:last] = np.exp(-np.maximum(after, 0) * np.float32(1 / fades_us)) * (after > 0.2)
    source[:, first:last] *= (
        _scatterers(scene, rng, last - first) * (scene.bone * level / pulse.energy).astype(np.float32)[:, None]
    )
    return np.asarray(scipy.fft.rfft(source, axis=1)[:, pulse.band] * pulse.loss(scene.hand.depth_mm))


def _scatterers(scene: Scene, rng: np.random.Generator, samples: int) -> Floats:
    """Normal numbers (n, samples), each line's like the line's before: more so when the probe stays."""
    stays = (np.diff(scene.hand.place) == 0) & (not scene.setup.sweeps)
    field = rng.standard_normal((len(scene.skin_us), samples), dtype=np.float32)
    for row, keep in enumerate(np.where(stays, 0.93, 0.6), start=1):
        field[row] *= np.float32(np.sqrt(1 - keep**2))
        field[row] += np.float32(keep) * field[row - 1]
    return field


def _draw_layers(rng: np.random.Generator, thick: float, visible_mm: float) -> tuple[list[float], list[float], int]:
    """Depths and reflections of what lies in the tissue of a place; the last three only where there is no bone."""
    depths = [min(rng.uniform(1.1, 2), 0.45 * thick), rng.uniform(0.55, 0.8) * thick]  # dermis, galea
    levels = [rng.uniform(-0.05, -0.01), rng.choice([-1, 1], p=[0.3, 0.7]) * rng.uniform(0.015, 0.09)]
    if thick > 4 and rng.random() < 0.6:  # loose tissue, periosteum
        depths.append(thick - rng.uniform(0.5, 1.0))
        levels.append(rng.uniform(0.008, 0.03))
    if thick > 7:  # muscle, fascia
        for _ in range(int(rng.integers(1, 3))):
            depths.append(rng.uniform(0.25, 0.9) * thick)
            levels.append(rng.choice([-1, 1]) * rng.uniform(0.01, 0.08))
    over_bone = len(depths)
    for _ in range(3):
        depths.append(rng.uniform(min(thick, visible_mm - 4), visible_mm - 1.5))
        levels.append(rng.choice([-1, 1]) * rng.uniform(0.01, 0.08))
    return depths, levels, over_bone


def _layers(scene: Scene, rng: np.random.Generator) -> Complex:
    """The tissue's layers, at angles of their own, and dura under a burr hole, over the pulse (n, band)."""
    setup, hand, pulse = scene.setup, scene.hand, scene.pulse
    own_tilt = np.radians(rng.normal(0, 1.5, (hand.places, 2)))[hand.place]
    aperture = setup.aperture_mm * rng.uniform(0.3, 0.6)
    height, depth = (np.zeros((len(hand.place), 8)) for _ in range(2))
    for number, (thick, bone) in enumerate(zip(hand.thick_mm, scene.square_bone)):
        depths, levels, over_bone = _draw_layers(rng, float(thick), scene.visible_mm)
        most = BELOW_BONE * bone / pulse.height(depths)
        reflect = np.clip(levels, -most, most)
        rows = np.flatnonzero(hand.place == number)
        there = np.where(
            np.arange(len(depths)) < over_bone, scene.coupling[rows, None], (scene.coupling * scene.bare)[rows, None]
        )
        height[rows, : len(depths)] = reflect * there
        depth[rows, : len(depths)] = depths * (hand.depth_mm[rows] / thick * np.cos(hand.angle[rows]))[:, None]
    total = pulse.series(scene.skin_us[:, None] + depth / setup.mm_per_us, height, depth)
    total *= pulse.mirror(np.hypot(*(hand.tilt + own_tilt).T), aperture)
    if (hand.hole == 2).any():
        high = 0.05 * scene.coupling * (hand.hole == 2)
        dura = pulse.series(scene.arrival_us(hand.square_mm + 6), high, hand.depth_mm + 6)
        total += dura * pulse.mirror(hand.angle, setup.aperture_mm)
    return total


def _face(scene: Scene, rng: np.random.Generator, bang: float) -> Complex:
    """The transmitted pulse, the delay line's echoes, bone heard through them, and gel on hair, over the pulse (n, band)."""
    setup, hand, pulse, skin = scene.setup, scene.hand, scene.pulse, scene.skin_us
    count = len(skin)
    echoes: list[tuple[Array, Array]] = [(np.zeros(count), np.full(count, bang))]
    hair = (hand.kind == "hair") * 0.3
    for number in range(1, MULTIPLES + 1):  # dies out within 1.5 mm
        echoes.append((skin + number * rng.uniform(0.35, 0.45), hair * 0.45**number * rng.uniform(0.5, 1, count)))
    total = np.zeros((count, len(pulse.mhz)), dtype=np.complex64)
    if setup.face_r:
        wet = setup.face_r * np.clip(1 + wander(rng, 0.5 * setup.rate_hz, 0.1, (count, 1))[:, 0], 0.6, 1.4)
        if setup.without == "gel":
            wet[:] = 0.8 * setup.face_r
        partly = scene.coupling * setup.face_r + (1 - np.clip(scene.coupling, 0, 1)) * AIR_R
        wet = np.where(hand.kind == "landing", partly, wet)
        face = np.where(hand.touching | (setup.without == "gel"), wet, AIR_R)
        back = rng.uniform(0.2, 0.5)
        echoes += [(number * skin, face**number * back ** (number - 1)) for number in range(1, MULTIPLES + 1)]
        late_us = scene.arrival_us(hand.square_mm) + skin
        total += pulse.series(late_us, 2 * back * face * scene.bone, hand.depth_mm)
        total *= pulse.mirror(hand.angle, setup.aperture_mm)
    time, height = (np.stack(column, axis=1) for column in zip(*echoes))
    return np.asarray(total + pulse.series(time, height, np.zeros_like(time)))


def _ring_down(scene: Scene, rng: np.random.Generator, bang: float) -> Floats:
    """What the element does after the transmitted pulse (samples,); with a delay line it has ended when bone comes."""
    setup = scene.setup
    time = np.arange(scene.pulse.samples) / setup.sampling_mhz
    fades_us = rng.uniform(0.25, 0.7)
    first_us = scene.skin_us.min() + max(1.8, scene.hand.depth_mm.min()) / setup.mm_per_us
    at_bone = rng.uniform(0.03, 0.25) * scene.square_bone.min()
    height = 0.3 * bang if setup.face_r else min(0.5 * bang, at_bone * np.exp(first_us / fades_us))
    wave = height * np.exp(-time / fades_us) * np.cos(2 * np.pi * 0.93 * setup.centre_mhz * time) * (time > 0.3)
    return np.asarray(wave, dtype=np.float32)


def _received(scene: Scene, rng: np.random.Generator, spectra: Complex) -> Floats:
    """Lines (n, samples) of the echoes, and of noise that is white within the receiver's band."""
    setup, pulse = scene.setup, scene.pulse
    mhz = np.arange(pulse.size // 2 + 1) * pulse.step_mhz
    highest = min(2.5 * setup.centre_mhz, 0.45 * setup.sampling_mhz)
    band = (mhz > 0.05 * setup.centre_mhz) / np.sqrt(1 + (mhz / highest) ** 8)
    whole = rng.standard_normal((len(spectra), 2 * len(mhz)), dtype=np.float32).view(np.complex64)
    whole *= (band * (0.5 * pulse.size * scene.noise / np.linalg.norm(band))).astype(np.float32)
    whole[:, pulse.band] += spectra * pulse.spectrum
    return np.asarray(scipy.fft.irfft(whole, pulse.size, axis=1)[:, : pulse.samples])


def _add_speckle(scene: Scene, rng: np.random.Generator, rf: Floats) -> None:
    """Put in what scatters in the tissue, down to the bone: the pulse, attenuated as in the middle of a slab of depth."""
    if not scene.hand.touching.any():
        return
    setup, pulse, mean_us = scene.setup, scene.pulse, float(scene.skin_us.mean())
    to_mm = np.float32(setup.mm_per_us)
    time = (np.arange(rf.shape[1]) / setup.sampling_mhz).astype(np.float32)
    ends = np.where(scene.seen, scene.hand.depth_mm, 99.0).astype(np.float32)
    ends[~scene.hand.touching] = 0.0
    there = (time - scene.skin_us.astype(np.float32)[:, None]) * to_mm < ends[:, None]
    average_mm = (time - mean_us) * to_mm
    there &= average_mm > 0.3
    used = int(np.flatnonzero(there.any(axis=0))[-1]) + 1
    source = _scatterers(scene, rng, used) * (scene.speckle / pulse.energy * scene.coupling).astype(np.float32)[:, None]
    source *= there[:, :used]
    edges = np.searchsorted(average_mm[:used], np.arange(0, average_mm[used - 1] + SLAB_MM, SLAB_MM))
    for number, (start, stop) in enumerate(zip(edges[:-1], edges[1:])):
        rows = np.flatnonzero(there[:, start:stop].any(axis=1))
        kernel, zero = pulse.kernel((number + 0.5) * SLAB_MM)
        length = stop - start + len(kernel) - 1
        size = scipy.fft.next_fast_len(length, real=True)
        wave = scipy.fft.irfft(
            scipy.fft.rfft(source[rows, start:stop], size, axis=1) * scipy.fft.rfft(kernel, size), size, axis=1
        )
        first, last = max(start - zero, 0), min(start - zero + length, rf.shape[1])
        rf[rows, first:last] += wave[:, first - start + zero : last - start + zero]


def _add_spikes(scene: Scene, rng: np.random.Generator, rf: Floats) -> None:
    """Put in the spikes that one recording in five has, on an eighth of its lines."""
    if rng.random() >= 0.2:
        return
    for row in np.flatnonzero(rng.random(len(rf)) < 0.12):
        first = int(rng.integers(0, rf.shape[1] - 3))
        rf[row, first : first + int(rng.integers(1, 4))] += rng.choice([-1, 1]) * rng.uniform(0.3, 1.2) * scene.square_bone.mean()


def _convert(scene: Scene, rng: np.random.Generator, rf: Floats) -> tuple[npt.NDArray[np.int16], float]:
    """The lines as codes, over an offset that drifts and hums, and the height that fills the converter."""
    setup, bone = scene.setup, float(scene.square_bone.max())
    fullest = bone / rng.uniform(1.3, 2.5) if setup.overdriven else max(bone, abs(setup.face_r)) / rng.uniform(0.35, 0.9)
    bits = setup.bits
    while bits < 16 and scene.noise / fullest * 2 ** (bits - 1) < 0.7:
        bits += 2
    codes = 2 ** (bits - 1)
    time = np.arange(rf.shape[1]) / setup.sampling_mhz
    base = rng.uniform(-0.02, 0.02) + rng.uniform(-0.04, 0.04) * np.exp(-time / rng.uniform(4, 12))
    hum = np.exp(2j * np.pi * rng.uniform(0.02, 0.06) * setup.centre_mhz * time) * (0.01 * codes)
    phase = 2 * np.pi * rng.random((len(rf), 1))
    rf *= np.float32(codes / fullest)
    rf += (base * codes).astype(np.float32)
    rf += np.sin(phase).astype(np.float32) * hum.real.astype(np.float32)
    rf += np.cos(phase).astype(np.float32) * hum.imag.astype(np.float32)
    np.rint(rf, out=rf)
    return np.clip(rf, -codes, codes - 1, out=rf).astype(np.int16), float(fullest)


def _judge(scene: Scene, snr_db: Array, clipped: Bools) -> tuple[Words, Bools]:
    """What each line is for an acceptance test (n,), and which lines it leaves out (n,)."""
    hand, seen = scene.hand, scene.seen
    held, tilt_deg = hand.touching & (hand.kind != "landing"), np.degrees(hand.angle)
    faint = seen & (snr_db < LEAST_SNR_DB) & (tilt_deg < SQUARE_DEG)
    kind = hand.kind.copy()
    kind[held] = "bone"
    kind[held & seen & (tilt_deg >= SQUARE_DEG)] = "tilted"
    kind[held & seen & (tilt_deg >= TILTED_DEG)] = "steep"
    kind[held & faint] = "faint"
    kind[held & seen & clipped] = "clipped"
    kind[held & (hand.soft | (scene.setup.without == "tissue"))] = "soft"
    kind[held & (hand.hole == 2)] = "hole"
    kind[held & (hand.hole == 1)] = "hole-edge"
    return kind, np.isin(kind, ["landing", "hole-edge"]) | (seen & clipped) | faint


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, World]:
    """A recording of about `frames` lines, at least LEAST_LINES, the truth about it, and what it was drawn from."""
    setup = setup or draw_setup(rng)
    scene = _draw_scene(rng, setup, draw_hand(rng, setup, frames))
    hand, bang = scene.hand, float(rng.uniform(3, 10))
    heights: Array = np.zeros(len(hand.place))
    spectra = np.zeros((len(hand.place), len(scene.pulse.mhz)), dtype=np.complex64)
    if scene.seen.any():
        spectra += _bone(scene, rng)
        heights = _bone_heights(scene, spectra)
        spectra += _behind_bone(scene, rng)
    if hand.touching.any():
        spectra += _layers(scene, rng)
    if setup.without != "cable":
        spectra += _face(scene, rng, bang)
    rf = _received(scene, rng, spectra)
    _add_speckle(scene, rng, rf)
    if setup.without != "cable":
        rf += _ring_down(scene, rng, bang)
    _add_spikes(scene, rng, rf)
    lines, fullest = _convert(scene, rng, rf)
    statuses = draw_statuses(rng, len(lines))
    lost = np.array([status != "OK" for status in statuses])
    recording = Recording(
        lines=lines,
        acquisition=setup.acquisition,
        probe_to_reference=np.where(lost[:, None, None], np.nan, draw_poses(rng, setup, hand)),
        statuses=statuses,
        timestamps_s=draw_timestamps(rng, setup, hand),
        palpation_points=np.full(len(lines), -1) if setup.sweeps else hand.place,
    )
    snr_db = np.where(scene.seen, 20 * np.log10(np.maximum(heights, 1e-12) / scene.noise), -np.inf)
    kind, ignore = _judge(scene, snr_db, heights / fullest > 0.97)
    deepest_db = 20 * np.log10(scene.square_bone.min() / scene.noise)
    world = World(**(vars(setup) | {"snr_db": float(deepest_db)}), kind=kind, ignore=ignore, skin_us=scene.skin_us)
    depth = np.where(scene.seen, hand.depth_mm, np.nan)
    return recording, Truth(depth, np.degrees(hand.angle), setup.speed_m_s, snr_db), world
