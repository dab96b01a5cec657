"""Simulated A-lines of strokes and dwells in which every echo is one pulse, attenuated and dispersed as causality demands.

Other families attenuate without dispersion, or keep the pulse's phase: here the phase of each echo turns with its depth, around a
speed of sound that is the group's. Bone has a specular part that tilt dims and a diffuse one that follows the roughness from line
to line; eighty scatterers move with the hand instead of filtered noise. The delay line's echo takes its sign and height from the
scalp's impedance, grows to a total one where hair or a bubble takes the contact away, and comes back with bone's echo riding on
it. Strokes cross defects with edges; gains are too high, bits few. What a recording is drawn from is in stroke_plan.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.stroke_plan import (
    MATERIALS,
    Array,
    Bools,
    Hand,
    Rows,
    World,
    decibel,
    draw_hand,
    draw_poses,
    draw_statuses,
    draw_times,
    draw_world,
    wander,
)

Waves = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]

NEPER = np.log(10) / 20  # a decibel
BLOCK = 32  # frequencies a block of a geometric series
FAINT = 1e-4  # of a pulse's largest frequency: not simulated below
STRONG = 0.02  # of a pulse's largest frequency: so far out the dispersion is exact to DISPERSION_ERROR
DISPERSION_ERROR = 2e-3
MOST_NODES = 7
GUARD_US, HEARD_US = 4.0, 2.0  # behind the last sample: what begins there goes round to the first; echoes end before
SKULL_MM_US = 2.9
TYPICAL_BONE_R = 0.55
AIR_R = -1.0
GAP_DB = -62.0  # coupling through hair or a bubble
FINE_ECHOES, SCATTERERS, LAYERS = 10, 80, 6
UNWETTED = ["air", "unplugged"]
WITH_BONE = ["bone", "gap", "halfwet"]
CONVERTERS = [10, 12, 14]  # bits; 16 when none of them sees the noise


class Band:
    """The frequencies that a pulse has, and sums of its echoes: the envelope of an echo that lost nothing peaks at its time."""

    def __init__(self, world: World, samples: int) -> None:
        self.samples, self.sampling_mhz = samples, world.acquisition.sampling_hz * 1e-6
        self.size = scipy.fft.next_fast_len(samples + int(GUARD_US * self.sampling_mhz), real=True)
        self.step_mhz = self.sampling_mhz / self.size
        self.centre_mhz = world.centre_mhz
        self.last_us = samples / self.sampling_mhz + HEARD_US
        half = np.sqrt(2 * np.log(2)) / (np.pi * world.bandwidth * world.centre_mhz)
        rise_us = 1.1 * np.sqrt(2) * half / (1 + world.skew)
        self.fall_us = rise_us * world.skew
        time = ((np.arange(self.size) + self.size // 2) % self.size - self.size // 2) / self.sampling_mhz
        width = np.where(time < 0, rise_us, self.fall_us)
        pulse = np.exp(-0.5 * (time / width) ** 2 + 1j * (2 * np.pi * world.centre_mhz * time + world.phase))
        spectrum = scipy.fft.fft(pulse)[: self.size // 2]
        every = np.arange(self.size // 2) * self.step_mhz
        inside = (every > 0.1 * world.centre_mhz) & (every < 0.49 * self.sampling_mhz)
        heard = np.flatnonzero((np.abs(spectrum) > FAINT * np.abs(spectrum).max()) & inside)
        self.bins = slice(int(heard[0]), int(heard[-1]) + 1)
        self.mhz, self.pulse = every[self.bins], spectrum[self.bins].astype(np.complex64)
        # dispersion that belongs to the attenuation, less what only turns the phase; zero at the centre, with its slope
        self.bend_mhz = self.mhz * (np.log(self.mhz / self.centre_mhz) - 1) + self.centre_mhz
        level = np.abs(self.pulse)
        self.most_bend_mhz = float(self.bend_mhz[level > STRONG * level.max()].max())

    def series(self, echoes: Echoes) -> Complex:
        """Sums of echoes over the pulse (n, band).

        Delay and attenuation are geometric series in frequency: powers within a block times powers of whole blocks. Dispersion is
        not; it is interpolated between a few nodes of attenuation.
        """
        lost = NEPER * echoes.loss  # neper/MHz
        height = np.where(echoes.time_us < self.last_us, echoes.height, 0.0)
        turn = np.exp(-2j / np.pi * self.centre_mhz * lost)
        nodes = self._nodes(lost[height != 0])
        shares = _lagrange(lost, nodes) * (height * turn).astype(np.complex64)[:, None, :]
        blocks = -(-len(self.mhz) // BLOCK)
        starts = self.mhz[0] + np.arange(blocks) * (BLOCK * self.step_mhz)
        coarse = _powers(echoes.time_us, lost, starts)[:, None] * shares[:, :, None]  # (n, nodes, blocks, m)
        fine = _powers(echoes.time_us, lost, np.arange(BLOCK) * self.step_mhz).transpose(0, 2, 1)  # (n, m, BLOCK)
        lines, echo_count = lost.shape
        sums = np.matmul(coarse.reshape(lines, -1, echo_count), fine).reshape(lines, len(nodes), -1)[:, :, : len(self.mhz)]
        bends = np.exp(2j / np.pi * np.outer(nodes, self.bend_mhz)).astype(np.complex64)
        total = (sums * bends).sum(axis=1)
        if echoes.askew.any():  # the wider the aperture in wavelengths, the narrower the lobe
            total *= np.exp(-np.log(2) * np.outer(echoes.askew, self.mhz / self.centre_mhz) ** 2).astype(np.float32)
        return np.asarray(total)

    def _nodes(self, lost: Array) -> Array:
        """Attenuations (Chebyshev's) between which the dispersion's phase may be interpolated."""
        if not lost.size:
            return np.zeros(1)
        low, high = float(lost.min()), float(lost.max())
        half = (high - low) / np.pi * self.most_bend_mhz
        errors = [half**count / (factorial(count) * 2 ** (count - 1)) for count in range(1, MOST_NODES)]
        count = 1 + sum(error > DISPERSION_ERROR for error in errors)
        places = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        return np.asarray((low + high) / 2 + (high - low) / 2 * places)

    def analytic(self, spectra: Complex) -> Complex:
        """Lines (n, samples) of sums over the pulse: their real part is received, their magnitude is the envelope."""
        full = np.zeros((len(spectra), self.size), dtype=np.complex64)
        np.multiply(spectra, self.pulse, out=full[:, self.bins])
        return np.asarray(scipy.fft.ifft(full, axis=1, overwrite_x=True)[:, : self.samples])


def _lagrange(values: Array, nodes: Array) -> Waves:
    """Weights (n, nodes, m) of the nodes at values (n, m)."""
    weights = np.ones((len(values), len(nodes), values.shape[1]), dtype=np.float32)
    for one, node in enumerate(nodes):
        for other in np.delete(nodes, one):
            weights[:, one] *= (values - other) / (node - other)
    return weights


def _powers(time_us: Array, lost: Array, mhz: Array) -> Complex:
    """exp(-(2 pi i time + lost) mhz) (n, k, m) for echoes (n, m) and frequencies (k,)."""
    turns = time_us[:, None, :] * mhz[:, None]
    angle = ((turns - np.rint(turns)) * (-2 * np.pi)).astype(np.float32)
    height = np.exp((lost[:, None, :] * -mhz[:, None]).astype(np.float32))
    powers = np.empty(angle.shape, dtype=np.complex64)
    powers.real = np.cos(angle) * height
    powers.imag = np.sin(angle) * height
    return powers


@dataclass(frozen=True, eq=False)
class Echoes:
    """Echoes in each of n lines; all of them answer tilt alike."""

    height: Array  # (n, m) before any loss
    time_us: Array  # (n, m)
    loss: Array  # (n, m) dB/MHz, with the dispersion that belongs to it
    askew: Array  # (n,) tilt over the one at which the pulse's centre has lost 6 dB; 0: they answer all tilts


class Scene:
    """What lies under the probe in each line, and how well it couples."""

    def __init__(self, world: World, hand: Hand, rng: np.random.Generator) -> None:
        self.world, self.hand, self.rng = world, hand, rng
        self.lines, self.places = len(hand.place), len(world.place_mm)
        self.skin_us = world.delay_us * (1 + world.late + world.warming * hand.progress)
        self.coupling = self._draw_coupling()
        self.edge = hand.state == "edge"
        self.boned = np.isin(hand.state, WITH_BONE) & hand.solid
        self.soft = (hand.state == "soft") | ~(self.boned | self.edge)
        self.face_r = self._draw_face()
        there = np.where(self.edge, rng.uniform(0.1, 0.7, self.lines), self.boned)
        self.bone = there * self.coupling * self.each(rng.uniform(0.45, 0.65, self.places))  # height before all loss
        self.found: list[Echoes] = []

    def each(self, of_places: npt.NDArray[np.float64]) -> Array:
        """What belongs to places (P, ...), for each line."""
        return np.asarray(of_places[self.hand.place])

    def wander(self, columns: int, keeps: float) -> Array:
        """Variance 1 (n, columns), changing slowly."""
        return wander(self.rng, self.lines, columns, keeps)

    def _draw_coupling(self) -> Array:
        """How much of an echo comes through the face (n,)."""
        state, rng = self.hand.state, self.rng
        gap = decibel(GAP_DB) * rng.uniform(0.2, 1, self.lines)
        halfwet = rng.uniform(0.05, 0.6, self.lines)
        whole = np.select([np.isin(state, UNWETTED), state == "gap", state == "halfwet"], [0.0, gap, halfwet], 1.0)
        return np.asarray(whole * decibel(self.wander(1, 0.7)[:, 0]))

    def _draw_face(self) -> Array:
        """Reflection of the wetted face (n,): between the scalp and the delay line, or the transducer itself."""
        skin = self.each(self.rng.uniform(1.55, 1.8, self.places)) * (1 + 0.01 * self.wander(1, 0.8)[:, 0])
        if not self.world.material:
            return np.full(self.lines, self.world.face_r)
        line = MATERIALS[self.world.material].impedance
        return np.asarray((skin - line) / (skin + line))

    def arrival_us(self, depth_mm: Array) -> Array:
        """When an echo from depths (n, m) in tissue comes."""
        return np.asarray(self.skin_us[:, None] + 2e3 * depth_mm / self.world.speed_m_s)

    def loss(self, depth_mm: Array) -> Array:
        """dB/MHz, there and back in tissue."""
        return 0.2 * self.world.attenuation * depth_mm

    def add(self, height: Array, time_us: Array, loss: Array, lobe_deg: npt.ArrayLike = np.inf) -> None:
        """Echoes (n, m), half as high at a tilt of `lobe_deg`, one for all lines or (n,)."""
        self.found.append(Echoes(height, time_us, loss, self.hand.angle_deg / lobe_deg))

    def take(self, band: Band) -> Complex:
        """All echoes added since the last call, as analytic lines (n, samples)."""
        spectra = np.zeros((self.lines, len(band.mhz)), dtype=np.complex64)
        for echoes in self.found:
            spectra += band.series(echoes)
        self.found = []
        return band.analytic(spectra)


def _add_surface(scene: Scene) -> None:
    """Bone's surface: a specular part from the nearer side of the beam, and a diffuse one from its roughness."""
    world, rng, depth = scene.world, scene.rng, scene.hand.depth_mm
    slope = np.tan(np.radians(scene.hand.angle_deg))
    near = (depth - rng.uniform(0, 0.5, scene.lines) * slope)[:, None]
    scene.add(scene.bone[:, None], scene.arrival_us(near), scene.loss(near), world.lobe_deg)
    spread = np.hypot(world.rough_mm, 0.4 * slope)[:, None]
    fine = depth[:, None] + scene.wander(FINE_ECHOES, 0.8) * spread
    height = world.floor / np.sqrt(FINE_ECHOES) * scene.bone[:, None] * scene.wander(FINE_ECHOES, 0.8)
    scene.add(height, scene.arrival_us(fine), scene.loss(fine))


def _add_behind_bone(scene: Scene) -> None:
    """The inner table, the diploe before it, and what goes once or twice more between bone and face."""
    world, rng, places = scene.world, scene.rng, scene.places
    depth, bone = scene.hand.depth_mm[:, None], scene.bone[:, None]
    outer, inner = rng.uniform(1.5, 3, (places, 1)), rng.uniform(4, 8, (places, 1))
    diploe = outer + (inner - outer) * rng.random((places, 8))
    tables = -decibel(-rng.uniform([18, 26], [30, 38], (places, 2)))
    grains = decibel(-rng.uniform(34, 46, (places, 8))) * rng.choice([-1, 1], (places, 8))
    within = scene.each(np.concatenate([outer, inner, diploe], axis=1))
    height = scene.each(np.concatenate([tables, grains], axis=1)) * (1 + 0.3 * scene.wander(10, 0.8))
    time = scene.arrival_us(depth) + 2 * within / SKULL_MM_US
    scene.add(bone * height, time, scene.loss(depth) + 0.1 * within, 2 * world.lobe_deg)
    times = np.array([2, 3])
    again = bone**times * (-scene.face_r[:, None]) ** (times - 1)
    scene.add(again, scene.arrival_us(times * depth), scene.loss(times * depth), world.lobe_deg / 2)


def _draw_layers(rng: np.random.Generator, bone_mm: float) -> tuple[Array, Array]:
    """Depths and heights (2, LAYERS) of soft interfaces in one place: above bone; and where bone is missing."""
    depth, height = np.zeros((2, LAYERS)), np.zeros((2, LAYERS))
    over = np.arange(LAYERS - 1)
    depth[0, over] = rng.uniform(2, max(2.1, bone_mm - 1.5), LAYERS - 1)
    height[0, over] = decibel(-rng.uniform(24, 38, LAYERS - 1)) * (over < 2 + min(3, int(bone_mm / 4)))
    depth[0, :2] = rng.uniform(1, 2), bone_mm - rng.uniform(0.4, 1.8)  # skin to fat, and the galea
    height[0, :2] = decibel(-rng.uniform(22, 34, 2))
    height[0] *= rng.choice([-1, 1], LAYERS) * ((depth[0] > 0.8) & (depth[0] < bone_mm - 0.35))
    depth[1] = np.sort(rng.uniform(2.5, 20, LAYERS))
    height[1] = decibel(-rng.uniform(26, 38, LAYERS)) * rng.choice([-1, 1], LAYERS)
    depth[1, 0], height[1, 0] = depth[0, 0], decibel(-rng.uniform(22, 34))
    height[1] *= np.abs(depth[1] - bone_mm) > 1.5  # nothing in a defect carries the trace of bone on
    return depth, height


def _add_tissue(scene: Scene) -> None:
    """Soft interfaces, and scatterers: down to the bone, or all the way."""
    world, hand, rng = scene.world, scene.hand, scene.rng
    wet = scene.coupling[:, None]
    drawn = [_draw_layers(rng, bone_mm) for bone_mm in world.place_mm]
    depths, heights = (np.array(parts)[hand.place, scene.soft.astype(int)] for parts in zip(*drawn))
    depth = depths * hand.pressed[:, None] + 0.03 * scene.wander(LAYERS, 0.85)
    height = wet * heights * (1 + 0.3 * scene.wander(LAYERS, 0.8))
    lobe_deg = np.where(scene.soft, rng.uniform(4, 8), rng.uniform(4, 8))
    scene.add(height, scene.arrival_us(depth), scene.loss(depth), lobe_deg)
    bone = hand.depth_mm[:, None]
    deepest = np.where(scene.soft[:, None], 24.0, bone)
    depth = 0.3 + (deepest - 0.35) * scene.each(rng.random((scene.places, SCATTERERS)))
    depth += 0.05 * scene.wander(SCATTERERS, 0.95)
    depth = np.where(scene.soft[:, None], depth, np.minimum(depth, bone - 0.05))
    density = world.speckle / np.sqrt(0.3 * SCATTERERS / deepest)
    height = wet * density * scene.wander(SCATTERERS, 0.75 if world.sweeps else 0.9)
    scene.add(height, scene.arrival_us(depth), scene.loss(depth))


def _add_delay_line(scene: Scene) -> None:
    """The delay line's end with two multiples, total in air, and bone's echo that rides on the second one."""
    world, depth = scene.world, scene.hand.depth_mm[:, None]
    if not world.material or world.without == "unplugged":
        return
    wetted = np.clip(np.abs(scene.coupling), 0, 1)
    end = (scene.face_r * wetted + AIR_R * (1 - wetted))[:, None]
    times, skin_us = np.arange(1, 4), scene.skin_us[:, None]
    loss = np.broadcast_to(world.delay_loss * (times - 1), (scene.lines, 3))
    scene.add(end**times * world.back_r ** (times - 1), skin_us * times, loss)
    riding = 2 * scene.bone[:, None] * end * world.back_r
    scene.add(riding, scene.arrival_us(depth) + skin_us, scene.loss(depth) + world.delay_loss, world.lobe_deg)


def _square_heights(scene: Scene, band: Band) -> Array:
    """Height of the envelope of bone met squarely in each place (P,)."""
    depth = scene.world.place_mm[:, None]
    time = scene.skin_us[0] + 2e3 * depth / scene.world.speed_m_s
    echo = Echoes(np.full_like(depth, TYPICAL_BONE_R), time, scene.loss(depth), np.zeros(len(depth)))
    return np.asarray(np.abs(band.analytic(band.series(echo))).max(axis=1), dtype=float)


def _draw_noise(rng: np.random.Generator, band: Band, lines: int) -> Waves:
    """Noise of variance 1 (n, samples) within the receiver's band."""
    mhz = np.maximum(np.arange(band.size // 2 + 1) * band.step_mhz, 1e-6)
    low, high = (0.35 * band.centre_mhz / mhz) ** 8, (mhz / (1.9 * band.centre_mhz)) ** 8
    spectrum = rng.standard_normal((lines, 2 * len(mhz)), dtype=np.float32).view(np.complex64)
    spectrum *= (1 / np.sqrt((1 + low) * (1 + high))).astype(np.float32)
    noise = scipy.fft.irfft(spectrum, band.size, axis=1)[:, : band.samples]
    return np.asarray(noise / noise.std())


def _add_receiver(scene: Scene, rf: Waves, sigma: float) -> None:
    """The transmitted pulse's ringing, spikes, a narrow-band tone, an offset that drifts."""
    world, rng, (lines, samples) = scene.world, scene.rng, rf.shape
    stated_mhz = world.acquisition.transducer_hz * 1e-6
    time = np.arange(samples) / (world.acquisition.sampling_hz * 1e-6)
    ringing = np.exp(-time * stated_mhz / rng.uniform(0.6, 0.9)) * np.cos(2 * np.pi * stated_mhz * time + rng.uniform(0, 6))
    drift = rng.uniform(-4, 4) + rng.uniform(0, 6) * np.cos(2 * np.pi * rng.uniform(0.01, 0.08) * time)
    sent = 20 * rng.uniform(0.3, 1) * (world.without != "unplugged")
    rf += (sent * ringing + sigma * drift).astype(np.float32)
    rf += (2 * sigma * scene.wander(1, 0.98)).astype(np.float32)
    if world.spikes:
        for row in rng.integers(0, lines, int(0.4 * lines)):
            at = int(rng.integers(0, samples - 3))
            rf[row, at : at + int(rng.integers(1, 3))] += rng.choice([-1, 1]) * rng.uniform(4, 20) * sigma
    if world.tone:
        phase = 2 * np.pi * rng.uniform(0.1, 0.35) * stated_mhz * time + rng.uniform(0, 6, (lines, 1))
        rf += (rng.uniform(1, 3) * sigma * np.cos(phase)).astype(np.float32)


def _convert(scene: Scene, rf: Waves, strongest: float, others: Complex, sigma: float) -> npt.NDArray[np.int16]:
    """Codes of a converter whose range bone fills in part, and the delay line's echo at most a little over."""
    world, rng = scene.world, scene.rng
    touching = scene.coupling > 0.5
    loudest = float(np.abs(others[touching]).max()) if touching.any() else 0.0
    range_ = max(strongest / rng.uniform(0.1, 0.6), 0.6 * loudest)
    if world.hot:
        range_ /= rng.uniform(2, 6)
    fitting = [bits for bits in rng.permutation(CONVERTERS) if sigma / range_ * 2 ** (bits - 1) > 0.7]
    largest = 2 ** ((int(fitting[0]) if fitting else 16) - 1) - 1
    codes = np.clip(np.rint(rf * np.float32(largest / range_)), -largest - 1, largest).astype(np.int16)
    codes[:, : world.junk] = rng.integers(-largest, largest, (len(codes), 1))
    return codes


def _bone_heights(scene: Scene, band: Band, bone: Complex) -> Array:
    """Height of the envelope of bone's own echo about its true depth (n,)."""
    arrival_us = scene.arrival_us(scene.hand.depth_mm[:, None])
    half = int(1.5 * band.fall_us * band.sampling_mhz) + 2
    near: Rows = np.rint(arrival_us * band.sampling_mhz).astype(np.int64) + np.arange(-half, half + 1)
    rows = np.arange(scene.lines)[:, None]
    return np.asarray(np.abs(bone[rows, near.clip(0, band.samples - 1)]).max(axis=1), dtype=float)


def simulate(rng: np.random.Generator, frames: int, world: World | None = None) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines (fewer when the session has not so many), the truth about it, and its set-up."""
    world = world or draw_world(rng, frames)
    hand = draw_hand(rng, world, frames)
    scene = Scene(world, hand, rng)
    last_us = float(scene.skin_us.max()) + 2e3 * world.reach_mm / world.speed_m_s
    band = Band(world, int(last_us * world.acquisition.sampling_hz * 1e-6))
    _add_surface(scene)
    bone = scene.take(band)
    _add_behind_bone(scene)
    _add_tissue(scene)
    _add_delay_line(scene)
    others = scene.take(band)
    square = _square_heights(scene, band)
    sigma = float(square.min() / decibel(world.snr_db))
    rf = _draw_noise(rng, band, scene.lines) * np.float32(sigma) + bone.real + others.real
    _add_receiver(scene, rf, sigma)
    statuses = draw_statuses(rng, scene.lines)
    poses = draw_poses(rng, world, hand)
    poses[np.array(statuses) != "OK"] = np.nan
    recording = Recording(
        lines=_convert(scene, rf, float(square.max()), others, sigma),
        acquisition=world.acquisition,
        probe_to_reference=poses,
        statuses=statuses,
        timestamps_s=draw_times(rng, hand),
        palpation_points=hand.place,
    )
    seen: Bools = (scene.boned | scene.edge) & (hand.state != "gap")
    level_db = 20 * np.log10(np.maximum(_bone_heights(scene, band, bone), 1e-12) / sigma)
    truth = Truth(np.where(seen, hand.depth_mm, np.nan), hand.angle_deg, world.speed_m_s, np.where(seen, level_db, -np.inf))
    return recording, truth, world
