"""The browser windows that show the session: one controls, the others watch. What a watcher sends is not carried out."""

from __future__ import annotations

import uuid
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

from wslink import register
from wslink.websocket import LinkProtocol

STATE_TOPIC = "trame.state.topic"
OPEN, TAKE = "cranionav.window.open", "cranionav.window.take"
WATCHER_MAY = frozenset({"wslink.hello", "trame.state.get", "trame.lifecycle.update", "trame.error.client", OPEN, TAKE})
LOCAL_STATE = frozenset({"keys", "muted", "my_window", "trame__busy", "typed"})  # each window's own: not shared
NOBODY = {"window": 0, "text": ""}
LOST_BYTES = 16_000_000  # of one that takes nothing any more; it is closed, and comes back by itself


@dataclass
class Connection:
    """One websocket."""

    transport: Any
    address: str
    window: int = 0  # number of the browser window; 0 until it has said which it is
    sizes: dict[str, tuple[str, dict[str, Any]]] = field(default_factory=dict)  # view -> (origin, size) it would like


class Windows(LinkProtocol):  # type: ignore[misc]
    """Knows who is connected and who controls; stands in front of every message. In the event loop's thread."""

    def __init__(self, state: Any, draw_again: Callable[[str], None]) -> None:
        super().__init__()
        self.boot = uuid.uuid4().hex  # tells a page that the server was started anew
        self._state, self._draw_again = state, draw_again
        self._connections: dict[str, Connection] = {}
        self._numbers: dict[str, int] = {}  # a window's own name -> its number
        self._controller = 0
        self._by_default = True  # nobody has asked for the control: it fell to the first
        self._speaking = ""  # client whose message is being handled
        self._resize: Callable[[str, str, dict[str, Any]], None] = lambda *_: None
        state.control, state.my_window = dict(NOBODY), -1

    # The server's side

    def guard(self, web: Any) -> None:
        """Stand in front of the handlers of a web server (wslink's)."""
        for handler in web._ws_handlers:
            handler.onCompleteMessage = self._guarded(handler, handler.onCompleteMessage)
            handler.sendWrappedError = _without_traces(handler.sendWrappedError)
            for protocol in handler.serverProtocol.getLinkProtocols():
                if hasattr(protocol, "push_content"):
                    self._resize = protocol.update_size

    def onConnect(self, request: Any, client_id: str) -> None:
        """A websocket is open. What it cannot take at once is kept here: a stalled window must not hold up the others."""
        request.transport.set_write_buffer_limits(high=4 * LOST_BYTES)
        self._connections[client_id] = Connection(request.transport, _place_of(request.remote or ""))

    def onClose(self, client_id: str) -> None:
        """A websocket is closed; the window may come back."""
        self._connections.pop(client_id, None)
        self._tell()

    def drop_stalled(self) -> None:
        """Close connections that take nothing any more."""
        for connection in list(self._connections.values()):
            if connection.transport.get_write_buffer_size() > LOST_BYTES:
                connection.transport.abort()

    def is_open(self, name: str) -> bool:
        """Whether the window of that name has a connection."""
        number = self._numbers.get(name, 0)
        return any(connection.window == number for connection in self._connections.values()) and number > 0

    def holds_control(self, name: str) -> bool:
        """Whether the window of that name controls."""
        return self.is_open(name) and self._numbers.get(name) == self._controller

    # The page's side

    @register(OPEN)  # type: ignore[untyped-decorator]
    def open(self, name: str, held: bool) -> int:
        """A window says which one it is, and whether it controlled when it was last connected. Returns its number."""
        connection = self._connections[self._speaking]
        connection.window = self._numbers.setdefault(str(name)[:64], len(self._numbers) + 1)
        if not self._present(self._controller):
            self._hand_over(connection.window, by_default=not held)
        elif held and self._by_default and self._controller != connection.window:
            self._hand_over(connection.window, by_default=False)  # the server was started anew, and another came first
        elif self._controller == connection.window:
            self._apply_sizes(connection)
        self.publish(STATE_TOPIC, {"my_window": connection.window}, client_id=self._speaking)
        self._tell()
        self._draw_again("")
        return connection.window

    @register(TAKE)  # type: ignore[untyped-decorator]
    def take(self) -> None:
        """The window that asks controls from now on; the other is told."""
        window = self._connections[self._speaking].window
        if window:
            self._hand_over(window, by_default=False)
            self._tell()

    def _hand_over(self, window: int, by_default: bool) -> None:
        self._controller, self._by_default = window, by_default
        for connection in self._connections.values():
            if connection.window == window:
                self._apply_sizes(connection)

    def _apply_sizes(self, connection: Connection) -> None:
        for view, (origin, size) in connection.sizes.items():
            self._resize(view, origin, size)

    def _present(self, window: int) -> bool:
        return any(connection.window == window for connection in self._connections.values()) and window > 0

    def _tell(self) -> None:
        if not self._controller:
            return
        connection = next((one for one in self._connections.values() if one.window == self._controller), None)
        text = f"Window {self._controller}, {connection.address}, controls" if connection else "The controlling window is gone"
        told = {"window": self._controller, "text": text}
        if self._state.control != told:
            with self._state as state:
                state.control = told

    # In front of the messages

    def controls(self, client_id: str) -> bool:
        """Whether a client's window controls."""
        connection = self._connections.get(client_id)
        return connection is not None and connection.window == self._controller > 0

    def _guarded(self, handler: Any, pass_on: Callable[[Any, str], Awaitable[None]]) -> Callable[[Any, str], Awaitable[None]]:
        async def on_complete_message(rpc: Any, client_id: str) -> None:
            method, arguments = str(rpc.get("method")), list(rpc.get("args") or [])
            connection = self._connections.get(client_id)
            if method == "trame.rca.size" and connection is not None and len(arguments) == 3:
                connection.sizes[str(arguments[0])] = (arguments[1], arguments[2])
            if method == "trame.state.update" and arguments:
                rpc["args"] = [[change for change in arguments[0] if change.get("key") not in LOCAL_STATE]]
            if method in WATCHER_MAY or self.controls(client_id) or not handler.isClientAuthenticated(client_id):
                self._speaking = client_id
                await pass_on(rpc, client_id)
                return
            await handler.sendWrappedMessage(rpc.get("id"), None, method=method, client_id=client_id)
            if method == "trame.state.update":  # a watcher's page goes back to what is
                keys = [change["key"] for change in rpc["args"][0]] if arguments else []
                truth = {key: self._state[key] for key in keys if self._state.has(key)}
                if truth:
                    handler.publish(STATE_TOPIC, truth, client_id=client_id)
            elif method == "trame.rca.size" and arguments:
                self._draw_again(str(arguments[0]))

        return on_complete_message


def _without_traces(send: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
    """Errors go to the page without the server's stack, which names files of this computer."""

    async def send_error(rpcid: Any, code: int, message: str, data: Any = None, client_id: str | None = None) -> None:
        await send(rpcid, code, message, client_id=client_id)

    return send_error


def _place_of(address: str) -> str:
    return "on this computer" if address in ("127.0.0.1", "::1", "") else f"at {address}"
