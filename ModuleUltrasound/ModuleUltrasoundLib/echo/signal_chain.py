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
BLOCK = 16  # lines transformed at once: the working set stays in the processor's second cache
OVERSAMPLING = 4.0  # complex samples a cycle of the transducer's frequency


@dataclass(frozen=True, eq=False)
class Envelopes:
    """Complex envelopes of n lines: `|values|` is the envelope, its phase that of the RF at `carrier_hz`."""

    values: npt.NDArray[np.complex64]  # (n, M)
    rate_hz: float  # samples of `values` a second; sample 0 is the line's time zero
    carrier_hz: float


@dataclass(frozen=True, eq=False)
class Band:
    """The band-pass of a recording: which bins of the line's spectrum pass, and how much.

    Bins are counted in numbers: real and imaginary part of each. What is multiplied to a block of lines is kept once for each
    line, because numpy works on whole arrays several times as fast as on their rows.
    """

    length: int  # samples of a line that are used
    padded: int  # FFT length
    passed: slice  # of the line's spectrum
    gain: Floats  # (BLOCK, B) of what passes
    trend: Floats  # (2, B) what passes of a constant 1 and of `ramp`
    below: int  # how much of it lies below the carrier
    out_length: int  # FFT length of the envelope
    rate_hz: float
    carrier_hz: float
    fade: Floats  # weights of a line's last samples: a hum that is cut off would pass the band
    ends: Floats  # (Q, 2) weights of the line's last samples that give its offset and its drift a sample


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
    fade = np.cos(np.linspace(0, np.pi / 2, min(max(int(FADE_CYCLES * sampling / centre), 2), length))) ** 2
    gain *= 2.0 * out_length / padded  # twice: the negative frequencies are left out
    trend = scipy.fft.rfft(_trend(length) * np.concatenate([np.ones(length - len(fade)), fade]), padded, axis=1)
    return Band(
        length=length,
        padded=padded,
        passed=slice(2 * first, 2 * last),
        gain=np.tile(np.repeat(gain, 2).astype(np.float32), (BLOCK, 1)),
        trend=(trend[:, first:last] * gain).astype(np.complex64).view(np.float32),
        below=2 * (middle - first),
        out_length=out_length,
        rate_hz=out_length * step,
        carrier_hz=middle * step,
        fade=fade.astype(np.float32),
        ends=_ends(length).astype(np.float32),
    )


def _trend(length: int) -> npt.NDArray[np.float64]:
    """Offset and drift (2, N) of a line, the drift none in the middle of its last quarter."""
    return np.stack([np.ones(length), np.arange(length) - (length - max(length // 4, 1) / 2 - 0.5)])


def _ends(length: int) -> npt.NDArray[np.float64]:
    """Weights (Q, 2) of a line's second half: the mean of its last quarter, and the rise to it from the quarter before."""
    quarter = max(length // 4, 1)
    weights = np.zeros((min(2 * quarter, length), 2))
    weights[-quarter:] = np.array([1.0, 1 / quarter]) / quarter
    weights[:quarter, 1] -= 1 / quarter**2
    return weights


def complex_envelopes(lines: npt.NDArray[np.int16], band: Band) -> Envelopes:
    """Complex envelopes of RF lines (n, N): DC and drift removed, band-passed without phase, demodulated."""
    return envelopes_of(lines, band)[0]


def envelopes_of(lines: npt.NDArray[np.int16], band: Band) -> tuple[Envelopes, Floats]:
    """As complex_envelopes, and their magnitude (n, M), taken while they are in the processor's cache."""
    size, below = band.gain.shape[1], band.below
    keep = min(band.out_length, int(np.ceil(band.length * band.out_length / band.padded)))
    values = np.empty((len(lines), keep), dtype=np.complex64)
    magnitude = np.empty(values.shape, dtype=np.float32)
    rows = min(BLOCK, len(lines))
    whole = np.zeros((rows, band.padded), dtype=np.float32)
    shifted = np.zeros((rows, 2 * band.out_length), dtype=np.float32)
    for start in range(0, len(lines), BLOCK):
        block = slice(start, start + BLOCK)
        some = lines[block, : band.length]
        rf = whole[: len(some)]
        rf[:, : band.length] = some
        trend = trends(rf[:, : band.length], band)
        rf[:, band.length - len(band.fade) : band.length] *= band.fade
        spectrum = scipy.fft.rfft(rf, axis=1).view(np.float32)[:, band.passed].copy()
        spectrum *= band.gain[: len(some)]
        spectrum -= trend @ band.trend
        turned = shifted[: len(some)]  # the carrier comes first, what lies below it last
        turned[:, : size - below] = spectrum[:, below:]
        turned[:, 2 * band.out_length - below :] = spectrum[:, :below]
        values[block] = scipy.fft.ifft(turned.view(np.complex64), axis=1)[:, :keep]
        np.abs(values[block], out=magnitude[block])
    return Envelopes(values=values, rate_hz=band.rate_hz, carrier_hz=band.carrier_hz), magnitude


def trends(rf: Floats, band: Band) -> Floats:
    """Offset and straight-line drift a sample (n, 2) of lines (n, N), the drift 0 where it makes no step that matters.

    Both are taken from the quiet second half. Slower waves are left to the band-pass; only the step between a line's end and
    its start would pass it.
    """
    trend = rf[:, rf.shape[1] - len(band.ends) :] @ band.ends
    trend[:, 1] *= np.abs(trend[:, 1]) * rf.shape[1] > LEAST_DRIFT
    return np.asarray(trend)
