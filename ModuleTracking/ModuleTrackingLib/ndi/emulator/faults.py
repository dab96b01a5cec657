"""Faults on demand: what goes wrong on the line, with the tools and in the device, by name and by chance."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np
from CranioNavLib.errors import InputError

Generator = np.random.Generator


@dataclass(frozen=True)
class FaultKind:
    """A fault's meaning and the meaning and default of its numbers (`NAME=FIRST:SECOND`)."""

    help: str
    numbers: tuple[tuple[str, float], ...]


CHANCE = "share of replies"
TIME_SHARE = "share of the time"
FAULTS: dict[str, FaultKind] = {
    "byte-loss": FaultKind("replies lose bytes", ((CHANCE, 0.02),)),
    "bit-errors": FaultKind("bits of replies flip", ((CHANCE, 0.02),)),
    "stray-bytes": FaultKind("noise before replies", ((CHANCE, 0.02),)),
    "truncate": FaultKind("replies break off", ((CHANCE, 0.02),)),
    "silence": FaultKind("no reply at all", ((CHANCE, 0.02),)),
    "delays": FaultKind("replies come late", ((CHANCE, 0.02), ("seconds late", 0.5))),
    "errors": FaultKind("tracking replies are ERROR0C", ((CHANCE, 0.02),)),
    "missing": FaultKind("tools are not seen", ((TIME_SHARE, 0.2),)),
    "out-of-volume": FaultKind("tools are out of volume", ((TIME_SHARE, 0.2),)),
    "partly-out-of-volume": FaultKind("tools are partly out of volume", ((TIME_SHARE, 0.2),)),
    "interference": FaultKind("infrared interference", ((TIME_SHARE, 0.2),)),
    "too-few-markers": FaultKind("tools show too few markers", ((TIME_SHARE, 0.2),)),
    "disabled": FaultKind("handles are disabled", ((TIME_SHARE, 0.2),)),
    "unplugged": FaultKind("handles are unoccupied", ((TIME_SHARE, 0.2),)),
    "bumped": FaultKind("the bump detector has an alert", ()),
    "disconnect": FaultKind("the cable is out", (("seconds between", 10.0), ("seconds out", 2.0))),
    "brown-out": FaultKind("power fails: the device resets to 9600 baud", (("seconds between", 10.0),)),
}
WINDOW_S = 0.5  # tools come and go for this long at a time


@dataclass
class Faults:
    """The faults that are switched on; they can be changed while the emulator runs."""

    seed: int = 0
    active: dict[str, tuple[float, ...]] = field(default_factory=dict)
    rng: Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def switch_on(self, spec: str) -> None:
        """Add `NAME`, `NAME=NUMBER` or `NAME=NUMBER:NUMBER` (`:` does for `=`).

        Raises
        ------
        InputError
            An unknown fault, or numbers that do not fit it.
        """
        name, *given = spec.strip().replace("=", ":").split(":")
        if name not in FAULTS:
            raise InputError(f"unknown fault {name!r}; known: {', '.join(FAULTS)}")
        described = FAULTS[name].numbers
        try:
            numbers = [float(text) for text in given]
        except ValueError:
            numbers = [-1.0]
        if len(numbers) > len(described) or any(not 0.0 <= number < 1e6 for number in numbers):
            wanted = ", ".join(f"{what} (default {default:g})" for what, default in described) or "no numbers"
            raise InputError(f"fault {spec!r}: {name} takes {wanted}")
        if numbers and described[0][0] in (CHANCE, TIME_SHARE) and numbers[0] > 1.0:
            raise InputError(f"fault {spec!r}: the {described[0][0]} is between 0 and 1")
        self.active[name] = (*numbers, *(default for _, default in described[len(numbers) :]))

    def switch_off(self, name: str = "") -> None:
        """Switch one fault off, or all."""
        if name:
            self.active.pop(name.split(":")[0], None)
        else:
            self.active.clear()

    def strikes(self, name: str) -> bool:
        """Whether a fault by chance strikes this reply."""
        return name in self.active and bool(self.rng.random() < self.active[name][0])

    def tool_has(self, name: str, tool: str, time_s: float) -> bool:
        """Whether a tool has a fault at this time; the same answer within one window of time."""
        if name not in self.active:
            return False
        share = self.active[name][0]
        what = f"{self.seed} {name} {tool} {int(time_s / WINDOW_S)}".encode()
        return int.from_bytes(hashlib.blake2b(what, digest_size=4).digest(), "big") / 2**32 < share

    def cable_out(self, time_s: float) -> bool:
        """Whether the cable is out at this time."""
        if "disconnect" not in self.active:
            return False
        between, out = self.active["disconnect"]
        return time_s % (between + out) >= between

    def brown_outs(self, time_s: float) -> int:
        """How often power has failed up to this time."""
        return int(time_s / max(self.active["brown-out"][0], 0.1)) if "brown-out" in self.active else 0

    def spoil(self, reply: bytes) -> tuple[float, bytes]:
        """A reply after the line's faults: how much later it comes, and what is left of it."""
        if self.strikes("silence"):
            return 0.0, b""
        if self.strikes("byte-loss"):
            reply = lose_bytes(reply, self.rng)
        if self.strikes("bit-errors"):
            reply = flip_bits(reply, self.rng)
        if self.strikes("truncate"):
            reply = reply[: int(self.rng.integers(0, max(1, len(reply))))]
        if self.strikes("stray-bytes"):
            reply = self.rng.bytes(int(self.rng.integers(1, 12))) + reply
        return (self.active["delays"][1] if self.strikes("delays") else 0.0), reply


def lose_bytes(reply: bytes, rng: Generator) -> bytes:
    """`reply` without one to four bytes somewhere."""
    drop = rng.choice(len(reply), size=min(len(reply), int(rng.integers(1, 5))), replace=False)
    return bytes(byte for at, byte in enumerate(reply) if at not in set(drop.tolist()))


def flip_bits(reply: bytes, rng: Generator) -> bytes:
    """`reply` with one to eight bits flipped."""
    spoilt = bytearray(reply)
    for bit in rng.integers(0, 8 * len(reply), size=int(rng.integers(1, 9))).tolist():
        spoilt[bit // 8] ^= 1 << bit % 8
    return bytes(spoilt)


def garble(reply: bytes, rng: Generator) -> bytes:
    """What a line at the wrong speed makes of a reply: other bytes, another number of them."""
    return rng.bytes(max(1, int(len(reply) * rng.uniform(0.3, 1.2))))
