"""From raw RF lines to complex envelopes: drift removal, zero-phase band-pass, demodulation. All lines at once.

The band-pass and the demodulation are one multiplication in the frequency domain; only the band is transformed
back, so the complex envelope comes out at the few samples a cycle that it needs, whatever the converter's rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.errors import InputError
from CranioNavLib.sequence_metafile import Acquisition

Floats = npt.NDArray[np.float32]

# The pulse's centre lies a little below the transducer's nominal frequency once tissue has taken its upper
# part; a damped transducer's -6 dB band is 50 to 100 % of it.
BAND_CENTRE = 0.92  # of the transducer's frequency
BAND_WIDTH = 0.75  # full width at half amplitude, of the transducer's frequency
BAND_EDGES = (0.25, 1.9)  # of the transducer's frequency: nothing outside gets through (drift, spikes' upper part)
LEAST_DRIFT = 8.0  # codes over a line: less makes no step that matters
FADE_CYCLES = 1.5
BLOCK = 32  # lines transformed at once: the working set stays in the processor's second cache
OVERSAMPLING = 4.0  # complex samples a cycle of the transducer's frequency


@dataclass(frozen=True, eq=False)
class Envelopes:
    """Complex envelopes of n lines: `|values|` is the envelope, its phase that of the RF at `carrier_hz`."""

    values: npt.NDArray[np.complex64]  # (n, M)
    rate_hz: float  # samples of `values` a second; sample 0 is the line's time zero
    carrier_hz: float


@dataclass(frozen=True, eq=False)
class Band:
    """The band-pass of a recording: which bins of the line's spectrum pass, and how much."""

    length: int  # samples of a line that are used
    padded: int  # FFT length
    first: int  # first bin that passes
    gain: Floats  # of each bin that passes
    centre: int  # the bin of the carrier
    out_length: int  # FFT length of the envelope
    rate_hz: float
    carrier_hz: float
    fade: Floats  # weights of a line's last samples: a hum that is cut off would pass the band


def check_acquisition(acquisition: Acquisition) -> None:
    """Refuse an acquisition whose numbers cannot be those of a pulse-echo line.

    Raises
    ------
    InputError
        Sampling rate or transducer frequency missing or below Nyquist, or a forerun without its speed of sound.
    """
    sampling, centre = acquisition.sampling_hz, acquisition.transducer_hz
    if not (np.isfinite(sampling) and 1e5 <= sampling <= 1e10):
        raise InputError(f"SamplingFrequencyHz is {sampling}; expected the sampling rate in Hz, for example 60000000")
    if not (np.isfinite(centre) and centre >= 1e4):
        raise InputError(f"TransducerFrequencyHz is {centre}; expected the transducer's frequency in Hz, for example 5000000")
    if centre * 2.0 > sampling:
        raise InputError(
            f"TransducerFrequencyHz {centre:g} is above half of SamplingFrequencyHz {sampling:g}; correct the one that is wrong"
        )
    length, speed = acquisition.forerun_length_mm, acquisition.forerun_speed_m_s
    if length < 0 or not np.isfinite(length) or (length > 0 and not 500 <= speed <= 10000):
        raise InputError(
            f"ForerunLengthMm {length} with ForerunSpeedOfSoundMps {speed}: expected a length in mm and 500 to 10000 m/s"
        )


@lru_cache(maxsize=16)
def design_band(acquisition: Acquisition, samples: int, until_s: float) -> Band:
    """The band-pass for lines of `samples` samples of which the part before `until_s` is wanted."""
    sampling, centre = acquisition.sampling_hz, acquisition.transducer_hz
    length = min(samples, int(np.ceil(until_s * sampling)))
    padded = int(scipy.fft.next_fast_len(length + int(3 * sampling / centre), real=True))
    step = sampling / padded
    first = max(1, int(np.ceil(BAND_EDGES[0] * centre / step)))
    last = min(padded // 2, int(BAND_EDGES[1] * centre / step))
    frequencies = np.arange(first, last) * step
    sigma = BAND_WIDTH * centre / 2.3548
    gain = np.exp(-0.5 * ((frequencies - BAND_CENTRE * centre) / sigma) ** 2)
    middle = round(BAND_CENTRE * centre / step)
    out_length = int(scipy.fft.next_fast_len(max(int(np.ceil(OVERSAMPLING * centre / step)), last - first)))
    return Band(
        length=length,
        padded=padded,
        first=first,
        gain=(2.0 * gain).astype(np.float32),  # twice: the negative frequencies are left out
        centre=middle,
        out_length=out_length,
        rate_hz=out_length * step,
        carrier_hz=middle * step,
        fade=np.cos(np.linspace(0, np.pi / 2, min(max(int(FADE_CYCLES * sampling / centre), 2), length))).astype(np.float32) ** 2,
    )


def complex_envelopes(lines: npt.NDArray[np.int16], band: Band) -> Envelopes:
    """Complex envelopes of RF lines (n, N): DC and drift removed, band-passed without phase, demodulated."""
    size = len(band.gain)
    below = band.centre - band.first
    gain = band.gain * np.float32(band.out_length / band.padded)
    keep = min(band.out_length, int(np.ceil(band.length * band.out_length / band.padded)))
    values = np.empty((len(lines), keep), dtype=np.complex64)
    rows = min(BLOCK, len(lines))
    whole = np.zeros((rows, band.padded), dtype=np.float32)
    shifted = np.zeros((rows, band.out_length), dtype=np.complex64)
    for start in range(0, len(lines), BLOCK):
        some = lines[start : start + BLOCK, : band.length]
        rf = whole[: len(some), : band.length]
        rf[:] = some
        remove_drift(rf)
        rf[:, band.length - len(band.fade) :] *= band.fade
        spectrum = scipy.fft.rfft(whole[: len(some)], axis=1)[:, band.first : band.first + size]
        turned = shifted[: len(some)]
        np.multiply(spectrum[:, below:], gain[below:], out=turned[:, : size - below])
        np.multiply(spectrum[:, :below], gain[:below], out=turned[:, band.out_length - below :])
        values[start : start + BLOCK] = scipy.fft.ifft(turned, axis=1)[:, :keep]
    return Envelopes(values=values, rate_hz=band.rate_hz, carrier_hz=band.carrier_hz)


def remove_drift(rf: Floats) -> None:
    """Take the offset out of lines (n, N), in place, and their straight-line drift where they have one.

    Both are taken from the quiet second half. Slower waves are left to the band-pass; only the step between a line's end and
    its start would pass it.
    """
    length = rf.shape[1]
    quarter = max(length // 4, 1)
    weights = np.full(quarter, 1 / quarter, dtype=np.float32)
    third = rf[:, max(length - 2 * quarter, 0) : max(length - 2 * quarter, 0) + quarter] @ weights
    fourth = rf[:, -quarter:] @ weights
    slope = (fourth - third) / np.float32(quarter)
    rf -= fourth[:, None]
    drifting = np.flatnonzero(np.abs(slope) * length > LEAST_DRIFT)
    if len(drifting):
        ramp = np.arange(length, dtype=np.float32) - np.float32(length - quarter / 2 - 0.5)
        rf[drifting] -= slope[drifting, None] * ramp
