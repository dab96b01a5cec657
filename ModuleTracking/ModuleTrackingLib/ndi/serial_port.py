"""The port under the tracker: serial by pyserial, or TCP; and the list of ports that a person can choose from."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from CranioNavLib.errors import InputError

from ModuleTrackingLib.ndi.steps import Port, PortLostError, SpeedError

BREAK_S = 0.3
CONNECT_S = 1.0  # to open or to send; a tracker on the same network answers within milliseconds
WORKER_READ_S = 0.02  # where the system cannot wait on a port (Windows), pyserial waits in slices of this
MAKER_WORDS = ("ndi", "northern digital", "polaris", "vicra", "spectra", "vega")


def open_port(url: str) -> Port:
    """A serial port by its name, `socket://host:port`, or another URL of pyserial's.

    Raises
    ------
    PortLostError
        It cannot be opened; the message says why and what to do.
    """
    return TcpPort(url) if url.startswith("socket://") else SerialPort(url)


class SerialPort:
    """A pyserial port at 9600 8N1 without handshake."""

    def __init__(self, url: str) -> None:
        import serial

        self.url = url
        self.has_speeds = "://" not in url
        self.has_break = self.has_speeds and not os.path.realpath(url).startswith("/dev/pts/")  # pseudo-terminals drop it
        self._failures: tuple[type[BaseException], ...] = (serial.SerialException, OSError, TypeError, AttributeError, ValueError)
        self._can_wait = sys.platform != "win32" and self.has_speeds
        if sys.platform != "win32":
            import termios

            self._failures += (termios.error,)
        try:
            self._serial: Any = serial.serial_for_url(url, baudrate=9600, timeout=0 if self._can_wait else WORKER_READ_S)
        except self._failures as error:
            raise PortLostError(_why_closed(url, error)) from None
        with contextlib.suppress(*self._failures, NotImplementedError):
            self._serial.set_low_latency_mode(True)  # FTDI adapters otherwise hold replies back for 16 ms

    def write(self, data: bytes) -> None:
        """See Port.write."""
        with self._watched():
            self._serial.write(data)

    def read(self, timeout_s: float) -> bytes:
        """See Port.read."""
        with self._watched():
            if not self._can_wait:
                return self._read_in_slices(timeout_s)
            ready, _, _ = select.select([self._serial.fileno()], [], [], max(0.0, timeout_s))
            return bytes(self._serial.read(4096)) if ready else b""

    def _read_in_slices(self, timeout_s: float) -> bytes:
        until_s = time.monotonic() + timeout_s
        while not self._serial.in_waiting:
            if time.monotonic() >= until_s:
                return b""
            first = bytes(self._serial.read(1))
            if first:
                return first + bytes(self._serial.read(self._serial.in_waiting))
        return bytes(self._serial.read(self._serial.in_waiting))

    def flush_input(self) -> None:
        """See Port.flush_input."""
        with self._watched():
            self._serial.reset_input_buffer()

    def set_speed(self, baud: int) -> None:
        """See Port.set_speed."""
        before = self._serial.baudrate
        if not self.has_speeds or before == baud:
            return
        try:
            self._serial.baudrate = baud
        except (ValueError, NotImplementedError) as error:
            with self._watched():
                self._serial.baudrate = before
            raise SpeedError(f"{self.url} cannot be set to {baud} baud: {error}") from None
        except self._failures as error:
            raise PortLostError(f"{self.url} is gone: {error}") from None

    def send_break(self) -> None:
        """See Port.send_break."""
        with self._watched():
            if self.has_break:
                self._serial.send_break(BREAK_S)

    def close(self) -> None:
        """See Port.close."""
        with contextlib.suppress(*self._failures):
            self._serial.close()

    @contextlib.contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except self._failures as error:
            raise PortLostError(f"{self.url} is gone: {error}") from None


class TcpPort:
    """A TCP connection to a tracker on the network."""

    has_speeds = has_break = False

    def __init__(self, url: str) -> None:
        self.url = url
        host, port = tcp_address(url)
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_S)
        except OSError as error:
            raise PortLostError(_why_closed(url, error)) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(CONNECT_S)

    def write(self, data: bytes) -> None:
        """See Port.write."""
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise PortLostError(f"{self.url} is gone: {error}") from None

    def read(self, timeout_s: float) -> bytes:
        """See Port.read."""
        try:
            if not select.select([self._socket], [], [], max(0.0, timeout_s))[0]:
                return b""
            data = self._socket.recv(65536)
        except (OSError, ValueError) as error:
            raise PortLostError(f"{self.url} is gone: {error}") from None
        if not data:
            raise PortLostError(f"{self.url} was closed by the other end")
        return data

    def flush_input(self) -> None:
        """See Port.flush_input."""
        while self.read(0.0):
            pass

    def set_speed(self, baud: int) -> None:
        """A network has no speeds."""

    def send_break(self) -> None:
        """A network has no break."""

    def close(self) -> None:
        """See Port.close."""
        self._socket.close()


def tcp_address(url: str) -> tuple[str, int]:
    """Host and port of `socket://host:port`.

    Raises
    ------
    InputError
        Another form.
    """
    parts = urlsplit(url)
    try:
        if parts.scheme == "socket" and parts.hostname and parts.port:
            return parts.hostname, parts.port
    except ValueError:
        pass
    raise InputError(f"expected a network port as socket://host:port, got {url!r}")


def _why_closed(url: str, error: BaseException) -> str:
    """Why a port cannot be opened, and what to do."""
    text = str(error)
    if "://" in url:
        return f"no connection to {url}: {text}; check that the tracker is on and the address is right"
    if not os.path.exists(url) and sys.platform != "win32":  # noqa: PTH110  (a port, not a file)
        there = ", ".join(choice.device for choice in list_ports()) or "none"
        return f"there is no port {url}; plug the tracker in or choose one of: {there}"
    if getattr(error, "errno", None) == 13 or "ermission" in text or "ccess is denied" in text:
        return f"{url} may not be opened: {text}; close other programs that use it, or (Linux) join the group dialout"
    return f"{url} cannot be opened: {text}; close other programs that use it"


@dataclass(frozen=True)
class PortChoice:
    """One line of the list of ports."""

    device: str
    description: str
    hint: str  # in words: why this may or may not be the tracker
    rank: int  # 0 likely, 1 possible, 2 unlikely
    identity: tuple[int, int, str] = (0, 0, "")  # USB vendor, product, serial number: found again under another name


def list_ports() -> list[PortChoice]:
    """The serial ports of this computer, the likely ones first."""
    from serial.tools import list_ports as tools

    choices = [_choice(info) for info in tools.comports()]
    return sorted(choices, key=lambda choice: (choice.rank, choice.device))


def _choice(info: Any) -> PortChoice:
    words = " ".join(str(text or "") for text in (info.description, info.manufacturer, info.product)).lower()
    named = any(word in words.replace("/", " ").split() or (len(word) > 4 and word in words) for word in MAKER_WORDS)
    if named:
        rank, hint = 0, "names itself a tracker of this maker"
    elif info.vid is not None:
        rank, hint = 1, "USB serial adapter: possible"
    elif "bluetooth" in words:
        rank, hint = 2, "Bluetooth: unlikely"
    else:
        rank, hint = 2, "built-in port: only if the tracker hangs on it by RS-232"
    if sys.platform != "win32" and not os.access(info.device, os.R_OK | os.W_OK):
        hint += "; you may not open it: join the group dialout and log in again"
    description = str(info.description or info.device)
    return PortChoice(info.device, description, hint, rank, (info.vid or 0, info.pid or 0, str(info.serial_number or "")))


def same_device(wanted: str, identity: tuple[int, int, str]) -> str:
    """The name under which a USB adapter is found now: `wanted` if it exists, else a port of the same identity."""
    if os.path.exists(wanted) or not any(identity):  # noqa: PTH110
        return wanted
    return next((choice.device for choice in list_ports() if choice.identity == identity), wanted)
