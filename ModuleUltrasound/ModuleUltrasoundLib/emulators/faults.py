"""What goes wrong between a device and a computer, by name and at a given rate."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from CranioNavLib.errors import InputError

STALL_S = 0.5
SPLIT_S = 0.03

# How often each happens, per line or answer, unless "name=rate" says otherwise
DEFAULT_RATES = {
    "byte-loss": 0.2,  # a run of bytes is missing
    "bit-errors": 0.2,  # some bits are turned over
    "stall": 0.1,  # half a second of silence in the middle
    "split-prompts": 1.0,  # the prompt comes in two portions
    "adc-timeout": 0.1,  # the converter did not answer
    "extra-prompts": 0.3,  # empty prompts before an answer
    "stale-fragment": 1.0,  # half a command of the last user waits in the device at connect
    "bang-jitter": 1.0,  # the whole line moves by up to a sample
    "pulser-off": 0.1,  # a line without a transmit pulse
    "disconnect": 0.03,  # the cable is pulled, and put back
}


@dataclass(frozen=True)
class Chunk:
    """Bytes to send after a wait; or the end of the connection."""

    data: bytes
    wait_s: float = 0.0
    hang_up: bool = False


class Faults:
    """The faults switched on, and the dice that decide when they strike."""

    def __init__(self, names: Iterable[str] = (), seed: int = 0) -> None:
        self.rates: dict[str, float] = {}
        self.struck: dict[str, int] = {}
        self._rng = np.random.default_rng(seed)
        for entry in names:
            name, _, rate = entry.partition("=")
            if name not in DEFAULT_RATES:
                raise InputError(f"unknown fault {name!r}; known: {', '.join(DEFAULT_RATES)}")
            try:
                self.rates[name] = float(rate) if rate else DEFAULT_RATES[name]
            except ValueError:
                self.rates[name] = float("nan")
            if not 0 <= self.rates[name] <= 1:
                raise InputError(f"fault {name}: expected a rate from 0 to 1 after =, got {rate!r}")

    def strikes(self, name: str) -> bool:
        """Whether the fault happens now."""
        struck = self.rates.get(name, 0.0) > 0 and bool(self._rng.random() < self.rates[name])
        if struck:
            self.struck[name] = self.struck.get(name, 0) + 1
        return struck

    def jitter(self) -> int:
        """Samples (-1, 0 or 1) by which a line moves."""
        return int(self._rng.integers(-1, 2)) if self.strikes("bang-jitter") else 0

    def spoil(self, data: bytes) -> Sequence[Chunk]:
        """`data` as it leaves a bad line: bytes lost, bits turned, a stall in the middle."""
        if self.strikes("byte-loss"):
            at, count = int(self._rng.integers(len(data))), int(self._rng.integers(1, 9))
            data = data[:at] + data[at + count :]
        if self.strikes("bit-errors"):
            spoiled = bytearray(data)
            for _ in range(int(self._rng.integers(1, 4))):
                spoiled[int(self._rng.integers(len(spoiled)))] ^= 1 << int(self._rng.integers(8))
            data = bytes(spoiled)
        if self.strikes("disconnect"):
            return [Chunk(data[: int(self._rng.integers(len(data)))]), Chunk(b"", hang_up=True)]
        if self.strikes("stall"):
            at = int(self._rng.integers(len(data)))
            return [Chunk(data[:at]), Chunk(data[at:], wait_s=STALL_S)]
        return [Chunk(data)]
