"""What the pic0rick's shell firmware says and means: text to converter codes to an RF line, no input or output.

The board is open hardware (github.com/kelu124/pic0rick): RP2040 or RP2350, 10 bit converter at 60 MS/s, AD8331
variable-gain amplifier set by a MCP4812 converter, three-level pulser. Its firmware answers text commands; the
facts below were read from its sources and measured on its authors' recordings.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.sequence_metafile import Acquisition
from scipy.signal import butter, hilbert, sosfiltfilt

PROMPT = b"run> "
START_MARK = b"----------Start of ACQ----------"
END_MARK = b"-----------End of ACQ-----------"
LINE_SAMPLES = 8000
CODE_MIDDLE, CODE_MAX = 512, 1023
STEPS_A_CODE = 16  # lines are given in sixteenths of a converter step, so that averages keep their fractions

USB_RP2040, USB_RP2350 = (0x2E8A, 0x000A), (0x2E8A, 0x0009)
RP2350_SAMPLING_HZ = 60e6
RP2040_SAMPLING_HZ = 125e6 / 2 / (267 / 256)  # its fractional clock divider cannot make 60 MS/s: 59.925
GAIN_CODE_LOW, GAIN_CODE_HIGH = 20, 500  # the amplifier's pin follows between these
GAIN_DB_AT_ZERO, GAIN_DB_A_CODE = 5.5, 0.1  # AD8331 data sheet, equation 2, high gain; 2 mV a code
GAIN_DB_LOW, GAIN_DB_HIGH = 7.5, 55.5
NS_A_TICK = 8

JUNK_SAMPLES = 10  # 0..5 stale conversions, 6..9 the spike of the restarted clock
BANG_SEARCH = (10, 60)  # samples; seen at 21..23 with current firmware, 10 with version 2.0
BANG_CODES = 100  # off the base line
ZERO_AFTER_BANG = 25.0  # samples from the pulse's onset to time zero of envelope peaks, from echo multiples
FORERUN_SEARCH = 0.08  # of its echo's time: speed of sound of the delay line over 5 to 40 degrees C, and its length
FORERUN_OVER_NOISE = 8.0  # of the forerun echo's envelope, over the line's median


def gain_db_of_code(code: int) -> float:
    """Gain in dB that a DAC code makes."""
    return GAIN_DB_AT_ZERO + GAIN_DB_A_CODE * min(max(code, GAIN_CODE_LOW), GAIN_CODE_HIGH)


def gain_code(gain_db: float) -> int:
    """DAC code whose gain is nearest to `gain_db`, within what the amplifier follows."""
    return min(max(round((gain_db - GAIN_DB_AT_ZERO) / GAIN_DB_A_CODE), GAIN_CODE_LOW), GAIN_CODE_HIGH)


def start_command(pon_ns: float, poff_ns: float, damp_ns: float) -> str:
    """The command for one shot: positive pulse, negative pulse, damping; whole ticks, never negative."""
    ticks = [NS_A_TICK * max(0, round(width / NS_A_TICK)) for width in (pon_ns, poff_ns, damp_ns)]
    return "start acq " + " ".join(str(width) for width in ticks)


def answer_to(command: str, received: bytes) -> Optional[bytes]:
    """What stands between a command's echo and the prompt at the end; None if it is not there (yet).

    Prompts that come before the echo, from empty lines, are passed over.
    """
    if not received.endswith(PROMPT):
        return None
    at = received.find(command.encode("ascii") + b"\r\n")
    return None if at < 0 else received[at + len(command) + 2 : -len(PROMPT)]


def parse_codes(answer: bytes) -> npt.NDArray[np.int64]:
    """The converter codes (8000,) in the answer to `read`.

    Raises
    ------
    ValueError
        A mark or the last comma is missing, not 8000 values, or one that is no code of 10 bits.
    """
    match = re.fullmatch(rb"(?:\s|run> )*" + START_MARK + rb"\r\n([0-9A-F,]*),\r\n" + END_MARK + rb"\r\n(?:\s|run> )*", answer)
    if match is None:
        raise ValueError("the marks around the values, or the values themselves, are damaged")
    words = match.group(1).split(b",")
    if len(words) != LINE_SAMPLES:
        raise ValueError(f"expected {LINE_SAMPLES} values, got {len(words)}")
    if any(not 1 <= len(word) <= 3 or (len(word) > 1 and word.startswith(b"0")) for word in words):
        raise ValueError("a value is empty, too long or padded with zeros")
    codes = np.array([int(word, 16) for word in words])
    if codes.max() > CODE_MAX:
        raise ValueError(f"a value is {codes.max()}, over {CODE_MAX}")
    return codes


def bang_onset(codes: npt.NDArray[np.int64]) -> Optional[int]:
    """Sample at which the transmit pulse begins, or None if there is none."""
    low, high = BANG_SEARCH
    away = np.abs(codes[low:high] - np.median(codes)) > BANG_CODES
    return low + int(np.argmax(away)) if away.any() else None


def forerun_echo(codes: npt.NDArray[np.int64], bang: int, acquisition: Acquisition) -> Optional[float]:
    """Sample (with fraction) of the echo of the forerun's face, or None if none stands out where it should be."""
    rate = acquisition.sampling_hz
    flight = 2e-3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s * rate
    expected = bang + ZERO_AFTER_BANG + flight
    first, last = int(expected - FORERUN_SEARCH * flight), int(expected + FORERUN_SEARCH * flight) + 1
    if last + 2 > len(codes):
        return None
    low, high = 0.6 * acquisition.transducer_hz, min(1.4 * acquisition.transducer_hz, 0.45 * rate)
    band = butter(2, [low, high], "bandpass", fs=rate, output="sos")
    envelope = np.abs(hilbert(sosfiltfilt(band, codes[JUNK_SAMPLES:] - np.median(codes)))).astype(float)
    window = envelope[first - JUNK_SAMPLES : last - JUNK_SAMPLES]
    peak = int(np.argmax(window))
    if not 0 < peak < len(window) - 1 or window[peak] < FORERUN_OVER_NOISE * np.median(envelope):
        return None
    before, at, after = window[peak - 1 : peak + 2]
    return float(first + peak + 0.5 * (before - after) / (before - 2 * at + after))


@dataclass(frozen=True, eq=False)
class AlignedShot:
    """One shot whose sample 0 is the transmit pulse."""

    samples: npt.NDArray[np.float64]  # (N,) sixteenths of a converter step off mid scale
    clipped: bool  # after the blind time


def align_shot(
    codes: npt.NDArray[np.int64],
    acquisition: Acquisition,
    flights: Optional[deque[float]],
    zero_after_bang: float,
    blind_us: float,
) -> AlignedShot:
    """Bring a shot to its own time zero.

    Without a forerun, time zero is the onset of the transmit pulse plus a calibrated constant. With one, the sharp
    echo of its face takes the place of the onset: `flights` collects the samples between the two over the last
    shots (this one is added), and their median tells where the pulse was. So the onset's jitter cancels while
    the delay line's own time, which its temperature changes, stays in the line for the measurement to see.

    Raises
    ------
    ValueError
        The line holds no transmit pulse, or no forerun echo.
    """
    bang = bang_onset(codes)
    if bang is None:
        raise ValueError("no transmit pulse")
    zero = bang + zero_after_bang
    if flights is not None:
        echo = forerun_echo(codes, bang, acquisition)
        if echo is None:
            raise ValueError("no forerun echo")
        flights.append(echo - bang)
        zero = echo - float(np.median(flights)) + zero_after_bang
    start = max(JUNK_SAMPLES, round(zero))
    gate = codes[start + int(blind_us * 1e-6 * acquisition.sampling_hz) :]
    clipped = bool(((gate == 0) | (gate == CODE_MAX)).any())
    return AlignedShot(STEPS_A_CODE * (codes[start:] - CODE_MIDDLE).astype(float), clipped)
