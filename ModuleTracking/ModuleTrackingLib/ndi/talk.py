"""One command and its reply: asked again where that is safe, with patience that grows, and a probe that tells who is there."""

from __future__ import annotations

import re
from collections.abc import Callable

from ModuleTrackingLib.ndi.replies import BadReplyError, DeviceError, check_okay
from ModuleTrackingLib.ndi.steps import Answer, Ask, DamagedReplyError, Hush, Script, SilenceError

POWER_ON_SPEED = 9600
PROBE_S = 0.25  # a device that is there answers PROBE long before
PROBE = "APIREV:"  # harmless in every mode; an error reply is an answer too
SLOW_S, QUICK_S = (1.0, 8.0), (0.3, 1.2)  # first and longest patience with slow commands and with the others
SLOW_COMMANDS = ("INIT", "PINIT", "TSTART", "SET")
REPEATS = 8  # of a command whose answers come damaged
LATE_S = 0.05
_REVISION = re.compile(rb"[A-Z]\.\d{3}\.\d{3}")


class Patience:
    """How long an answer is waited for: short at first, longer after each silence, and as long as answers have taken."""

    def __init__(self, first_s: float, longest_s: float) -> None:
        self.first_s, self.longest_s, self.seconds, self._slowest_s = first_s, longest_s, first_s, 0.0

    def grow(self) -> None:
        """An answer did not come."""
        self.seconds = min(self.longest_s, 2.0 * self.seconds)

    def note(self, took_s: float) -> None:
        """An answer came."""
        self._slowest_s = max(self._slowest_s, took_s)

    def settle(self) -> None:
        """All is well: no more patience than answers need."""
        self.seconds = max(self.first_s, min(self.longest_s, 2.0 * self._slowest_s))


class Talk:
    """Commands to a device at a known speed; its methods are scripts.

    Parameters
    ----------
    now : callable
        Monotonic seconds.
    say : callable
        Told in words what is going on: ("connecting" or "setting up", what).
    """

    def __init__(self, now: Callable[[], float], say: Callable[[str, str], None]) -> None:
        self.now, self.say = now, say
        self.speed = POWER_ON_SPEED
        self._slow, self._quick = Patience(*SLOW_S), Patience(*QUICK_S)

    def _okay(self, command: str) -> Script[None]:
        payload = yield from self._tell(command)
        try:
            check_okay(payload)
        except BadReplyError as problem:
            raise DamagedReplyError(str(problem)) from None

    def _tell(self, command: str, repeat: bool = True) -> Script[bytes]:
        """The reply to a command of the set-up.

        Some commands take seconds, and a pulled cable must be noticed sooner. So patience is short at first;
        when it ends, a device that still answers a probe gets the command again, with more patience.
        """
        patience = self._slow if command.startswith(SLOW_COMMANDS) else self._quick
        damaged = 0
        while True:
            asked_s = self.now()
            try:
                answer: Answer = yield Ask(command, patience.seconds + self._time_for(len(command) + 40))
                patience.note(answer.at_s - asked_s)
                return answer.data
            except DeviceError as error:
                if error.code != 0x04 or not repeat:  # 04: the command was damaged on its way
                    raise
            except DamagedReplyError as error:
                damaged += 1
                yield Hush()
                if not repeat or damaged > REPEATS:
                    raise
                self.say("setting up", f"{error}; asking again")
            except SilenceError as error:
                patience.grow()
                yield Hush()
                if not repeat or not ((yield from self._answers()) or (yield from self._answers())):
                    raise
                self.say("setting up", f"{error}; asking again")

    def _time_for(self, count: int) -> float:
        """Time-out of a prompt reply: the bytes on the line four times over, and never under 0.2 s."""
        return max(0.2, 4.0 * 10.0 * count / self.speed)

    def _answers(self) -> Script[bool]:
        """Whether a device answers at the present speed."""
        try:
            answer: Answer = yield Ask(PROBE, PROBE_S)
            if not _REVISION.fullmatch(answer.data):
                yield Hush(LATE_S)  # RESET, or an earlier command's answer: the probe's own is still to come
        except DeviceError:
            pass
        except (SilenceError, DamagedReplyError):
            yield Hush()
            return False
        return True
