"""The frequencies in which the lines of a single-element transducer are simulated: its pulse, its lobe, echoes as spectra."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.special import j1

from Testing.Studies.simulators.echo_spectra import echo_spectra, short_peaks
from Testing.Studies.simulators.sparse_plan import Array, Setup

Floats = npt.NDArray[np.float32]
Complex = npt.NDArray[np.complex64]

NEPER = np.log(10) / 20  # a decibel
GUARD_US = 4.0  # behind the last sample: what rings there does not come round to the first
HEARD_US = 1.5  # behind the last sample: an echo that comes later is left out
FAINT = 3e-6  # of the pulse's spectrum, over its height: what is less is left out
LOBE_STEP, LOBE_LAST = 0.002, 60.0  # of the table of a disc's lobe


def _lobe_table() -> Floats:
    """Answer of a flat disc to a tilted mirror, over ka sin(tilt)."""
    turns = np.arange(1, int(LOBE_LAST / LOBE_STEP) + 1) * LOBE_STEP
    return np.concatenate([[1.0], 2 * j1(turns) / turns]).astype(np.float32)


LOBE = _lobe_table()


class Band:
    """The frequencies of a recording's pulse: only these are simulated."""

    def __init__(self, setup: Setup, samples: int) -> None:
        self.setup, self.samples = setup, samples
        self.size = scipy.fft.next_fast_len(samples + int(GUARD_US * setup.sampling_mhz), real=True)
        self.step_mhz = setup.sampling_mhz / self.size
        every = pulse_spectrum(setup, self.size)
        self.every_mhz = np.arange(len(every)) * self.step_mhz
        level = np.abs(every)
        within = (self.every_mhz > 0.15 * setup.centre_mhz) & (self.every_mhz < 2.1 * setup.centre_mhz)
        strong = np.flatnonzero(within & (level > FAINT * level.max()))
        self.bins = slice(int(strong[0]), int(strong[-1]) + 1)
        self.mhz, self.pulse = self.every_mhz[self.bins], every[self.bins]
        self.last_us = samples / setup.sampling_mhz + HEARD_US

    def echoes(self, time_us: Array, height: npt.ArrayLike, lost_db_mhz: npt.ArrayLike) -> Complex:
        """Sum of echoes (n, m) over the pulse, as spectra (n, band): when, how high before the loss, and the loss."""
        heard = time_us < self.last_us
        time = np.where(heard, time_us, 0.0)
        lost = np.broadcast_to(NEPER * np.asarray(lost_db_mhz), time.shape)
        return echo_spectra(time, np.where(heard, height, 0.0), lost, self.mhz, self.step_mhz)

    def loss(self, db_mhz: float) -> Floats:
        """What is left of each frequency (band,)."""
        return np.exp(-NEPER * db_mhz * self.mhz).astype(np.float32)

    def lobe(self, tilt_rad: Array) -> Floats:
        """Answer of the aperture (n, band) to mirrors of these tilts (n,)."""
        wave_numbers = (2e3 * np.pi / self.setup.speed_m_s * self.setup.aperture_mm / LOBE_STEP) * self.mhz
        steps = np.outer(np.abs(np.sin(tilt_rad)), wave_numbers).astype(np.float32)
        return np.asarray(LOBE[np.minimum(steps + np.float32(0.5), len(LOBE) - 1).astype(np.int32)])

    def peaks(self, spectra: npt.NDArray[np.complexfloating] | Floats, lasts_us: float) -> Array:
        """Height of the envelope's peak (n,) of echoes that last no longer than stated."""
        every = max(int(1 / (lasts_us * self.step_mhz)), 1)
        return short_peaks(spectra * self.pulse, every, self.size)

    def waves(self, spectra: Complex) -> Floats:
        """Samples (n, samples) of what comes back as these spectra (n, band) over the pulse."""
        whole = np.zeros((len(spectra), len(self.every_mhz)), dtype=np.complex64)
        whole[:, self.bins] = spectra * self.pulse
        return np.asarray(scipy.fft.irfft(whole, self.size, axis=1)[:, : self.samples])


def pulse_spectrum(setup: Setup, size: int) -> Complex:
    """Of `size` samples (size // 2 + 1,): the pulse as it comes out of the receiver, its envelope's peak at time zero."""
    time = (np.arange(size) - size // 2) / setup.sampling_mhz
    width = setup.attack_us * np.where(time < 0, 1.0, setup.decay)
    pulse = np.exp(-0.5 * (time / width) ** 2) * np.cos(2 * np.pi * setup.centre_mhz * time + setup.phase)
    mhz = np.arange(size // 2 + 1) * (setup.sampling_mhz / size)
    low = 1 + (0.25 * setup.centre_mhz / np.maximum(mhz, 1e-6)) ** 6
    high = 1 + (mhz / (0.47 * setup.sampling_mhz)) ** 16
    return np.asarray(scipy.fft.rfft(scipy.fft.ifftshift(pulse)) / (low * high), dtype=np.complex64)
