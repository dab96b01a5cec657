"""What answers over a head of spheres: bone's two parts, what lies over and under it, the delay line, gel in air, texture.

All echoes are one pulse, delayed, damped by frequency, and dimmed as the lobe of a round element dims what it meets at an angle:
a narrower one the higher the frequency, so that a tilted echo is lower, longer and duller.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.special import j1

from Testing.Studies.simulators.echo_spectra import echo_spectra
from Testing.Studies.simulators.sphere_hand import Hand, draw_hand
from Testing.Studies.simulators.sphere_plan import Array, Setup, decibel, reflected

Floats = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]

NEPER = np.log(10) / 20  # a decibel
GUARD_US, HEARD_US = 6.0, 3.0  # behind the last sample: what begins there goes round to the first; echoes begin before
LOBE_STEP, LOBE_END = 1 / 16, 400.0
LOBE_AT = np.arange(LOBE_STEP, LOBE_END, LOBE_STEP)
LOBE = np.concatenate([[1.0], 2 * j1(LOBE_AT) / LOBE_AT])  # of a round element met at an angle
SKULL_MM_US = 2.9
GEL_IMPEDANCE, GEL_ATTENUATION = 1.5, 0.1
AIR_R, GEL_AIR_R = -0.95, -0.9
RUNGS = 7  # of the ladder that a film of gel makes
LAYERS, EXTRA = 4, 2  # of a place; further ones in tissue without bone, that stand out of its texture
LEAST_LAYER_MM = 0.9
SPOT_SHARE = 0.25 / 1.7  # standard deviation of the beam's spot on the bone, of the aperture
ROUGH_MM, ROUGH_SIZE, ROUGH_START = 0.15, 900, 60  # grid of the bone's roughness, along the way of the probe
KNOT_MM, KNOTS, KNOT_START = 0.8, 60, 8  # so far on, the probe sees other texture
LEAST_TEXTURE_MM = 0.2


class Band:
    """The frequencies that the pulse has; its envelope is about 1 at time zero, and rings once more behind."""

    def __init__(self, setup: Setup, samples: int) -> None:
        self.samples, self.sampling_mhz = samples, setup.sampling_mhz
        self.size = scipy.fft.next_fast_len(samples + int(GUARD_US * setup.sampling_mhz), real=True)
        self.step_mhz = setup.sampling_mhz / self.size
        self.every_mhz: Array = np.arange(self.size // 2 + 1) * self.step_mhz
        low = max(0.05 * setup.centre_mhz, setup.true_mhz - 4.5 * setup.spread_mhz)
        heard = np.flatnonzero((self.every_mhz > low) & (self.every_mhz < setup.true_mhz + 4 * setup.spread_mhz))
        self.bins = slice(int(heard[0]), min(int(heard[-1]) + 1, (self.size + 1) // 2))
        self.mhz = self.every_mhz[self.bins]
        shape = np.exp(-0.5 * ((self.mhz - setup.true_mhz) / setup.spread_mhz) ** 2)
        turns = self.mhz / setup.centre_mhz * setup.ring_cycles + setup.ring_turn
        ringing = np.exp(1j * setup.phase) * (1 + setup.ring * np.exp(-2j * np.pi * turns))
        self.pulse = (self.size / shape.sum() * shape * ringing).astype(np.complex64)

    @property
    def last_us(self) -> float:
        """What comes later is not heard."""
        return self.samples / self.sampling_mhz + HEARD_US

    def analytic(self, spectra: Complex) -> Complex:
        """Lines (n, samples) of sums over the pulse: their real part is received, their magnitude is the envelope."""
        full = np.zeros((len(spectra), self.size), dtype=np.complex64)
        np.multiply(spectra, self.pulse, out=full[:, self.bins])
        return np.asarray(scipy.fft.ifft(full, axis=1, overwrite_x=True)[:, : self.samples])

    def waves(self, spectra: Complex) -> Floats:
        """What is received of sums over the pulse (n, samples)."""
        full = np.zeros((len(spectra), self.size // 2 + 1), dtype=np.complex64)
        np.multiply(spectra, 0.5 * self.pulse, out=full[:, self.bins])
        return np.asarray(scipy.fft.irfft(full, self.size, axis=1, overwrite_x=True)[:, : self.samples])


@dataclass(frozen=True, eq=False)
class Scene:
    """What is under the probe in each line."""

    setup: Setup
    hand: Hand
    skin_us: Array  # (n,) when the skin answers
    wet: Array  # (n,) share of the face that touches
    bone: Array  # (n,) height of bone's echo met squarely, before any loss; 0: no bone

    @property
    def entering(self) -> float:
        """What comes of an echo through the delay line's face, there and back."""
        return 1 - self.setup.face_r**2

    @property
    def gap_mm(self) -> float:
        """From the galea to the bone: at least as much as the pulse tells apart."""
        return max(0.6, 1.6 * self.setup.pulse_mm)

    def arrival_us(self, depth_mm: Array) -> Array:
        """When echoes from depths in the scalp (n, m) come."""
        return np.asarray(self.skin_us[:, None] + 2 * depth_mm / self.setup.mm_us)

    def lost_db(self, depth_mm: npt.ArrayLike, passes: npt.ArrayLike = 1) -> Array:
        """dB/MHz on the way to a depth in the scalp and back, after so many ways to the delay line's end and back."""
        setup, delay = self.setup, self.setup.delay
        in_scalp = setup.attenuation * np.asarray(depth_mm)
        in_delay = delay.attenuation * delay.length_mm * np.asarray(passes)
        return np.asarray(0.2 * (in_scalp + in_delay))


def draw_scene(rng: np.random.Generator, setup: Setup, frames: int) -> Scene:
    """The hand's way, and how the probe couples in each line; the delay line is not as fast as stated, and warms or cools."""
    hand = draw_hand(rng, setup, frames)
    count, places = len(hand.place), len(hand.radius_mm)
    stated_us = 2e3 * setup.delay.length_mm / (setup.delay.speed_m_s or 1.0)
    late = rng.uniform(-0.01, 0.01) + rng.uniform(-0.002, 0.002) * np.linspace(0, 1, count)
    wet = np.where(hand.landing, rng.uniform(0.3, 0.8, count), 1.0)
    scene = Scene(setup, hand, stated_us * (1 + late), wet, np.zeros(count))
    varies = decibel(rng.normal(0, 1, places))[hand.place] * decibel(rng.normal(0, 0.5, count))
    return Scene(setup, hand, scene.skin_us, wet, setup.bone_r * scene.entering * wet * hand.bone * varies)


class Echoes:
    """A sum of echoes over the pulse, as spectra (n, band)."""

    def __init__(self, scene: Scene, band: Band) -> None:
        self.setup, self.band = scene.setup, band
        self.spectra: Complex = np.zeros((len(scene.skin_us), len(band.mhz)), dtype=np.complex64)

    def add(self, height: Array, time_us: Array, lost_db: Array, lean: npt.ArrayLike = 0.0) -> None:
        """Echoes (n, m): height, arrival, loss in dB/MHz; all of them are met at the angle of sine `lean` (n,).

        An echo of only a share of the aperture is met at that share of the sine.
        """
        height, time_us, lost_db = np.broadcast_arrays(height, time_us, lost_db)
        height = np.where(time_us < self.band.last_us, height, 0.0)
        rows = np.flatnonzero(height.any(axis=1))
        if not len(rows):
            return
        total = echo_spectra(time_us[rows], height[rows], NEPER * lost_db[rows], self.band.mhz, self.band.step_mhz)
        lean = np.broadcast_to(np.asarray(lean, dtype=float), len(height))[rows]
        if lean.any():
            total *= self._lobe(lean)
        self.spectra[rows] += total

    def _lobe(self, lean: Array) -> Floats:
        """What the element hears of echoes met at angles of such sines (n, band)."""
        across = 2 * np.pi * self.setup.lobe_mm / self.setup.mm_us
        place = np.outer(np.abs(lean) * across / LOBE_STEP, self.band.mhz).astype(np.float32)
        before = np.minimum(place.astype(np.int32), len(LOBE) - 2)
        part = place - before
        table = LOBE.astype(np.float32)
        low = table[before]
        return np.asarray(low + part * (table[before + 1] - low))


def bone_echoes(rng: np.random.Generator, scene: Scene, band: Band) -> Complex:
    """Bone: a mirror at its nearest point, and scatterers over the beam's spot, about its depth along the beam."""
    setup, hand = scene.setup, scene.hand
    echoes = Echoes(scene, band)
    square = hand.square_mm[:, None]
    echoes.add(scene.bone[:, None], scene.arrival_us(square), scene.lost_db(square), np.sin(hand.incidence_rad))
    spread = np.linspace(-1.5, 1.5, 9)
    aside_mm = spread * SPOT_SHARE * setup.lobe_mm
    rough = rng.normal(size=(len(hand.radius_mm), ROUGH_SIZE))
    at = np.clip((hand.along_mm[:, None] + aside_mm) / ROUGH_MM + ROUGH_START, 0, ROUGH_SIZE - 1.001)
    before = at.astype(int)
    place, part = hand.place[:, None], at - before
    scattered = (1 - part) * rough[place, before] + part * rough[place, before + 1]
    height = scene.bone[:, None] * setup.diffuse / 2 * scattered * np.exp(-0.5 * spread**2)
    depth = hand.depth_mm[:, None]
    slope = np.tan(hand.incidence_rad)[:, None]
    echoes.add(height, scene.arrival_us(depth + aside_mm * slope), scene.lost_db(depth))
    return echoes.spectra


def square_echo(scene: Scene, band: Band) -> float:
    """Height of the envelope of bone met squarely at the session's typical depth."""
    depth = np.array([[scene.setup.typical_mm]])
    time_us = scene.skin_us[:1, None] + 2 * depth / scene.setup.mm_us
    height = np.full((1, 1), scene.setup.bone_r * scene.entering)
    spectra = echo_spectra(time_us, height, NEPER * scene.lost_db(depth), band.mhz, band.step_mhz)
    return float(np.abs(band.analytic(spectra)).max())


def other_echoes(rng: np.random.Generator, scene: Scene, band: Band, noise: float) -> Floats:
    """All that answers besides bone's surface (n, samples), without the noise, above which tissue without bone is seen."""
    echoes = Echoes(scene, band)
    _add_delay_line(rng, scene, echoes)
    _add_about_bone(rng, scene, echoes)
    deepest_mm = _add_layers(rng, scene, echoes)
    _add_gel(rng, scene, echoes)
    texture = _draw_soft_texture(rng, scene, noise, deepest_mm)
    _add_soft_layers(rng, scene, echoes, texture, deepest_mm)
    waves = band.waves(echoes.spectra)
    if scene.hand.on_skin.any():
        waves += _texture(rng, scene, band, texture)
    return waves


def _add_delay_line(rng: np.random.Generator, scene: Scene, echoes: Echoes) -> None:
    """The delay line's end and its multiples: all comes back from air, part from gel and from skin half wetted."""
    setup, hand = scene.setup, scene.hand
    if not setup.delay.length_mm or setup.without == "cable":
        return
    on_gel = reflected(setup.delay.impedance, GEL_IMPEDANCE)
    half = 0.5 * setup.face_r - 0.5 * (1 - scene.wet)
    end = np.select([hand.landing, hand.on_skin, hand.gel], [half, setup.face_r, on_gel], AIR_R)
    times = np.arange(1, 5)
    end = end[:, None] * decibel(rng.normal(0, 0.4, (len(end), len(times))))
    height = end**times * (-setup.back_r) ** (times - 1)
    echoes.add(height, times * scene.skin_us[:, None], scene.lost_db(0.0, times))


def _add_about_bone(rng: np.random.Generator, scene: Scene, echoes: Echoes) -> None:
    """Periosteum, diploe and inner table; what goes once more between bone and face, or through the delay line."""
    setup, hand, bone = scene.setup, scene.hand, scene.bone[:, None]
    places, count = len(hand.radius_mm), len(hand.place)
    square, lean = hand.square_mm[:, None], np.sin(hand.incidence_rad)
    arrival, lost = scene.arrival_us(square), scene.lost_db(square)
    periosteum_us = 2 * rng.uniform(0.15, 0.4, (places, 1))[hand.place] / setup.mm_us
    echoes.add(bone * rng.uniform(0.02, 0.05), arrival - periosteum_us, lost, 0.7 * lean)
    within_mm = rng.uniform([1.2, 4], [2.5, 8], (places, 2))[hand.place]
    level = decibel(rng.uniform([-26, -36], [-14, -22], (places, 2)))[hand.place] * decibel(rng.normal(0, 2, (count, 2)))
    echoes.add(bone * level * [-1, 1], arrival + 2 * within_mm / SKULL_MM_US, lost, 0.9 * lean)
    delayed = setup.delay.length_mm > 0
    face_r = -setup.face_r if delayed else -setup.back_r
    echoes.add(bone * setup.bone_r * face_r, scene.arrival_us(2 * square), scene.lost_db(2 * square), 2 * lean)
    if delayed:
        again = -2 * bone * setup.back_r * setup.face_r
        echoes.add(again, arrival + scene.skin_us[:, None], scene.lost_db(square, 2), lean)


def _draw_layers(rng: np.random.Generator, scene: Scene, kind: str, place_mm: float) -> tuple[Array, Array]:
    """Depths and reflections (2, LAYERS) of soft interfaces in one place, before it is pressed."""
    depth, height = np.zeros(LAYERS), np.zeros(LAYERS)
    if kind == "soft":
        return np.cumsum(rng.uniform(1.2, 3.5, LAYERS)) + 0.5, rng.choice([-1, 1], LAYERS) * rng.uniform(0.04, 0.12, LAYERS)
    if kind != "bone":
        return depth, height
    galea_mm = place_mm - rng.uniform(scene.gap_mm, scene.gap_mm + 1.5)
    depth[:3] = galea_mm, rng.uniform(1.2, 2.4), rng.uniform(0.35, 0.7) * place_mm
    height[:3] = rng.uniform([0.03, -0.12, 0.05], [0.12, -0.03, 0.12])
    height[2] *= place_mm > 7  # fat to muscle
    height *= (depth >= LEAST_LAYER_MM) & (depth <= place_mm - scene.gap_mm)
    over_bone_db = np.where(depth < place_mm - 3, 3, -4) - scene.setup.loss_db_mm * (place_mm - depth)
    most = scene.setup.bone_r * decibel(over_bone_db)
    return depth, np.clip(height, -most, most)


def _add_layers(rng: np.random.Generator, scene: Scene, echoes: Echoes) -> Array:
    """Layers of the soft tissue, which the hand presses with it; how deep the deepest of each place is (k,)."""
    hand = scene.hand
    places, count = len(hand.place_kind), len(hand.place)
    drawn = [_draw_layers(rng, scene, kind, place_mm) for kind, place_mm in zip(hand.place_kind, hand.place_mm)]
    depths, heights = (np.array(part) for part in zip(*drawn))
    depth = depths[hand.place] * (hand.square_mm / hand.place_mm[hand.place])[:, None]
    heard = (hand.on_skin * scene.entering * scene.wet)[:, None]
    height = heights[hand.place] * heard * decibel(rng.normal(0, 1.5, (count, LAYERS)))
    askew = np.radians(rng.normal(0, 1.2, (places, LAYERS)))[hand.place]
    lean = 0.5 * np.sin(hand.incidence_rad[:, None] + askew)
    arrival, lost = scene.arrival_us(depth), scene.lost_db(depth)
    for one in range(LAYERS):
        layer = slice(one, one + 1)
        echoes.add(height[:, layer], arrival[:, layer], lost[:, layer], lean[:, one])
    return np.asarray(depths.max(axis=1))


def _add_gel(rng: np.random.Generator, scene: Scene, echoes: Echoes) -> None:
    """A film of gel with air behind: a ladder of multiples, whose first rung is nearer than any bone."""
    setup, hand = scene.setup, scene.hand
    if not hand.gel.any():
        return
    places, count = len(hand.place_kind), len(hand.place)
    film = rng.uniform(0.7, 1.4, places)[hand.place] * (1 + 0.06 * np.cumsum(rng.normal(0, 0.3, count)))
    film_mm = np.clip(film, 0.6, 1.5)[:, None]
    rungs = np.arange(1, RUNGS + 1)
    back = rng.uniform(0.5, 0.65, places)
    if setup.delay.length_mm:
        on_gel = reflected(GEL_IMPEDANCE, setup.delay.impedance)
        back = np.full(places, np.copysign(max(abs(on_gel), 0.25), on_gel))
    height = hand.gel[:, None] * GEL_AIR_R * (GEL_AIR_R * back[hand.place][:, None]) ** (rungs - 1)
    lean = rng.uniform(0, 0.01, (places, RUNGS))[hand.place]
    as_scalp_mm = film_mm * GEL_ATTENUATION / setup.attenuation
    for one, rung in enumerate(rungs):
        echoes.add(height[:, one : one + 1], scene.arrival_us(rung * film_mm), scene.lost_db(rung * as_scalp_mm), lean[:, one])


def _draw_soft_texture(rng: np.random.Generator, scene: Scene, noise: float, deepest_mm: Array) -> Array:
    """Strength of the texture at the surface of each place (k,): without bone, it is seen on beyond the last layer."""
    setup, soft = scene.setup, scene.hand.place_kind == "soft"
    usual = setup.speckle * decibel(-setup.delay_db)
    seen_db = rng.uniform(9, 16, len(soft)) + setup.loss_db_mm * (deepest_mm + 1)
    return np.where(soft, noise * decibel(np.where(soft, seen_db, 0.0)), usual)


def _add_soft_layers(rng: np.random.Generator, scene: Scene, echoes: Echoes, texture: Array, deepest_mm: Array) -> None:
    """Two more layers where there is no bone, that stand out of the texture."""
    hand, count = scene.hand, len(scene.skin_us)
    if not hand.soft.any():
        return
    places = len(texture)
    depth = np.stack([rng.uniform(2, 5, places), deepest_mm - rng.uniform(0, 3, places)], axis=1)[hand.place]
    over = decibel(rng.uniform(4, 12, (places, EXTRA))) * rng.choice([-1, 1], (places, EXTRA))
    height = (hand.soft * texture[hand.place])[:, None] * over[hand.place] * decibel(rng.normal(0, 1.5, (count, EXTRA)))
    height *= decibel(scene.setup.delay_db)  # the texture is told behind the delay line
    lean = 0.5 * np.sin(rng.normal(0, 0.02, (count, EXTRA)))
    arrival, lost = scene.arrival_us(depth), scene.lost_db(depth)
    for one in range(EXTRA):
        layer = slice(one, one + 1)
        echoes.add(height[:, layer], arrival[:, layer], lost[:, layer], lean[:, one])


def _texture(rng: np.random.Generator, scene: Scene, band: Band, strength: Array) -> Floats:
    """What scatters in the scalp (n, samples), the same while the probe hardly moves: down to the bone, or all the way."""
    setup, hand = scene.setup, scene.hand
    at = hand.along_mm / KNOT_MM + KNOT_START
    knot = np.clip(at.astype(int), 0, KNOTS - 2)
    part = np.clip(at - knot, 0, 1)
    knots = hand.place * KNOTS + knot
    used, which = np.unique(np.concatenate([knots, knots + 1]), return_inverse=True)
    drawn = rng.standard_normal((len(used), 2 * len(band.mhz)), dtype=np.float32).view(np.complex64)
    before, behind = which[: len(knots)], which[len(knots) :]
    spectra = np.sqrt(1 - part).astype(np.float32)[:, None] * drawn[before]
    spectra += np.sqrt(part).astype(np.float32)[:, None] * drawn[behind]
    waves = band.waves(spectra * np.float32(band.size / np.linalg.norm(band.pulse)))
    level = strength[hand.place] * hand.on_skin * scene.wet
    time = (np.arange(band.samples) / band.sampling_mhz).astype(np.float32)
    depth = (time - scene.skin_us.astype(np.float32)[:, None]) * np.float32(setup.mm_us / 2)
    ends = np.where(hand.soft, np.inf, hand.square_mm).astype(np.float32)[:, None]
    fading = np.exp(np.float32(-NEPER * setup.loss_db_mm) * np.maximum(depth, 0))
    waves *= fading * level.astype(np.float32)[:, None]
    waves *= (depth > LEAST_TEXTURE_MM) & (depth < ends)
    return waves
