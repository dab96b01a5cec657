"""A byte link to a pulser/receiver: a serial port or a socket, with deadlines and plain words when it fails."""

from __future__ import annotations

import importlib
import select
import socket
import time
from enum import Enum
from typing import Any, Optional
from urllib.parse import urlsplit

from CranioNavLib.errors import InputError

from ModuleUltrasoundLib.devices.device import DeviceError

BOOTLOADER_BAUD = 1200  # opening an RP2040/RP2350 board at this rate reboots it into its bootloader
READ_SLICE_S = 0.02  # longest wait inside one read of the port, so that deadlines hold to this


class DeviceState(str, Enum):
    """Where a device stands."""

    CLOSED = "closed"
    CONNECTED = "connected"
    RUNNING = "running"
    LOST = "lost"  # unplugged or gone silent; the driver tries to reach it again


class LinkLostError(DeviceError):
    """The port vanished: cable pulled, board reset or program ended."""


class _SerialPort:
    """A serial device through pyserial."""

    def __init__(self, name: str, baud_rate: int) -> None:
        serial: Any = importlib.import_module("serial")
        self._port = serial.Serial(name, baud_rate, timeout=READ_SLICE_S, write_timeout=2.0, exclusive=True)

    def send(self, data: bytes) -> None:
        self._port.write(data)

    def receive(self, wait_s: float) -> bytes:
        self._port.timeout = wait_s
        data = bytes(self._port.read(max(1, self._port.in_waiting)))
        waiting = self._port.in_waiting
        return data + bytes(self._port.read(waiting)) if waiting else data

    def close(self) -> None:
        self._port.close()


class _SocketPort:
    """A TCP connection, `socket://host:port`."""

    def __init__(self, name: str) -> None:
        parts = urlsplit(name)
        if parts.scheme != "socket" or not parts.hostname or not parts.port:
            raise InputError(f"cannot open {name}: expected socket://host:port")
        self._socket = socket.create_connection((parts.hostname, parts.port), timeout=2.0)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes) -> None:
        self._socket.settimeout(2.0)
        self._socket.sendall(data)

    def receive(self, wait_s: float) -> bytes:
        if not select.select([self._socket], [], [], wait_s)[0]:
            return b""
        data = self._socket.recv(65536)
        if not data:
            raise ConnectionResetError("closed by the other side")
        return data

    def close(self) -> None:
        self._socket.close()


class ByteLink:
    """Bytes to and from a port. Every wait has an end, every failure of the port is a LinkLostError."""

    def __init__(self, port: _SerialPort | _SocketPort, name: str) -> None:
        self._port, self.name = port, name

    @classmethod
    def open(cls, name: str, baud_rate: int = 115200) -> ByteLink:
        """Open a serial device (`/dev/ttyACM0`, `COM5`) or `socket://host:port`, exclusively.

        Raises
        ------
        InputError
            No port was named, or the rate is the one that reboots Pico boards.
        DeviceError
            The port cannot be opened; the message says how to mend it.
        """
        if not name:
            raise InputError(f"no port given for the A-mode device; set its parameter port ({_ports_in_words()})")
        if baud_rate == BOOTLOADER_BAUD:
            raise InputError("1200 baud would reboot a Pico board into its bootloader; use 115200")
        try:
            return cls(_SocketPort(name) if "://" in name else _SerialPort(name, baud_rate), name)
        except InputError:
            raise
        except (OSError, ValueError) as error:  # pyserial's SerialException is an OSError
            raise DeviceError(f"cannot open {name}: {_reason(error)}") from None

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        try:
            self._port.send(data)
        except (OSError, TypeError) as error:  # pyserial raises TypeError on a port that vanished
            raise self._lost(error) from None

    def read(self, timeout_s: float = READ_SLICE_S) -> bytes:
        """What has come, waiting at most `timeout_s` for a first byte; empty if nothing came."""
        try:
            return self._port.receive(max(0.0, timeout_s))
        except (OSError, TypeError) as error:
            raise self._lost(error) from None

    def drain(self, quiet_s: float, limit_s: float = 2.0) -> bytes:
        """Read until nothing has come for `quiet_s`, at most for `limit_s`; returns what came."""
        received, end = b"", time.monotonic() + limit_s
        quiet_since = time.monotonic()
        while time.monotonic() - quiet_since < quiet_s and time.monotonic() < end:
            data = self.read()
            received += data
            if data:
                quiet_since = time.monotonic()
        return received

    def close(self) -> None:
        """Let go of the port; never fails."""
        try:
            self._port.close()
        except OSError:
            return

    def _lost(self, error: Exception) -> LinkLostError:
        return LinkLostError(f"the A-mode device at {self.name} was lost ({_reason(error)}); check its cable and power")


def usb_product(name: str) -> Optional[tuple[int, int]]:
    """USB vendor and product id of a serial port, if the system knows them."""
    for info in _listed_ports():
        if info.device == name and info.vid is not None:
            return int(info.vid), int(info.pid)
    return None


def usb_ports(products: set[tuple[int, int]]) -> list[str]:
    """Serial ports whose USB vendor and product id is one of `products`."""
    return [str(info.device) for info in _listed_ports() if (info.vid, info.pid) in products]


def _listed_ports() -> list[Any]:
    list_ports: Any = importlib.import_module("serial.tools.list_ports")
    return sorted(list_ports.comports(), key=lambda info: str(info.device))


def _ports_in_words() -> str:
    names = [str(info.device) for info in _listed_ports()]
    return f"serial ports here: {', '.join(names)}" if names else "this computer shows no serial port now"


def _reason(error: Exception) -> str:
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    hints = {
        2: f"no such port; {_ports_in_words()}",
        13: "permission denied; add yourself to the group dialout (Linux) and log in again",
        16: "another program uses it; close that program",
        11: "another program uses it; close that program",
        111: "nothing listens there; start the device's server or the emulator first",
    }
    number = getattr(error, "errno", None)
    return hints.get(number, text) if number is not None else text
