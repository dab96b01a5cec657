"""Simulated A-lines as a textbook would write them in a page.

A Gaussian pulse, a delay line with strong multiples, one interface that follows the bone, filtered noise for speckle that ends
at the bone, the inner table, white noise that is as faint in each line as the SNR says; the probe glides or jumps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition, Recording
from CranioNavLib.rigid import rigid_from_vector

from Testing.Studies.simulators.line_truth import Truth

Array = npt.NDArray[np.float64]

FACE, BACK = 0.3, -0.4  # forerun's echo, and each further one over the one before
BONE = 0.5
DELAY_M_S = 2340.0  # polystyrene
SKULL_M_S = 3000.0
BEHIND_MM = 22.0  # of tissue that the lines cover


@dataclass(frozen=True)
class Plain:
    """What all lines of a recording share."""

    acquisition: Acquisition
    bandwidth: float
    phase: float
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    snr_db: float
    glides: bool
    place_of_layer: float  # of the bone's depth
    layer: float  # its echo over bone's
    speckle: float  # over bone's echo
    lobe_deg: float
    inner: float  # over bone's echo
    skull_mm: float
    codes: float


def draw_plain(rng: np.random.Generator) -> Plain:
    """A set-up from the ranges of the literature."""
    centre = float(rng.uniform(3, 10))
    sampling = float(rng.choice([25, 40, 50, 60, 80, 100, 125]))
    forerun = rng.random() < 0.5
    return Plain(
        acquisition=Acquisition(
            (sampling if sampling >= 2.5 * centre else 60.0) * 1e6,
            centre * 1e6,
            float(rng.uniform(18, 25)) if forerun else 0.0,
            DELAY_M_S if forerun else 0.0,
        ),
        bandwidth=float(rng.uniform(0.5, 0.8)),
        phase=float(rng.choice([0, np.pi / 2, np.pi])),
        speed_m_s=float(rng.uniform(1450, 1630)),
        attenuation=float(rng.uniform(0.3, 2.6)),
        snr_db=float(rng.uniform(12, 40)),
        glides=bool(rng.random() < 0.6),
        place_of_layer=float(rng.uniform(0.5, 0.9)),
        layer=float(rng.uniform(0.06, 0.25)),
        speckle=float(10 ** (-rng.uniform(20, 40) / 20)),
        lobe_deg=float(rng.uniform(3, 8)),
        inner=float(rng.uniform(0.1, 0.4)),
        skull_mm=float(rng.uniform(3, 7)),
        codes=float(rng.choice([2000, 12000, 30000])),
    )


def draw_depths(plain: Plain, rng: np.random.Generator, frames: int) -> tuple[Array, npt.NDArray[np.int64]]:
    """Depth of the bone (n,), and what is there (n,): 0 bone, 1 an interface in tissue without end, 2 nothing."""
    if plain.glides:
        depth = np.clip(rng.uniform(2, 15) + np.cumsum(rng.normal(0, 0.08, frames)), 2, 15)
        missing = np.arange(frames) // 10 % 6 == 5
    else:
        depth, missing = rng.uniform(2, 15, frames), rng.random(frames) < 0.15
    return depth, np.where(missing, rng.integers(1, 3, frames), 0)


def simulate(rng: np.random.Generator, frames: int, plain: Plain | None = None) -> tuple[Recording, Truth, Plain]:
    """A recording of `frames` lines, and the truth about it."""
    plain = plain or draw_plain(rng)
    depth, kind = draw_depths(plain, rng, frames)
    tilt = np.abs(rng.normal(0, 2, frames))
    sampling, centre = plain.acquisition.sampling_hz, plain.acquisition.transducer_hz
    skin = 2e-3 * plain.acquisition.forerun_length_mm / DELAY_M_S
    time = np.arange(int(sampling * (skin + 2e-3 * BEHIND_MM / plain.speed_m_s))) / sampling
    sigma = np.sqrt(2 * np.log(2)) / (np.pi * plain.bandwidth * centre)

    def pulse(at: Array) -> Array:
        return np.asarray(np.exp(-0.5 * (at / sigma) ** 2) * np.cos(2 * np.pi * centre * at + plain.phase))

    def loss(way_mm: npt.ArrayLike) -> Array:
        return np.asarray(10 ** (-0.01 * plain.attenuation * centre * 1e-6 * np.asarray(way_mm)))

    to_s = 2e-3 / plain.speed_m_s
    kernel = pulse(np.arange(-int(4 * sigma * sampling), int(4 * sigma * sampling) + 1) / sampling)
    strength = BONE * np.exp(-0.5 * (tilt / plain.lobe_deg) ** 2) * loss(depth)
    noise = strength * 10 ** (-plain.snr_db / 20)
    lines = rng.normal(size=(frames, len(time))) * noise[:, None]
    if skin:
        lines += FACE * sum(BACK**number * pulse(time - (number + 1) * skin) for number in range(3))
    way = (time - skin) / to_s
    for index in range(frames):
        end = (depth[index], 40.0, 0.0)[kind[index]]
        speckle = np.convolve(rng.normal(size=len(time)), kernel, "same")
        speckle *= plain.speckle * BONE / speckle.std() * loss(np.clip(way, 0, 60)) * ((way > 0) & (way < end))
        lines[index] += speckle
        if kind[index] < 2:
            layer = plain.place_of_layer * depth[index]
            lines[index] += BONE * plain.layer * loss(layer) * rng.choice([1, 1, 0.7]) * pulse(time - skin - to_s * layer)
        if kind[index] == 0:
            arrival = skin + to_s * depth[index]
            lines[index] += strength[index] * pulse(time - arrival)
            lines[index] -= plain.inner * strength[index] * pulse(time - arrival - 2e-3 * plain.skull_mm / SKULL_M_S)
    lines = lines / np.percentile(np.abs(lines).max(axis=1), 95) * plain.codes
    steps = rng.normal(0, 0.3, (frames, 3))
    where = np.cumsum(steps, axis=0) if plain.glides else rng.uniform(-60, 60, (frames, 3))
    recording = Recording(
        lines=np.clip(np.round(lines), -32768, 32767).astype(np.int16),
        acquisition=plain.acquisition,
        probe_to_reference=rigid_from_vector(np.zeros((frames, 3)), where),
        statuses=("OK",) * frames,
        timestamps_s=np.arange(frames) / 40,
        palpation_points=np.full(frames, -1),
    )
    bone = kind == 0
    snr = np.where(bone, plain.snr_db, -np.inf)
    return recording, Truth(np.where(bone, depth, np.nan), tilt, plain.speed_m_s, snr), plain
