"""The transmitted pulse of range_lines.py as a spectrum, and the lines that its echoes are put into.

Every echo is filtered for each frequency: by the attenuation of its way, by the tilt of what it comes from. It is short, so its
spectrum is one of a window just as long, and the window is set into the line where the echo belongs, to a part of a sample.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.special import j1

from Testing.Studies.simulators.range_plan import Array, World

Rows = npt.NDArray[np.int64]
Spectra = npt.NDArray[np.complex64]  # (n, K) over a pulse's frequencies
Waves = npt.NDArray[np.float32]

ALIGN_US = 0.002  # to which the envelope's peak is brought to time zero


class Pulse:
    """The transmitted pulse as a spectrum, its envelope's peak at time zero and of height 1, in a window that holds one echo."""

    def __init__(self, world: World) -> None:
        self.world, self.mhz = world, world.sampling_mhz
        self.highest_mhz = min(self.mhz / 2 * 0.98, world.centre_mhz * (1 + 2 * world.bandwidth))
        cut = np.exp(-0.5 * ((self.highest_mhz - world.centre_mhz) / world.sigma_mhz) ** 2)
        spread_us = 7 / (2 * np.pi * world.sigma_mhz) + 6.5 / world.centre_mhz + 0.3  # pulse, tilted disc, rough surface
        half_us = max(spread_us, 64 * cut / world.sigma_mhz)  # a spectrum that the sampling cuts rings for long
        self.samples = 2 * scipy.fft.next_fast_len(int(half_us * self.mhz) + 1)
        self.frequency = np.arange(int(self.samples * self.highest_mhz / self.mhz) + 1) * self.mhz / self.samples
        self.shift_us, self.height = 0.0, 1.0
        fine = scipy.fft.next_fast_len(int(self.samples / self.mhz / ALIGN_US) + 1)
        envelope = np.abs(scipy.fft.ifft(self.spectrum_at(self.frequency), fine)) * fine / (self.samples / 2)
        peak = int(envelope.argmax())
        self.shift_us = (peak if peak < fine / 2 else peak - fine) / fine * self.samples / self.mhz
        self.height = 1 / float(envelope[peak])
        self.spectrum = self.spectrum_at(self.frequency)
        self.energy = float(np.linalg.norm(scipy.fft.irfft(self.spectrum, self.samples)))

    def spectrum_at(self, mhz: Array) -> Spectra:
        """The spectrum at any frequencies."""
        world = self.world
        off = (mhz - world.centre_mhz) / world.sigma_mhz
        size = self.height * world.wiring * np.exp(-0.5 * off**2) * -np.expm1(-((mhz / (0.2 * world.centre_mhz)) ** 4))
        turn = world.phase + world.bend * off**3 + 2 * np.pi * mhz * self.shift_us
        return (size * np.exp(1j * turn)).astype(np.complex64)

    def lag(self, time_us: Array) -> Spectra:
        """What a short delay (n,) does to a spectrum."""
        return np.exp(np.outer(time_us, -2j * np.pi * self.frequency).astype(np.complex64))

    def attenuation(self, depth_mm: Array) -> Waves:
        """What the way to depths (n,) and back leaves of each frequency."""
        return loss(self.world, self.frequency, depth_mm)

    def disc(self, tilt_deg: Array) -> Waves:
        """What the transducer hears of a plane at tilts (n,), for each frequency."""
        across = self.world.disc_mm * np.sin(np.radians(tilt_deg)) / self.world.mm_us
        at = np.maximum(np.outer(across, 2 * np.pi * self.frequency), 1e-6)
        return (2 * j1(at) / at).astype(np.float32)

    def peak_of(self, spectra: Spectra) -> Array:
        """Largest value of the envelope of echoes (n, K), as it is sampled."""
        return np.abs(scipy.fft.ifft(2 * spectra, self.samples, axis=1)).max(axis=1).astype(float)


def loss(world: World, mhz: Array, depth_mm: Array) -> Waves:
    """What the way to depths (n,) and back leaves of frequencies (K,): (n, K)."""
    return np.exp(np.outer(depth_mm, -0.2 * np.log(10) / 20 * world.attenuation * mhz).astype(np.float32))


class Sheet:
    """Lines under way, with room on both sides."""

    def __init__(self, pulse: Pulse, lines: int, samples: int) -> None:
        self.pulse, self.samples = pulse, samples
        self.room = pulse.samples
        self.wide = np.zeros((lines, samples + 2 * self.room), dtype=np.float32)
        self.starts: list[Rows] = []
        self.rows: list[Rows] = []
        self.spectra: list[Spectra] = []

    @property
    def rf(self) -> Waves:
        """The lines (n, samples)."""
        return self.wide[:, self.room : self.room + self.samples]

    def add(self, time_us: Array, spectra: Spectra) -> None:
        """One echo in every line (n,): when, and its spectrum about that time (n, K)."""
        start = np.rint(time_us * self.pulse.mhz).astype(np.int64)
        part = time_us - start / self.pulse.mhz
        rows = np.flatnonzero(spectra.any(axis=1) & (start < self.samples + self.room // 2))
        if len(rows):
            self.rows.append(rows)
            self.starts.append(start[rows])
            self.spectra.append(spectra[rows] * self.pulse.lag(part[rows]))

    def draw(self) -> None:
        """Put the echoes into the lines."""
        if not self.rows:
            return
        spectra = np.concatenate(self.spectra)
        spectra[:, 1::2] *= -1  # time zero into the middle of the window
        waves = scipy.fft.irfft(spectra, self.pulse.samples, axis=1)
        span, done = np.arange(self.pulse.samples), 0
        for rows, start in zip(self.rows, self.starts):
            first = start + self.room - self.pulse.samples // 2
            self.wide[rows[:, None], first[:, None] + span] += waves[done : done + len(rows)]
            done += len(rows)

    def scatter(self, rows: Rows, grains: Waves, first: Rows, depth_mm: Array) -> None:
        """Each grain (n, m) of some lines, from sample `first` (n,) on, sends a pulse of energy 1 from a depth (n,) or (1,)."""
        pulse, count = self.pulse, grains.shape[1]
        size = scipy.fft.next_fast_len(count + pulse.samples, real=True)
        mhz = np.arange(int(size * pulse.highest_mhz / pulse.mhz) + 1) * pulse.mhz / size
        middle = np.exp(-1j * np.pi * mhz * pulse.samples / pulse.mhz)
        shape = (pulse.spectrum_at(mhz) * middle / pulse.energy).astype(np.complex64) * loss(pulse.world, mhz, depth_mm)
        spectra = scipy.fft.rfft(grains, size, axis=1)[:, : len(mhz)] * shape
        waves = scipy.fft.irfft(spectra, size, axis=1)[:, : count + pulse.samples]
        for row, start, wave in zip(rows, first + self.room - pulse.samples // 2, waves):
            target = self.wide[row, start : start + len(wave)]
            target += wave[: len(target)]
