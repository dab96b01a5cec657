"""Delays and losses of echoes as factors of their spectra, quickly, for simulators that work by frequency."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def echo_powers(
    time_us: npt.NDArray[np.float64], lost: npt.NDArray[np.float64], mhz: npt.NDArray[np.float64]
) -> npt.NDArray[np.complex64]:
    """exp(-(2 pi i time + lost) mhz), (n, m, k), for echoes (n, m) at frequencies (k,); whole turns are taken off before
    single precision."""
    turns = time_us[:, :, None] * mhz
    angle = ((turns - np.rint(turns)) * (-2 * np.pi)).astype(np.float32)
    height = np.exp((lost[:, :, None] * -mhz).astype(np.float32))
    powers = np.empty(angle.shape, dtype=np.complex64)
    powers.real = np.cos(angle) * height
    powers.imag = np.sin(angle) * height
    return powers
