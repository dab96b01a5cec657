"""Whether the forerun stands where the recording's header puts it."""

from __future__ import annotations

import numpy as np
from CranioNavLib.sequence_metafile import Recording

from ModuleUltrasoundLib.echo.candidates import rough_noise
from ModuleUltrasoundLib.echo.forerun import SEARCH, SEARCH_S, find_forerun, nominal_skin_s
from ModuleUltrasoundLib.echo.signal_chain import check_acquisition, complex_envelopes, design_band
from ModuleUltrasoundLib.measurement.measure import several_spots, stays

LINES = 64  # that are looked at
LEAST_LINES = 8
BANG_S = 2e-6  # of a line belong to the main bang
LEAST_PLACES = 4  # the same interface may happen to lie equally deep at two or three
STEADY = 0.95  # mean resultant length: an echo of the probe itself stands still while the tissue under it changes
LEAST_SNR = 20.0
RISE_S, LEAST_RISE = 1e-6, 2.0  # an echo stands out of what comes before it, the main bang's tail does not


def forerun_remark(recording: Recording) -> str:
    """One line on a forerun whose echo lies elsewhere than the header says; empty if nothing speaks against the header.

    Asked only where the lines come from several places on the head: an echo that then stands still is the probe's own.

    Raises
    ------
    InputError
        The recording's header cannot be that of pulse-echo lines.
    """
    acquisition = recording.acquisition
    check_acquisition(acquisition)
    nominal = nominal_skin_s(acquisition)
    runs = stays(recording)
    if nominal == 0.0 or len(recording) < LEAST_LINES or not several_spots(recording, runs):
        return ""
    if 1 < len(np.unique(runs)) < LEAST_PLACES:
        return ""
    lines = recording.lines[:: max(len(recording) // LINES, 1)]
    envelopes = complex_envelopes(lines, design_band(acquisition, lines.shape[1], lines.shape[1] / acquisition.sampling_hz))
    magnitude = np.abs(envelopes.values)
    noise = rough_noise(magnitude)
    if find_forerun(envelopes, magnitude, noise, acquisition).measured.any():
        return ""
    mean = np.abs(envelopes.values.mean(axis=0))
    time_s = np.arange(len(mean)) / envelopes.rate_hz
    expected = np.abs(time_s - nominal) < SEARCH * nominal + SEARCH_S
    steady = (mean > STEADY * magnitude.mean(axis=0)) & (mean > LEAST_SNR * np.median(noise)) & (time_s > BANG_S) & ~expected
    back = max(int(RISE_S * envelopes.rate_hz), 1)
    steady[back:] &= mean[back:] > LEAST_RISE * mean[:-back]
    if not steady.any():
        return ""
    there_s = float(time_s[np.where(steady, mean, 0.0).argmax()])
    length_mm = there_s * acquisition.forerun_speed_m_s * 500
    stated = f"{1e6 * nominal:.1f} us, where ForerunLengthMm {acquisition.forerun_length_mm:g} puts it"
    return (
        f"no forerun echo near {stated}; one stands at {1e6 * there_s:.1f} us in every line, as of {length_mm:.1f} mm:"
        " correct ForerunLengthMm or ForerunSpeedOfSoundMps"
    )
