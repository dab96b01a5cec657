"""The pulse of a flat disc, as spectra: its echoes, what attenuation leaves of them, and how the disc answers a tilted mirror."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.special import gamma, j1

from Testing.Studies.simulators.echo_spectra import echo_spectra
from Testing.Studies.simulators.piston_plan import Array, Setup

Floats = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]

NEPER = np.log(10) / 20  # a decibel
FAINT = 1e-4  # of the pulse's largest frequency: not simulated below
HIGHEST = 0.48  # of the sampling rate
BLOCK = 64  # frequencies a block of a geometric series
GUARD_US = 12.0  # behind the last sample; what comes later still returns at the line's start, as echoes of the last shot do
PULSE_US = 12.0  # no echo with what belongs to it is longer
TABLE_MM = np.arange(41.0)  # depths at which the height that attenuation leaves is exact
JINC_STEP, JINC_END = 0.005, 400.0
JINC_AT = np.arange(JINC_STEP, JINC_END, JINC_STEP)
JINC = np.append(1.0, 2 * j1(JINC_AT) / JINC_AT).astype(np.float32)  # of a disc


class Pulse:
    """The transmitted pulse, its envelope's peak 1 and at time zero, and what tissue leaves of it."""

    def __init__(self, setup: Setup, samples: int) -> None:
        self.setup, self.samples = setup, samples
        self.size = scipy.fft.next_fast_len(samples + int(GUARD_US * setup.sampling_mhz), real=True)
        self.step_mhz = float(setup.sampling_mhz / self.size)
        fullness = np.sqrt(2 ** (2 / (setup.order + 1)) - 1)
        self.rise_us = fullness * setup.order / (np.pi * setup.bandwidth * setup.centre_mhz)
        every = np.arange(self.size // 2 + 1) * self.step_mhz
        spectrum = self._gamma_spectrum(every[every < HIGHEST * setup.sampling_mhz])
        heard = np.flatnonzero(np.abs(spectrum) > FAINT * np.abs(spectrum).max())
        self.band = slice(int(heard[0]), int(heard[-1]) + 1)
        self.mhz, self.spectrum = every[self.band], spectrum[self.band].astype(np.complex64)
        self.spectrum /= self.peaks(np.ones((1, len(self.mhz)), dtype=np.complex64))[0]
        self.energy = float(np.linalg.norm(self.spectrum) * np.sqrt(2 / self.size))  # root of the sum of its samples' squares
        self.log_heights = np.log(self.peaks(self.loss(TABLE_MM)))

    def _gamma_spectrum(self, mhz: Array) -> npt.NDArray[np.complex128]:
        """Of (t / rise)^order exp(order (1 - t / rise)) on a carrier, its peak at zero; the element does not pass slow waves."""
        setup, rise = self.setup, self.rise_us

        def envelope(off_mhz: Array) -> npt.NDArray[np.complex128]:
            turns = 2j * np.pi * off_mhz
            return np.asarray(np.exp(turns * rise) / (1 + turns * rise / setup.order) ** (setup.order + 1))

        both = np.exp(1j * setup.phase) * envelope(mhz - setup.centre_mhz)
        both += np.exp(-1j * setup.phase) * envelope(mhz + setup.centre_mhz)
        whole = np.exp(setup.order) * gamma(setup.order + 1) * rise / setup.order ** (setup.order + 1)
        passed = np.minimum(1, (mhz / (0.25 * setup.centre_mhz)) ** 3)
        return np.asarray(0.5 * whole * both * passed)

    def peaks(self, spectra: npt.NDArray[np.floating] | Complex) -> Array:
        """Height of the envelope (n,) of the pulse times spectra (n, band) of echoes around time zero."""
        every = self.sparse
        thin = np.asarray(self.spectrum[::every] * spectra[:, ::every], dtype=np.complex64)
        size = scipy.fft.next_fast_len(4 * thin.shape[1])
        envelope = np.abs(scipy.fft.ifft(thin, size, axis=1)).max(axis=1)
        return np.asarray(envelope * (2.0 * size * every / self.size), dtype=float)

    @property
    def sparse(self) -> int:
        """Of so many frequencies one is enough for an echo around time zero."""
        return max(1, int(1 / (PULSE_US * self.step_mhz)))

    def loss(self, depth_mm: Array) -> Floats:
        """What attenuation leaves on the way to depths (n,) and back, (n, band)."""
        lost = (0.2 * NEPER * self.setup.attenuation * depth_mm).astype(np.float32)
        return np.asarray(np.exp(-lost[:, None] * self.mhz.astype(np.float32)))

    def height(self, depth_mm: npt.ArrayLike) -> Array:
        """Of the envelope of a perfect mirror's echo, met squarely at a depth."""
        return np.asarray(np.exp(np.interp(np.asarray(depth_mm, dtype=float), TABLE_MM, self.log_heights)))

    def mirror(self, angle: Array, aperture_mm: float) -> Floats:
        """A mirror's answer to a disc when tilted by angles (n,), rad, over its square one: (n, band)."""
        waves = np.abs(np.sin(angle)) * (2 * np.pi * aperture_mm / (self.setup.speed_m_s * 1e-3) / JINC_STEP)
        index = np.outer(waves.astype(np.float32), self.mhz.astype(np.float32)).astype(np.int32)
        return np.asarray(JINC[np.minimum(index, len(JINC) - 1)])

    def series(self, time_us: Array, height: Array, depth_mm: Array) -> Complex:
        """Sum of echoes (n,) or (n, m) over the pulse, as spectra (n, band)."""
        time, high, depth = (np.reshape(one, (len(time_us), -1)) for one in (time_us, height, depth_mm))
        lost = 0.2 * NEPER * self.setup.attenuation * depth
        return echo_spectra(time, high, lost, self.mhz, self.step_mhz, BLOCK)

    def kernel(self, depth_mm: float) -> tuple[Floats, int]:
        """Samples of a scatterer's echo from a depth, and which of them is at time zero."""
        full = np.zeros(self.size // 2 + 1, dtype=np.complex64)
        full[self.band] = self.spectrum * self.loss(np.array([depth_mm]))[0]
        before, after = (int(length * self.setup.sampling_mhz) + 1 for length in (1.0 + self.rise_us, 1.0 + 6 * self.rise_us))
        return np.roll(scipy.fft.irfft(full, self.size), before)[: before + after], before
