"""A stand-in for a pic0rick with its shell firmware: prompt, echo, commands and quirks of the real one."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ModuleUltrasoundLib.devices.pic0rick_shell import (
    CODE_MIDDLE,
    LINE_SAMPLES,
    PROMPT,
    RP2350_SAMPLING_HZ,
    STEPS_A_CODE,
    ZERO_AFTER_BANG,
    gain_db_of_code,
)
from ModuleUltrasoundLib.emulators.faults import SPLIT_S, Chunk, Faults
from ModuleUltrasoundLib.emulators.line_source import LineSource, RawCodes

LONGEST_COMMAND = 127  # characters; more are dropped silently
BANG_ONSET = 22
BANG_CODES = 420.0
BANG_HZ = 5e6
BANG_DECAY_S = 0.25e-6
REFERENCE_GAIN_CODE = 245  # 30 dB: a source's lines come as they are
NOISE_CODES = 1.2


class Pic0rickShell:
    """The board's side of the shell: bytes in, chunks out."""

    def __init__(self, source: LineSource | RawCodes, faults: Faults, read_s: float = 0.1, timeout_s: float = 3.0) -> None:
        self._source, self._faults = source, faults
        self._read_s, self._timeout_s = read_s, timeout_s  # time to print a buffer; the converter's time-out
        self._rng = np.random.default_rng(1)
        self._typed = bytearray()
        self._buffer: npt.NDArray[np.int64] = np.zeros(LINE_SAMPLES, dtype=np.int64)
        self._gain_code = 0
        self._scale = float("nan")  # converter steps a unit of the source
        self.commands: list[str] = []

    def greet(self) -> list[Chunk]:
        """A board that runs already has printed its prompt to nobody; its input keeps what the last user typed."""
        if self._faults.strikes("stale-fragment"):
            self._typed = bytearray(b"write da")
        return []

    def tick(self, now_s: float) -> list[Chunk]:
        """The board says nothing of its own."""
        del now_s
        return []

    def receive(self, data: bytes, now_s: float) -> list[Chunk]:
        """Echo and answers."""
        del now_s
        chunks: list[Chunk] = []
        for byte in data:
            if byte in (0x0A, 0x0D):
                command = self._typed.decode("ascii")
                self._typed.clear()
                chunks += [Chunk(b"\r\n"), *self._answer(command), *self._prompt()]
            elif byte in (0x08, 0x7F):
                del self._typed[-1:]
            elif 0x20 <= byte < 0x7F and len(self._typed) < LONGEST_COMMAND:
                self._typed.append(byte)
                chunks.append(Chunk(bytes([byte])))
        return _joined(chunks)

    def _prompt(self) -> list[Chunk]:
        chunks = [Chunk(b"\r\n" + PROMPT)] if self._faults.strikes("extra-prompts") else []
        if self._faults.strikes("split-prompts"):
            return [*chunks, Chunk(PROMPT[:2]), Chunk(PROMPT[2:], wait_s=SPLIT_S)]
        return [*chunks, Chunk(PROMPT)]

    def _answer(self, command: str) -> list[Chunk]:
        if command:
            self.commands.append(command)
        words = command.split(" ")
        if not command:
            return []
        if words[:2] == ["start", "acq"]:
            return self._shoot()
        if command == "read":
            return [Chunk(b"", wait_s=self._read_s), *self._faults.spoil(self._printed())]
        if words[:2] == ["write", "dac"] and len(words) == 3 and words[2].isdigit():
            self._gain_code = int(words[2]) % 1024
            return [Chunk(b"DAC writing started\r\nDAC writing ended\r\n")]
        return [Chunk(f"Unknown command: {' '.join(words[:2])}\r\n".encode())]

    def _shoot(self) -> list[Chunk]:
        begin = f"Acquisition of {LINE_SAMPLES} samples started\r\n".encode()
        if self._faults.strikes("adc-timeout"):
            self._buffer = np.concatenate([np.zeros(LINE_SAMPLES // 2, dtype=np.int64), self._buffer[LINE_SAMPLES // 2 :]])
            return [Chunk(begin), Chunk(b"ADC timeout occured\r\nAcquisition ended\r\n", wait_s=self._timeout_s)]
        self._buffer = self._shot()
        return [Chunk(begin), Chunk(b"Acquisition ended\r\n")]

    def _printed(self) -> bytes:
        values = ",".join(f"{code:X}" for code in self._buffer.tolist())
        return f"----------Start of ACQ----------\r\n{values},\r\n-----------End of ACQ-----------\r\n".encode()

    def _shot(self) -> npt.NDArray[np.int64]:
        shift = self._faults.jitter()
        if isinstance(self._source, RawCodes):
            codes = self._source.next_codes()
            return np.concatenate([codes[:10], np.roll(codes, shift)[10:]])  # junk at the start does not move
        with_bang = not self._faults.strikes("pulser-off")
        codes = self._converted(self._source, BANG_ONSET + shift, with_bang)
        codes[:6] = self._rng.integers(400, 600, 6)  # stale conversions
        codes[6:10] = CODE_MIDDLE + np.array([160, -150, 155, -145])  # clock restart
        return codes

    def _converted(self, source: LineSource, onset: int, with_bang: bool) -> npt.NDArray[np.int64]:
        """A source's line as the board's converter gives it: gain, base line, noise, transmit pulse, clipping."""
        rate, line = source.acquisition.sampling_hz, source.next_line().astype(float)
        if np.isnan(self._scale):
            self._scale = _steps_a_unit(float(np.abs(line).max(initial=1.0)))
        gain = 10.0 ** ((gain_db_of_code(self._gain_code) - gain_db_of_code(REFERENCE_GAIN_CODE)) / 20.0)
        signal = CODE_MIDDLE - 3.0 + NOISE_CODES * self._rng.standard_normal(LINE_SAMPLES)
        times = np.arange(LINE_SAMPLES) - onset
        if with_bang:
            after = np.maximum(times, 0) / RP2350_SAMPLING_HZ
            signal += np.where(times >= 0, BANG_CODES * np.exp(-after / BANG_DECAY_S) * np.cos(2 * np.pi * BANG_HZ * after), 0.0)
            zero = round(onset + ZERO_AFTER_BANG)
            signal[zero:] += gain * self._scale * _resampled(line, rate, RP2350_SAMPLING_HZ, LINE_SAMPLES - zero)
        return np.clip(np.round(signal), 0, 1023).astype(np.int64)


def _steps_a_unit(largest: float) -> float:
    """What a unit of a source's line is to the converter: a step, a sixteenth of one as the driver gives, or less."""
    if largest <= CODE_MIDDLE:
        return 1.0
    return min(1.0 / STEPS_A_CODE, CODE_MIDDLE / largest)


def _resampled(line: npt.NDArray[np.float64], rate_hz: float, wanted_hz: float, count: int) -> npt.NDArray[np.float64]:
    """`line` at another sampling rate, cut or padded with zeros to `count` samples."""
    out = np.zeros(count)
    if rate_hz == wanted_hz:
        out[: len(line)] = line[:count]
        return out
    from scipy.interpolate import CubicSpline

    positions = np.arange(count) * rate_hz / wanted_hz
    inside = positions <= len(line) - 1
    out[inside] = CubicSpline(np.arange(len(line)), line)(positions[inside])
    return out


def _joined(chunks: list[Chunk]) -> list[Chunk]:
    """The same bytes and waits in as few chunks as can be."""
    joined: list[Chunk] = []
    for chunk in chunks:
        if joined and not chunk.wait_s and not chunk.hang_up and not joined[-1].hang_up:
            joined[-1] = Chunk(joined[-1].data + chunk.data, joined[-1].wait_s)
        else:
            joined.append(chunk)
    return joined
