"""What a script of the conversation can ask for. Scripts are generators: they yield a step and get its result."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol, TypeVar, Union

T = TypeVar("T")


class LinkError(Exception):
    """Something between host and device failed; the message says what."""


class SilenceError(LinkError):
    """No whole reply in time."""


class DamagedReplyError(LinkError):
    """A reply came, and it cannot be trusted."""


class PortLostError(LinkError):
    """The port cannot be opened or is gone."""


class SpeedError(Exception):
    """This computer's port cannot be set to that speed."""


class ReplyKind(Enum):
    """What the next reply looks like."""

    TEXT = "text"
    BINARY = "binary"
    FENCE = "fence"  # the answer to FENCE_COMMAND, whatever comes before it


# Legal in every mode. Its answer looks like no other, so whatever precedes it belongs to earlier commands.
FENCE_COMMAND = "GET:Info.Status.System Mode"


@dataclass(frozen=True)
class Connect:
    """Open the port afresh at 9600 baud."""


@dataclass(frozen=True)
class Disconnect:
    """Close the port if it is open."""


@dataclass(frozen=True)
class SetSpeed:
    """Set the host's speed; SpeedError where the port cannot."""

    baud: int


@dataclass(frozen=True)
class Break:
    """Send a serial break."""


@dataclass(frozen=True)
class Pause:
    """Wait."""

    seconds: float


@dataclass(frozen=True)
class Hush:
    """Throw away what comes until the line is quiet."""

    quiet_s: float = 0.02
    longest_s: float = 0.3


@dataclass(frozen=True)
class Ask:
    """Flush, send a command and wait for its reply: an Answer, DeviceError or LinkError. No command: only wait."""

    command: str
    timeout_s: float
    kind: ReplyKind = ReplyKind.TEXT


@dataclass(frozen=True)
class Answer:
    """A reply: a text payload without its CRC, or a whole binary reply; and when its last byte was read."""

    data: bytes
    at_s: float


Step = Union[Connect, Disconnect, SetSpeed, Break, Pause, Hush, Ask]
Script = Generator[Step, Any, T]


class Port(Protocol):
    """A byte line. Every method raises PortLostError once the port is gone."""

    has_speeds: bool  # a serial line has, a socket has not
    has_break: bool

    def write(self, data: bytes) -> None:
        """Send all of it."""

    def read(self, timeout_s: float) -> bytes:
        """What has come, as soon as anything has; empty after the time-out."""

    def flush_input(self) -> None:
        """Forget what has come."""

    def set_speed(self, baud: int) -> None:
        """Set the speed, 8 data bits, no parity, 1 stop bit, no handshake."""

    def send_break(self) -> None:
        """Hold the line for about 300 ms."""

    def close(self) -> None:
        """Let go; never raises."""


class Clock(Protocol):
    """Time, given from outside so that tests need not wait."""

    def now(self) -> float:
        """Monotonic seconds."""

    def sleep(self, seconds: float) -> None:
        """Wait."""
