"""Sums of delayed and damped echoes as spectra, quickly, for simulators that work by frequency."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex64]
BLOCK = 32  # frequencies a block of the geometric series


def echo_spectra(
    time_us: Array, height: npt.NDArray[np.generic], lost: Array, mhz: Array, step_mhz: float, block: int = BLOCK
) -> Complex:
    """Sum of echoes (n, m) over the pulse at frequencies `mhz` (k,), `step_mhz` apart, shape (n, k).

    `lost` is in neper a MHz; a height may be complex. Delay and loss of an echo are a geometric series in frequency: powers
    within a block times powers of whole blocks.
    """
    starts = mhz[0] + np.arange(-(-len(mhz) // block)) * (block * step_mhz)
    high = height.astype(np.complex64 if np.iscomplexobj(height) else np.float32)
    coarse = _powers(time_us, lost, starts) * high[:, :, None]
    total = np.matmul(coarse.transpose(0, 2, 1), _powers(time_us, lost, np.arange(block) * step_mhz))
    return np.asarray(total.reshape(len(time_us), -1)[:, : len(mhz)])


def _powers(time_us: Array, lost: Array, mhz: Array) -> Complex:
    """exp(-(2 pi i time + lost) mhz), (n, m, k), of echoes (n, m); whole turns are taken off before single precision."""
    turns = time_us[:, :, None] * mhz
    angle = ((turns - np.rint(turns)) * (-2 * np.pi)).astype(np.float32)
    height = np.exp((lost[:, :, None] * -mhz).astype(np.float32))
    powers = np.empty(angle.shape, dtype=np.complex64)
    powers.real = np.cos(angle) * height
    powers.imag = np.sin(angle) * height
    return powers


def short_peaks(spectra: npt.NDArray[np.complexfloating], every: int, size: int) -> Array:
    """Height of the envelope's peak (n,) of echoes so short that `every` so many frequencies tell their spectra (n, k).

    `size` is the number of samples that all frequencies belong to.
    """
    thin = spectra[:, ::every]
    few = scipy.fft.next_fast_len(3 * thin.shape[1])
    envelope = np.abs(scipy.fft.ifft(thin, few, axis=1)).max(axis=1)
    return np.asarray(envelope * (2 * every * few / size), dtype=float)
