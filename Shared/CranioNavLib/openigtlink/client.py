"""An OpenIGTLink client that keeps itself connected. It has no thread: whoever calls `receive` drives it."""

from __future__ import annotations

import errno
import select
import socket
import sys
import time
from typing import Optional

from CranioNavLib.openigtlink.codec import Decoder, StreamError, encode
from CranioNavLib.openigtlink.messages import Message

RETRY_S = 0.5  # between attempts to connect; a peer that returns is found again well within 2 s
CONNECT_S = 2.0  # longest wait for one attempt
SEND_S = 2.0  # a peer that takes nothing for this long is given up
BATCH_BYTES = 1 << 20  # read at most this much before handing messages over


class IgtlClient:
    """Connection to one server, made anew whenever it is lost.

    Attributes
    ----------
    connected : bool
        Whether there is a connection now.
    problem : str
        Why there is none, in words; empty while connected and hearing from the peer.
    arrival_s : float
        time.monotonic() at which the last bytes came.
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = 18944, silence_s: float = 2.0, greetings: tuple[Message, ...] = ()
    ) -> None:
        """`greetings` are sent after every connection, e.g. a StartTracking; `silence_s`: see `silent`."""
        self.host, self.port, self.silence_s, self.greetings = host, port, silence_s, greetings
        self.arrival_s = float("nan")
        self.connections = 0
        self._reason = "not connected yet"
        self._socket: Optional[socket.socket] = None
        self._connecting: Optional[socket.socket] = None
        self._attempt_s = self._next_attempt_s = 0.0
        self._decoder = Decoder()
        self._rejected = self._crc_errors = self._received = 0  # of earlier connections

    @property
    def connected(self) -> bool:
        return self._socket is not None

    @property
    def silent(self) -> bool:
        """Connected, but nothing was heard for `silence_s`: the peer may hang."""
        return self.connected and time.monotonic() - self.arrival_s > self.silence_s

    @property
    def problem(self) -> str:
        if not self.connected:
            return f"{self.host}:{self.port}: {self._reason}"
        if self.silent:
            return f"{self.host}:{self.port}: nothing heard for {time.monotonic() - self.arrival_s:.1f} s; is the peer running?"
        return ""

    @property
    def received(self) -> int:
        """Messages so far, rejected ones included."""
        return self._received + self._decoder.received

    @property
    def rejected(self) -> int:
        """Messages that were not believed."""
        return self._rejected + self._decoder.rejected

    @property
    def crc_errors(self) -> int:
        """Messages whose checksum was wrong; they count as rejected, too."""
        return self._crc_errors + self._decoder.crc_errors

    def receive(self, timeout_s: float = 1.0) -> list[Message]:
        """The messages that came, in order; empty if none came in time or the connection was lost just now.

        Connects first where needed. A loss is told by an early empty answer and by `connected` and `problem`.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            left = max(deadline - time.monotonic(), 0.0)
            if self._socket is None:
                if not self._connect(left):
                    return []
                continue
            if not select.select([self._socket], [], [], left)[0]:
                return []
            messages = self._read(self._socket)
            if messages or self._socket is None:
                return messages

    def send(self, message: Message) -> bool:
        """Send one message; False when there is no connection or it was lost on the way."""
        if self._socket is None:
            return False
        try:
            self._socket.sendall(encode(message, header_version=self._decoder.peer_version))
        except OSError as error:
            self._lose(f"sending failed ({error.strerror or 'the peer takes nothing'}); connecting again")
            return False
        return True

    def close(self) -> None:
        """Let go of the connection; may be called twice."""
        self._lose("closed")

    def _read(self, connection: socket.socket) -> list[Message]:
        messages: list[Message] = []
        size = 0
        try:
            while size < BATCH_BYTES:
                data = connection.recv(1 << 16)
                if not data:
                    self._lose("the peer closed the connection; connecting again")
                    break
                self.arrival_s = time.monotonic()
                size += len(data)
                messages += self._decoder.feed(data)
                if len(data) < 1 << 16 or not select.select([connection], [], [], 0)[0]:
                    break
        except StreamError as error:
            self._lose(f"{error}; connecting again")
        except OSError as error:
            self._lose(f"the connection broke ({error.strerror or error}); connecting again")
        return messages

    def _connect(self, timeout_s: float) -> bool:
        """Go on connecting for `timeout_s`; True when connected."""
        deadline = time.monotonic() + timeout_s
        while True:
            now = time.monotonic()
            if self._connecting is None:
                pause = self._next_attempt_s - now
                if pause > 0:
                    time.sleep(min(pause, max(deadline - now, 0.0)))
                    if pause > deadline - now:
                        return False
                if not self._begin():
                    continue
            assert self._connecting is not None
            if self._finish(max(deadline - time.monotonic(), 0.0)):
                return True
            if time.monotonic() >= deadline:
                return False

    def _begin(self) -> bool:
        self._attempt_s = time.monotonic()
        self._next_attempt_s = self._attempt_s + RETRY_S
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)[0]
            connection = socket.socket(family, kind, protocol)
        except OSError as error:
            self._reason = f"{error.strerror}; check the host's name"
            return False
        connection.setblocking(False)
        result = connection.connect_ex(address)
        if result not in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
            connection.close()
            self._reason = f"{_words(result)}; is the server running?"
            return False
        self._connecting = connection
        return True

    def _finish(self, timeout_s: float) -> bool:
        connection = self._connecting
        assert connection is not None
        left = min(timeout_s, max(self._attempt_s + CONNECT_S - time.monotonic(), 0.0))
        _, ready, failed = select.select([], [connection], [connection], left)
        if not ready and not failed:
            if time.monotonic() - self._attempt_s >= CONNECT_S:
                self._give_up("no answer; check host and port")
            return False
        result = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if result:
            self._give_up(f"{_words(result)}; is the server running?")
            return False
        self._connecting = None
        self._adopt(connection)
        return self.connected

    def _give_up(self, reason: str) -> None:
        assert self._connecting is not None
        self._connecting.close()
        self._connecting = None
        self._reason = reason

    def _adopt(self, connection: socket.socket) -> None:
        connection.settimeout(SEND_S)
        prepare(connection)
        self._received, self._rejected, self._crc_errors = self.received, self.rejected, self.crc_errors
        self._decoder = Decoder()
        self._socket = connection
        self.arrival_s = time.monotonic()
        self.connections += 1
        for greeting in self.greetings:
            self.send(greeting)

    def _lose(self, reason: str) -> None:
        for connection in (self._socket, self._connecting):
            if connection is not None:
                connection.close()
        self._socket = self._connecting = None
        self._reason = reason


def prepare(connection: socket.socket) -> None:
    """No delay for small messages, and a vanished host is noticed within about five seconds."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    if sys.platform == "linux":
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 2)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)


def _words(code: int) -> str:
    return (
        "connection refused" if code == errno.ECONNREFUSED else OSError(code, errno.errorcode.get(code, "error")).strerror or ""
    )
