"""Simulated A-lines that cover the stated ranges evenly: every quantity over its whole range, whatever the others are.

The other families are drawn as devices and heads usually are; here a slow transducer on thin skin is as frequent as any other
set-up. What they lack besides: the bone's echo is that of a disc on a tilted plane, filtered for each frequency (nulls, smear)
and moved by the tilt, over diffuse echoes of a rough surface that passes under the beam; a diploe that scatters behind the bone;
layers with tilts of their own that outshine the bone now and then; tissue without bone in which echoes go on behind every echo
that one sees; and a fixed share of recordings wholly without bone: soft tissue, air, or the cable pulled.
What a recording is drawn from is in range_plan.py, the pulse in range_pulse.py.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.range_plan import (
    Array,
    Hand,
    World,
    decibel,
    draw_hand,
    draw_poses,
    draw_statuses,
    draw_world,
)
from Testing.Studies.simulators.range_pulse import Pulse, Rows, Sheet, Spectra, Waves

SKULL_MM_US = 2.9
SCATTERERS, PATCH_MM, ROUGH_MM = 70, 6.0, 0.05  # of the bone's surface: how many, over what half width, how high
BANDS_MM = np.linspace(0.3, 32, 13)  # depths between which speckle has one attenuation
SPECKLE_KEEPS = 0.92  # from line to line
BONE_SPECKLE_DB, SOFT_SPECKLE_DB = (-42, -28), (-28, -18)
TAIL = 6.5  # time constants of the diploe that are simulated: below, nothing shows
NEAR_DEG = 3.0  # bone that tells the recording's SNR
TABLES_MM = ((1.2, 2.5, -1), (4.0, 8.0, 1))  # of bone behind its surface, and the sign of their echo


class Scene:
    """What of the drawn recording its parts need: when the skin answers, and how loud what is under it."""

    def __init__(self, world: World, hand: Hand, rng: np.random.Generator) -> None:
        self.world, self.hand, self.rng = world, hand, rng
        lines = len(hand.place)
        stated = world.acquisition
        late = 1 + world.tolerance + world.warming * np.linspace(0, 1, lines)
        self.face_us = 2e3 * stated.forerun_length_mm / (stated.forerun_speed_m_s or 1.0) * late
        self.jitter_us = world.jitter_us * rng.normal(size=lines)
        self.skin_us = self.face_us + self.jitter_us
        self.samples = int((self.face_us.max() + 2 * world.behind_mm / world.mm_us) * world.sampling_mhz) + 8
        self.through = 1 - world.face_r**2  # the face, both ways
        self.depth_mm = np.where(hand.bone, hand.depth_mm, world.depth_mm)
        self.bone_us = 2 * self.depth_mm / world.mm_us
        self.bone_r = self.each(0.45, 0.65)
        self.pulse = Pulse(world)
        self.noise = _follow(rng, hand.place, self.samples)

    def each(self, low: float, high: float) -> Array:
        """A value for each place, as one of each line (n,)."""
        return self.rng.uniform(low, high, self.hand.places)[self.hand.place]

    def sign(self) -> int:
        """Either polarity."""
        return int(self.rng.choice([-1, 1]))

    def column(self, values: Array) -> Waves:
        """Values of lines (n,) beside spectra (n, K)."""
        return values.astype(np.float32)[:, None]


def _follow(rng: np.random.Generator, place: Rows, samples: int) -> Waves:
    """Normal numbers whose rows are like the row before, while the place is the same."""
    noise = rng.standard_normal((len(place), samples), dtype=np.float32)
    fresh = np.float32(np.sqrt(1 - SPECKLE_KEEPS**2))
    for row in np.flatnonzero(np.diff(place) == 0) + 1:
        noise[row] *= fresh
        noise[row] += np.float32(SPECKLE_KEEPS) * noise[row - 1]
    return noise


def _rough(scene: Scene) -> Spectra:
    """Diffuse echoes of the surface under the beam (n, K), about the time of the bone on the beam."""
    world, hand, rng, pulse = scene.world, scene.hand, scene.rng, scene.pulse
    beam_mm = 0.3 * world.disc_mm
    spots = (hand.places, SCATTERERS)
    where, strength, high = rng.uniform(-PATCH_MM, PATCH_MM, spots), rng.normal(size=spots), rng.normal(0, ROUGH_MM, spots)
    passed = (hand.along_mm + PATCH_MM) % (2 * PATCH_MM) - PATCH_MM
    off = where[hand.place] - passed[:, None]
    weight = strength[hand.place] * np.exp(-0.5 * (off / beam_mm) ** 2)
    time_us = 2 * (off * np.tan(np.radians(hand.tilt_deg))[:, None] + high[hand.place]) / world.mm_us
    finer = max(1, int(np.ceil(48 * world.centre_mhz / pulse.mhz)))  # 48 places a cycle for the echoes
    count = pulse.samples * finer
    cell = np.rint(time_us * pulse.mhz * finer).astype(np.int64) % count
    cells = np.bincount((cell + np.arange(len(cell))[:, None] * count).ravel(), weight.ravel(), len(cell) * count)
    spectra = scipy.fft.rfft(cells.reshape(len(cell), count).astype(np.float32), axis=1)[:, : len(pulse.frequency)]
    return spectra / np.float32(np.sqrt(SCATTERERS * beam_mm * np.sqrt(np.pi) / (2 * PATCH_MM)))


def _add_bone(scene: Scene, sheet: Sheet) -> Array:
    """Bone, its tables, the way there once more, and its echo by the face's multiple; the peak of the first's envelope (n,)."""
    world, hand, rng, pulse = scene.world, scene.hand, scene.rng, scene.pulse
    height = scene.through * scene.bone_r * hand.bone * hand.coupling * np.where(hand.kind == "edge", 0.4, 1.0)
    tissue = pulse.attenuation(scene.depth_mm)
    echo = scene.column(height) * pulse.spectrum * tissue
    disc = pulse.disc(hand.tilt_deg)
    nearer_us = scene.bone_us * (np.cos(np.radians(hand.tilt_deg)) - 1)
    bone = echo * (disc * pulse.lag(nearer_us) + np.float32(world.rough) * _rough(scene))
    arrival_us = scene.skin_us + scene.bone_us
    sheet.add(arrival_us, bone)
    for low, high, sign in TABLES_MM:
        level = np.float32(sign * decibel(rng.uniform(-30, -16)))
        sheet.add(arrival_us + 2 * scene.each(low, high) / SKULL_MM_US, level * echo * disc)
    back = -world.face_r if world.face_r else rng.uniform(0.2, 0.5) * scene.sign()
    again = scene.column(back * scene.bone_r) * tissue * pulse.disc(2 * hand.tilt_deg)
    sheet.add(arrival_us + scene.bone_us, echo * again)
    if world.face_r:
        _add_face(scene, sheet, bone)
    return pulse.peak_of(bone)


def _add_face(scene: Scene, sheet: Sheet, bone: Spectra) -> None:
    """The delay line's face with its multiples, weak when wet and total in air; and bone heard through the first multiple."""
    world, hand, pulse = scene.world, scene.hand, scene.pulse
    if world.without == "cable":
        return
    wetted = np.clip(hand.coupling, 0, 1)
    reflection = np.where(hand.wet, world.face_r, -1.0)
    reflection = np.where(hand.kind == "transition", world.face_r * wetted - (1 - wetted), reflection)
    within = scene.rng.uniform(0.2, 0.5) * scene.sign() * world.face_loss
    for number in (1, 2, 3):
        height = reflection**number * within ** (number - 1)
        sheet.add(number * scene.face_us + scene.jitter_us, scene.column(height) * pulse.spectrum)
    later = scene.face_us + scene.skin_us + scene.bone_us
    sheet.add(later, scene.column(2 * world.face_r * within * hand.wet) * bone)


def _add_layers(scene: Scene, sheet: Sheet) -> None:
    """Dermis to fat, fat to muscle, galea: with own tilts, none so near to the bone that the two run together."""
    world, hand, rng, pulse = scene.world, scene.hand, scene.rng, scene.pulse
    pulse_mm = 0.44 / (world.bandwidth * world.centre_mhz) * world.mm_us
    for number, share in enumerate((0.7, 0.6, 0.5)):
        there = (rng.random(hand.places) < share)[hand.place]
        gap = max(0.7, 1.5 * pulse_mm) * scene.each(1, 2.5)
        shallow, middle = scene.depth_mm * scene.each(0.2, 0.4), scene.depth_mm * scene.each(0.4, 0.75)
        depth = (shallow, middle, scene.depth_mm - gap)[number]
        there = there & (depth > max(0.8, 1.5 * pulse_mm)) & (scene.depth_mm - depth >= gap * 0.99) & hand.bone
        own = rng.normal(0, 1.2, (2, hand.places))[:, hand.place]
        tilt = np.hypot(hand.tilt_x_deg + own[0], hand.tilt_y_deg + own[1])
        height = scene.through * scene.sign() * scene.each(0.02, 0.12) * there * hand.coupling
        depth = np.maximum(depth, 0.0)
        spectra = scene.column(height) * pulse.spectrum * pulse.attenuation(depth) * pulse.disc(tilt)
        sheet.add(scene.skin_us + 2 * depth / world.mm_us, spectra)


def _add_speckle(scene: Scene, sheet: Sheet, rows: Rows, end_mm: Array, level: float) -> None:
    """What scatters between the skin and a depth (n,) in some of the lines."""
    world, skin_us = scene.world, scene.skin_us[rows]
    height = scene.hand.coupling[rows] * scene.through * level
    if not len(rows):
        return
    for near, far in zip(BANDS_MM[:-1], BANDS_MM[1:]):
        first = max(int((skin_us.min() + 2 * near / world.mm_us) * world.sampling_mhz), 0)
        last = min(int((skin_us.max() + 2 * far / world.mm_us) * world.sampling_mhz) + 2, scene.samples)
        reached = end_mm > near
        if last <= first or not reached.any():
            return
        some = rows[reached]
        depth = (np.arange(first, last) / world.sampling_mhz - skin_us[reached, None]) * (world.mm_us / 2)
        inside = (depth >= near) & (depth < np.minimum(far, end_mm[reached])[:, None])
        grains = scene.noise[some, first:last] * inside * scene.column(height[reached])
        sheet.scatter(some, grains, np.full(len(some), first), np.array([(near + far) / 2]))


def _add_diploe(scene: Scene, sheet: Sheet) -> None:
    """What scatters behind the surface of the bone, dying away."""
    world, rng, rows = scene.world, scene.rng, np.flatnonzero(scene.hand.bone)
    dies_us, level = rng.uniform(0.6, 2), decibel(rng.uniform(-36, -24))
    if not len(rows):
        return
    arrival_us = (scene.skin_us + scene.bone_us)[rows]
    first = ((arrival_us + 0.3) * world.sampling_mhz).astype(np.int64) + 1
    index = first[:, None] + np.arange(int(TAIL * dies_us * world.sampling_mhz))
    behind_us = index / world.sampling_mhz - arrival_us[:, None]
    height = level * scene.through * scene.bone_r[rows] * scene.hand.coupling[rows]
    grains = scene.noise[rows[:, None], np.minimum(index, scene.samples - 1)] * (index < scene.samples)
    grains = grains * (np.exp(-behind_us / dies_us) * height[:, None]).astype(np.float32)
    sheet.scatter(rows, grains, first, scene.depth_mm[rows])


def _soft_tissue(scene: Scene, noise: float, level: float) -> tuple[Rows, Waves]:
    """Tissue without bone, as the lines that have it and what they get: layer after layer, and echoes that go on behind.

    A place where the largest visible echo has nothing behind it could be taken for bone: it is weakened until none is left.
    """
    world, hand, rng, pulse = scene.world, scene.hand, scene.rng, scene.pulse
    rows = np.flatnonzero(hand.soft)
    sheet = Sheet(pulse, len(hand.place), scene.samples)
    _add_speckle(scene, sheet, rows, np.full(len(rows), BANDS_MM[-1]), level)
    for place in np.unique(hand.place[rows]):
        here = hand.soft & (hand.place == place)
        deep = rng.uniform(1.2, 4)
        while deep < 30:
            tilt = np.hypot(hand.tilt_x_deg + rng.normal(0, 2), hand.tilt_y_deg + rng.normal(0, 2))
            depth = deep * (1 + 0.02 * hand.along_mm)
            height = scene.through * hand.coupling * scene.sign() * rng.uniform(0.015, 0.08) * here
            spectra = scene.column(height) * pulse.spectrum * pulse.attenuation(depth) * pulse.disc(tilt)
            sheet.add(scene.skin_us + 2 * depth / world.mm_us, spectra)
            deep += rng.uniform(1.5, 5)
    sheet.draw()
    tissue = sheet.rf[rows]
    for place in np.unique(hand.place[rows]):
        some = np.flatnonzero((hand.place[rows] == place) & (hand.kind[rows] == "soft"))
        if len(some):
            tissue[some] *= np.float32(_weaker(scene, tissue[some], scene.skin_us[rows[some]], noise))
    return rows, tissue


def _weaker(scene: Scene, tissue: Waves, skin_us: Array, noise: float) -> float:
    """By how much lines of one place are weakened so that hardly any has a visible echo with nothing visible behind it."""
    world = scene.world
    size = scipy.fft.next_fast_len(scene.samples)
    spectra = 2 * scipy.fft.fft(tissue, size, axis=1)
    spectra[:, size // 2 :] = 0
    envelope = np.abs(scipy.fft.ifft(spectra, axis=1))[:, : scene.samples]
    pulse_samples = int(2 * 0.88 / (world.bandwidth * world.centre_mhz) * world.sampling_mhz)
    peak, behind, short = np.zeros(len(tissue)), np.zeros(len(tissue)), np.zeros(len(tissue), dtype=bool)
    for line, first in enumerate(((skin_us + 0.8) * world.sampling_mhz).astype(int)):
        at = first + int(envelope[line, first:].argmax())
        rest = envelope[line, at + pulse_samples : at + pulse_samples + int(5 * world.sampling_mhz)]
        peak[line], behind[line], short[line] = envelope[line, at], rest.max(initial=0.0), len(rest) < 10
    weaker = 1.0
    for _ in range(12):
        ends = short | (weaker * behind < np.maximum(0.2 * weaker * peak, 2.2 * noise))
        if ((weaker * peak > 2.8 * noise) & ends).mean() <= 0.1:
            break
        weaker *= 0.6
    return weaker


def _typical(scene: Scene, peak: Array) -> float:
    """Height of the bone's echo in the recording, or where there is none, of the one that would be."""
    near = (scene.hand.kind == "bone") & (scene.hand.tilt_deg <= NEAR_DEG)
    if near.sum() > 3:
        return float(np.median(peak[near]))
    alone = scene.pulse.spectrum * scene.pulse.attenuation(np.array([scene.world.depth_mm]))
    return float(scene.through * 0.55 * scene.pulse.peak_of(alone)[0])


def _same_in_all(scene: Scene, typical: float) -> Waves:
    """What the instrument adds to every line alike (samples,): an echo that stands still, the bang's ring, the base line."""
    world, hand, rng, pulse = scene.world, scene.hand, scene.rng, scene.pulse
    still = Sheet(pulse, 1, scene.samples)
    if world.static:
        at_us = scene.face_us.mean() + 2 * rng.uniform(1.5, 14) / world.mm_us
        still.add(np.array([at_us]), np.float32(decibel(rng.uniform(-26, -12)) * typical) * pulse.spectrum[None])
        still.draw()
    line = still.rf[0].astype(float)
    if world.without == "cable":
        return line.astype(np.float32)
    time_us = np.arange(scene.samples) / world.sampling_mhz
    least_mm = hand.depth_mm[hand.bone].min() if hand.bone.any() else 0.8 * world.depth_mm
    tenth_us = float(np.clip(rng.uniform(0.4, 0.7) * 2 * least_mm / world.mm_us, 0.6, 3))  # the ring is down to a tenth of bone
    if world.face_r:
        tenth_us = rng.uniform(0.7, 2.5)
    ring = np.exp(np.minimum((tenth_us - time_us) / (rng.uniform(0.08, 0.13) * tenth_us), 12))
    line += 0.1 * typical * ring * np.cos(2 * np.pi * world.centre_mhz * time_us * rng.uniform(0.8, 1.1) + rng.uniform(0, 6))
    if rng.random() < 0.5:
        line += rng.uniform(-1, 1) * typical * np.exp(-time_us / rng.uniform(3, 12))
    return line.astype(np.float32)


def _receiver(scene: Scene, noise: float, typical: float) -> Waves:
    """Noise in the receiver's band, interference, and spikes (n, samples)."""
    world, rng = scene.world, scene.rng
    lines, samples = len(scene.hand.place), scene.samples
    size = scipy.fft.next_fast_len(samples, real=True)
    mhz = np.arange(size // 2 + 1) * world.sampling_mhz / size
    low, high = 0.15 * world.centre_mhz, min(2.5 * world.centre_mhz, 0.47 * world.sampling_mhz)
    band = np.exp(-((low / np.maximum(mhz, 1e-6)) ** 4) - (mhz / high) ** 8)
    band = band[: int(np.flatnonzero(band > 1e-4)[-1]) + 1].astype(np.float32)
    spectra = rng.standard_normal((lines, 2 * len(band)), dtype=np.float32).view(np.complex64) * band
    received = scipy.fft.irfft(spectra, size, axis=1)[:, :samples]
    received *= np.float32(noise) / received.std()
    if world.hums:
        turns = 2 * np.pi * rng.uniform(0.15, 1.0) * world.centre_mhz * np.arange(samples) / world.sampling_mhz
        start = rng.uniform(0, 2 * np.pi, (lines, 1)).astype(np.float32)
        tone = np.sin(start) * np.cos(turns).astype(np.float32) + np.cos(start) * np.sin(turns).astype(np.float32)
        received += np.float32(noise * rng.uniform(0.2, 0.5)) * tone
    if world.spikes:
        for row in np.repeat(np.arange(lines), (rng.random(lines) < 0.15) * rng.integers(1, 3, lines)):
            at, lasts = int(rng.integers(5, samples - 5)), int(rng.integers(1, 4))
            received[row, at : at + lasts] += scene.sign() * typical * rng.uniform(0.3, 2)
    return received


def _codes(scene: Scene, rf: Waves, noise: float, typical: float) -> npt.NDArray[np.int16]:
    """What the converter makes of it: bone at a sensible height, and a wet face not clipped unless the gain is too high."""
    world, rng, bits = scene.world, scene.rng, scene.world.bits
    gain = (rng.uniform(1.2, 1.8) if world.hot else rng.uniform(0.15, 0.6)) / typical
    if world.face_r and world.without != "cable" and not world.hot:
        beyond = rng.uniform(1, 2) if rng.random() < 0.1 else 1.0
        gain = min(gain, 0.9 * beyond / abs(world.face_r))
    while bits < 16 and noise * gain * 2 ** (bits - 1) < 0.6:
        bits += 2
    most = 2 ** (bits - 1) - 1
    codes = np.rint(rf * np.float32(gain * most) + np.float32(rng.uniform(-0.03, 0.03) * most))
    return np.asarray(np.clip(codes, -most - 1, most), dtype=np.int16)


def simulate(rng: np.random.Generator, frames: int, world: World | None = None) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines, or of a few when fewer are asked for than a place takes, and the truth about it."""
    world = world or draw_world(rng)
    hand = draw_hand(rng, world, frames)
    scene, lines = Scene(world, hand, rng), len(hand.place)
    sheet = Sheet(scene.pulse, lines, scene.samples)
    peak = _add_bone(scene, sheet)
    typical = _typical(scene, peak)
    noise = typical / float(decibel(world.snr_db))
    _add_layers(scene, sheet)
    in_bone, in_soft = (0.55 * float(decibel(rng.uniform(*levels))) for levels in (BONE_SPECKLE_DB, SOFT_SPECKLE_DB))
    rows = np.flatnonzero(hand.bone)
    _add_speckle(scene, sheet, rows, hand.depth_mm[rows] - 0.1, in_bone)
    _add_diploe(scene, sheet)
    sheet.draw()
    rf = sheet.rf + _same_in_all(scene, typical) + _receiver(scene, noise, typical)
    if hand.soft.any():
        rows, tissue = _soft_tissue(scene, noise, in_soft)
        rf[rows] += tissue
    statuses = draw_statuses(rng, lines)
    poses = draw_poses(rng, world, hand)
    poses[[status != "OK" for status in statuses]] = np.nan
    recording = Recording(
        lines=_codes(scene, rf, noise, typical),
        acquisition=world.acquisition,
        probe_to_reference=poses,
        statuses=statuses,
        timestamps_s=np.cumsum(rng.uniform(0.02, 0.1) * rng.uniform(0.9, 1.1, lines)),
        palpation_points=hand.place,
    )
    snr = np.where(hand.bone, 20 * np.log10(np.maximum(peak, 1e-12) / noise), -np.inf)
    return recording, Truth(np.where(hand.bone, hand.depth_mm, np.nan), hand.tilt_deg, world.speed_m_s, snr), world
