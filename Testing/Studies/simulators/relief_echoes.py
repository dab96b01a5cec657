"""Echoes of a skull in relief, as spectra of each line: bone, layers, speckle, and the face of the delay line.

The bone is a patch of facets under the beam, read from a rough surface that repeats. Everything in tissue is put in as it comes
back to the skin; relief_lines.py adds probe and receiver.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft

from Testing.Studies.simulators.relief_plan import (
    MATERIALS,
    SQUARE_DEG,
    Array,
    Bools,
    Ground,
    Hand,
    Setup,
    decibel,
    wander,
)

Floats = npt.NDArray[np.float32]
Spectra = npt.NDArray[np.complex64]

NEPER = np.log(10) / 20  # a decibel
TISSUE_MRAYL, BONE_R = 1.63, (0.52, 0.65)
BONE_MM_US = 2.9
GUARD_US = 6.0  # behind the last sample: what begins there goes round to the first
ECHO_US = 8.0  # no echo of bone is longer
FACETS, FACETS_WIDE = 64, 2.6  # across the beam; standard deviations to each side
GRID_MM, GRID = 0.1, 256  # of the relief, which repeats
FINE = 24  # steps a cycle of the facets' delays
WAVES = 6  # by which layers and speckle change along the skin


def turned(turns: Array, lost: Array | float = 0.0) -> Spectra:
    """exp(-2 pi i turns - lost)."""
    angle = ((turns - np.rint(turns)) * (-2 * np.pi)).astype(np.float32)
    out = np.empty(angle.shape, dtype=np.complex64)
    height = np.exp(-np.asarray(lost, dtype=np.float32))
    np.multiply(np.cos(angle), height, out=out.real)
    np.multiply(np.sin(angle), height, out=out.imag)
    return out


class Band:
    """Frequencies of the pulse, the pulse in them, and what tissue does to each."""

    def __init__(self, setup: Setup, rng: np.random.Generator, samples: int) -> None:
        self.setup, centre, sampling = setup, setup.centre_mhz, setup.sampling_mhz
        self.size = scipy.fft.next_fast_len(samples + int(GUARD_US * sampling), real=True)
        self.step_mhz = sampling / self.size
        first = int(0.12 * centre / self.step_mhz) + 1
        last = int(min(2.1 * centre, 0.48 * sampling) / self.step_mhz)
        self.slice = slice(first, last + 1)
        self.mhz: Array = np.arange(first, last + 1) * self.step_mhz
        self.pulse = self._draw_pulse(rng)
        loss = 0.2 * NEPER * setup.attenuation  # neper a mm and MHz
        dispersion = loss * self.mhz * (np.log(self.mhz / centre) - 1) / np.pi**2  # turns, of a loss that grows with frequency
        self.lost_mm: Array = loss * self.mhz
        self.turns_mm: Array = self.mhz * setup.us_mm - dispersion

    @property
    def through_line(self) -> Array:
        """What the delay line leaves, there and back (band,)."""
        line = self.setup.delay_line
        if line is None:
            return np.ones(len(self.mhz))
        return np.asarray(np.exp(-0.2 * NEPER * MATERIALS[line.material].loss_db_cm * line.length_mm * self.mhz / 5))

    def _draw_pulse(self, rng: np.random.Generator) -> npt.NDArray[np.complex128]:
        """Spectrum of the pulse both ways: a resonance with an unknown phase; the envelope's peak is 1, at time zero."""
        centre, mhz = self.setup.centre_mhz, self.mhz
        width = self.setup.bandwidth * centre / 2.3548
        spectrum = np.exp(-0.5 * ((mhz - centre) / width) ** 2) / (1 + (0.15 * centre / mhz) ** 4)
        ringing = spectrum / (1 + 1j * rng.uniform(0, 1.2) * (mhz / centre - centre / mhz))
        ringing = ringing * np.exp(1j * rng.uniform(-np.pi, np.pi))
        at = np.linspace(-1.5, 3, 73) / centre
        for _ in range(2):  # coarse, then around the largest
            height = np.abs(np.exp(2j * np.pi * np.outer(at, mhz)) @ ringing)
            peak, step = at[height.argmax()], at[1] - at[0]
            at = peak + np.linspace(-step, step, 57)
        below = np.clip((0.48 * self.setup.sampling_mhz - mhz) / (0.06 * self.setup.sampling_mhz), 0, 1)
        anti_alias = np.sin(np.pi / 2 * below) ** 2
        return np.asarray(ringing * np.exp(2j * np.pi * mhz * peak) / height.max() * anti_alias)

    def delayed(self, time_us: Array) -> Spectra:
        """Delays (n,) as factors (n, band)."""
        return turned(np.outer(time_us, self.mhz))

    def way(self, depth_mm: Array) -> Spectra:
        """There and back through tissue (n, band)."""
        return turned(np.outer(depth_mm, self.turns_mm), np.outer(depth_mm, self.lost_mm))

    def ways(self, step_mm: float, count: int) -> Spectra:
        """The same for depths (count,) from half a step on: powers within a block times powers of whole blocks."""
        block = int(np.sqrt(count)) + 1
        fine = self.way((np.arange(block) + 0.5) * step_mm)
        coarse = self.way(np.arange(0, count, block) * step_mm)
        return np.asarray((coarse[:, None] * fine).reshape(-1, len(self.mhz))[:count])

    def peaks(self, spectra: Spectra, time_us: Array) -> Array:
        """Height of the envelope (n,) of echoes that arrive about `time_us` (n,)."""
        every = max(int(1 / (ECHO_US * self.step_mhz)), 1)
        few = spectra[:, ::every] * turned(np.outer(-time_us, self.mhz[::every]))
        size = scipy.fft.next_fast_len(4 * few.shape[1])
        return np.asarray(np.abs(scipy.fft.ifft(few, size, axis=1)).max(axis=1) * (size * every), dtype=float)


@dataclass(frozen=True, eq=False)
class Scene:
    """Probe and head in each of n lines."""

    setup: Setup
    hand: Hand
    ground: Ground
    band: Band
    reach_mm: float  # that the lines show
    last_us: float  # what comes later is not simulated
    face_us: Array  # (n,) end of the delay line
    trigger_us: Array  # (n,)
    bone_r: float
    face_r: float  # reflection of the delay line's wet face; 0: none
    back_r: float  # what the transducer throws back
    coupled: Array  # (n,) share of the sound that enters the skin
    waves: Floats  # (WAVES, n) slow changes along the skin
    entered: Spectra  # (n, band) the pulse in the skin, the way through the delay line without its delay

    @property
    def bone(self) -> Bools:
        """Where there is bone, however little of its echo."""
        return np.asarray(np.isin(self.hand.kind, ["bone", "touch", "hair"]) & (self.setup.without == ""))

    @property
    def square(self) -> Bools:
        """Lines that the noise is set by."""
        return np.asarray((self.hand.kind == "bone") & (self.hand.tilt_deg <= SQUARE_DEG) & ~self.ground.edge)

    @property
    def skin_us(self) -> Array:
        return np.asarray(self.face_us + self.trigger_us)


def draw_scene(rng: np.random.Generator, setup: Setup, hand: Hand, ground: Ground) -> tuple[Scene, int]:
    """Probe and contact of each line; and how many samples a line has."""
    count, line = len(hand.kind), setup.delay_line
    face_us = setup.face_us(count)
    latest_us = 0.02 if line is None else 0.1
    trigger_us = rng.uniform(-latest_us, latest_us) + rng.normal(0, 0.001, count)
    reach_mm = float(max(20.0, 1.6 * setup.depth_mm) + rng.uniform(0, 6))
    more_us = float(rng.uniform(3, 14)) if rng.random() < 0.4 else 0.0
    samples = int(np.ceil((face_us.max() + reach_mm * setup.us_mm + more_us) * setup.sampling_mhz))
    band = Band(setup, rng, samples)
    face_r = 0.0
    if line is not None:
        made = MATERIALS[line.material].impedance_mrayl
        face_r = float(TISSUE_MRAYL * rng.uniform(0.95, 1.05) - made) / (TISSUE_MRAYL + made)
        face_r = float(np.copysign(max(abs(face_r), 0.025), face_r))
    coupled = _draw_contact(rng, hand)
    turns = rng.normal(0, 1 / 1.5, (WAVES, 2)) @ hand.moved_mm.T + rng.uniform(0, 6.3, (WAVES, 1))
    waves = np.cos(turns + 2.4 * np.arange(WAVES)[:, None] * hand.place).astype(np.float32)
    entered = band.pulse * (1 - face_r**2) * band.through_line
    scene = Scene(
        setup=setup,
        hand=hand,
        ground=ground,
        band=band,
        reach_mm=reach_mm,
        last_us=samples / setup.sampling_mhz + 2,
        face_us=face_us,
        trigger_us=trigger_us,
        bone_r=float(rng.uniform(*BONE_R)),
        face_r=face_r,
        back_r=float(rng.uniform(0.25, 0.5)),
        coupled=coupled,
        waves=waves,
        entered=(coupled[:, None] * entered).astype(np.complex64),
    )
    return scene, samples


def _draw_contact(rng: np.random.Generator, hand: Hand) -> Array:
    """Share of the sound that comes through the skin (n,); hair lets the faintest echo through."""
    count = len(hand.kind)
    coupled = np.where(hand.touching, 1.0, np.where(hand.kind == "touch", rng.uniform(0.05, 0.6, count), 0.0))
    coupled *= decibel(wander(rng, count, hand.step_s, 0.4, 0.7))
    hair = hand.kind == "hair"
    coupled[hair] = decibel(-rng.uniform(38, 50, hair.sum()))
    return coupled


def add_bone(rng: np.random.Generator, scene: Scene, from_skin: Spectra) -> tuple[Array, Array]:
    """Put in bone, the lower face of its outer table and its second echo; height of the echo and relief in mm (n,)."""
    setup, hand, band, bone_r = scene.setup, scene.hand, scene.band, scene.bone_r
    rows = np.flatnonzero(scene.bone)
    peak, relief_mm = np.zeros(len(hand.kind)), np.zeros(len(hand.kind))
    if len(rows) == 0:
        return peak, relief_mm
    depth_mm = scene.ground.depth_mm[rows]
    surface, relief_mm[rows] = answer_of_surface(rng, scene, rows)
    once = surface * band.way(depth_mm)
    echo = bone_r * once
    peak[rows] = band.peaks(echo * scene.entered[rows], depth_mm * setup.us_mm)
    table_mm = rng.uniform(1, 3, hand.places)[hand.place[rows]]
    lost = 0.2 * NEPER * rng.uniform(3, 8) * np.outer(table_mm, band.mhz)
    below = rng.uniform(0.15, 0.4) / bone_r * (1 - bone_r**2)
    table = turned(np.outer(table_mm * (2 / BONE_MM_US), band.mhz), lost)
    from_skin[rows] = echo - echo * table * np.float32(below)
    heard = scene.face_us[rows] + 2 * depth_mm * setup.us_mm < scene.last_us
    skin_r = scene.face_r if setup.delay_line else -scene.back_r
    from_skin[rows[heard]] += np.float32(skin_r * bone_r) * echo[heard] * once[heard]
    return peak, relief_mm


def answer_of_surface(rng: np.random.Generator, scene: Scene, rows: npt.NDArray[np.intp]) -> tuple[Spectra, Array]:
    """What the patch of bone makes of a pulse (rows, band), of 1 for a mirror met squarely; and relief on the axis, mm."""
    setup, hand, band = scene.setup, scene.hand, scene.band
    relief = _draw_relief(rng)
    deviation = setup.beam_mm / 2.3548
    across = np.linspace(-FACETS_WIDE, FACETS_WIDE, FACETS) * deviation
    lit = np.exp(-0.5 * (across / deviation) ** 2)
    weight = np.outer(lit, lit) / lit.sum() ** 2
    centre = hand.moved_mm[rows] + rng.uniform(0, 25, (hand.places, 2))[hand.place[rows]]
    slope = np.tan(np.radians(hand.lean_deg[rows]))
    plane_mm = slope[:, :, None] * across + across**2 / 2 / scene.ground.round_mm[hand.place[rows], None, None]
    further_mm = _read_relief(relief, centre[:, :1] + across, centre[:, 1:] + across)
    further_mm += plane_mm[:, 0, :, None].astype(np.float32) + plane_mm[:, 1, None, :].astype(np.float32)
    on_axis = _read_relief(relief, centre[:, :1], centre[:, 1:])[:, 0, 0]
    # arrivals on a grid of delays, each facet shared between two steps
    step_us = 1 / (FINE * setup.centre_mhz)
    delay = further_mm * np.float32(setup.us_mm / step_us)
    whole = np.floor(delay)
    part = (delay - whole) * weight.astype(np.float32)
    first = int(whole.min())
    steps = int(whole.max()) - first + 2
    at = (whole.astype(np.int64) - first + steps * np.arange(len(rows))[:, None, None]).ravel()
    size = len(rows) * steps
    shares = np.bincount(at, (weight.astype(np.float32) - part).ravel(), size)
    shares += np.bincount(at + 1, part.ravel(), size + 1)[:size]
    series = turned(np.outer((first + np.arange(steps)) * step_us, band.mhz))
    return shares.reshape(len(rows), steps).astype(np.complex64) @ series, on_axis


def _draw_relief(rng: np.random.Generator) -> Floats:
    """Height of the bone over its mean surface (GRID, GRID), mm: smoothed noise that repeats."""
    noise = scipy.fft.rfft2(rng.standard_normal((GRID, GRID), dtype=np.float32))
    alike, across, along = rng.uniform(3, 10), scipy.fft.fftfreq(GRID), scipy.fft.rfftfreq(GRID)
    noise *= np.exp(-2 * (np.pi * alike) ** 2 * (across[:, None] ** 2 + along**2)).astype(np.float32)
    relief = scipy.fft.irfft2(noise, (GRID, GRID))
    return np.asarray(relief * np.float32(rng.uniform(0.005, 0.045) / relief.std()))


def _read_relief(relief: Floats, along_mm: Array, aside_mm: Array) -> Floats:
    """Bilinear values (n, m, k) at along_mm (n, m) and aside_mm (n, k)."""

    def split(position_mm: Array) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Floats]:
        position = position_mm / GRID_MM
        lower = np.floor(position).astype(np.int64)
        return lower % GRID, (lower + 1) % GRID, (position - lower).astype(np.float32)

    before, behind, share = split(along_mm)
    left, right, aside = split(aside_mm)
    flat, share, aside = relief.ravel(), share[:, :, None], aside[:, None, :]

    def row(number: npt.NDArray[np.int64]) -> Floats:
        start = (number * GRID)[:, :, None]
        low, high = flat[start + left[:, None, :]], flat[start + right[:, None, :]]
        return np.asarray(low + (high - low) * aside)

    low, high = row(before), row(behind)
    return np.asarray(low + (high - low) * share)


def add_layers(rng: np.random.Generator, scene: Scene, from_skin: Spectra) -> None:
    """Put in what else reflects: skin to fat, fat to muscle, galea; sheets where there is no bone, dura where it is missing."""
    if scene.setup.without in ("air", "gel"):
        return
    hand, depth_mm, tilt = scene.hand, scene.ground.depth_mm, scene.hand.tilt_deg
    fat = float(decibel(rng.uniform(-6, 0)))
    for place in range(hand.places):
        rows = np.flatnonzero((hand.place == place) & (scene.coupled > 0) & (hand.kind != "gel"))
        if len(rows) == 0:
            continue
        typical = float(np.median(depth_mm[rows]))
        missing = rows[hand.kind[rows] == "defect"]
        if (hand.kind[rows] == "soft").any():
            layers = _draw_sheets(rng, scene.reach_mm)
        else:
            layers = _draw_layers(rng, scene.setup, typical)
        listed = [(rows, *layer) for layer in layers]
        if len(missing):
            listed.append((missing, typical + rng.uniform(2, 5), rng.uniform(0.03, 0.08), 0.3))
        for number, (where, deep, reflection, follows) in enumerate(listed):
            at_mm = deep / typical * depth_mm[where] + 0.03 * scene.waves[number % WAVES, where]
            lobe = np.exp(-((max(follows, 0.3) * tilt[where] / 4.5) ** 2))
            height = reflection * fat * rng.choice([-1, 1]) * decibel(3 * scene.waves[(number + 2) % WAVES, where]) * lobe
            from_skin[where] += height[:, None].astype(np.float32) * scene.band.way(at_mm)


def _draw_layers(rng: np.random.Generator, setup: Setup, deep_mm: float) -> list[tuple[float, float, float]]:
    """Layers over bone at `deep_mm`: depth, reflection, how far each leans with the bone."""
    layers = [(min(float(rng.uniform(1.2, 2.4)), 0.55 * deep_mm), float(rng.uniform(0.03, 0.12)), 0.0)]
    if deep_mm > 4.5:
        layers.append((float(rng.uniform(0.45, 0.75)) * deep_mm, float(rng.uniform(0.02, 0.09)), 0.4))
    if deep_mm > 8 and rng.random() < 0.6:
        layers.append((float(rng.uniform(0.3, 0.85)) * deep_mm, float(rng.uniform(0.02, 0.08)), 0.4))
    gap = float(rng.uniform(0.6, 1.7)) * max(1.0, float(np.sqrt(5 / setup.centre_mhz)))
    if deep_mm > 3 + gap and rng.random() < 0.7:
        layers.append((deep_mm - gap, float(rng.uniform(0.02, 0.09)), 0.8))
    return layers


def _draw_sheets(rng: np.random.Generator, reach_mm: float) -> list[tuple[float, float, float]]:
    """Neck or cheek: sheets all the way down, none of them the last, and none that stands out."""
    reflection = rng.uniform(0.025, 0.07)
    deep = 1.4 + np.cumsum(rng.uniform(1.0, 3.5, 24))
    return [(float(one), float(reflection * rng.uniform(0.6, 1.3)), 0.3) for one in deep[deep < reach_mm]]


def add_speckle(rng: np.random.Generator, scene: Scene, from_skin: Spectra) -> None:
    """Put in what scatters, down to the bone; it changes as the probe moves along the skin, and is pressed with it."""
    setup, hand, ground, band = scene.setup, scene.hand, scene.ground, scene.band
    if setup.without in ("air", "gel"):
        return
    step_mm = setup.speed_m_s / (10e3 * setup.centre_mhz)
    count = int(scene.reach_mm / step_mm)
    depth_mm = (np.arange(count) + 0.5) * step_mm
    level = rng.uniform(-34, -26) if setup.without == "soft" else rng.uniform(-44, -30)
    power = 0.5 * np.sum(np.abs(band.pulse) ** 2) / (band.step_mhz * step_mm * setup.us_mm)  # of the real pulse, over the steps
    height = float(decibel(level)) * scene.bone_r * np.abs(band.pulse.sum()) / np.sqrt(2 * power)
    scatter = np.zeros((len(hand.kind), count), dtype=np.float32)
    for place in range(hand.places):
        rows = np.flatnonzero((hand.place == place) & (scene.coupled > 0) & (hand.kind != "gel"))
        knots_mm, knots_db = np.sort(rng.uniform(0, scene.reach_mm, 5)), rng.uniform(-5, 4, 5)
        profile = decibel(np.interp(depth_mm, knots_mm, knots_db)) * (height / np.sqrt(WAVES / 2))
        kept = rng.standard_normal((WAVES, count), dtype=np.float32) * profile.astype(np.float32)
        at = np.minimum((depth_mm / (ground.pressed[rows, None] * step_mm)).astype(np.int64), count - 1)
        scatter[rows] = np.take_along_axis(scene.waves[:, rows].T @ kept, at, axis=1)
    scatter[scene.bone[:, None] & (depth_mm > ground.depth_mm[:, None] - 0.05)] = 0
    scatter[(hand.kind == "defect")[:, None] & (depth_mm > ground.depth_mm[:, None])] *= np.float32(0.6)
    used = int(np.flatnonzero(scatter.any(axis=0))[-1]) + 1 if scatter.any() else 1
    ways = band.ways(step_mm, used)
    from_skin.real += scatter[:, :used] @ np.ascontiguousarray(ways.real)
    from_skin.imag += scatter[:, :used] @ np.ascontiguousarray(ways.imag)


def add_face(scene: Scene, spectra: Spectra) -> None:
    """Put in the echo of the delay line's face, which turns over in air, a faint one behind it, and its multiples."""
    setup, band = scene.setup, scene.band
    line = setup.delay_line
    assert line is not None
    wet = np.clip(scene.coupled, 0, 1)
    answers = (wet * scene.face_r - (1 - wet) * 0.97)[:, None].astype(np.float32)
    again = answers * band.through_line.astype(np.float32) * band.delayed(scene.face_us)
    echo = again * (band.pulse * band.delayed(scene.trigger_us)).astype(np.complex64)
    spectra += echo * (1 + line.trail * band.delayed(np.array([line.trail_us])))
    for number in range(2, 5):
        echo *= again * np.float32(-scene.back_r)
        spectra += echo * (number * scene.face_us < scene.last_us)[:, None]
