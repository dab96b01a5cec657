"""A third family of simulated A-lines: a bench of many transducers, receivers and kinds of tissue, drawn as wide as they go.

It shares neither code nor model with echo_lines.py and tissue_lines.py. The pulse is what a pulser's square wave leaves
behind two passes of a damped transducer (or a symmetric one); speckle is filtered noise of uneven texture; the delay line
may ring strongly and hold echoes of its own; interfaces follow the bone, the skin, or neither; bone is curved, rough and
porous; whole recordings may dwell, glide or jump, with or without poses that tell. Some lines show a lone interface, tissue
without end, air or nothing. The ranges are meant to hold any simulator or phantom, not to be typical.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition, Recording
from CranioNavLib.rigid import rigid_from_vector
from scipy.signal import fftconvolve

from Testing.Studies.simulators.line_truth import Truth

Array = npt.NDArray[np.float64]

PER_CYCLE = 32  # samples of the pulse's table a cycle of the transducer
LEVEL_MM = 2.5  # of path between two pulses of the table
LEVELS = 14
MISSES = ("tissue", "interface", "air", "nothing")
DEPTH_MM = (2.0, 15.0)


@dataclass(frozen=True)
class Bench:
    """What all lines of a recording share. Levels are under (or over) the echo of bone met squarely, in dB."""

    acquisition: Acquisition
    samples: int
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    selective: bool  # attenuation acts on each frequency
    symmetric: bool  # pulse with its origin in its middle; else at its onset
    cycles: float  # length of the pulse (symmetric), or ringing of the transducer
    phase: float
    skewness: float  # of a symmetric pulse: its rear is longer than its front
    chirp: float
    snr_db: float
    snr_of: str  # line, square, recording
    noise: str  # white, band, pink
    bursts: float  # interference: share of lines
    spikes: float  # a line
    face_db: float  # forerun's echo over bone
    face_sign: float
    ratio: float  # of one forerun multiple to the next
    parasites: int  # fixed echoes of the delay line or the cable
    parasites_db: float
    bang_db: float
    bang_us: float
    speckle_db: float
    texture: float  # 0: Gaussian speckle; larger: lumpy
    leak_db: float  # what is left of speckle in the shadow
    borders: int
    borders_db: tuple[float, float]
    borders_follow: str  # bone, skin, place
    lobe: str  # gauss, linear, flat
    lobe_deg: float
    floor_db: float  # diffuse echo
    rough_mm: float
    inner_db: float
    pores_db: float
    skull_mm: float
    skull_m_s: float
    multiple_db: float
    codes: float
    clip: float
    offset: float
    way: str  # dwell, glide, jump
    step_mm: float
    poses: bool  # they tell the way; otherwise the probe's pose never changes
    depth_mm: tuple[float, float]
    misses: float
    most_tilt_deg: float
    bare: bool = False  # nothing but bone, or nothing


def _maybe(rng: np.random.Generator, share: float, low: float, high: float, otherwise: float) -> float:
    return float(rng.uniform(low, high)) if rng.random() < share else otherwise


def draw_bench(rng: np.random.Generator) -> Bench:
    """A bench from the widest ranges; half of them are kind: no accidents, weak interfaces."""
    kind = rng.random() < 0.5
    centre = float(rng.uniform(3, 10))
    sampling = float(rng.choice([25.0, 32.0, 40.0, 50.0, 60.0, 64.0, 80.0, 100.0, 125.0]))
    sampling = sampling if sampling >= 2.5 * centre else float(rng.choice([25.0, 50.0, 100.0, 125.0])) * (1 if centre < 10 else 2)
    speed, delay_speed = float(rng.uniform(1450, 1630)), float(rng.uniform(1450, 2750))
    forerun = rng.random() < 0.6
    length = float(rng.uniform(11, 20) * delay_speed / speed) if forerun else 0.0
    low = float(rng.uniform(2, 13))
    depth = (low, min(low + float(rng.uniform(0.5, 5)), 15.0)) if rng.random() < 0.5 else DEPTH_MM
    end_us = 2e3 * length / max(delay_speed, 1) + 2e3 * (depth[1] + rng.uniform(1.2, 9)) / speed
    weak = float(rng.uniform(11, 26) if kind else rng.uniform(3, 24))
    dynamic = np.log(0.3), np.log(2.6)
    return Bench(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, length, delay_speed if forerun else 0.0),
        samples=int(end_us * sampling) + 8,
        speed_m_s=speed,
        attenuation=float(np.exp(rng.uniform(*dynamic)) if rng.random() < 0.5 else rng.uniform(0.3, 2.6)),
        selective=bool(rng.random() < 0.5),
        symmetric=bool(rng.random() < (0.75 if kind else 0.5)),
        cycles=float(rng.uniform(0.8, 2.8)),
        phase=float(rng.choice([0.0, np.pi / 2, np.pi, rng.uniform(0, 2 * np.pi)])),
        skewness=_maybe(rng, 0.0 if kind else 0.4, 1.2, 2.5, 1.0),
        chirp=_maybe(rng, 0.2, -0.2, 0.2, 0.0),
        snr_db=float(rng.uniform(11, 41)),
        snr_of=str(rng.choice(["line", "square", "recording"], p=[0.45, 0.4, 0.15])),
        noise=str(rng.choice(["white", "band", "pink"], p=[0.75, 0.15, 0.1])),
        bursts=_maybe(rng, 0.0 if kind else 0.2, 0.02, 0.3, 0.0),
        spikes=_maybe(rng, 0.0 if kind else 0.3, 0.05, 1.0, 0.0),
        face_db=float(rng.uniform(-16, 8)),
        face_sign=float(rng.choice([-1, 1])),
        ratio=float(rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(0.01), np.log(0.6)))) * (rng.random() < 0.9),
        parasites=0 if kind or rng.random() < 0.6 else int(rng.integers(1, 4)),
        parasites_db=float(rng.uniform(10, 35)),
        bang_db=_maybe(rng, 0.5, 0, 35, -99.0),
        bang_us=float(rng.uniform(0.1, 0.7)),
        speckle_db=_maybe(rng, 0.85, 16, 48, 99.0),
        texture=_maybe(rng, 0.4, 0.3, 1.2, 0.0),
        leak_db=_maybe(rng, 0.25, 6, 25, 99.0),
        borders=int(rng.integers(0, 4 if kind else 6)),
        borders_db=(weak, weak + float(rng.uniform(1, 14))),
        borders_follow=str(rng.choice(["bone", "skin", "place"])),
        lobe=str(rng.choice(["gauss", "linear", "flat"], p=[0.6, 0.2, 0.2])),
        lobe_deg=float(rng.uniform(3, 9) if kind else rng.uniform(1.5, 8)),
        floor_db=float(rng.uniform(15, 40)),
        rough_mm=_maybe(rng, 0.4, 0.005, 0.05, 0.0),
        inner_db=_maybe(rng, 0.75, 5, 26, 99.0),
        pores_db=_maybe(rng, 0.5, 16, 40, 99.0),
        skull_mm=float(rng.uniform(2.5, 9)),
        skull_m_s=float(rng.uniform(2500, 3600)),
        multiple_db=_maybe(rng, 0.5, 5, 30, 99.0),
        codes=float(rng.choice([511, 2047, 8191, 20000, 32767], p=[0.1, 0.25, 0.2, 0.2, 0.25])),
        clip=1.0 if kind else _maybe(rng, 0.2, 0.4, 1.0, 1.0),
        offset=_maybe(rng, 0.3, -0.05, 0.05, 0.0),
        way=str(rng.choice(["dwell", "glide", "jump"], p=[0.4, 0.35, 0.25])),
        step_mm=float(np.exp(rng.uniform(np.log(0.02), np.log(0.8)))),
        poses=bool(rng.random() < 0.85),
        depth_mm=depth,
        misses=float(rng.choice([0.0, 0.08, 0.2, 0.45], p=[0.3, 0.3, 0.25, 0.15])),
        most_tilt_deg=float(rng.choice([2.0, 5.0, 8.0], p=[0.3, 0.5, 0.2])),
    )


def draw_bare(rng: np.random.Generator) -> Bench:
    """A bench in a water bath: bone, sometimes its inner table and a reverberation, noise, and nothing else."""
    return replace(
        draw_bench(rng),
        bare=True,
        snr_db=float(rng.uniform(11, 60)),  # water takes nothing
        noise="white",
        bursts=0.0,
        spikes=0.0,
        parasites=0,
        speckle_db=99.0,
        leak_db=99.0,
        borders=0,
        floor_db=99.0,
        rough_mm=0.0,
        inner_db=_maybe(rng, 0.5, 5, 26, 99.0),
        pores_db=99.0,
        multiple_db=_maybe(rng, 0.3, 5, 30, 99.0),
        clip=1.0,
    )


def pulse_table(bench: Bench) -> Array:
    """The pulse behind 0, LEVEL_MM, ... of tissue (LEVELS, T), sampled PER_CYCLE times a cycle; its origin in the middle."""
    u = np.arange(-12 * PER_CYCLE, 12 * PER_CYCLE + 1) / PER_CYCLE  # cycles
    if bench.symmetric:
        width = bench.cycles / 2.355 * np.where(u > 0, bench.skewness, 1.0)
        wave = np.exp(-0.5 * (u / width) ** 2) * np.cos(2 * np.pi * (u + bench.chirp * u**2 / bench.cycles) + bench.phase)
    else:  # a half wave of the pulser, then the transducer as transmitter and as receiver
        ringing = np.where(u >= 0, np.exp(-u.clip(0) * 2.2 / bench.cycles) * np.sin(2 * np.pi * u), 0.0)
        square = ((u >= 0) & (u < 0.5)).astype(float) * np.cos(bench.phase) + ((u >= 0.5) & (u < 1.0)) * np.sin(bench.phase)
        wave = fftconvolve(fftconvolve(square, ringing, mode="same"), ringing, mode="same")
    spectrum = np.fft.rfft(wave / np.abs(wave).max())
    frequency = np.fft.rfftfreq(len(u), 1 / PER_CYCLE) * bench.acquisition.transducer_hz * 1e-6
    carrier = bench.acquisition.transducer_hz * 1e-6
    path = np.arange(LEVELS)[:, None] * LEVEL_MM
    decibel = 0.2 * bench.attenuation * path * (np.clip(frequency, 0, 3 * carrier) if bench.selective else carrier)
    return np.asarray(np.fft.irfft(spectrum * 10 ** (-decibel / 20), len(u), axis=1))


class Lines:
    """Lines under way: echoes are collected, then summed."""

    def __init__(self, bench: Bench, frames: int) -> None:
        self.bench, self.frames, self.table = bench, frames, pulse_table(bench)
        self.parts: list[Array] = [np.zeros((4, 0))]

    def add(self, line: npt.ArrayLike, time_us: npt.ArrayLike, strength: npt.ArrayLike, path_mm: npt.ArrayLike = 0.0) -> None:
        """Echoes: their line, time from the pulse, strength before the tissue's attenuation, and way into the tissue."""
        self.parts.append(np.stack(np.broadcast_arrays(line, time_us, strength, path_mm)).reshape(4, -1).astype(float))

    def total(self) -> Array:
        """RF (frames, samples) of all echoes."""
        bench = self.bench
        line, time, strength, path = np.concatenate(self.parts, axis=1)
        sampling, centre = bench.acquisition.sampling_hz * 1e-6, bench.acquisition.transducer_hz * 1e-6
        half = 12 / centre
        first = np.ceil((time - half) * sampling).astype(np.int64)
        index = first[:, None] + np.arange(int(2 * half * sampling))
        at = ((index / sampling - time[:, None]) * centre + 12) * PER_CYCLE
        level = np.minimum(np.rint(path / LEVEL_MM).astype(np.int64), LEVELS - 1)
        rest = 10 ** (-0.01 * bench.attenuation * centre * (path - level * LEVEL_MM))  # 0.2 dB a mm of way, over 20
        whole = np.clip(at.astype(np.int64), 0, self.table.shape[1] - 2)
        part = at - whole
        wave = self.table[level[:, None], whole] * (1 - part) + self.table[level[:, None], whole + 1] * part
        ok = (index >= 0) & (index < bench.samples)
        flat = (line.astype(np.int64)[:, None] * bench.samples + index)[ok]
        values = (wave * (strength * rest)[:, None])[ok]
        return np.bincount(flat, values, self.frames * bench.samples).reshape(self.frames, bench.samples)

    def speckle(self, rng: np.random.Generator, level: Array, depth_mm: Array, keep: Array) -> Array:
        """Filtered noise of local amplitude `level` (frames, samples); `keep` (frames,): likeness to the line before."""
        bench = self.bench
        raw = rng.normal(size=(self.frames, bench.samples))
        for row in range(1, self.frames):
            raw[row] = keep[row] * raw[row - 1] + np.sqrt(1 - keep[row] ** 2) * raw[row]
        raw *= level
        step = PER_CYCLE * bench.acquisition.transducer_hz / bench.acquisition.sampling_hz
        size = bench.samples + int(24 * PER_CYCLE / step)
        total = np.zeros((self.frames, size // 2 + 1), dtype=complex)
        deepest = min(int(depth_mm.max(initial=0.0) / LEVEL_MM) + 1, LEVELS)
        scale = np.sqrt(
            (np.interp(np.arange(0, self.table.shape[1], step), np.arange(self.table.shape[1]), self.table[0]) ** 2).sum()
        )
        for number in range(0, deepest, 2):
            wave = np.interp(np.arange(0, self.table.shape[1], step), np.arange(self.table.shape[1]), self.table[number]) / scale
            own = (depth_mm >= (number - 1) * LEVEL_MM) & (depth_mm < (number + 1) * LEVEL_MM)
            over = 10 ** (-0.01 * bench.attenuation * bench.acquisition.transducer_hz * 1e-6 * (depth_mm - number * LEVEL_MM))
            total += np.fft.rfft(raw * np.where(own, over, 0.0), size, axis=1) * np.fft.rfft(wave, size)
        start = int(12 * PER_CYCLE / step)
        return np.asarray(np.fft.irfft(total, size, axis=1)[:, start : start + bench.samples])


@dataclass(frozen=True, eq=False)
class Path:
    """Where the probe goes and what lies under it."""

    place: npt.NDArray[np.int64]  # (n,) which place of the head
    origin_mm: Array  # (n, 3)
    depth_mm: Array
    tilt_deg: Array
    kind: npt.NDArray[np.str_]


def draw_path(bench: Bench, rng: np.random.Generator, frames: int) -> Path:
    """Depth, tilt and kind of each line along the probe's way."""
    stay = {"dwell": int(rng.integers(4, 40)), "glide": frames, "jump": 1}[bench.way]
    place = np.arange(frames) // stay
    count = int(place[-1]) + 1
    low, high = bench.depth_mm
    depth, tilt = rng.uniform(low, high, count)[place], rng.uniform(0, bench.most_tilt_deg, count)[place]
    if bench.way == "glide":
        smooth = np.cumsum(rng.normal(0, 1, (2, frames)) * np.sqrt(bench.step_mm) * 0.3, axis=1)
        depth, tilt = depth + smooth[0] + rng.normal(0, 0.03) * bench.step_mm * np.arange(frames), tilt + smooth[1]
    tremor = rng.choice([0.0, 0.02, 0.1])
    depth = low + np.abs((depth + rng.normal(0, tremor, frames) - low + (high - low)) % (2 * (high - low)) - (high - low))
    lost = np.where(rng.random(count) < bench.misses, rng.choice(MISSES, count, p=[0.4, 0.2, 0.2, 0.2]), "bone")
    kind = lost[place]
    if bench.way == "glide" and bench.misses:  # the probe leaves the bone for a while
        start, length = rng.integers(0, frames, 2)
        kind = np.where((np.arange(frames) - start) % frames < length * bench.misses, str(rng.choice(MISSES)), "bone")
    if bench.bare:  # alone, an interface is all that bone is: nothing could tell them apart
        kind = np.where(kind == "interface", "nothing", kind)
    walk = np.cumsum(rng.normal(0, 0.05, (frames, 3)), axis=0)
    origin = rng.uniform(-70, 70, (count, 3))[place] + walk
    origin[:, 0] += bench.step_mm * np.arange(frames) * (bench.way == "glide")
    return Path(place, origin if bench.poses else np.zeros((frames, 3)), depth, np.abs(tilt + rng.normal(0, 0.3, frames)), kind)


def simulate(rng: np.random.Generator, frames: int, bench: Bench | None = None) -> tuple[Recording, Truth, Bench]:
    """A recording of `frames` lines, and the truth about it."""
    bench = bench or draw_bench(rng)
    path, lines = draw_path(bench, rng, frames), Lines(bench, frames)
    skin_us = (
        2e3 * bench.acquisition.forerun_length_mm / bench.acquisition.forerun_speed_m_s
        if bench.acquisition.forerun_length_mm
        else 0.0
    )
    late = skin_us * (1 + rng.uniform(-0.01, 0.01) * (rng.random() < 0.4))
    add_delay_line(lines, rng, path, late)
    bone = add_bone(lines, rng, path, late)
    add_borders(lines, rng, path, late)
    rf = lines.total() + tissue(lines, rng, path, late)
    loss = 10 ** (-0.01 * bench.attenuation * bench.acquisition.transducer_hz * 1e-6 * path.depth_mm)
    peak = np.abs(lines.table).max(axis=1)
    square = np.interp(path.depth_mm, np.arange(LEVELS) * LEVEL_MM, peak) if bench.selective else loss
    shown = path.kind == "bone"
    middle = float(np.median((square * bone)[shown])) if shown.any() else float(np.median(square))
    own = np.where(shown, square * bone, square)
    noise = {"line": own, "square": square, "recording": np.full(frames, middle)}[bench.snr_of] * 10 ** (-bench.snr_db / 20)
    codes = receive(bench, rng, rf, noise)
    turns = np.tile(rng.uniform(-2, 2, 3), (frames, 1)) + rng.normal(0, 0.01, (frames, 3)) * bench.poses
    recording = Recording(
        lines=codes, acquisition=bench.acquisition, probe_to_reference=rigid_from_vector(turns, path.origin_mm),
        statuses=("OK",) * frames, timestamps_s=np.arange(frames) / 40,
        palpation_points=path.place.astype(np.int64) if bench.way == "dwell" and rng.random() < 0.5 else np.full(frames, -1),
    )  # fmt: skip
    inside = late + 2e3 * path.depth_mm / bench.speed_m_s < bench.samples / bench.acquisition.sampling_hz * 1e6 - 0.6
    has = shown & inside
    snr = np.where(has, 20 * np.log10(np.maximum(own, 1e-12) / noise), -np.inf)
    return (
        recording,
        Truth(np.where(has, path.depth_mm, np.nan), path.tilt_deg, bench.speed_m_s, snr),
        bench,
    )


def add_delay_line(lines: Lines, rng: np.random.Generator, path: Path, skin_us: float) -> None:
    """The face of the forerun, its multiples, and echoes that never move."""
    bench, every = lines.bench, np.arange(lines.frames)
    if skin_us:
        face = np.where(path.kind == "air", 4.0, 1.0) * bench.face_sign * 10 ** (bench.face_db / 20)
        for number in range(1, 6):
            lines.add(every, number * skin_us, face * bench.ratio ** (number - 1))
    for _ in range(bench.parasites):
        end = bench.samples / bench.acquisition.sampling_hz * 1e6
        lines.add(every, rng.uniform(0, end), 10 ** (-(bench.parasites_db + rng.uniform(0, 15)) / 20))


def add_bone(lines: Lines, rng: np.random.Generator, path: Path, skin_us: float) -> Array:
    """Bone and what follows it; gives its strength at each line's tilt (n,)."""
    bench, per_mm = lines.bench, 2e3 / lines.bench.speed_m_s
    mirror = {
        "gauss": np.exp(-np.log(2) * (path.tilt_deg / bench.lobe_deg) ** 2),
        "linear": np.clip(1 - 0.5 * path.tilt_deg / bench.lobe_deg, 0.02, 1),
        "flat": np.ones(lines.frames),
    }[bench.lobe]
    has = np.flatnonzero(path.kind == "bone")
    depth, count = path.depth_mm[has], len(has)
    arrival = skin_us + depth * per_mm
    if bench.rough_mm:
        facets = 5
        off = rng.normal(0, bench.rough_mm, (facets, count))
        lines.add(has, arrival + off * per_mm, mirror[has] / facets, depth)
    else:
        lines.add(has, arrival, mirror[has], depth)
    diffuse = 10 ** (-bench.floor_db / 20)
    spread = rng.uniform(0, 1.2, (4, count)) * np.tan(np.radians(path.tilt_deg[has]))
    lines.add(has, arrival + spread * per_mm, diffuse * rng.normal(0, 0.5, (4, count)), depth)
    behind = 2 * bench.skull_mm * rng.uniform(0.9, 1.1) / bench.skull_m_s * 1e3
    if bench.inner_db < 90:
        lines.add(has, arrival + behind * rng.normal(1, 0.02, count), -mirror[has] * 10 ** (-bench.inner_db / 20), depth)
    if bench.pores_db < 90:
        z = rng.uniform(0, 1, (10, count))
        lines.add(
            has,
            arrival + behind * z,
            mirror[has] * 10 ** (-bench.pores_db / 20) * np.exp(-2 * z) * rng.normal(size=z.shape),
            depth,
        )
    if bench.multiple_db < 90:
        lines.add(has, arrival + depth * per_mm, -mirror[has] * 10 ** (-bench.multiple_db / 20), 2 * depth)
    return np.asarray(np.hypot(mirror, diffuse))


def add_borders(lines: Lines, rng: np.random.Generator, path: Path, skin_us: float) -> None:
    """Interfaces before the bone (or without it), single or as two faces of a thin layer."""
    bench, count = lines.bench, int(path.place[-1]) + 1
    tissue = np.flatnonzero((path.kind == "bone") | (path.kind == "tissue") | (path.kind == "interface"))
    alone = path.kind[tissue] == "interface"
    depth, place = path.depth_mm[tissue], path.place[tissue]
    sway = rng.choice([0.0, 1.0]) * rng.normal(0, 1.5, lines.frames)[tissue]  # dB from line to line
    for number in range(max(bench.borders, int(alone.any()))):
        share, above = rng.uniform(0.1, 0.95, count)[place], rng.uniform(0.5, 4.0, count)[place]
        bone = rng.uniform(0.3, 0.95) * depth if rng.random() < 0.5 else depth - above
        at = {"bone": bone, "skin": above, "place": share * depth}[bench.borders_follow]
        at = np.where((at > 0.3) & (at < depth - 0.3), at, share * depth)
        level = rng.uniform(*bench.borders_db, count)[place] + sway
        strength = rng.choice([-1, 1]) * 10 ** (-level / 20)
        use = ~alone if number else np.ones(len(tissue), dtype=bool)
        use &= (number < bench.borders) | alone
        lines.add(tissue[use], skin_us + at[use] * 2e3 / bench.speed_m_s, strength[use], at[use])
        if rng.random() < 0.3:
            second = skin_us + (at[use] + rng.uniform(0.15, 0.8)) * 2e3 / bench.speed_m_s
            lines.add(tissue[use], second, -strength[use] * rng.uniform(0.4, 1.0), at[use])


def tissue(lines: Lines, rng: np.random.Generator, path: Path, skin_us: float) -> Array:
    """The tissue's speckle, which bone ends."""
    bench = lines.bench
    if bench.speckle_db > 90:
        return np.zeros((lines.frames, bench.samples))
    depth = (np.arange(bench.samples) / bench.acquisition.sampling_hz * 1e6 - skin_us) * bench.speed_m_s * 5e-4
    end = np.select(
        [path.kind == "bone", path.kind == "tissue", path.kind == "interface"],
        [path.depth_mm, 99.0, rng.choice([0.0, 99.0])],
        0.0,
    )
    zones = np.exp(rng.normal(0, 0.5, (int(path.place[-1]) + 1, 4)))[path.place]
    which = np.clip((4 * depth / 15).astype(np.int64), 0, 3)
    level = 10 ** (-bench.speckle_db / 20) * zones[:, which]
    leak = 10 ** (-bench.leak_db / 20) if bench.leak_db < 90 else 0.0
    level = level * np.where(depth[None] < end[:, None], 1.0, leak * (path.kind == "bone")[:, None]) * (depth > 0)
    if bench.texture:
        coarse = np.exp(bench.texture * rng.normal(size=(lines.frames, bench.samples // 40 + 2)))
        level = level * np.repeat(coarse, 40, axis=1)[:, : bench.samples]
    moved = np.linalg.norm(np.diff(path.origin_mm, axis=0, prepend=path.origin_mm[:1]), axis=1)
    return lines.speckle(rng, level, np.clip(depth, 0, None), np.exp(-np.clip(moved, 0.02, None) / 1.0))


def receive(bench: Bench, rng: np.random.Generator, rf: Array, noise: Array) -> npt.NDArray[np.int16]:
    """Main bang, noise, interference and converter."""
    count, samples = rf.shape
    sampling, centre = bench.acquisition.sampling_hz, bench.acquisition.transducer_hz
    t = np.arange(samples) / sampling
    if bench.bang_db > -90:
        rf = rf + 10 ** (bench.bang_db / 20) * np.exp(-t / (bench.bang_us * 1e-6)) * np.cos(2 * np.pi * centre * t + bench.phase)
    own = rng.normal(size=(count, samples))
    if bench.noise != "white":
        frequency = np.fft.rfftfreq(samples, 1 / sampling) / centre
        shape = (frequency > 0.3) & (frequency < 2.2) if bench.noise == "band" else 1 / np.sqrt(frequency + 0.2)
        own = np.fft.irfft(np.fft.rfft(own, axis=1) * shape, samples, axis=1)
        own /= own.std()
    rf = rf + own * noise[:, None]
    for row in np.flatnonzero(rng.random(count) < bench.bursts):
        middle, width = rng.uniform(0, t[-1]), rng.uniform(0.3, 3) * 1e-6
        wave = np.exp(-0.5 * ((t - middle) / width) ** 2) * np.cos(2 * np.pi * centre * rng.uniform(0.4, 1.6) * t)
        rf[row] += noise[row] * rng.uniform(2, 15) * wave
    for row, number in enumerate(rng.poisson(bench.spikes, count)):
        rf[row, rng.integers(0, samples, number)] += noise[row] * rng.uniform(-50, 50, number)
    later = np.abs(rf[:, min(int(1e-6 * sampling), samples // 4) :])
    scale = bench.codes / (np.percentile(later.max(axis=1), 95) * bench.clip)
    return np.asarray(np.clip(np.round(rf * scale + bench.offset * bench.codes), -bench.codes, bench.codes), dtype=np.int16)
