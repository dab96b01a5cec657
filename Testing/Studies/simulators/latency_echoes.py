"""What answers in a recording whose trigger comes late: bone, what follows it, layers, speckle, and the delay line.

All is summed as spectra over the pulse. A mirror askew is the disc's average of arrivals; bone's come on the shortest path, what
its roughness scatters along the beam. latency_lines.py makes lines of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft

from Testing.Studies.simulators.echo_spectra import echo_spectra, short_peaks
from Testing.Studies.simulators.latency_hand import Ground, Hand, draw_ground, draw_hand, wander
from Testing.Studies.simulators.latency_plan import Array, Bools, Setup, decibel

Floats = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]

NEPER = np.log(10) / 20  # a decibel
GUARD_US = 8.0  # behind the last sample: what rings there does not come round to the first
ECHO_US = 8.0  # no echo of bone is longer
FAINT = 1e-4  # of the pulse's spectrum: not simulated
PULSE_STEPS = 16  # a cycle
ARRIVALS = 21  # over the disc
CYCLES_STEP, MOST_CYCLES = 1 / 2048, 5.25  # of the table of what the disc makes of a mirror askew
BONE_MM_US = 2.9
BONE_PARTS, LAYER_PARTS, DIPLOE_PARTS, SPECKLE_PARTS = 16, 8, 12, 150  # what scatters, in a line
SPECKLE_MM, CLEAR_MM = 26.0, 0.05  # down to here; and none so near to the bone
DIFFUSE_LAYER = 0.15  # of a layer's echo
AIR_R = -0.95
DELAY_ECHOES = 4


class Band:
    """The frequencies of a recording's pulse: only these are simulated."""

    def __init__(self, setup: Setup, samples: int) -> None:
        self.setup, self.samples = setup, samples
        self.size = scipy.fft.next_fast_len(samples + int(GUARD_US * setup.sampling_mhz), real=True)
        self.step_mhz = setup.sampling_mhz / self.size
        self.last_us = samples / setup.sampling_mhz + GUARD_US / 2  # what comes later is not heard
        self.every_mhz = np.arange(self.size // 2 + 1) * self.step_mhz
        centre = setup.transducer.centre_mhz
        inside = (self.every_mhz > 0.15 * centre) & (self.every_mhz < min(2.1 * centre, 0.49 * setup.sampling_mhz))
        self._take(np.flatnonzero(inside))
        pulse = self._pulse()
        heard = np.flatnonzero(np.abs(pulse) > FAINT * np.abs(pulse).max())
        self._take(np.arange(heard[0], heard[-1] + 1) + self.bins.start)
        self.pulse = pulse[heard[0] : heard[-1] + 1]
        self.table = self._table()
        roughness = 2 * np.pi * self.mhz * setup.skull.rough_mm / setup.mm_us
        self.smooth = np.exp(-2 * roughness**2).astype(np.float32)  # what roughness leaves of a mirror

    def _take(self, bins: npt.NDArray[np.int64]) -> None:
        self.bins = slice(int(bins[0]), int(bins[-1]) + 1)
        self.mhz = self.every_mhz[self.bins]

    def receiver(self, mhz: Array) -> Array:
        """What it lets through."""
        over, highest = mhz / self.setup.transducer.centre_mhz, 0.47 * self.setup.sampling_mhz
        return np.asarray(1 / np.sqrt((1 + (0.3 / over) ** 4) * (1 + (over / 2) ** 4) * (1 + (mhz / highest) ** 24)))

    def _pulse(self) -> Complex:
        """The pulse, whose envelope rises to 1 at time zero and falls more slowly, as the receiver hears it."""
        made = self.setup.transducer
        width_us = 0.375 / (made.bandwidth * made.centre_mhz)
        rise_us, fall_us = 2 * width_us / (1 + made.fall), 2 * width_us * made.fall / (1 + made.fall)
        time: Array = np.arange(-6 * rise_us, 6 * fall_us, 1 / (PULSE_STEPS * made.centre_mhz), dtype=float)
        envelope = np.exp(-0.5 * (time / np.where(time < 0, rise_us, fall_us)) ** 2)
        height = envelope * np.exp(1j * (2 * np.pi * made.centre_mhz * time + made.phase))
        spectrum = self.echoes(time[None], height[None], np.zeros((1, len(time))))[0]
        spectrum *= self.size / (2 * np.abs(spectrum).sum())
        return np.asarray(spectrum * self.receiver(self.mhz).astype(np.float32))

    def _table(self) -> Floats:
        """A mirror askew: the disc's average of arrivals that differ by up to so many cycles to each side."""
        across = (np.arange(ARRIVALS) - ARRIVALS // 2) / (ARRIVALS / 2)
        weight = (1 - across**2) ** self.setup.transducer.taper
        cycles = np.arange(0, MOST_CYCLES, CYCLES_STEP)[:, None]
        half = slice(ARRIVALS // 2 + 1, None)  # the other half is the same
        turning = np.cos((2 * np.pi * cycles * across[half]).astype(np.float32))
        total = weight[ARRIVALS // 2] + 2 * turning @ weight[half].astype(np.float32)
        return np.asarray(total / weight.sum(), dtype=np.float32)

    def mirror(self, askew_deg: Array) -> Floats:
        """What is left of a rough mirror's echo (n, band)."""
        apart_us = self.setup.transducer.disc_mm * np.sin(np.radians(np.abs(askew_deg))) / self.setup.mm_us
        steps = (apart_us[:, None] / CYCLES_STEP).astype(np.float32) * self.mhz.astype(np.float32)
        return np.asarray(self.table[np.minimum(steps + 0.5, len(self.table) - 1).astype(np.int32)] * self.smooth)

    def lost(self, depth_mm: npt.ArrayLike) -> Array:
        """Neper a MHz, there and back through tissue."""
        return np.asarray(0.2 * NEPER * self.setup.attenuation * np.asarray(depth_mm, dtype=float))

    @property
    def lost_in_delay(self) -> float:
        """Neper a MHz, there and back through the delay line."""
        delay = self.setup.delay
        return float(NEPER * delay.loss_db_cm * 2 * delay.length_mm / 10 / 5)

    def echoes(self, time_us: Array, height: npt.NDArray[np.generic], lost: Array) -> Complex:
        """Sum of echoes (n, m) over the pulse, as spectra (n, band): when, how high, and what they lost in neper a MHz."""
        heard = time_us < self.last_us
        time = np.where(heard, time_us, 0.0)
        return echo_spectra(time, np.where(heard, height, 0), lost, self.mhz, self.step_mhz)

    def echo(self, time_us: Array, lost: Array) -> Complex:
        """One echo of height 1 a line (n, band)."""
        return self.echoes(time_us[:, None], np.ones((len(time_us), 1)), lost[:, None])

    def peaks(self, spectra: Complex) -> Array:
        """Height of the envelope's peak (n,) of one short echo each."""
        every = max(int(1 / (ECHO_US * self.step_mhz)), 1)
        return short_peaks(spectra * self.pulse, every, self.size)


@dataclass(frozen=True, eq=False)
class Scene:
    """The lines of a recording under way, and what their parts need of it; arrays (n,)."""

    setup: Setup
    hand: Hand
    ground: Ground
    start_us: Array  # the trigger
    line_us: Array  # there and back through the delay line
    skin_us: Array
    coupling: Array
    alike: Array  # how much of its scatterers a line shares with the line before

    @property
    def through(self) -> Array:
        """What comes of an echo through the face, there and back."""
        return np.asarray((1 - self.setup.delay.face_r**2) * self.coupling**2)

    @property
    def face_r(self) -> Array:
        """Reflection of the delay line's face: a part of it may be dry."""
        partly = self.setup.delay.face_r * self.coupling - 0.9 * (1 - np.minimum(self.coupling, 1))
        return np.where(self.ground.wet, partly, AIR_R)

    @property
    def clear(self) -> Bools:
        """Bone met squarely by a probe that is held."""
        return np.asarray(self.ground.bone & self.hand.on & self.hand.square)

    @property
    def axial_us(self) -> Array:
        """From the skin to the bone along the beam, there and back."""
        return np.asarray(2 * self.hand.depth_mm / self.setup.mm_us)

    @property
    def shortest_us(self) -> Array:
        """From the skin to the bone where it is nearest, there and back; the way in the delay line shortens too."""
        faster = self.setup.delay.speed_m_s / self.setup.speed_m_s
        refracted = np.clip(np.sin(np.radians(self.hand.askew_deg)) * faster, 0, 0.95)
        return np.asarray(2 * self.hand.thick_mm / self.setup.mm_us - self.line_us * (1 - np.sqrt(1 - refracted**2)))

    def shimmer(self, rng: np.random.Generator, columns: int) -> Floats:
        """Normal numbers (n, columns) that change from line to line as the probe moves on."""
        fresh = rng.standard_normal((len(self.alike), columns), dtype=np.float32)
        keeps = self.alike.astype(np.float32)
        fresh *= np.sqrt(1 - keeps[:, None] ** 2)
        for row in range(1, len(fresh)):
            fresh[row] += keeps[row] * fresh[row - 1]
        return fresh


def draw_scene(rng: np.random.Generator, setup: Setup, frames: int) -> Scene:
    hand = draw_hand(rng, setup, frames)
    ground = draw_ground(rng, setup, hand)
    count, delay = len(hand.place), setup.delay
    steady = np.clip(1 + wander(rng, count, 5, 0.1)[:, 0], 0.6, 1.2)
    coupling = np.where(hand.state == "edge", rng.uniform(0.05, 0.7, count), steady) * ground.wet
    start_us: Array = delay.latency_us + rng.normal(0, 0.004, count)
    line_us: Array = setup.delay_us * (1 + delay.slower + np.linspace(0, delay.warms, count, dtype=float))
    film_mm = np.abs(rng.normal(0.03, 0.02, count))  # of gel
    moved_mm = np.linalg.norm(np.diff(hand.aside_mm, axis=0, prepend=hand.aside_mm[:1]), axis=1)
    turned_deg = np.linalg.norm(np.diff(hand.tilt_deg, axis=0, prepend=hand.tilt_deg[:1]), axis=1)
    alike = np.exp(-((moved_mm / (0.35 * setup.transducer.disc_mm)) ** 2) - (turned_deg / 3) ** 2)
    alike[np.diff(hand.place, prepend=-1) != 0] = 0
    skin_us = start_us + line_us + 2 * film_mm / setup.mm_us
    return Scene(setup, hand, ground, start_us, line_us, skin_us, coupling, alike)


def bone_echo(scene: Scene, band: Band, rng: np.random.Generator) -> Complex:
    """Bone's echo in every line as if it were there, over the pulse (n, band): a mirror, and what its roughness scatters."""
    skull, hand = scene.setup.skull, scene.hand
    lost = band.lost(hand.depth_mm) + band.lost_in_delay
    mirrored = band.mirror(hand.askew_deg) * band.echo(scene.skin_us + scene.shortest_us, lost)
    lag = _lags(scene, rng, 1, BONE_PARTS)[:, 0]
    strength = scene.shimmer(rng, BONE_PARTS) / np.sqrt(BONE_PARTS)
    strength *= (skull.diffuse * np.exp(-((hand.askew_deg / 14) ** 2)))[:, None]
    time = (scene.skin_us + scene.axial_us)[:, None] + lag
    scattered = band.echoes(time, strength, np.broadcast_to(lost[:, None], time.shape))
    return np.asarray((mirrored + scattered) * (skull.reflection * scene.through).astype(np.float32)[:, None])


def _lags(scene: Scene, rng: np.random.Generator, layers: int, parts: int) -> Array:
    """How much later (n, layers, parts) the parts of a rough layer answer: each place has its own, across the tilted beam."""
    places = int(scene.hand.place[-1]) + 1
    across_mm = rng.uniform(-0.3, 0.3, (places, layers, parts, 2)) * scene.setup.transducer.disc_mm
    further_mm = rng.exponential(0.05, (places, layers, parts))
    slope = np.tan(np.radians(scene.hand.tilt_deg))[:, None, None, :]
    rows = scene.hand.place
    return np.asarray(2 * ((across_mm[rows] * slope).sum(axis=3) + further_mm[rows]) / scene.setup.mm_us)


def after_bone(scene: Scene, band: Band, rng: np.random.Generator) -> Complex:
    """What follows bone, over it (n, band): diploe, inner table, bone again by way of the face or the delay line."""
    setup, skull, hand = scene.setup, scene.setup.skull, scene.hand
    count = len(hand.place)
    entering = 0.35 * (1 - skull.reflection**2) / skull.reflection
    depth_mm = np.append((np.arange(DIPLOE_PARTS) + 0.6) / DIPLOE_PARTS * skull.thick_mm, skull.thick_mm)
    height = np.append(skull.diploe * scene.shimmer(rng, DIPLOE_PARTS), np.full((count, 1), -entering), axis=1)
    time = np.broadcast_to(2 * depth_mm / BONE_MM_US, height.shape)
    lost = np.broadcast_to(0.2 * NEPER * skull.attenuation * depth_mm, height.shape)
    if setup.delay.length_mm:
        heard = scene.skin_us + scene.axial_us + scene.line_us < band.last_us
        again = heard * scene.face_r * setup.delay.back_r
        time = np.append(time, scene.line_us[:, None], axis=1)
        height = np.append(height, again[:, None], axis=1)
        lost = np.append(lost, np.full((count, 1), band.lost_in_delay), axis=1)
    total = band.echoes(time, height, lost)
    under_face = band.mirror(1.5 * hand.askew_deg) * band.echo(scene.shortest_us, band.lost(hand.depth_mm))
    total += np.float32(skull.reflection * skull.again) * under_face
    return total


@dataclass(frozen=True, eq=False)
class Layers:
    """Layers of the tissue, line by line (n, m)."""

    depth_mm: Array
    height: Array  # 0: not there
    askew_deg: Array


def _draw_layers_of_place(rng: np.random.Generator, thick_mm: float) -> list[tuple[float, float, bool]]:
    """Where a layer lies, over the scalp's thickness; its reflection; whether it lies behind where bone would be."""

    def either(least: float, most: float) -> float:
        return float(rng.uniform(least, most) * rng.choice([-1, 1]))

    drawn = [(min(rng.uniform(1.1, 2.1) / thick_mm, 0.5), either(0.03, 0.11), False)]  # dermis to fat
    if thick_mm > 3:
        drawn.append((1 - rng.uniform(0.6, 1.8) / thick_mm, either(0.02, 0.08), False))  # galea
    if rng.random() < 0.5:
        drawn.append((1 - min(rng.uniform(0.3, 0.6) / thick_mm, 0.15), rng.uniform(0.01, 0.04), False))  # periosteum
    if thick_mm > 6.5:
        drawn += [(rng.uniform(0.35, 0.8), either(0.02, 0.09), False) for _ in range(2)]  # fasciae
    behind_mm = thick_mm + np.cumsum(rng.uniform(1, 6, 5))
    return drawn + [(place / thick_mm, either(0.02, 0.09), True) for place in behind_mm]


def _draw_layers(scene: Scene, rng: np.random.Generator) -> Layers:
    """The layers of every place. Those behind are seen where there is no bone; the skin's follows the probe."""
    hand, soft = scene.hand, scene.ground.soft
    places = [np.flatnonzero(hand.place == number) for number in range(int(hand.place[-1]) + 1)]
    thick = [float(np.median(hand.thick_mm[rows])) for rows in places]
    drawn = [_draw_layers_of_place(rng, thick_mm) for thick_mm in thick]
    shape = (len(soft), max(len(layers) for layers in drawn))
    depth, height, askew = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for rows, thick_mm, layers in zip(places, thick, drawn):
        for column, (share, reflection, behind) in enumerate(layers):
            off_deg = np.hypot(*(hand.tilt_deg[rows] + rng.normal(0, 0.8, 2)).T)
            depth[rows, column] = hand.thick_mm[rows] * share
            height[rows, column] = reflection * (soft[rows] if behind else 1)
            askew[rows, column] = off_deg * (0.4 if share * thick_mm < 2.2 else 1.0)
    height *= scene.through[:, None]
    seen = np.flatnonzero(height.any(axis=0))
    return Layers(depth[:, seen], height[:, seen], askew[:, seen])


def tissue(scene: Scene, band: Band, rng: np.random.Generator) -> Complex:
    """Layers, and speckle down to the bone, over the pulse (n, band)."""
    setup, hand, mm_us = scene.setup, scene.hand, scene.setup.mm_us
    layers = _draw_layers(scene, rng)
    count, columns = layers.height.shape
    parts = (count, columns * LAYER_PARTS)
    lags = _lags(scene, rng, columns, LAYER_PARTS).reshape(parts)
    rough_mm = np.repeat(layers.depth_mm, LAYER_PARTS, axis=1)
    strength = scene.shimmer(rng, parts[1]) * (DIFFUSE_LAYER / np.sqrt(LAYER_PARTS))
    strength *= np.repeat(layers.height, LAYER_PARTS, axis=1)
    speckle_mm = (np.arange(SPECKLE_PARTS) + rng.random(SPECKLE_PARTS)) / SPECKLE_PARTS * SPECKLE_MM
    speckle_mm = speckle_mm * (1 - hand.pressed[:, None])
    speckle = scene.shimmer(rng, SPECKLE_PARTS) * (setup.speckle * scene.through)[:, None]
    speckle *= scene.ground.soft[:, None] | (speckle_mm < hand.depth_mm[:, None] - CLEAR_MM)
    seen = np.flatnonzero(speckle.any(axis=0))
    depth = np.concatenate([rough_mm, speckle_mm[:, seen]], axis=1)
    later = np.concatenate([lags, np.zeros((count, len(seen)))], axis=1)
    height = np.concatenate([strength, speckle[:, seen]], axis=1)
    time = scene.skin_us[:, None] + 2 * depth / mm_us + later
    total = band.echoes(time, height, band.lost(depth) + band.lost_in_delay)
    for column in range(columns):
        rows = np.flatnonzero(layers.height[:, column])
        depth_mm = layers.depth_mm[rows, column]
        echo = band.echo(scene.skin_us[rows] + 2 * depth_mm / mm_us, band.lost(depth_mm) + band.lost_in_delay)
        echo *= band.mirror(layers.askew_deg[rows, column])
        total[rows] += echo * layers.height[rows, column].astype(np.float32)[:, None]
    return total


def delay_line(scene: Scene, band: Band, rng: np.random.Generator) -> Complex:
    """The delay line's echo and its multiples, over the pulse (n, band): a drop may hang on it in air, its edges answer."""
    delay, count = scene.setup.delay, len(scene.line_us)
    drop = ~scene.ground.wet & (rng.random(count) < 0.25)
    once_us = scene.line_us + drop * rng.uniform(0, 0.4, count)
    number = np.arange(1, DELAY_ECHOES + 1)
    time = scene.start_us[:, None] + once_us[:, None] * number
    height = scene.face_r[:, None] ** number * delay.back_r ** (number - 1)
    lost = np.broadcast_to(band.lost_in_delay * number, time.shape)
    if delay.static:
        edges_us = (scene.start_us + scene.line_us)[:, None] + rng.uniform(0.6, 6, 3)
        edges = np.broadcast_to(decibel(-rng.uniform(45, 58, 3)), edges_us.shape)
        time, height = np.append(time, edges_us, axis=1), np.append(height, edges, axis=1)
        lost = np.append(lost, np.full(edges_us.shape, band.lost_in_delay), axis=1)
    return band.echoes(time, height, lost)
