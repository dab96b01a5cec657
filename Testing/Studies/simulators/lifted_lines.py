"""Simulated A-lines of a probe that meets no bone: lifted into air, a drop of gel on its face, over hair, on soft tissue.

All of it goes on while a session is prepared and between its points. What misleads is the drop: air behind gel sends all back
that comes square to it, and nothing shows behind, as with bone in a water bath. Its echo wanders with the drop, comes again
between the drop's two ends, and lies within a few millimetres. Hair holds air, too, in many small pieces. Soft tissue scatters,
has layers, and goes on. Frequencies are synthesised one by one, so that each loses what it loses on its way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition, Recording
from CranioNavLib.rigid import rigid_from_vector

from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.units import InMicroseconds

Array = npt.NDArray[np.float64]

# Speed of sound (m/s) and impedance (MRayl) of delay lines: Aqualene, TPX, polystyrene, HDPE, PMMA
MATERIALS = ((1616.0, 1.49), (2170.0, 1.79), (2340.0, 2.47), (2460.0, 2.30), (2670.0, 3.15))
TISSUE_MRAYL, GEL_MRAYL, PIEZO_MRAYL = 1.63, 1.5, 8.0
GEL_M_S = 1500.0
DROP_MM = (0.25, 5.0)
KINDS = ("air", "drop", "hair", "soft")
NEPER = np.log(10) / 20  # a decibel


@dataclass(frozen=True)
class Lifted(InMicroseconds):
    """What all lines of a recording share."""

    acquisition: Acquisition
    samples: int
    face_mrayl: float  # of what touches the gel: delay line, or the transducer's front
    line_db_cm_mhz: float  # the delay line's loss
    bandwidth: float
    order: int  # of the pulse's rise (t^order exp(-t/tau)); 0: symmetric about its middle
    phase: float
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    snr_db: float  # of an echo that sends all back, over the noise
    ringing: float  # of the transmit pulse, over such an echo
    speckle: float  # of soft tissue, over such an echo
    rate_hz: float
    shares: tuple[float, ...]  # of KINDS


def draw_lifted(rng: np.random.Generator) -> Lifted:
    """A set-up, and what its probe meets."""
    centre = float(rng.uniform(3, 10))
    sampling = float(rng.choice([rate for rate in (25, 30, 40, 50, 62.5, 80, 100, 125) if rate >= 4 * centre]))
    forerun, speed = rng.random() < 0.5, float(rng.uniform(1450, 1630))
    line_m_s, line_mrayl = MATERIALS[int(rng.integers(len(MATERIALS)))]
    length = float(rng.uniform(10, 30)) if forerun else 0.0
    covered_us = 2e3 * length / line_m_s + 2e3 * rng.uniform(14, 22) / speed
    return Lifted(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, length, line_m_s if forerun else 0.0),
        samples=int(covered_us * sampling),
        face_mrayl=line_mrayl if forerun else float(rng.uniform(2, PIEZO_MRAYL)),
        line_db_cm_mhz=float(rng.uniform(0.05, 0.6)),
        bandwidth=float(rng.uniform(0.4, 0.95)),
        order=int(rng.choice([0, 0, 2, 3, 4])),
        phase=float(rng.uniform(0, 2 * np.pi)),
        speed_m_s=speed,
        attenuation=float(rng.uniform(0.3, 2.6)),
        snr_db=float(rng.uniform(20, 65)),
        ringing=float(rng.choice([0.0, 10 ** rng.uniform(-1.5, 1)])),
        speckle=float(10 ** rng.uniform(-2.6, -1.2)),
        rate_hz=float(rng.uniform(10, 50)),
        shares=tuple(float(share) for share in rng.dirichlet([0.6, 1.2, 0.4, 0.6])),
    )


def spectrum_of(lifted: Lifted, mhz: Array) -> npt.NDArray[np.complex128]:
    """The pulse's spectrum; its start (of a damped one) or its middle lies at time zero."""
    half = lifted.bandwidth * lifted.centre_mhz / 2
    if not lifted.order:
        return np.exp(-np.log(2) * ((mhz - lifted.centre_mhz) / half) ** 2 + 1j * lifted.phase)
    rate = half / np.sqrt(4 ** (1 / (lifted.order + 1)) - 1)  # -6 dB at the band's ends
    damped = (1 + 1j * (mhz - lifted.centre_mhz) / rate) ** -(lifted.order + 1)
    return np.asarray(damped * np.exp(1j * lifted.phase) * (1 - np.exp(-((mhz / lifted.centre_mhz) ** 2) * 6)))


class Lines:
    """Spectra of n lines under way."""

    def __init__(self, lifted: Lifted, count: int) -> None:
        self.lifted, size = lifted, lifted.samples + 256
        frequency = np.fft.rfftfreq(size, 1 / lifted.sampling_mhz)
        self.size, self.used = size, frequency < 2.5 * lifted.centre_mhz
        self.mhz = frequency[self.used]
        self.values = np.zeros((count, len(self.mhz)), dtype=complex)

    def add(self, lines: npt.NDArray[np.int64], time_us: Array, strength: Array, loss_db_mhz: npt.ArrayLike = 0.0) -> None:
        """Echoes (m,) in `lines`, at times from the pulse, after a loss for each megahertz."""
        loss = np.broadcast_to(np.asarray(loss_db_mhz, dtype=float), lines.shape)
        waves = strength[:, None] * np.exp(-(2j * np.pi * time_us + NEPER * loss)[:, None] * self.mhz)
        np.add.at(self.values, lines, waves)

    def rf(self) -> Array:
        """The lines (n, samples)."""
        whole = np.zeros((len(self.values), self.size // 2 + 1), dtype=complex)
        whole[:, self.used] = self.values * spectrum_of(self.lifted, self.mhz)
        return np.fft.irfft(whole, self.size, axis=1)[:, : self.lifted.samples]


def reflected(before: float, behind: npt.ArrayLike) -> Array:
    """Share of the pressure that an interface between these impedances sends back."""
    return np.asarray((np.asarray(behind) - before) / (np.asarray(behind) + before))


def draw_stays(lifted: Lifted, rng: np.random.Generator, frames: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.str_]]:
    """Which stay each line (n,) belongs to, and what the probe meets there (n,)."""
    ends = np.cumsum(rng.integers(4, 30, frames))
    stay = np.searchsorted(ends, np.arange(frames), side="right")
    return stay, rng.choice(KINDS, frames, p=lifted.shares)[stay]


def add_drop(lines: Lines, rng: np.random.Generator, rows: npt.NDArray[np.int64], skin_us: float, passed: float) -> None:
    """A drop of gel on the face with air behind: its end's echo, and the same between its two ends."""
    count, step = len(rows), rng.choice([0.005, 0.03, 0.15])
    low, high = np.log(DROP_MM)
    thick = (
        np.exp(rng.uniform(low, high)) + np.cumsum(rng.normal(0, step, count)) + rng.normal(0, rng.choice([0.01, 0.08]), count)
    )
    thick = np.clip(np.abs(thick), DROP_MM[0], 1.5 * DROP_MM[1])
    square = 10 ** (-rng.uniform(0, 30) / 20) * np.exp(rng.normal(0, rng.choice([0.1, 0.5]), count))  # a drop is round
    back = reflected(GEL_MRAYL, lines.lifted.face_mrayl)
    for turn in range(1, 5):
        lines.add(rows, skin_us + turn * 2e3 * thick / GEL_M_S, passed * (-np.minimum(square, 1)) ** turn * back ** (turn - 1))


def add_hair(lines: Lines, rng: np.random.Generator, rows: npt.NDArray[np.int64], skin_us: float, passed: float) -> None:
    """Air between hairs: many small echoes close to the face."""
    depth = rng.exponential(rng.uniform(0.3, 1.2), 12)
    for one in depth:
        strength = rng.normal(0, 0.08, len(rows)) * np.exp(-one)
        lines.add(rows, skin_us + 2e3 * (one + rng.normal(0, 0.03, len(rows))) / GEL_M_S, passed * strength)


def add_soft(lines: Lines, rng: np.random.Generator, rows: npt.NDArray[np.int64], skin_us: float, passed: float) -> None:
    """Tissue without end: scatterers, denser than the pulse is long, and a few layers, that fade with depth."""
    lifted = lines.lifted
    way = (lifted.samples / lifted.sampling_mhz - skin_us) * lifted.speed_m_s / 2e3
    for layer in range(int(rng.integers(0, 4))):
        at = rng.uniform(0.5, 12) + rng.normal(0, 0.05, len(rows))
        strength = lifted.speckle * rng.uniform(1, 6) * rng.choice([-1, 1]) * np.exp(rng.normal(0, 0.3, len(rows)))
        lines.add(rows, skin_us + 2e3 * at / lifted.speed_m_s, passed * strength, 0.2 * lifted.attenuation * at)
        if layer == 0 and rng.random() < 0.5:  # a fascia has two faces
            second = at + rng.uniform(0.1, 0.6)
            lines.add(rows, skin_us + 2e3 * second / lifted.speed_m_s, -passed * strength, 0.2 * lifted.attenuation * second)
    count = int(6 * way * lifted.centre_mhz / 1.5)
    depth, weight = rng.uniform(0, way, count), rng.normal(0, lifted.speckle / 2, count)
    moving = np.cumsum(rng.normal(0, 0.02, (len(rows), 1)), axis=0) + rng.normal(0, 0.01, (len(rows), count))
    for number in range(count):
        at = np.abs(depth[number] + moving[:, number])
        lines.add(
            rows,
            skin_us + 2e3 * at / lifted.speed_m_s,
            np.full(len(rows), passed * weight[number]),
            0.2 * lifted.attenuation * at,
        )


ADD = {"drop": add_drop, "hair": add_hair, "soft": add_soft}
BEHIND_MRAYL = {"air": 0.0004, "drop": GEL_MRAYL, "hair": GEL_MRAYL, "soft": TISSUE_MRAYL}


def simulate(rng: np.random.Generator, frames: int, lifted: Lifted | None = None) -> tuple[Recording, Truth, Lifted]:
    """A recording of `frames` lines, none with bone, and the truth about it."""
    lifted = lifted or draw_lifted(rng)
    stay, kind = draw_stays(lifted, rng, frames)
    lines, acquisition = Lines(lifted, frames), lifted.acquisition
    length, every = acquisition.forerun_length_mm, np.arange(frames)
    skin_us = 2e3 * length / acquisition.forerun_speed_m_s if length else 0.0
    face = np.array([float(reflected(lifted.face_mrayl, BEHIND_MRAYL[one])) for one in kind]) * rng.normal(1, 0.03, frames)
    if length:
        own = rng.uniform(0.2, 0.8)  # of what comes back, the transducer sends in again
        for turn in range(1, 4):
            lines.add(
                every,
                np.full(frames, turn * skin_us),
                face**turn * own ** (turn - 1),
                turn * 0.2 * lifted.line_db_cm_mhz * length,
            )
    for number in range(int(stay[-1]) + 1):
        rows = np.flatnonzero(stay == number)
        passed = float(1 - face[rows[0]] ** 2) if length else 1.0
        if kind[rows[0]] in ADD:
            ADD[str(kind[rows[0]])](
                lines, rng, rows, skin_us, passed * 10 ** (-0.01 * lifted.line_db_cm_mhz * length * lifted.centre_mhz)
            )
    rf = lines.rf()
    full = np.abs(spectrum_of(lifted, lines.mhz)).sum() * 2 / lines.size  # peak of an echo that sends all back
    time = np.arange(lifted.samples) / lifted.sampling_mhz
    rf += (
        lifted.ringing
        * full
        * np.exp(-time * lifted.centre_mhz / rng.uniform(0.5, 3))
        * np.cos(2 * np.pi * lifted.centre_mhz * time)
    )
    rf += rng.normal(0, full * 10 ** (-lifted.snr_db / 20), rf.shape)
    codes = float(rng.choice([511, 2047, 8191, 32000])) * rng.choice([1, 1, 1, 1.5]) / np.abs(rf).max()
    limit = 32767
    recording = Recording(
        lines=np.clip(np.round(rf * codes), -limit, limit).astype(np.int16),
        acquisition=acquisition,
        probe_to_reference=rigid_from_vector(
            np.tile(rng.uniform(-2, 2, 3), (frames, 1)),
            rng.uniform(-60, 60, (frames, 3))[stay] + np.cumsum(rng.normal(0, 0.1, (frames, 3)), axis=0),
        ),
        statuses=("OK",) * frames,
        timestamps_s=every / lifted.rate_hz,
        palpation_points=stay.astype(np.int64) if rng.random() < 0.5 else np.full(frames, -1),
    )
    nothing = np.full(frames, np.nan)
    return recording, Truth(nothing, np.full(frames, 90.0), lifted.speed_m_s, np.full(frames, -np.inf)), lifted
