"""The forerun (delay line): its echo found in each line, which is the line's own zero of tissue depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Acquisition

from ModuleUltrasoundLib.echo_candidates import noise_level, refine_peaks
from ModuleUltrasoundLib.signal_chain import Envelopes

SEARCH = 0.05  # of the nominal time: temperature changes the delay line's speed by 1 to 3 %, and its length is machined
SEARCH_S = 3e-7  # on top: the pulse's own delay
LEAST_SNR = 8.0  # envelope peak over the noise of one quadrature


@dataclass(frozen=True, eq=False)
class Forerun:
    """Where the tissue starts in each line."""

    skin_s: Array  # (n,) time of the skin
    amplitude: Array  # (n,) envelope of the forerun's echo; 0 without a forerun
    found: npt.NDArray[np.bool_]  # (n,) the echo was seen in this line


def nominal_skin_s(acquisition: Acquisition) -> float:
    """Two-way time through the forerun as the header states it; 0 without a forerun."""
    if acquisition.forerun_length_mm <= 0:
        return 0.0
    return 2e-3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s


def find_forerun(envelopes: Envelopes, acquisition: Acquisition) -> Forerun:
    """The echo of the forerun's face in each line; where it is too weak, the median of the other lines' times."""
    nominal = nominal_skin_s(acquisition)
    count, length = envelopes.values.shape
    if nominal == 0.0:
        return Forerun(np.zeros(count), np.zeros(count), np.zeros(count, dtype=bool))
    rate = envelopes.rate_hz
    first = max(int((nominal * (1 - SEARCH) - SEARCH_S) * rate), 1)
    last = min(int((nominal * (1 + SEARCH) + SEARCH_S) * rate) + 1, length - 1)
    if last - first < 3:
        return Forerun(np.full(count, nominal), np.zeros(count), np.zeros(count, dtype=bool))
    magnitude = np.abs(envelopes.values)
    samples = magnitude[:, first:last].argmax(axis=1)[:, None] + first
    positions, heights = (values[:, 0] for values in refine_peaks(magnitude, samples))
    inside = (samples[:, 0] > first) & (samples[:, 0] < last - 1)
    found = inside & (heights > LEAST_SNR * noise_level(magnitude))
    times = positions / rate
    fallback = float(np.median(times[found])) if found.any() else nominal
    return Forerun(np.where(found, times, fallback), np.where(found, heights, 0.0), found)
