"""Plays a script on a port, step by step, and can stop at any deadline and go on later."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Any, Optional

from ModuleTrackingLib.ndi.crc import crc_text
from ModuleTrackingLib.ndi.replies import BadReplyError, DeviceError, command_bytes, raise_if_error, text_payload
from ModuleTrackingLib.ndi.steps import (
    Answer,
    Ask,
    Break,
    Clock,
    Connect,
    DamagedReplyError,
    Disconnect,
    Hush,
    Pause,
    Port,
    PortLostError,
    ReplyKind,
    Script,
    SetSpeed,
    SilenceError,
    SpeedError,
    Step,
)
from ModuleTrackingLib.ndi.tracking import BX_HEADER, BX_START, bx_length

LONGEST_TEXT = 4096
GAP_S = 0.06  # a reply whose bytes stop for this long is broken off; USB adapters hold bytes back for up to 16 ms
_FENCE = re.compile(rb"((?:Info\.Status\.System Mode=[^\r]*?|ERROR[0-9A-F]{2}))([0-9A-F]{4})\r")


class SystemClock:
    """The computer's monotonic clock."""

    def now(self) -> float:
        """See Clock.now."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """See Clock.sleep."""
        time.sleep(seconds)


class ReplyReader:
    """Collects bytes until one whole reply is there."""

    def __init__(self, kind: ReplyKind) -> None:
        self.kind, self.buffer = kind, b""

    def feed(self, data: bytes) -> Optional[bytes]:
        """The reply once it is whole: a text payload, or a binary reply with its CRCs.

        Raises
        ------
        BadReplyError
            What came cannot become a reply.
        """
        self.buffer += data
        if self.kind is ReplyKind.TEXT:
            return self._text(0)
        return self._binary() if self.kind is ReplyKind.BINARY else self._fence()

    def _text(self, start: int) -> Optional[bytes]:
        end = self.buffer.find(b"\r", start)
        if end < 0:
            if len(self.buffer) > LONGEST_TEXT:
                raise BadReplyError(f"more than {LONGEST_TEXT} bytes without an end")
            return None
        return text_payload(self.buffer[start:end])

    def _binary(self) -> Optional[bytes]:
        start, error = self.buffer.find(BX_START), self.buffer.find(b"ERROR")
        if error >= 0 and not 0 <= start < error:
            return self._text(error)
        if start < 0:
            if len(self.buffer) > LONGEST_TEXT:
                raise BadReplyError(f"{len(self.buffer)} bytes without the start of a binary reply")
            return None
        reply = self.buffer[start:]
        if len(reply) < BX_HEADER or len(reply) < bx_length(reply[:BX_HEADER]):
            return None
        return reply[: bx_length(reply[:BX_HEADER])]

    def _fence(self) -> Optional[bytes]:
        for found in _FENCE.finditer(self.buffer):
            if crc_text(found.group(1)) == found.group(2):
                return found.group(1)
        return None


class Conductor:
    """Holds the port and the script that is being played."""

    def __init__(self, open_port: Callable[[], Port], clock: Clock) -> None:
        self.open_port, self.clock = open_port, clock
        self.port: Optional[Port] = None
        self.speed = 9600
        self.result: Any = None
        self._script: Optional[Script[Any]] = None
        self._step: Optional[Step] = None
        self._until_s = self._last_byte_s = 0.0
        self._reader = ReplyReader(ReplyKind.TEXT)

    @property
    def busy(self) -> bool:
        """Whether a script is under way."""
        return self._script is not None

    def begin(self, script: Script[Any]) -> None:
        """Take up a script; one under way is dropped."""
        self.drop()
        self._script = script
        self._move(lambda: script.send(None))

    def drop(self) -> None:
        """Forget the script under way."""
        if self._script is not None:
            self._script.close()
        self._script = self._step = None

    def advance(self, deadline_s: float) -> bool:
        """Play on until the script ends (True, with its value in `result`) or the deadline comes (False).

        What the script itself raises comes out of here, and the script is over.
        """
        while self._script is not None and self._step is not None:
            script = self._script
            try:
                done, value = self._perform(self._step, deadline_s)
            except (SilenceError, DamagedReplyError, PortLostError, SpeedError, DeviceError) as error:
                thrown = error
                self._move(lambda: script.throw(thrown))  # noqa: B023  (called at once)
                continue
            if not done:
                return False
            self._move(lambda: script.send(value))  # noqa: B023
        return True

    def _move(self, forward: Callable[[], Step]) -> None:
        """Let the script run to its next step, and start that step."""
        try:
            self._step = forward()
        except StopIteration as end:
            self._script = self._step = None
            self.result = end.value
            return
        except BaseException:
            self._script = self._step = None
            raise
        self._started = False

    def _perform(self, step: Step, deadline_s: float) -> tuple[bool, Any]:
        now = self.clock.now()
        if not self._started:
            self._begin_step(step, now)
            self._started = True
            now = self.clock.now()
        if isinstance(step, Ask):
            return self._wait_for_reply(step, deadline_s)
        if isinstance(step, Hush):
            return self._wait_for_quiet(step, deadline_s)
        if isinstance(step, Pause) and now < self._until_s:
            self.clock.sleep(max(0.0, min(self._until_s, deadline_s) - now))
            return self.clock.now() >= self._until_s, self.clock.now()
        return True, now

    def _begin_step(self, step: Step, now: float) -> None:
        if isinstance(step, Connect):
            self.close_port()
            self.port, self.speed = self.open_port(), 9600
        elif isinstance(step, Disconnect):
            self.close_port()
        elif isinstance(step, SetSpeed):
            self._open.set_speed(step.baud)
            self.speed = step.baud
        elif isinstance(step, Break):
            self._open.send_break()
        elif isinstance(step, Pause):
            self._until_s = now + step.seconds
        elif isinstance(step, Hush):
            self._until_s, self._last_byte_s = now + step.longest_s, now
        else:
            self._reader = ReplyReader(step.kind)
            if step.command:
                self._open.flush_input()
                self._open.write(command_bytes(step.command))
            self._until_s = self._last_byte_s = self.clock.now() + step.timeout_s

    def _wait_for_reply(self, ask: Ask, deadline_s: float) -> tuple[bool, Any]:
        port = self._open
        while True:
            now = self.clock.now()
            limit_s = self._until_s
            if self._reader.buffer and ask.kind is not ReplyKind.FENCE:
                limit_s = min(limit_s, self._last_byte_s + GAP_S)
            data = port.read(max(0.0, min(limit_s, deadline_s) - now))
            now = self.clock.now()
            try:
                reply = self._reader.feed(data) if data else None
            except BadReplyError as problem:
                raise DamagedReplyError(str(problem)) from None
            if reply is not None:
                raise_if_error(reply, ask.command)
                return True, Answer(reply, now)
            if data:
                self._last_byte_s = now
            elif now >= limit_s:
                if self._reader.buffer:
                    raise DamagedReplyError(f"a reply broke off after {len(self._reader.buffer)} bytes")
                raise SilenceError(f"no answer to {ask.command.split(':')[0] or 'a reset'} within {ask.timeout_s:.2f} s")
            elif now >= deadline_s:
                return False, None

    def _wait_for_quiet(self, hush: Hush, deadline_s: float) -> tuple[bool, Any]:
        while True:
            now = self.clock.now()
            limit_s = min(self._until_s, self._last_byte_s + hush.quiet_s)
            if now >= limit_s:
                return True, None
            if now >= deadline_s:
                return False, None
            if self._open.read(min(limit_s, deadline_s) - now):
                self._last_byte_s = self.clock.now()

    @property
    def _open(self) -> Port:
        if self.port is None:
            raise PortLostError("the port is closed")
        return self.port

    def close_port(self) -> None:
        """Close the port if it is open."""
        if self.port is not None:
            self.port.close()
            self.port = None
