"""The lines that the emulator serves: a pseudo-terminal or a TCP port, with a side channel on standard input."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import signal
import socket
import sys
import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Optional

from CranioNavLib.errors import InputError

from ModuleTrackingLib.ndi.emulator.device import POWER_ON_SPEED
from ModuleTrackingLib.ndi.emulator.station import Station

IDLE_S = 0.2  # the longest sleep: signals and timed faults are seen this soon
HUNG_UP_S = 0.01  # how often a closed pseudo-terminal is looked at
LINUX_TCGETS2, LINUX_TERMIOS2_BYTES = 0x802C542A, 44  # asm-generic/ioctls.h; the last word is the output speed


class Line(ABC):
    """One way to the host. Its owner selects on `files` and calls `read` when one is ready."""

    url: str

    @abstractmethod
    def files(self) -> list[int]:
        """File descriptors to wait for."""

    @abstractmethod
    def read(self, ready: list[int]) -> bytes:
        """What the host sent, or nothing."""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send to the host, if there is one."""

    @abstractmethod
    def host_speed(self) -> Optional[int]:
        """The speed that the host has set, or None for a line without speeds."""

    @abstractmethod
    def hung_up(self) -> bool:
        """True once after the host has let go of the line."""

    @abstractmethod
    def close(self) -> None:
        """Let go."""


class TerminalLine(Line):
    """A pseudo-terminal. It carries speeds but no break; closing it is seen instead."""

    def __init__(self, link: Path | None = None) -> None:
        import termios
        import tty

        self._termios = termios
        self._speeds = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
        self._host, device = os.openpty()
        tty.setraw(device)
        settings = termios.tcgetattr(device)
        settings[4] = settings[5] = termios.B9600
        termios.tcsetattr(device, termios.TCSANOW, settings)
        self.url = os.ttyname(device)
        os.close(device)
        os.set_blocking(self._host, False)
        self._link = link
        if link is not None:
            with contextlib.suppress(FileNotFoundError):
                link.unlink()
            link.symlink_to(self.url)
            self.url = str(link)
        self._open = self._closed_now = False
        self._poll = select.poll()
        self._poll.register(self._host, select.POLLIN)

    def files(self) -> list[int]:
        return [self._host] if self._look() else []

    def _look(self) -> bool:
        """Whether a host has the terminal open; notes the moment when it let go."""
        events = self._poll.poll(0)
        hung = bool(events and events[0][1] & select.POLLHUP)
        if hung and self._open:
            self._closed_now = True
        self._open = not hung
        return self._open

    def read(self, ready: list[int]) -> bytes:
        if self._host not in ready:
            return b""
        try:
            return os.read(self._host, 65536)
        except OSError as error:
            if error.errno in (errno.EIO, errno.EAGAIN):
                return b""
            raise

    def write(self, data: bytes) -> None:
        if self._look():
            with contextlib.suppress(BlockingIOError):  # nobody reads: a line has no memory
                os.write(self._host, data)

    def host_speed(self) -> Optional[int]:
        speed = self._speeds.get(self._termios.tcgetattr(self._host)[5], 0)
        return speed or self._any_speed()

    def _any_speed(self) -> int:
        """A speed that has no constant of its own, such as 1228739: Linux tells it by another request."""
        import fcntl

        settings = bytearray(LINUX_TERMIOS2_BYTES)
        try:
            fcntl.ioctl(self._host, LINUX_TCGETS2, settings)
        except OSError:
            return 0
        return int.from_bytes(settings[-4:], sys.byteorder)

    def hung_up(self) -> bool:
        self._look()
        closed, self._closed_now = self._closed_now, False
        return closed

    def close(self) -> None:
        os.close(self._host)
        if self._link is not None:
            with contextlib.suppress(FileNotFoundError):
                self._link.unlink()


class SocketLine(Line):
    """A TCP port on this computer for one host at a time; a new one takes the line over."""

    def __init__(self, port: int = 0) -> None:
        self._listener = socket.create_server(("127.0.0.1", port))
        self._host: Optional[socket.socket] = None
        self._closed_now = False
        self.url = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def files(self) -> list[int]:
        return [self._listener.fileno(), *([self._host.fileno()] if self._host else [])]

    def read(self, ready: list[int]) -> bytes:
        if self._listener.fileno() in ready:
            self._drop()
            self._host, _ = self._listener.accept()
            self._host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        if self._host is None or self._host.fileno() not in ready:
            return b""
        with contextlib.suppress(OSError):
            data = self._host.recv(65536)
            if data:
                return data
        self._drop()
        return b""

    def write(self, data: bytes) -> None:
        if self._host is not None:
            with contextlib.suppress(OSError):
                self._host.sendall(data)

    def _drop(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host, self._closed_now = None, True

    def host_speed(self) -> Optional[int]:
        return None

    def hung_up(self) -> bool:
        closed, self._closed_now = self._closed_now, False
        return closed

    def close(self) -> None:
        self._drop()
        self._listener.close()


def open_line(tcp: bool = False, port: int = 0, link: Path | None = None) -> Line:
    """A TCP port on this computer, or a pseudo-terminal.

    Raises
    ------
    InputError
        The port is taken, or this system has no pseudo-terminals.
    """
    if tcp:
        try:
            return SocketLine(port)
        except (OSError, OverflowError) as error:
            raise InputError(f"cannot serve TCP port {port}: {error}; choose another, or 0 for a free one") from None
    if sys.platform == "win32":
        raise InputError("Windows has no pseudo-terminals; serve a TCP port instead")
    try:
        return TerminalLine(link)
    except OSError as error:
        raise InputError(f"no pseudo-terminal: {error}; choose another link, or serve a TCP port instead") from None


def serve(station: Station, line: Line, keep_state: bool = False) -> None:
    """Serve the line until the process is interrupted or terminated.

    Lines on standard input are the side channel (see `CONTROL_HELP`), answered on standard error;
    SIGUSR1 resets the device.

    Parameters
    ----------
    keep_state : bool
        Let the device go on when the host closes the line or goes back to 9600 baud. Otherwise both reset
        it, which stands for the break that neither a pseudo-terminal nor a socket carries.
    """
    with contextlib.suppress(KeyboardInterrupt):  # it came before the handler stood
        _serve(station, line, keep_state, side_channel())


def _serve(station: Station, line: Line, keep_state: bool, control: Optional[int]) -> None:
    reset_asked: list[bool] = []
    stop_asked: list[bool] = []
    # an exception instead could be swallowed where Python may not raise one, such as inside an import
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: stop_asked.append(True))
    if hasattr(signal, "SIGUSR1"):
        signal.signal(signal.SIGUSR1, lambda *_: reset_asked.append(True))
    typed = b""
    while not stop_asked:
        now = time.monotonic()
        files = line.files()
        waits = [IDLE_S if files else HUNG_UP_S]
        wakes = station.wakes_at_s()
        if wakes is not None:
            waits.append(max(0.0, wakes - now))
        ready, _, _ = select.select([*files, *([control] if control is not None else [])], [], [], min(waits))
        now = time.monotonic()
        if reset_asked:
            reset_asked.clear()
            station.reset(now)
        if line.hung_up() and not keep_state:
            station.hang_up()
        if control is not None and control in ready:
            piece = os.read(control, 4096)
            control = control if piece else None
            *lines, typed = (typed + piece).split(b"\n")
            for text in lines:
                print(station.control(text.decode("utf-8", "replace"), now), file=sys.stderr, flush=True)
        data = line.read(ready)
        if data:
            speed = line.host_speed()
            if not keep_state and speed == POWER_ON_SPEED != station.device.speed:
                station.hang_up()  # a host that goes back to 9600 by itself means a break, or opened the line anew
            station.receive(data, speed, now)
        wakes = station.wakes_at_s()
        if wakes is not None and wakes <= time.monotonic():
            line.write(station.take_due(time.monotonic(), line.host_speed()))
        else:
            station.tick(now)


def side_channel() -> Optional[int]:
    """Standard input, where it can be read without stopping a process in the background."""
    try:
        number = sys.stdin.fileno()
        if os.isatty(number) and os.tcgetpgrp(number) != os.getpgrp():
            return None
        return number
    except (OSError, ValueError, AttributeError):
        return None
