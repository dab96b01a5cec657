"""The pulse of a probe at a patient's bed, and its echoes in the spectrum: transmitted pulse, attenuation of the way, delay.

Only the frequencies that the pulse has are kept. A line needs dozens of echoes, each with an attenuation of its own at every
frequency; they are summed before the pulse's spectrum is multiplied in, and only what is directive is weighed apart.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.special import j1

from Testing.Studies.simulators.bedside_plan import Array, Bedside, db

Spectra = npt.NDArray[np.complex64]  # (n, bins) of n lines
Echo = tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]  # when (us), how high, dB/MHz lost; each (n,) or one for all lines

NEPER = np.log(10) / 20  # a decibel
TO_SIGMA = 2.3548  # of a Gaussian, from its full width at half height
REACH = 5.0  # standard deviations of the pulse's spectrum
LINGER_US, PADDING_US = 1.5, 5.0  # of echoes behind the line's end; no echo may come round to the line's begin
FOLD_US = 8.0  # longer than any single echo
STEP = 32  # frequencies, in the two-step table of powers


class Band:
    """The frequencies that the pulse has, and echoes there: a line's real spectrum between them."""

    def __init__(self, world: Bedside, lines: int, samples: int) -> None:
        self.world, self.lines = world, lines
        self.mhz, self.centre = world.acquisition.sampling_hz * 1e-6, world.acquisition.transducer_hz * 1e-6
        self.sigma = world.bandwidth * self.centre / TO_SIGMA
        self.until_us = samples / self.mhz + LINGER_US
        top = min(self.centre + REACH * self.sigma, self.mhz / 2)
        self.slower = int(self.mhz / 2 / top)  # so many times slower sampling would do for the echoes
        self.coarse = scipy.fft.next_fast_len(int(samples + PADDING_US * self.mhz) // self.slower + 1, real=True)
        self.size = self.coarse * self.slower
        self.step_mhz = self.mhz / self.size
        self.first = max(int((self.centre - REACH * self.sigma) / self.step_mhz), 0)
        self.frequency = np.arange(self.first, int(top / self.step_mhz) + 1) * self.step_mhz
        pulse = self._transmitted(self.frequency) * np.exp(2j * np.pi * self.frequency * self._late_us())
        self.pulse = (pulse / self.peak(pulse[None])[0]).astype(np.complex64)

    def _transmitted(self, frequency: Array) -> npt.NDArray[np.complex128]:
        """The pulse: a Gaussian one, and what rings on a little lower."""
        main = np.exp(-((frequency - self.centre) ** 2) / (2 * self.sigma**2))
        tail = np.exp(-((frequency - 0.97 * self.centre) ** 2) / (2 * (0.45 * self.sigma) ** 2))
        delay = np.exp(-2j * np.pi * frequency * 1.6 / (TO_SIGMA * self.sigma))
        return np.asarray((main + self.world.ring * tail * delay) * np.exp(1j * self.world.phase))

    def _late_us(self) -> float:
        """When the envelope of the pulse has its peak, which is to be time zero."""
        points, longest_us = 8192, 20.0
        envelope = np.abs(np.fft.ifft(self._transmitted(np.arange(points // 8) / longest_us), points))
        late = int(envelope.argmax())
        return (late if late < points // 2 else late - points) * longest_us / points

    def peak(self, spectra: npt.NDArray[np.complexfloating]) -> Array:
        """Height of the envelope of one echo a line (n,), wherever it is: the line is folded to less than its length."""
        fold = max(int(self.size / self.mhz / FOLD_US), 1)
        count = scipy.fft.next_fast_len(4 * -(-spectra.shape[1] // fold))
        folded = scipy.fft.ifft(spectra[:, ::fold], count, axis=1)
        return np.asarray(np.abs(folded).max(axis=1) * (2 * fold * count / self.size), dtype=float)

    def loss_db(self, depth_mm: npt.ArrayLike) -> Array:
        """Lost on the way to a depth and back, a MHz."""
        return np.asarray(0.2 * self.world.attenuation * np.asarray(depth_mm))

    def attenuated(self, depth_mm: npt.ArrayLike) -> Array:
        """What is left of each frequency on the way to depths (n,) and back (n, bins)."""
        return db(-np.outer(self.loss_db(np.atleast_1d(depth_mm)), self.frequency))

    def sum_of(self, echoes: Sequence[Echo]) -> Spectra:
        """Spectra of some echoes in every line, before the pulse's own spectrum.

        Along the frequencies an echo is a geometric sequence: from a coarse and a fine table of powers the sum over the echoes
        is a product of matrices, which saves nearly all of the exponentials.
        """
        columns = (np.stack([np.broadcast_to(part, self.lines) for part in parts], axis=1) for parts in zip(*echoes))
        time, height, loss = columns
        heard = np.isfinite(time) & (time < self.until_us)
        power = np.where(heard, -(2j * np.pi * time + NEPER * loss), 0)
        height = np.where(heard, height, 0)
        far = self.frequency[::STEP]
        near = self.step_mhz * np.arange(STEP)
        coarse = np.exp(power[:, None, :] * far[:, None]) * height[:, None, :]
        fine = np.exp(power[:, :, None] * near)
        return (coarse.astype(np.complex64) @ fine.astype(np.complex64)).reshape(self.lines, -1)[:, : len(self.frequency)]

    def directivity(self, tilt_deg: Array) -> Array:
        """What of each frequency comes back from a mirror tilted so (n, bins): a focused lobe, or a disc's with its nulls."""
        world = self.world
        if world.focus_deg:
            lobe = np.exp(-np.log(2) / 2 * (tilt_deg / (world.focus_deg / 2)) ** 2)
            return np.broadcast_to(lobe[:, None], (len(lobe), len(self.frequency)))
        across = 2e3 * np.pi * world.disc_mm / world.speed_m_s * np.sin(np.radians(tilt_deg))
        turns = np.outer(across, self.frequency) + 1e-9
        return np.asarray(2 * j1(turns) / turns)

    def noise_colour(self, frequency: Array) -> Array:
        """Of the pre-amplifier: wide, and without a constant."""
        low = 1 / np.sqrt(1 + (frequency / (2.5 * self.centre)) ** 6)
        return np.asarray(low * frequency / np.sqrt(frequency**2 + (0.2 * self.centre) ** 2))

    def matched(self, spectra: npt.NDArray[np.complexfloating], depth_mm: npt.ArrayLike) -> Array:
        """Peak of echoes from a depth over noise of density 1 (n,), both behind the filter matched to the received pulse."""
        matching = np.abs(self.pulse) * self.attenuated(depth_mm)
        noise = np.sqrt(np.sum((self.noise_colour(self.frequency) * matching) ** 2, axis=1) / (self.size / 2))
        return self.peak(spectra * matching) / noise
