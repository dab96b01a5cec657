"""A stand-in for a pulser/receiver with the framed serial protocol (see `ModuleUltrasoundLib.devices.framed`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ModuleUltrasoundLib.devices.framed import KIND_LINE, KIND_TEXT, Frame, decode_command, encode_frame, parse_pairs
from ModuleUltrasoundLib.emulators.faults import Chunk, Faults
from ModuleUltrasoundLib.emulators.line_source import REFERENCE_GAIN_DB, LineSource

LONGEST_COMMAND = 500


class SerialPulser:
    """The device's side of the protocol: bytes in, chunks out; `tick` gives the lines that are due."""

    def __init__(self, source: LineSource, faults: Faults, rate_hz: float = 20.0) -> None:
        self._source, self._faults, self._rate_hz = source, faults, rate_hz
        self._input = b""
        self._running = False
        self._sequence = 0
        self._due_s = 0.0
        self._settings: dict[str, Any] = {
            "gain_db": REFERENCE_GAIN_DB,
            "delay_us": 0.0,
            "range_us": 60.0,
            "averaging": 1.0,
            "trigger": "free",
            "sampling_hz": source.acquisition.sampling_hz,
        }

    def greet(self) -> list[Chunk]:
        """A new connection: the device says nothing of its own and forgets what it was doing."""
        self._input, self._running = b"", False
        return [Chunk(b"\x00\xa5\x5aab")] if self._faults.strikes("stale-fragment") else []

    def receive(self, data: bytes, now_s: float) -> list[Chunk]:
        """Answers to what the computer sends."""
        self._input = (self._input + data)[-LONGEST_COMMAND:]
        chunks: list[Chunk] = []
        while b"\n" in self._input:
            line, _, self._input = self._input.partition(b"\n")
            chunks += self._obey(decode_command(line), now_s)
        return chunks

    def tick(self, now_s: float) -> list[Chunk]:
        """The line that is due, if one is."""
        if not self._running or self._settings["trigger"] != "free" or now_s < self._due_s:
            return []
        self._due_s = max(self._due_s + 1.0 / self._rate_hz, now_s - 1.0)
        return self._line(now_s)

    def _obey(self, command: str | None, now_s: float) -> list[Chunk]:
        if command is None:
            return self._answer("ERR damaged command")
        word, _, rest = command.partition(" ")
        if word == "SET":
            return self._answer(self._set(rest))
        if word == "INFO":
            return self._answer(self._in_force())
        if word in ("START", "STOP"):
            self._running, self._due_s = word == "START", now_s
            return self._answer("OK")
        if word == "SHOT" and self._settings["trigger"] == "software":
            return self._answer("OK") + self._line(now_s)
        return self._answer(f"ERR unknown or untimely command {word}")

    def _set(self, rest: str) -> str:
        for key, value in parse_pairs(rest).items():
            if key not in self._settings:
                return f"ERR no setting {key}"
            if key == "trigger":
                if value not in ("free", "software"):
                    return f"ERR no trigger input: trigger={value}"
                self._settings[key] = value
            elif key != "sampling_hz":  # this device samples at one rate only
                self._settings[key] = float(value)
        return self._in_force()

    def _in_force(self) -> str:
        return "OK " + " ".join(
            f"{key}={value}" if isinstance(value, str) else f"{key}={value:.12g}" for key, value in self._settings.items()
        )

    def _answer(self, text: str) -> list[Chunk]:
        return list(self._faults.spoil(encode_frame(Frame(KIND_TEXT, text.encode()))))

    def _line(self, now_s: float) -> list[Chunk]:
        rate = self._source.acquisition.sampling_hz
        gain_db = float(self._settings["gain_db"])
        first = round(float(self._settings["delay_us"]) * 1e-6 * rate)
        last = first + max(1, round(float(self._settings["range_us"]) * 1e-6 * rate))
        samples, clipped = amplified(self._source.next_line()[first:last], gain_db)
        if len(samples) == 0:
            samples = np.zeros(1, dtype=np.int16)
        self._sequence += 1
        frame = Frame(
            kind=KIND_LINE,
            payload=samples.astype("<i2").tobytes(),
            sequence=self._sequence,
            device_time_us=int(now_s * 1e6),
            sampling_hz=round(rate),
            gain_db=gain_db,
            first_sample=first,
            averaging=int(float(self._settings["averaging"])),
            clipped=clipped,
        )
        return list(self._faults.spoil(encode_frame(frame)))


def amplified(line: npt.NDArray[np.int16], gain_db: float) -> tuple[npt.NDArray[np.int16], bool]:
    """A source's line as the receiver gives it at a gain, and whether it is clipped."""
    louder = np.round(line * 10.0 ** ((gain_db - REFERENCE_GAIN_DB) / 20.0))
    return np.clip(louder, -32768, 32767).astype(np.int16), bool((np.abs(louder) > 32767).any())
