"""Simulated A-lines as anybody would write them in a page, with every choice of such a page drawn anew.

Where the other families widen the physics, this one widens the conventions: how strong the delay line's echo and its multiples
are against bone, what the signal-to-noise ratio refers to, where interfaces lie, what a line without bone shows, whether the
depths of a recording are of one place, of a glide or of everywhere, whether the poses tell so, and how it is all scaled to codes.
Echoes are Gaussian pulses or bursts whose attenuation has a closed form; speckle is filtered noise that ends at the bone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition, Recording
from CranioNavLib.rigid import rigid_from_vector
from scipy.signal import fftconvolve

from Testing.Studies.simulators.line_truth import Truth

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

NEPER = np.log(10) / 20  # a decibel
REACH = 4.0  # half length of a Gaussian pulse in standard deviations
DEPTH_MM = (2.0, 15.0)
MISSES = ("layered", "tissue", "noise", "air", "layers")  # what a line without bone shows; the last: interfaces and no speckle
LEAST_CODES = 0.5  # standard deviation of the noise: a converter that shows less shows no noise at all


@dataclass(frozen=True)
class Page:
    """What all lines of a recording share. Levels are in dB over (or under, where so named) bone met squarely."""

    acquisition: Acquisition
    samples: int
    bandwidth: float  # of a Gaussian pulse
    cycles: float  # of a Hann burst; 0: Gaussian
    phase: float
    downshift: bool  # attenuation acts on each frequency of a Gaussian pulse
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    snr_db: float
    snr_of: str  # line, depth, recording: whose bone echo it is
    band_noise: bool
    face_db: float
    ratio: float  # of one multiple of the delay line to the next
    bang_db: float
    bang_us: float
    skin_db: float  # echo just behind the transducer, without a forerun
    speckle_db: float
    speckle_keeps: float  # likeness to the line before
    layers: tuple[tuple[str, float, float], ...]  # from where (bone, skin, share), how far, strength
    layer_tilts: bool
    lobe_deg: float
    floor_db: float
    inner_db: float
    skull_mm: float
    again_db: float
    way: str  # random, glide, dwell, still
    poses: str  # tell, fixed, everywhere
    depth_mm: tuple[float, float]
    tilt: str  # normal, uniform, square
    tilt_deg: float
    misses: float
    miss: tuple[str, ...]
    codes: float
    near_clips: bool


def _maybe(rng: np.random.Generator, share: float, low: float, high: float, otherwise: float) -> float:
    return float(rng.uniform(low, high)) if rng.random() < share else otherwise


def draw_page(rng: np.random.Generator) -> Page:
    """A set-up from wide ranges; levels that are absent are -99 dB."""
    centre, speed = float(rng.uniform(3, 10)), float(rng.uniform(1450, 1630))
    sampling = float(rng.choice([25, 30, 40, 50, 60, 62.5, 80, 100, 125]))
    sampling = sampling if sampling >= 2.5 * centre else float(rng.choice([50, 60, 100, 125]))
    forerun, delay_speed = rng.random() < 0.55, float(rng.choice([1480, 1616, 2170, 2340, 2500, 2670]))
    length = float(rng.uniform(10, 20) * delay_speed / speed) if forerun else 0.0
    first = float(rng.uniform(*DEPTH_MM))
    depth = DEPTH_MM if rng.random() < 0.5 else (max(first - float(rng.uniform(0.2, 3)), 2.0), min(first + 2.0, 15.0))
    line_us = 2e3 * length / delay_speed + 2e3 * float(rng.uniform(depth[1] + 1.5, depth[1] + 14)) / speed
    strong = float(rng.choice([4.0, 9.0, 14.0], p=[0.3, 0.35, 0.35]))  # the strongest interface is this far under bone
    layers = tuple(
        (
            str(how),
            float({"share": rng.uniform(0.1, 0.93), "skin": rng.uniform(0.6, 6), "bone": rng.uniform(0.6, 5)}[str(how)]),
            level,
        )
        for how, level in zip(
            rng.choice(["share", "skin", "bone"], 4, p=[0.6, 0.2, 0.2])[: rng.choice(5, p=[0.25, 0.35, 0.2, 0.1, 0.1])],
            (rng.choice([-1, 1], 4) * 10 ** (-rng.uniform(strong, strong + 16, 4) / 20)).tolist(),
        )
    )
    return Page(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, length, delay_speed if forerun else 0.0),
        samples=int(line_us * sampling) + 8,
        bandwidth=float(rng.uniform(0.3, 1.1)),
        cycles=_maybe(rng, 0.25, 1.2, 4.0, 0.0),
        phase=float(rng.choice([0.0, np.pi / 2, np.pi, rng.uniform(0, 2 * np.pi)])),
        downshift=bool(rng.random() < 0.4),
        speed_m_s=speed,
        attenuation=float(np.exp(rng.uniform(np.log(0.3), np.log(2.6))) if rng.random() < 0.4 else rng.uniform(0.3, 2.6)),
        snr_db=float(rng.uniform(11, 41)),
        snr_of=str(rng.choice(["line", "depth", "recording"], p=[0.35, 0.4, 0.25])),
        band_noise=bool(rng.random() < 0.2),
        face_db=float(rng.uniform(-20, 26)),
        ratio=float(rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(0.02), np.log(0.6)))) * (rng.random() < 0.9),
        bang_db=_maybe(rng, 0.6, 0, 40, -99.0),
        bang_us=float(rng.uniform(0.1, 0.5)),
        skin_db=_maybe(rng, 0.3, -20, 0, -99.0),
        speckle_db=_maybe(rng, 0.75, -50, -18, -99.0),
        speckle_keeps=float(rng.choice([0.0, 0.7, 0.98])),
        layers=layers,
        layer_tilts=bool(rng.random() < 0.4),
        lobe_deg=float(rng.uniform(2.5, 10)),
        floor_db=_maybe(rng, 0.5, -40, -14, -99.0),
        inner_db=_maybe(rng, 0.6, -26, -5, -99.0),
        skull_mm=float(rng.uniform(3, 8)),
        again_db=_maybe(rng, 0.5, -30, -4, -99.0),
        way=str(rng.choice(["random", "glide", "dwell", "still"], p=[0.3, 0.3, 0.3, 0.1])),
        poses=str(rng.choice(["tell", "fixed", "everywhere"], p=[0.65, 0.2, 0.15])),
        depth_mm=depth,
        tilt=str(rng.choice(["normal", "uniform", "square"], p=[0.5, 0.4, 0.1])),
        tilt_deg=float(rng.uniform(1.5, 8)),
        misses=float(rng.choice([0.0, 0.1, 0.2, 0.4, 1.0], p=[0.25, 0.25, 0.25, 0.15, 0.1])),
        miss=tuple(rng.choice(MISSES, rng.integers(1, 4), p=[0.4, 0.2, 0.15, 0.15, 0.1]).tolist()),
        codes=float(rng.choice([511, 2047, 8191, 20000, 32767], p=[0.1, 0.2, 0.2, 0.25, 0.25])),
        near_clips=bool(rng.random() < 0.3),
    )  # fmt: skip


class Sheet:
    """The lines of a recording under way."""

    def __init__(self, page: Page, frames: int) -> None:
        self.page = page
        self.rf = np.zeros((frames, page.samples))
        megahertz = page.acquisition.transducer_hz * 1e-6
        self.carrier = megahertz
        self.band = 0.0 if page.cycles else page.bandwidth * megahertz / np.sqrt(8 * np.log(2))  # SD of the spectrum
        self.half_us = 0.5 * page.cycles / megahertz if page.cycles else REACH / (2 * np.pi * self.band)

    def pulse(self, at_us: Array, megahertz: npt.ArrayLike) -> Array:
        """The pulse about its middle, of height 1."""
        envelope = (
            np.where(np.abs(at_us) < self.half_us, np.cos(0.5 * np.pi * at_us / self.half_us) ** 2, 0.0)
            if self.page.cycles
            else np.exp(-0.5 * (2 * np.pi * self.band * at_us) ** 2)
        )
        return np.asarray(envelope * np.cos(2 * np.pi * np.asarray(megahertz) * at_us + self.page.phase))

    def loss(self, path_mm: npt.ArrayLike) -> Array:
        """What attenuation leaves of the height of an echo from a depth."""
        beta = self._beta(path_mm)
        shift = self.band if self.page.downshift else 0.0
        return np.asarray(np.exp(-beta * self.carrier + 0.5 * np.minimum(beta * shift, 1.5 * self.carrier) ** 2))

    def _beta(self, path_mm: npt.ArrayLike) -> Array:
        return np.asarray(0.2 * NEPER * self.page.attenuation * np.asarray(path_mm, dtype=float))

    def add(self, line: npt.ArrayLike, time_us: npt.ArrayLike, height: npt.ArrayLike, path_mm: npt.ArrayLike = 0.0) -> None:
        """Echoes at times from the pulse, their height before attenuation, and how deep they have been."""
        row, time, high, path = (x.ravel() for x in np.broadcast_arrays(line, time_us, height, path_mm))
        sampling = self.page.acquisition.sampling_hz * 1e-6
        index = np.ceil((time - self.half_us) * sampling).astype(np.int64)[:, None] + np.arange(
            int(2 * self.half_us * sampling) + 1
        )
        lowered = self.carrier - self._beta(path) * self.band**2 if self.page.downshift else np.full(len(time), self.carrier)
        wave = self.pulse(index / sampling - time[:, None], np.maximum(lowered, 0.4 * self.carrier)[:, None])
        wave *= (high * self.loss(path))[:, None]
        ok = (index >= 0) & (index < self.page.samples)
        flat = (row.astype(np.int64)[:, None] * self.page.samples + index)[ok]
        self.rf += np.bincount(flat, wave[ok], self.rf.size).reshape(self.rf.shape)

    def add_speckle(self, rng: np.random.Generator, skin_us: float, end_mm: Array) -> None:
        """Echoes of the tissue itself, from the skin to `end_mm` (n,) of each line."""
        page, sampling = self.page, self.page.acquisition.sampling_hz * 1e-6
        raw = rng.normal(size=self.rf.shape)
        for row in range(1, len(raw)):
            raw[row] = page.speckle_keeps * raw[row - 1] + np.sqrt(1 - page.speckle_keeps**2) * raw[row]
        kernel = self.pulse(np.arange(-int(self.half_us * sampling), int(self.half_us * sampling) + 1) / sampling, self.carrier)
        depth = (np.arange(page.samples) / sampling - skin_us) * page.speed_m_s * 5e-4
        inside = (depth > 0) & (depth < end_mm[:, None])
        speckle = fftconvolve(raw, kernel[None] / np.linalg.norm(kernel), mode="same", axes=1)
        self.rf += speckle * inside * (10 ** (page.speckle_db / 20) * self.loss(np.clip(depth, 0, 60)))


@dataclass(frozen=True, eq=False)
class Way:
    """Where the probe goes, and what lies under it."""

    depth_mm: Array  # (n,)
    tilt_deg: Array
    kind: npt.NDArray[np.str_]
    origin_mm: Array  # (n, 3)
    place: npt.NDArray[np.int64]


def draw_way(page: Page, rng: np.random.Generator, frames: int) -> Way:
    """The way of the probe and the bone under it."""
    low, high = page.depth_mm
    stay = {"random": 1, "glide": frames, "dwell": int(rng.choice([3, 5, 10, 20])), "still": frames}[page.way]
    place = np.arange(frames) // stay
    count = int(place[-1]) + 1
    depth = rng.uniform(low, high, count)[place]
    if page.way == "glide":
        swing = rng.uniform(0, 0.5 * (high - low)) * np.sin(np.arange(frames) / rng.uniform(4, 30) + rng.uniform(0, 6))
        depth = depth + swing + np.cumsum(rng.normal(0, rng.uniform(0, 0.1), frames))
    depth = np.clip(depth + rng.normal(0, rng.choice([0.0, 0.03, 0.1]), frames), *DEPTH_MM)
    spread = {"normal": rng.normal(0, page.tilt_deg / 2, frames), "uniform": rng.uniform(0, page.tilt_deg, frames)}
    tilt = np.abs(spread.get(page.tilt, np.zeros(frames)))
    tilt = tilt[place * stay] if rng.random() < 0.4 else tilt
    lost = rng.random(count) < page.misses
    if page.way in ("glide", "still") and 0 < page.misses < 1:
        start = int(rng.integers(frames))
        missing = (np.arange(frames) - start) % frames < page.misses * frames
    else:
        missing = lost[place]
    kind = np.where(missing, rng.choice(page.miss, count)[place], "bone")
    tremor = rng.normal(0, rng.choice([0.0, 0.1]), (frames, 3))
    origin = rng.uniform(-70, 70, (count, 3))[place] + tremor
    if page.way == "glide":
        origin = np.cumsum(rng.normal(0, 0.3, (frames, 3)) + [rng.uniform(0, 1), 0, 0], axis=0)
    if page.poses == "everywhere":
        origin = rng.uniform(-70, 70, (frames, 3))
    return Way(depth, tilt, kind, np.zeros((frames, 3)) if page.poses == "fixed" else origin, place)


def simulate(rng: np.random.Generator, frames: int, page: Page | None = None) -> tuple[Recording, Truth, Page]:
    """A recording of `frames` lines, and the truth about it."""
    page = page or draw_page(rng)
    way, sheet = draw_way(page, rng, frames), Sheet(page, frames)
    skin_us = 2e3 * page.acquisition.forerun_length_mm / (page.acquisition.forerun_speed_m_s or 1.0)
    bone = way.kind == "bone"
    strength = np.hypot(np.exp(-np.log(2) * (way.tilt_deg / page.lobe_deg) ** 2), 10 ** (page.floor_db / 20))
    _probe(sheet, rng, way, skin_us)
    _tissue(sheet, rng, way, skin_us)
    _bone(sheet, way, skin_us, strength)
    square = sheet.loss(way.depth_mm)
    own = np.where(bone, strength, 1.0) * square
    whole = float(np.median(square[bone])) if bone.any() else float(np.median(square))
    noise = {"line": own, "depth": square, "recording": np.full(frames, whole)}[page.snr_of] * 10 ** (-page.snr_db / 20)
    recording = Recording(
        lines=_receive(sheet, rng, noise, skin_us),
        acquisition=page.acquisition,
        probe_to_reference=rigid_from_vector(np.zeros((frames, 3)), way.origin_mm),
        statuses=("OK",) * frames,
        timestamps_s=np.arange(frames) / 40,
        palpation_points=way.place if page.way == "dwell" and rng.random() < 0.5 else np.full(frames, -1),
    )
    inside = skin_us + 2e3 * way.depth_mm / page.speed_m_s < page.samples / page.acquisition.sampling_hz * 1e6 - 0.6
    shown = bone & inside
    snr = np.where(shown, 20 * np.log10(own / noise), -np.inf)
    return recording, Truth(np.where(shown, way.depth_mm, np.nan), way.tilt_deg, page.speed_m_s, snr), page


def _probe(sheet: Sheet, rng: np.random.Generator, way: Way, skin_us: float) -> None:
    """The delay line's echoes, or what a transducer without one shows at its own face."""
    page, every = sheet.page, np.arange(len(sheet.rf))
    if skin_us:
        face = np.where(way.kind == "air", rng.uniform(1, 4), 1.0) * 10 ** (page.face_db / 20)
        for number in range(5):
            sheet.add(every, (number + 1) * skin_us, face * page.ratio**number * rng.choice([1.0, 1.0, 0.9]))
        return
    t_us = np.arange(page.samples) / page.acquisition.sampling_hz * 1e6
    sheet.rf += 10 ** (page.bang_db / 20) * np.exp(-t_us / page.bang_us) * np.cos(2 * np.pi * sheet.carrier * t_us + page.phase)
    if page.skin_db > -90:
        sheet.add(every, float(rng.uniform(0.0, 0.3)), 10 ** (page.skin_db / 20))


def _tissue(sheet: Sheet, rng: np.random.Generator, way: Way, skin_us: float) -> None:
    """Speckle and interfaces, over bone or without it."""
    page, per_mm = sheet.page, 2e3 / sheet.page.speed_m_s
    if page.speckle_db > -90:
        end = np.select([way.kind == "bone", np.isin(way.kind, ("layered", "tissue"))], [way.depth_mm, 99.0], 0.0)
        sheet.add_speckle(rng, skin_us, end)
    rows = np.flatnonzero(np.isin(way.kind, ("bone", "layered", "layers")))
    sway = rng.choice([0.0, 0.1, 0.3])
    for how, far, level in page.layers:
        depth = way.depth_mm[rows]
        at = {"share": far * depth, "skin": np.full(len(rows), far), "bone": depth - far}[how]
        use = (at > 0.4) & (at < depth - 0.5)
        tilted = np.exp(-np.log(2) * (way.tilt_deg[rows] / (2 * page.lobe_deg)) ** 2) if page.layer_tilts else 1.0
        height = level * tilted * np.exp(sway * rng.normal(size=len(rows)))
        sheet.add(rows[use], skin_us + at[use] * per_mm, height[use], at[use])


def _bone(sheet: Sheet, way: Way, skin_us: float, strength: Array) -> None:
    """Bone, its inner table, and its echo that has gone the way twice."""
    page, rows = sheet.page, np.flatnonzero(way.kind == "bone")
    depth, high = way.depth_mm[rows], strength[rows]
    arrival = skin_us + depth * 2e3 / page.speed_m_s
    sheet.add(rows, arrival, high, depth)
    if page.inner_db > -90:
        sheet.add(rows, arrival + 2 * page.skull_mm / 3.0, -high * 10 ** (page.inner_db / 20), depth)
    if page.again_db > -90:
        sheet.add(rows, arrival + depth * 2e3 / page.speed_m_s, -high * 10 ** (page.again_db / 20), 2 * depth)


def _receive(sheet: Sheet, rng: np.random.Generator, noise: Array, skin_us: float) -> npt.NDArray[np.int16]:
    """Noise of standard deviation `noise` (n,), and codes: the largest echo fills the converter, or the largest in the tissue."""
    page, sampling = sheet.page, sheet.page.acquisition.sampling_hz * 1e-6
    white = rng.normal(size=sheet.rf.shape)
    if page.band_noise:
        frequency = np.fft.rfftfreq(page.samples, 1 / sampling)
        white = np.fft.irfft(np.fft.rfft(white, axis=1) * (frequency < 2.5 * sheet.carrier), page.samples, axis=1)
        white /= white.std()
    rf = sheet.rf + white * noise[:, None]
    start = int((skin_us + 1.0) * sampling) if page.near_clips or not skin_us else 0
    peak = float(np.percentile(np.abs(rf[:, start:]).max(axis=1), 95))
    scale = max(page.codes / peak, LEAST_CODES / float(np.median(noise)))
    return np.asarray(np.clip(np.round(rf * scale), -32768 if page.codes > 3e4 else -page.codes - 1, page.codes), dtype=np.int16)
