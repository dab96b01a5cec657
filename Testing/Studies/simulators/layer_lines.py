"""A-lines over layered tissue by reflection coefficients: skin, fat, galea, loose tissue, periosteum, tables and diploe.

The other families add echoes; here the medium answers as a whole. Every interface has its impedances, so that all tissue
reverberations, the multiples of a lossy delay line and those of a bare transducer's face come out of one recursion, with the
dispersion that belongs to the attenuation. The transducer is a rectangular pulser and staggered resonators that ring, and
bone answers with a specular echo of its own width of beam and with facets that stay diffuse when it is tilted. Recordings go
as a hand goes: air, a touch, a place searched and turned upright, or a sweep over a burr hole; cheeks without bone; hair,
lost contact, clipped faces, sparks, echoes fixed in time, missing poses. What they are drawn from is in
layer_plan.py, how the tissue answers in layer_medium.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition, Recording

from Testing.Studies.simulators.layer_medium import Band, Real, Spectra, answer_of, phasor
from Testing.Studies.simulators.layer_plan import (
    NEPER,
    Array,
    Bools,
    Forerun,
    Head,
    Stay,
    Transducer,
    draw_forerun,
    draw_head,
    draw_poses,
    draw_stays,
    draw_transducer,
    wander,
)
from Testing.Studies.simulators.line_truth import Truth

LEAST_FRAMES = 8


@dataclass(frozen=True)
class World:
    """What was drawn for a recording."""

    pulse: str
    attenuation: float  # dB/cm/MHz
    snr_db: float  # of bone met squarely, as it would be received: mean of the recording in dB
    snr_of: str
    transducer: Transducer
    head: Head
    forerun: Forerun | None
    bits: int
    full: float  # scale of the converter over a perfect mirror at the transducer
    noise_codes: float
    fixed_echo: bool  # in all lines at one time


@dataclass(frozen=True, eq=False)
class Heard:
    """What the transducer hears at the face of the probe, line by line, and what stands there."""

    face: Spectra  # (n, F)
    bone: Spectra  # (n, F) the bone's echo alone
    square: Spectra  # (n, F) the bone's echo if it were met squarely
    depth_mm: Array  # (n,) along the beam; NaN: no bone
    tilt_deg: Array  # (n,)
    contact: Bools  # (n,)


def _listen(rng: np.random.Generator, band: Band, head: Head, stays: list[Stay], forerun: Forerun | None) -> Heard:
    """The places one after the other, with hair, bubbles, and contact lost for a moment."""
    count, air = sum(len(stay) for stay in stays), -1.0 if forerun else 0.0
    face = np.full((count, len(band.mhz)), air, dtype=np.complex64)
    bone, square = np.zeros_like(face), np.zeros_like(face)
    depth, tilt, contact, start = np.full(count, np.nan), np.zeros(count), np.zeros(count, dtype=bool), 0
    impedance = forerun.material.impedance if forerun else 0.0
    for stay in stays:
        here, start = slice(start, start + len(stay)), start + len(stay)
        if stay.kind == "lift":
            face[here] *= np.float32(rng.uniform(0.3, 1))
        if stay.stack is None:
            continue
        answer = answer_of(rng, band, head, stay, stay.stack, impedance or rng.uniform(1.5, 1.6))
        coupled = np.clip(1 - np.abs(wander(rng, len(stay), 0.25, 4)), 0.25, 1) if head.hair else np.ones(len(stay))
        dry = rng.random(len(stay)) < (0.03 if rng.random() < 0.4 else 0.0)
        coupling = coupled.astype(np.float32)[:, None]
        wet = answer.whole * coupling + (1 - coupling) * np.float32(0.7 * air)
        face[here] = np.where(dry[:, None], np.float32(air), wet)
        bone[here], square[here] = answer.bone * (coupling * ~dry[:, None]), answer.square
        tilt[here], contact[here] = stay.angle_deg, ~dry
        if stay.kind == "bone":
            along = stay.thickness_mm / np.cos(np.radians(stay.angle_deg))
            depth[here] = np.where(stay.hole | dry, np.nan, along)
    return Heard(face, bone, square, depth, tilt, contact)


def _all_echoes(band: Band, heard: Heard, forerun: Forerun | None, skin_us: Array, passed: Spectra) -> Spectra:
    """What the transducer hears (n, F): with what goes to and fro between its face and the skin."""
    echoes = heard.face * passed
    again = np.float32(band.transducer.face_r) * echoes
    if forerun is None:
        return np.asarray(echoes / (1 - again))
    whole, loop, number = echoes.copy(), echoes, 1
    while (number + 1) * skin_us.min() < band.samples / band.transducer.sampling_mhz and number < 5:
        loop = loop * again
        whole += loop
        number += 1
    return whole


@dataclass(frozen=True, eq=False)
class Levels:
    """Noise and converter, over the echo of a perfect mirror at the transducer."""

    noise: float
    full: float
    bits: int

    @property
    def code(self) -> float:
        """One step of the converter."""
        return float(self.full / 2 ** (self.bits - 1))


def _draw_levels(
    rng: np.random.Generator, band: Band, head: Head, forerun: Forerun | None, square: Array, largest: float, soft: bool
) -> Levels:
    """Noise from the perpendicular echoes of bone (n,), gain from the largest echo, a converter that shows the noise."""
    bone = len(square) > 0
    usual = square if bone else _usual(head, band.transducer)
    noise = float(np.exp(np.log(usual).mean()) * 10 ** (-rng.uniform(18, 42) / 20))
    noise = min(noise, float(np.percentile(usual, 5)) * 10 ** (-14 / 20))
    loss = head.attenuation * band.transducer.nominal_mhz
    if soft:  # tissue is seen 12 mm deep and more: it goes on, so it is no bone
        noise = 0.6 * head.speckle * 10 ** (-loss * 0.2 * 12 / 20)
        if forerun:
            noise *= np.exp(-2 * forerun.material.attenuation * NEPER / 10 * band.transducer.nominal_mhz * forerun.length_mm)
    seen = max(largest, float(usual.max()))
    if forerun and bone and rng.random() < 0.2:  # gain turned up: the face's echo clips, bone does not
        seen = max(float(usual.max()) * 1.1, seen * 0.35)
    full = seen / rng.uniform(0.35, 0.9) if rng.random() < 0.95 else seen / 1.3
    bits = int(rng.choice([10, 12, 14]))
    while bits < 15 and noise / full * 2 ** (bits - 1) < 0.5:
        bits += 1
    return Levels(max(noise, 0.5 * full / 2 ** (bits - 1)), full, bits)


def _usual(head: Head, transducer: Transducer) -> Array:
    """What stands for the bone's echo where there is none."""
    return np.array([0.1 * np.exp(-head.attenuation * transducer.nominal_mhz * NEPER)])


def _slow(rng: np.random.Generator, band: Band, levels: Levels, frames: int) -> Real:
    """The base line: what the amplifier recovers from, and what drifts (n, samples)."""
    time = np.arange(band.samples) / band.transducer.sampling_mhz
    still = rng.uniform(-0.05, 0.05) - rng.uniform(0.01, 0.08) * np.exp(-time / rng.uniform(3, 12))
    drift = 0.01 * np.sin(np.pi * time / time[-1] + rng.uniform(0, 6))
    unrest = wander(rng, frames, 1, 10).astype(np.float32)[:, None]
    return np.asarray(levels.full * (unrest * drift.astype(np.float32) + still.astype(np.float32)), dtype=np.float32)


def _bang(rng: np.random.Generator, band: Band, levels: Levels, first_us: float) -> Real:
    """Feed-through and ring-down (samples,), the same in every line; over before the first echo."""
    time = np.arange(band.samples) / band.transducer.sampling_mhz
    lasts = min(1.2 / band.transducer.nominal_mhz, 0.7 * first_us / np.log(8 * levels.full / levels.noise))
    turns = 2 * np.pi * band.transducer.centre_mhz * time + rng.uniform(0, 6)
    return np.asarray(8 * levels.full * np.exp(-time / lasts) * np.cos(turns), dtype=np.float32)


def _noise(rng: np.random.Generator, band: Band, frames: int) -> Spectra:
    """Noise of the receiver's band as spectra (n, F) on the frequencies heard; 1 RMS in the lines."""
    heard = band.receiver(band.heard_mhz)
    normal = rng.standard_normal((frames, 2 * len(heard)), dtype=np.float32).view(np.complex64)
    return np.asarray(normal * (heard * (band.size / np.sqrt(4 * (heard**2).sum()))).astype(np.float32))


def _sparks(rng: np.random.Generator, band: Band, full: float, noise: Spectra) -> None:
    """Sparks in single lines, added to the spectra (n, F)."""
    if rng.random() >= 0.3:
        return
    lines = np.flatnonzero(rng.random(len(noise)) < 0.04)
    time = rng.uniform(0.05, 0.95, len(lines)) * band.samples / band.transducer.sampling_mhz
    height = full * rng.uniform(0.05, 0.5, len(lines)) * band.transducer.sampling_mhz / (4 * band.transducer.nominal_mhz)
    spectra = phasor(np.outer(-2 * np.pi * time, band.heard_mhz)) * band.receiver(band.heard_mhz).astype(np.float32)
    noise[lines] += spectra * height.astype(np.float32)[:, None]


def _carrier(rng: np.random.Generator, band: Band, noise: float, frames: int) -> Real | float:
    """A carrier picked up by the cable (n, samples), in few recordings."""
    if rng.random() >= 0.10:
        return 0.0
    time = np.arange(band.samples) / band.transducer.sampling_mhz
    height, mhz = noise * rng.uniform(0.3, 0.8), rng.uniform(0.5, 1.6) * band.transducer.nominal_mhz
    phase = rng.uniform(0, 2 * np.pi, (frames, 1))
    return np.asarray(height * np.sin((2 * np.pi * mhz * time + phase).astype(np.float32)), dtype=np.float32)


def _fixed_echo(rng: np.random.Generator, band: Band, usual: Array, forerun: Forerun | None, skin_us: Array) -> Spectra:
    """One echo at one time in every line (n, F): the end of the damping, or a side wall of the delay line."""
    time = skin_us + (rng.uniform(3, 18) if forerun else rng.uniform(4, 20))
    height = rng.uniform(0.1, 0.3) * np.percentile(usual, 10) * np.exp(1j * rng.uniform(0, 6))
    return np.asarray(band.delay(time) * (band.pulse * height).astype(np.complex64))


def simulate(rng: np.random.Generator, frames: int) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines or very nearly so, 8 at least, and the truth about it."""
    transducer = draw_transducer(rng)
    head = draw_head(rng, transducer.nominal_mhz)
    stays = draw_stays(rng, head, max(frames, LEAST_FRAMES))
    count = sum(len(stay) for stay in stays)
    places = [stay for stay in stays if stay.stack is not None]
    deepest = max([float(stay.thickness_mm.max()) for stay in places] + [6.0])
    forerun = draw_forerun(rng, head, deepest)
    skin_us = forerun.delay_us(count) if forerun else np.zeros(count)
    window = skin_us.max() + 2 * max(deepest + 6, rng.uniform(18, 30)) / head.speed
    band = Band(transducer, int(np.ceil(window * transducer.sampling_mhz / 64) * 64))
    heard = _listen(rng, band, head, stays, forerun)
    received = _receive(rng, band, head, stays, forerun, heard, skin_us)
    levels, square = received.levels, received.square
    truth = Truth(heard.depth_mm, heard.tilt_deg, head.speed * 1e3, received.snr_db)
    known = rng.random(count) >= (0.04 if rng.random() < 0.5 else 0.0)
    lost = rng.choice(["MISSING", "INVALID", "OUT_OF_VIEW"], count)
    length, header_speed = (forerun.length_mm, forerun.material.speed * 1e3) if forerun else (0.0, 0.0)
    poses = draw_poses(rng, stays, length)
    poses[~known] = np.nan
    recording = Recording(
        lines=received.lines,
        acquisition=Acquisition(transducer.sampling_mhz * 1e6, transducer.nominal_mhz * 1e6, length, header_speed),
        probe_to_reference=poses,
        statuses=tuple("OK" if good else str(why) for good, why in zip(known, lost)),
        timestamps_s=_timestamps(rng, count),
        palpation_points=np.concatenate([np.full(len(stay), stay.place) for stay in stays]),
    )
    usual = square if len(square) else _usual(head, transducer)
    snr_db = float(np.log(usual).mean() / NEPER - np.log(levels.noise) / NEPER)
    world = World(
        pulse="resonators",
        attenuation=head.attenuation,
        snr_db=snr_db,
        snr_of="recording",
        transducer=transducer,
        head=head,
        forerun=forerun,
        bits=levels.bits,
        full=levels.full,
        noise_codes=levels.noise / levels.code,
        fixed_echo=received.fixed_echo,
    )
    return recording, truth, world


def _timestamps(rng: np.random.Generator, frames: int) -> Array:
    rate_hz = rng.uniform(15, 60)
    return np.cumsum(np.maximum(0.002, rng.normal(1 / rate_hz, 0.1 / rate_hz, frames)))


@dataclass(frozen=True, eq=False)
class Received:
    """What comes out of the converter, and what is known of it."""

    lines: npt.NDArray[np.int16]  # (n, samples)
    levels: Levels
    square: Array  # peaks of the bone's echoes if they were met squarely, one for each line with bone
    snr_db: Array  # (n,) of the bone's echo as it is received; -inf without
    fixed_echo: bool


def _receive(
    rng: np.random.Generator, band: Band, head: Head, stays: list[Stay], forerun: Forerun | None, heard: Heard, skin_us: Array
) -> Received:
    """The lines as they leave the converter."""
    frames, sampling = len(skin_us), band.transducer.sampling_mhz
    passed = band.delay(skin_us)
    if forerun:
        passed *= np.exp(-2 * forerun.material.attenuation * NEPER / 10 * forerun.length_mm * band.mhz).astype(np.float32)
    jitter = rng.normal(0, 0.4 / sampling if forerun else 0.002, frames)
    echoes = _all_echoes(band, heard, forerun, skin_us, passed) * band.delay(jitter) * band.pulse
    lines = band.lines(echoes, band.bins)
    bone = np.flatnonzero(np.isfinite(heard.depth_mm))
    square, height = (band.heights(each[bone] * passed[bone]) for each in (heard.square, heard.bone))
    first = 0 if forerun else int(1.2 * sampling)
    largest = float(np.abs(lines[heard.contact, first:]).max(initial=0.0))
    bare = all(stay.kind != "bone" for stay in stays)
    soft = bare and any(stay.kind == "soft" for stay in stays)
    levels = _draw_levels(rng, band, head, forerun, square, largest, soft)
    spectra = _noise(rng, band, frames) * np.float32(levels.noise)
    slow = _slow(rng, band, levels, frames)
    fixed = bool(rng.random() < 0.2 and head.without in ("", "soft"))
    if head.without == "unplugged":
        lines = band.lines(spectra, band.heard) + slow
    else:
        _sparks(rng, band, levels.full, spectra)
        if fixed:
            core = slice(band.bins[0] - band.heard[0], band.bins[-1] + 1 - band.heard[0])
            spectra[:, core] += _fixed_echo(rng, band, square if len(square) else _usual(head, band.transducer), forerun, skin_us)
        thin = [float(stay.thickness_mm.min()) for stay in stays if stay.stack is not None]
        first_us = skin_us.min() if forerun else 2 * min([*thin, 2.0]) / head.speed
        lines += band.lines(spectra, band.heard) + slow + _bang(rng, band, levels, first_us)
        lines += _carrier(rng, band, levels.noise, frames)
    codes = 2 ** (levels.bits - 1)
    lines = np.clip(np.rint(lines / np.float32(levels.code)), -codes, codes - 1).astype(np.int16)
    snr = np.full(frames, -np.inf)
    snr[bone] = 20 * np.log10(np.maximum(height, 1e-12) / np.hypot(levels.noise, levels.code / np.sqrt(12)))
    return Received(lines, levels, square, snr, fixed)
