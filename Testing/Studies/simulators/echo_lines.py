"""Simulated A-lines of many kinds, for calibrating and testing the echo detector.

Each recording draws its own pulse, transducer, forerun, tissue, noise and clutter from wide ranges, so that nothing fitted
to these lines is fitted to one simulator. All of it is simulated; ranges from the literature are marked with their source.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.sequence_metafile import Acquisition, Recording

from Testing.Studies.simulators.line_truth import Truth

Array = npt.NDArray[np.float64]

SAMPLING_MHZ = (25.0, 31.25, 40.0, 50.0, 60.0, 62.5, 80.0, 100.0, 125.0)
FORERUN_MATERIALS = {  # speed m/s, reflection coefficient to soft tissue (handbook values of delay-line plastics)
    "aqualene": (1616.0, 0.04),
    "pmp": (2170.0, -0.05),
    "polystyrene": (2340.0, -0.20),
    "hdpe": (2460.0, -0.17),
    "pmma": (2670.0, -0.32),
}
SPEED_M_S = (1450.0, 1630.0)
ATTENUATION_DB_CM_MHZ = (0.3, 2.6)
DEPTH_MM = (2.0, 15.0)
SNR_DB = (12.0, 40.0)
SAME_DEPTH_SHARE = 0.45  # of the recordings have about one depth everywhere
PLAIN_SHARE = 0.3  # of the worlds are textbook ones
BONE_SPEED_M_S = (2700.0, 3500.0)


@dataclass(frozen=True)
class World:
    """What all lines of one simulated recording share."""

    acquisition: Acquisition
    samples: int
    pulse: str  # gauss, ricker, gammatone, damped
    bandwidth: float  # fractional, -6 dB
    phase: float
    order: int  # of the gammatone
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    downshift: bool  # attenuation acts on each frequency, not on the amplitude alone
    forerun_reflection: float
    forerun_shown: bool
    snr_db: float
    snr_per_line: bool  # the SNR is that of each line's own bone echo
    bone_reflection: float
    tilt_law: str  # specular, cosine, none
    tilt_width_deg: float
    tilt_floor: float
    speckle_db: float  # under the bone's reflection
    speckle_per_us: float
    galea_db: tuple[float, float]  # range of interface reflections before the bone, under the bone's
    layers: int
    inner_db: float  # inner table under the outer one
    bone_mm: float
    bone_speed_m_s: float
    ringing: float
    ringing_s: float
    spikes: float  # a line
    noise_band: float  # upper edge of the receiver's band over the transducer's frequency; 0: white noise
    drift: float
    offset: float
    full_scale: float
    largest_code: int
    frames_a_point: int
    sweep: bool


def draw_world(rng: np.random.Generator, frames_a_point: int | None = None) -> World:
    """A world drawn from the wide ranges."""
    centre = rng.uniform(3, 10)
    rates = [rate for rate in SAMPLING_MHZ if rate >= 2.5 * centre]
    sampling = float(rng.choice(rates))
    speed = rng.uniform(*SPEED_M_S)
    forerun = rng.random() < 0.65
    material = str(rng.choice(list(FORERUN_MATERIALS)))
    forerun_speed, reflection = FORERUN_MATERIALS[material]
    length = rng.uniform(8, 30) if rng.random() < 0.3 else max(16.5 * forerun_speed / speed, rng.uniform(14, 30))
    skin_us = 2e3 * length / forerun_speed if forerun else 0.0
    needed = (skin_us + 2e3 * 17 / speed + 2) * sampling
    low, high = np.log(ATTENUATION_DB_CM_MHZ)
    return World(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, length if forerun else 0.0, forerun_speed if forerun else 0.0),
        samples=int(max(needed * rng.uniform(1, 1.4), 3200 if rng.random() < 0.5 else 0)),
        pulse=str(rng.choice(["gauss", "ricker", "gammatone", "damped"], p=[0.5, 0.1, 0.25, 0.15])),
        bandwidth=rng.uniform(0.3, 0.9),
        phase=rng.choice([0.0, np.pi, rng.uniform(0, 2 * np.pi)]),
        order=int(rng.integers(1, 4)),
        speed_m_s=speed,
        attenuation=float(np.exp(rng.uniform(low, high))),
        downshift=bool(rng.random() < 0.5),
        forerun_reflection=reflection if rng.random() < 0.7 else rng.uniform(0.05, 0.5) * rng.choice([-1, 1]),
        forerun_shown=bool(rng.random() < 0.93),
        snr_db=rng.uniform(*SNR_DB),
        snr_per_line=bool(rng.random() < 0.6),
        bone_reflection=rng.uniform(0.4, 0.66),
        tilt_law=str(rng.choice(["specular", "cosine", "none"], p=[0.6, 0.25, 0.15])),
        tilt_width_deg=rng.uniform(1.0, 6),
        tilt_floor=10 ** (-rng.uniform(12, 34) / 20),
        speckle_db=rng.choice([rng.uniform(20, 50), 90.0], p=[0.8, 0.2]),
        speckle_per_us=rng.uniform(2, 8),
        galea_db=(a := rng.uniform(8, 24), a + rng.uniform(0, 10)),
        layers=int(rng.integers(0, 4)),
        inner_db=rng.uniform(6, 25) if rng.random() < 0.8 else 99.0,
        bone_mm=rng.uniform(2.5, 9),
        bone_speed_m_s=rng.uniform(*BONE_SPEED_M_S),
        ringing=rng.uniform(0, 3) * (rng.random() < 0.8),
        ringing_s=rng.uniform(0.1, 0.4) * 1e-6,
        spikes=rng.choice([0.0, rng.uniform(0, 1.5)]),
        noise_band=rng.uniform(1.8, 3.5) if rng.random() < 0.25 else 0.0,
        drift=rng.uniform(0, 0.5) * (rng.random() < 0.4),
        offset=rng.uniform(-1, 1) * (rng.random() < 0.4),
        full_scale=rng.uniform(0.3, 1.2),
        largest_code=int(rng.choice([511, 2047, 8191, 32767], p=[0.1, 0.2, 0.3, 0.4])),
        frames_a_point=frames_a_point or int(rng.choice([1, 3, 10, 20])),
        sweep=bool(rng.random() < 0.3),
    )


def plain(world: World, rng: np.random.Generator) -> World:
    """The same set-up as a textbook would draw it: a clean symmetric pulse, weak interfaces, no accidents."""
    return replace(
        world,
        pulse="gauss",
        bandwidth=rng.uniform(0.4, 0.8),
        forerun_shown=True,
        tilt_law=str(rng.choice(["specular", "cosine", "none"])),
        tilt_width_deg=rng.uniform(3, 8),
        galea_db=(a := rng.uniform(11, 26), a + rng.uniform(0, 4)),
        layers=int(rng.integers(0, 3)),
        ringing=world.ringing * (rng.random() < 0.5),
        spikes=world.spikes * (rng.random() < 0.3),
        noise_band=0.0,
        drift=0.0,
        offset=0.0,
        full_scale=rng.uniform(0.3, 1.0),
        largest_code=int(rng.choice([2047, 8191, 32767])),
    )


def make_pulse(world: World, width_s: float) -> tuple[Array, float]:
    """The pulse sampled finely, and its rate; time zero at the middle sample (centre or onset of the pulse)."""
    rate = 16 * world.acquisition.transducer_hz
    half = int(width_s * rate)
    t = np.arange(-half, half + 1) / rate
    f = world.acquisition.transducer_hz
    sigma = np.sqrt(2 * np.log(2)) / (np.pi * world.bandwidth * f) * 1.0
    if world.pulse == "ricker":
        a = (np.pi * f * t) ** 2
        wave = (1 - 2 * a) * np.exp(-a) * np.cos(world.phase)
        wave = wave if abs(np.cos(world.phase)) > 0.2 else (1 - 2 * a) * np.exp(-a)
    elif world.pulse == "gammatone":
        rise = np.clip(t, 0, None) / sigma
        wave = rise**world.order * np.exp(-rise * np.sqrt(world.order)) * np.sin(2 * np.pi * f * t + world.phase)
    elif world.pulse == "damped":
        wave = np.where(t >= 0, np.exp(-np.clip(t, 0, None) / (1.2 * sigma)) * np.sin(2 * np.pi * f * t), 0) * np.cos(
            np.round(world.phase / np.pi) * np.pi
        )
    else:
        wave = np.exp(-0.5 * (t / sigma) ** 2) * np.cos(2 * np.pi * f * t + world.phase)
    return wave / np.abs(wave).max(), rate


def tilt_factor(world: World, tilt_deg: Array) -> Array:
    """Amplitude of the bone echo at a tilt, relative to perpendicular."""
    if world.tilt_law == "specular":
        lobe = np.exp(-np.log(2) * (tilt_deg / world.tilt_width_deg) ** 2)
        return np.asarray(np.sqrt(lobe**2 + world.tilt_floor**2))
    if world.tilt_law == "cosine":
        return np.asarray(np.cos(np.radians(tilt_deg)) ** 40)
    return np.ones_like(tilt_deg)


def simulate(
    rng: np.random.Generator, frames: int, world: World | None = None, without_bone: float = 0.2, most_tilt_deg: float = 5.0
) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines in one world, and the truth about it."""
    if world is None:
        world = draw_world(rng)
        world = plain(world, rng) if rng.random() < PLAIN_SHARE else world
    count = -(-frames // world.frames_a_point)
    repeat = np.repeat(np.arange(count), world.frames_a_point)[:frames]
    wander = 0.15 * np.cumsum(rng.normal(size=frames)) * 0.3
    wander = np.clip(wander - wander.mean(), -0.6, 0.6)
    places = rng.uniform(*DEPTH_MM, count)
    if rng.random() < SAME_DEPTH_SHARE:  # a head's scalp is alike from place to place; a phantom's layer is the same
        places = np.clip(rng.uniform(*DEPTH_MM) + rng.uniform(0, 1.5) * rng.normal(size=count), *DEPTH_MM)
    depth = np.clip(places[repeat] + wander * (world.frames_a_point > 1), *DEPTH_MM)
    tilt = np.abs(rng.uniform(0, most_tilt_deg, count)[repeat] + rng.normal(0, 0.4, frames))
    kinds = np.where(rng.random(count) < without_bone, rng.choice(["tissue", "air", "noise"], count, p=[0.55, 0.3, 0.15]), "bone")
    kind = kinds[repeat]
    layer_fraction = rng.uniform(0.1, 0.95, (count, 3))
    layer_db = rng.uniform(*world.galea_db, (count, 3))
    layer_sign = rng.choice([-1, 1], (count, 3))
    lines = np.zeros((frames, world.samples))
    snr = np.full(frames, -np.inf)
    loss = _loss(world, depth)
    bone = world.bone_reflection * tilt_factor(world, tilt)
    reference = (
        float(np.median((world.bone_reflection * _loss(world, depth))[kind == "bone"])) if (kind == "bone").any() else 0.05
    )
    for index in range(frames):
        amplitude = float(bone[index] * loss[index])
        if world.snr_per_line:
            noise = world.bone_reflection * float(loss[index]) * 10 ** (-world.snr_db / 20)
        else:
            noise = reference * 10 ** (-world.snr_db / 20)
        which = repeat[index]
        layers = [
            (f, world.bone_reflection * 10 ** (-d / 20) * s)
            for f, d, s in zip(layer_fraction[which], layer_db[which], layer_sign[which])
        ][: world.layers]
        lines[index] = _line(rng, world, str(kind[index]), float(depth[index]), float(bone[index]), layers, noise)
        if kind[index] == "bone":
            snr[index] = 20 * np.log10(amplitude / noise)
    codes = _digitise(rng, world, lines)
    origin = rng.uniform(-60, 60, (count, 3))[repeat] + np.cumsum(rng.normal(0, 0.05, (frames, 3)), axis=0)
    poses = rigid_from_vector(rng.uniform(-2, 2, (count, 3))[repeat] + rng.normal(0, 0.003, (frames, 3)), origin)
    recording = Recording(
        lines=codes,
        acquisition=world.acquisition,
        probe_to_reference=poses,
        statuses=("OK",) * frames,
        timestamps_s=np.arange(frames) / 50,
        palpation_points=np.full(frames, -1) if world.sweep else repeat.astype(np.int64),
    )
    truth = Truth(np.where(kind == "bone", depth, np.nan), tilt, world.speed_m_s, snr)
    return recording, truth, world


def _loss(world: World, depth_mm: Array) -> Array:
    decibel = world.attenuation * world.acquisition.transducer_hz * 1e-6 * 0.2 * np.asarray(depth_mm)
    return np.asarray(10 ** (-decibel / 20))


def _line(
    rng: np.random.Generator, world: World, kind: str, depth: float, bone: float, layers: list[tuple[float, float]], noise: float
) -> Array:
    """One line: main bang, forerun and its multiples, tissue, bone and what follows, noise, spikes, drift."""
    acquisition, speed = world.acquisition, world.speed_m_s
    skin = 2e-3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s if acquisition.forerun_length_mm else 0.0
    end = world.samples / acquisition.sampling_hz
    times: list[float] = []
    amplitudes: list[float] = []
    paths: list[float] = []  # tissue depth in mm, for the attenuation

    def add(time: float, amplitude: float, path: float) -> None:
        if time < end + 2e-6:
            times.append(time)
            amplitudes.append(amplitude)
            paths.append(path)

    if acquisition.forerun_length_mm and world.forerun_shown:
        reflection = -1.0 if kind == "air" else world.forerun_reflection
        back = rng.uniform(0.25, 0.5)
        for bounce in range(1, 6):
            add(bounce * skin, reflection**bounce * back ** (bounce - 1), 0.0)
    if kind in ("bone", "tissue"):
        reach = depth if kind == "bone" else 40.0
        if world.speckle_db < 80:
            n = rng.poisson(world.speckle_per_us * 2e3 * reach / speed)
            z = rng.uniform(0, reach, n)
            level = world.bone_reflection * 10 ** (-world.speckle_db / 20) / np.sqrt(1 + world.speckle_per_us * 0.3)
            for one, amount in zip(z, rng.normal(0, level, n)):
                add(skin + 2e-3 * one / speed, amount, one)
        for fraction, amount in layers:
            z1 = fraction * depth
            add(skin + 2e-3 * z1 / speed, amount, z1)
    if kind == "bone":
        arrival = skin + 2e-3 * depth / speed
        add(arrival, bone, depth)
        inner = arrival + 2e-3 * world.bone_mm * rng.uniform(0.9, 1.1) / world.bone_speed_m_s
        add(inner, -bone * 10 ** (-world.inner_db / 20), depth)
        for _ in range(rng.integers(0, 6)):  # diploe
            add(rng.uniform(arrival, inner), bone * rng.normal(0, 0.03), depth)
        add(arrival + 2e-3 * depth / speed, bone**2 * rng.uniform(0.02, 0.3), 2 * depth)
    rf = _synthesise(world, np.array(times), np.array(amplitudes), np.array(paths))
    clock = np.arange(world.samples) / acquisition.sampling_hz
    rf += world.ringing * np.exp(-clock / world.ringing_s) * np.cos(2 * np.pi * acquisition.transducer_hz * clock + world.phase)
    rf += _noise(rng, world) * noise
    for _ in range(rng.poisson(world.spikes)):
        rf[rng.integers(world.samples)] += rng.choice([-1, 1]) * rng.uniform(5, 40) * noise
    return rf + noise * 30 * (world.offset + world.drift * np.sin(2 * np.pi * (clock * rng.uniform(1e4, 6e4) + rng.random())))


def _noise(rng: np.random.Generator, world: World) -> Array:
    """Noise of unit standard deviation, white or limited to the receiver's band."""
    white = rng.normal(size=world.samples)
    edge = world.noise_band * world.acquisition.transducer_hz
    if edge <= 0 or edge >= world.acquisition.sampling_hz / 2:
        return white
    spectrum = np.fft.rfft(white)
    spectrum[np.fft.rfftfreq(world.samples, 1 / world.acquisition.sampling_hz) > edge] = 0
    limited = np.fft.irfft(spectrum, world.samples)
    return np.asarray(limited / limited.std())


def _synthesise(world: World, times: Array, amplitudes: Array, paths: Array) -> Array:
    """Sum of pulses at arbitrary times, by interpolation of a finely sampled pulse."""
    acquisition = world.acquisition
    rf = np.zeros(world.samples)
    if not len(times):
        return rf
    width = (5.5 if world.pulse in ("gauss", "ricker") else 12.0) / acquisition.transducer_hz
    wave, rate = make_pulse(world, width)
    clock = np.arange(int(2 * width * acquisition.sampling_hz) + 1)
    centre = acquisition.transducer_hz
    bank = [wave]
    step_mm = 1.5
    if world.downshift:
        spectrum = np.fft.rfft(wave)
        frequency = np.fft.rfftfreq(len(wave), 1 / rate)
        for level in range(1, int(40 / step_mm) + 2):
            decibel = world.attenuation * 0.2 * level * step_mm * 1e-6 * (frequency - centre)
            bank.append(np.fft.irfft(spectrum * 10 ** (-np.clip(decibel, -60, 200) / 20), len(wave)))
    strength = amplitudes * _loss(world, paths)
    for time, amplitude, path in zip(times, strength, paths):
        pulse = bank[min(round(path / step_mm), len(bank) - 1)]
        first = int(np.floor((time - width) * acquisition.sampling_hz)) + 1
        index = first + clock
        inside = (index >= 0) & (index < world.samples)
        index = index[inside]
        at = (index / acquisition.sampling_hz - time + width) * rate
        rf[index] += amplitude * np.interp(at, np.arange(len(pulse)), pulse, left=0, right=0)
    return rf


def _digitise(rng: np.random.Generator, world: World, lines: Array) -> npt.NDArray[np.int16]:
    """int16 codes; the gain is set so that the strongest echoes come near full scale, noise no finer than half a code."""
    start = int((0.5e-6 if world.acquisition.forerun_length_mm == 0 else 0) * world.acquisition.sampling_hz)
    peak = float(np.percentile(np.abs(lines[:, start:]).max(axis=1), 90))
    codes = np.round(lines / peak * world.full_scale * world.largest_code)
    return np.clip(codes, -world.largest_code - 1, world.largest_code).astype(np.int16)
