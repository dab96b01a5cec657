"""Where a simulated bone echo stands against its truth, worked out independently of the detector."""

import numpy as np
from scipy.signal import hilbert


def stated_skin_s(recording):
    """Where the delay line ends, as the header has it."""
    acquisition = recording.acquisition
    late_s = 2e-3 * acquisition.forerun_length_mm / (acquisition.forerun_speed_m_s or 1.0)
    return np.full(len(recording), late_s)


def peaks_off_mm(recording, truth, rows, skin_s, near_s):
    """Peak of the envelope within `near_s` of bone, minus the truth, of the lines `rows`; the tissue starts at `skin_s` (n,)."""
    sampling = recording.acquisition.sampling_hz
    time = np.arange(recording.lines.shape[1]) / sampling
    off = []
    for row in rows:
        arrival = skin_s[row] + 2e-3 * truth.depth_mm[row] / truth.speed_m_s
        near = np.abs(time - arrival) < max(near_s, 3 / sampling)
        level = np.abs(hilbert(recording.lines[row] - np.median(recording.lines[row])))[near]
        off.append((time[near][level.argmax()] - arrival) * truth.speed_m_s * 500)
    return off
