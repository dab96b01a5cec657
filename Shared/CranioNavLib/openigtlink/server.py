"""An OpenIGTLink server for several clients: one thread, one bounded queue a client, nobody waits for a slow one."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from types import TracebackType
from typing import Optional

from CranioNavLib.errors import InputError
from CranioNavLib.openigtlink.client import prepare
from CranioNavLib.openigtlink.codec import Decoder, StreamError, encode
from CranioNavLib.openigtlink.messages import (
    Capability,
    GetCapability,
    GetStatus,
    Message,
    StartTracking,
    Status,
    StopTracking,
    TrackingData,
    TrackingReply,
)

SPOKEN = ("TRANSFORM", "IMAGE", "STATUS", "STRING", "TDATA", "GET_STATUS", "GET_CAPABIL", "STT_TDATA", "STP_TDATA")
MOST_CLIENTS = 32


@dataclass(frozen=True)
class ClientInfo:
    """How one client is doing."""

    address: str
    sent: int
    dropped: int  # messages that its queue had no room for; the oldest go first
    rejected: int  # messages of its own that were not believed
    wants_tracking: bool


@dataclass
class _Client:
    connection: socket.socket
    address: str
    queue: deque[bytes]
    decoder: Decoder = field(default_factory=lambda: Decoder(largest_body=1 << 20))
    part: memoryview = field(default_factory=lambda: memoryview(b""))  # what is left of the message being sent
    sent: int = 0
    dropped: int = 0
    progress_s: float = field(default_factory=time.monotonic)
    tracking_interval_s: Optional[float] = None  # None: did not ask for TDATA
    tracking_s: float = float("-inf")

    @property
    def busy(self) -> bool:
        return bool(self.part) or bool(self.queue)


class IgtlServer:
    """Publishes messages to every client that connects; `with server:` opens and always closes.

    Parameters
    ----------
    port : int
        0 takes a free one; see `port` after `open`.
    host : str
        Loopback by default. OpenIGTLink has no authentication: open it to a network only where that is wanted.
    queue_length : int
        Messages kept for a slow client; beyond, the oldest are dropped and counted.
    status_interval_s : float
        A client that was sent nothing for so long gets STATUS, so that it can tell silence from loss.
    stall_s : float
        A client that takes nothing for so long is closed.
    """

    def __init__(
        self,
        port: int = 18944,
        host: str = "127.0.0.1",
        queue_length: int = 100,
        status_interval_s: float = 0.5,
        stall_s: float = 5.0,
        device: str = "CranioNav",
    ) -> None:
        self.host, self.port, self.device = host, port, device
        self.status = Status(device, code=1, text="")  # what GET_STATUS and the keep-alive say; replace it to tell more
        self.refused_streams = 0  # clients closed because they sent no OpenIGTLink
        self._queue_length, self._status_interval_s, self._stall_s = queue_length, status_interval_s, stall_s
        self._clients: dict[int, _Client] = {}
        self._inbox: deque[Message] = deque(maxlen=1000)
        self._lock = threading.Lock()
        self._thread: Optional[threading.Thread] = None
        self._listener: Optional[socket.socket] = None
        self._waker: Optional[socket.socket] = None
        self._running = False

    def open(self) -> None:
        """Listen and serve.

        Raises
        ------
        InputError
            The port is in use or the host is none of this computer.
        """
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((self.host, self.port))
            listener.listen(MOST_CLIENTS)
        except OSError as error:
            listener.close()
            raise InputError(
                f"cannot serve OpenIGTLink on {self.host}:{self.port}: {error.strerror}; "
                "another 3D Slicer or PlusServer may have it, choose another port"
            ) from None
        listener.setblocking(False)
        self.port = listener.getsockname()[1]
        self._listener = listener
        wakened, self._waker = socket.socketpair()
        wakened.setblocking(False)
        self._waker.setblocking(False)
        self._running = True
        self._thread = threading.Thread(target=self._serve, args=(listener, wakened), name="openigtlink-server", daemon=True)
        self._thread.start()

    def publish(self, message: Message) -> None:
        """Queue `message` for every client. Returns at once; may be called from any thread.

        Raises
        ------
        InputError
            The message cannot be packed (e.g. its device name is longer than 20 bytes).
        """
        data = encode(message)
        with self._lock:
            for client in self._clients.values():
                self._enqueue(client, data)
        self._wake()

    def publish_tracking(self, message: TrackingData) -> None:
        """Queue TDATA for the clients that asked for it, each at most as often as it asked."""
        data = encode(message)
        now = time.monotonic()
        with self._lock:
            for client in self._clients.values():
                interval = client.tracking_interval_s
                # half a millisecond of grace: a source at just the wanted rate must not be halved by its jitter
                if interval is not None and now - client.tracking_s >= interval - 5e-4:
                    client.tracking_s = now
                    self._enqueue(client, data)
        self._wake()

    def receive(self) -> list[Message]:
        """What clients sent since the last call, the server's own business (STT_TDATA, GET_...) left out."""
        with self._lock:
            messages = list(self._inbox)
            self._inbox.clear()
        return messages

    @property
    def clients(self) -> tuple[ClientInfo, ...]:
        with self._lock:
            return tuple(
                ClientInfo(c.address, c.sent, c.dropped, c.decoder.rejected, c.tracking_interval_s is not None)
                for c in self._clients.values()
            )

    def close(self) -> None:
        """Close all connections; may be called twice."""
        self._running = False
        self._wake()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
            self._thread = None
        if self._waker is not None:
            self._waker.close()
            self._waker = None

    def __enter__(self) -> IgtlServer:
        self.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _enqueue(self, client: _Client, data: bytes) -> None:
        if len(client.queue) >= self._queue_length:
            client.queue.popleft()
            client.dropped += 1
        if not client.busy:
            client.progress_s = time.monotonic()  # the stall clock starts when there is something to take
        client.queue.append(data)

    def _wake(self) -> None:
        if self._waker is not None:
            with contextlib.suppress(OSError):  # full: it is awake already
                self._waker.send(b"\0")

    def _serve(self, listener: socket.socket, wakened: socket.socket) -> None:
        with selectors.DefaultSelector() as selector, listener, wakened:
            selector.register(listener, selectors.EVENT_READ)
            selector.register(wakened, selectors.EVENT_READ)
            while self._running:
                events = selector.select(self._status_interval_s / 4)
                for key, mask in events:
                    if key.fileobj is listener:
                        self._accept(listener, selector)
                    elif key.fileobj is wakened:
                        with contextlib.suppress(OSError):
                            wakened.recv(4096)
                    elif mask & selectors.EVENT_READ:
                        self._read(key.fd, selector)
                self._send_all(selector)
            for handle in list(self._clients):
                self._drop(handle, selector)

    def _accept(self, listener: socket.socket, selector: selectors.BaseSelector) -> None:
        try:
            connection, address = listener.accept()
        except OSError:
            return  # it was gone before it was taken
        if len(self._clients) >= MOST_CLIENTS:
            connection.close()
            return
        connection.setblocking(False)
        prepare(connection)
        client = _Client(connection, f"{address[0]}:{address[1]}", deque())
        with self._lock:
            self._clients[connection.fileno()] = client
        selector.register(connection, selectors.EVENT_READ)

    def _read(self, handle: int, selector: selectors.BaseSelector) -> None:
        client = self._clients.get(handle)
        if client is None:
            return
        try:
            data = client.connection.recv(1 << 16)
            messages = client.decoder.feed(data) if data else None
        except BlockingIOError:
            return
        except OSError:
            messages = None
        except StreamError:
            self.refused_streams += 1
            messages = None
        if messages is None:
            self._drop(handle, selector)
            return
        with self._lock:
            for message in messages:
                self._answer(client, message)

    def _answer(self, client: _Client, message: Message) -> None:
        if isinstance(message, StartTracking):
            client.tracking_interval_s = message.interval_ms / 1000
            self._enqueue(client, encode(TrackingReply(self.device, time.time())))
        elif isinstance(message, StopTracking):
            client.tracking_interval_s = None
            self._enqueue(client, encode(TrackingReply(self.device, time.time())))
        elif isinstance(message, GetCapability):
            self._enqueue(client, encode(Capability(self.device, time.time(), types=SPOKEN)))
        elif isinstance(message, GetStatus):
            self._enqueue(client, self._status_bytes())
        else:
            self._inbox.append(message)

    def _status_bytes(self) -> bytes:
        status = self.status
        return encode(Status(status.device, time.time(), {}, status.code, status.sub_code, status.error_name, status.text))

    def _send_all(self, selector: selectors.BaseSelector) -> None:
        now = time.monotonic()
        for handle, client in list(self._clients.items()):
            with self._lock:
                if not client.busy and now - client.progress_s > self._status_interval_s:
                    client.queue.append(self._status_bytes())
            alive = self._send(client)
            if not alive or (client.busy and time.monotonic() - client.progress_s > self._stall_s):
                self._drop(handle, selector)
            else:
                selector.modify(client.connection, selectors.EVENT_READ | (selectors.EVENT_WRITE if client.busy else 0))

    def _send(self, client: _Client) -> bool:
        """Send what the client takes without waiting; False when it is gone."""
        while True:
            if not client.part:
                with self._lock:
                    if not client.queue:
                        return True
                    client.part = memoryview(client.queue.popleft())
                client.sent += 1
            try:
                done = client.connection.send(client.part)
            except BlockingIOError:
                return True
            except OSError:
                return False
            client.part = client.part[done:]
            client.progress_s = time.monotonic()

    def _drop(self, handle: int, selector: selectors.BaseSelector) -> None:
        with self._lock:
            client = self._clients.pop(handle, None)
        if client is not None:
            selector.unregister(client.connection)
            client.connection.close()
