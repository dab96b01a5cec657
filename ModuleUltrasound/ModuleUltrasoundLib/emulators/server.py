"""Serve an emulated device on a TCP port of this computer or on a pseudo terminal."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import sys
import tempfile
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

from ModuleUltrasoundLib.emulators.faults import Chunk

TICK_S = 0.002
RECONNECT_S = 0.3  # a pulled cable comes back after this


class EmulatedDevice(Protocol):
    """A device as its port sees it."""

    def greet(self) -> list[Chunk]:
        """What it sends when somebody connects."""

    def receive(self, data: bytes, now_s: float) -> list[Chunk]:
        """What it sends upon bytes from the computer."""

    def tick(self, now_s: float) -> list[Chunk]:
        """What it sends of its own."""


class Door:
    """Where a computer reaches the device: a port with a name, one peer at a time."""

    name: str

    @abstractmethod
    def wait_for_peer(self, timeout_s: float) -> bool:
        """Whether somebody is connected."""

    @abstractmethod
    def receive(self, timeout_s: float) -> bytes | None:
        """Bytes that came, empty if none in time, None if the peer has gone."""

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send bytes to the peer; a peer that has gone misses them."""

    @abstractmethod
    def hang_up(self) -> None:
        """Pull the cable; the door can be used again afterwards."""

    @abstractmethod
    def close(self) -> None:
        """End."""


class TcpDoor(Door):
    """A TCP port on loopback, `socket://127.0.0.1:N`."""

    def __init__(self, port: int = 0) -> None:
        self._listener = socket.create_server(("127.0.0.1", port))
        self._peer: socket.socket | None = None
        self.name = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def wait_for_peer(self, timeout_s: float) -> bool:
        if self._peer is None and select.select([self._listener], [], [], timeout_s)[0]:
            self._peer, _ = self._listener.accept()
            self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return self._peer is not None

    def receive(self, timeout_s: float) -> bytes | None:
        if self._peer is None:
            return None
        if not select.select([self._peer], [], [], timeout_s)[0]:
            return b""
        try:
            return self._peer.recv(4096) or None
        except OSError:
            return None

    def send(self, data: bytes) -> None:
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._peer.sendall(data)

    def hang_up(self) -> None:
        if self._peer is not None:
            self._peer.close()
            self._peer = None

    def close(self) -> None:
        self.hang_up()
        self._listener.close()


class PtyDoor(Door):
    """A pseudo terminal behind a link whose name stays the same when the cable is pulled and put back."""

    def __init__(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="cranionav-amode-"))
        self.name = str(self._folder / "port")
        self._lock = threading.Lock()
        self._open()

    def _open(self) -> None:
        import tty

        self._master, slave = os.openpty()
        tty.setraw(slave)
        self._slave = slave  # kept open, so that a computer may come and go
        link = Path(self.name)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(slave))

    def wait_for_peer(self, timeout_s: float) -> bool:
        return True  # a pty cannot tell; what nobody reads waits in its buffer

    def receive(self, timeout_s: float) -> bytes | None:
        if not select.select([self._master], [], [], timeout_s)[0]:
            return b""
        try:
            return os.read(self._master, 4096)
        except OSError:
            return None

    def send(self, data: bytes) -> None:
        deadline = time.monotonic() + 0.5  # what is not read for so long is dropped, as by the real firmware
        while data and time.monotonic() < deadline:
            if select.select([], [self._master], [], 0.05)[1]:
                data = data[os.write(self._master, data[:512]) :]

    def hang_up(self) -> None:
        os.close(self._slave)
        os.close(self._master)
        Path(self.name).unlink(missing_ok=True)
        time.sleep(RECONNECT_S)
        self._open()

    def close(self) -> None:
        os.close(self._slave)
        os.close(self._master)
        Path(self.name).unlink(missing_ok=True)
        self._folder.rmdir()


def serve(device: EmulatedDevice, door: Door, stopped: Callable[[], bool]) -> None:
    """Let `device` answer at `door` until `stopped()`."""
    connected = False
    while not stopped():
        if not connected:
            if not door.wait_for_peer(0.1):
                continue
            connected = _send(door, device.greet(), stopped)
            continue
        data = door.receive(TICK_S)
        if data is None:
            door.hang_up()
            connected = False
            continue
        chunks = device.receive(data, time.monotonic()) if data else []
        connected = _send(door, chunks + device.tick(time.monotonic()), stopped)


def _send(door: Door, chunks: list[Chunk], stopped: Callable[[], bool]) -> bool:
    """Send chunks in turn, until stopped; False if one of them pulls the cable."""
    for chunk in chunks:
        if stopped():  # an answer that nobody reads any more takes half a second a chunk
            break
        if chunk.wait_s:
            time.sleep(chunk.wait_s)
        if chunk.hang_up:
            door.hang_up()
            return False
        if chunk.data:
            door.send(chunk.data)
    return True


@contextlib.contextmanager
def served(device: EmulatedDevice, door: Door | None = None) -> Iterator[str]:
    """Serve `device` from a thread of this process while the block runs; gives the port's name. For tests of drivers."""
    door = door if door is not None else TcpDoor()
    ended = threading.Event()
    thread = threading.Thread(target=serve, args=(device, door, ended.is_set), daemon=True)
    thread.start()
    try:
        yield door.name
    finally:
        ended.set()
        thread.join(timeout=10.0)
        door.close()


def run_until_interrupted(device: EmulatedDevice, door: Door) -> None:
    """Print the port as the first line on stdout, then serve until the process is interrupted or ended."""
    import signal

    ended = threading.Event()
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: ended.set())
    print(door.name, flush=True)
    sys.stdout.flush()
    try:
        serve(device, door, ended.is_set)
    finally:
        door.close()
