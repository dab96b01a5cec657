"""A network cable between browser and workstation that can be pulled, for the tests."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from urllib.parse import urlsplit


class Cable:
    """Forwards TCP connections to a port of this computer."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._plugged, self._flowing = threading.Event(), threading.Event()
        self._plugged.set()
        self._flowing.set()
        self._ends: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def pull(self) -> None:
        """Break every connection and take no new one."""
        self._plugged.clear()
        for end in self._ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        self._ends.clear()

    def plug(self) -> None:
        """Be a cable again."""
        self._plugged.set()
        self._flowing.set()

    def stall(self) -> None:
        """Carry nothing, but say so to nobody: what a lost radio link looks like."""
        self._flowing.clear()

    def close(self) -> None:
        """Away with it."""
        self.pull()
        self._flowing.set()
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
                if not self._plugged.is_set():
                    near.close()
                    continue
                far = socket.create_connection(("127.0.0.1", self._port))
            except OSError:
                if self._listener.fileno() < 0:
                    return
                near.close()
                continue
            self._ends += [near, far]
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=(source, sink), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while True:
                self._flowing.wait()
                data = source.recv(65536)
                self._flowing.wait()
                if not data:
                    break
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


@contextmanager
def cabled(url: str) -> Iterator[tuple[str, Cable]]:
    """The same address through a cable."""
    cable = Cable(urlsplit(url).port or 80)
    try:
        yield f"http://127.0.0.1:{cable.port}/", cable
    finally:
        cable.close()
