"""What the simulated devices have in common: they join the session, keep its time, and their link breaks on request."""

from __future__ import annotations

from enum import Enum
from typing import ClassVar, Optional

import numpy as np

from CranioNavLib.device_plugin import DevicePlugin
from CranioNavLib.parameters import Parameters
from CranioNavLib.phantom.session import SimulatedSession, current_session


class Head(str, Enum):
    """Which head lies on the simulated table, if no session runs yet."""

    SAMPLE = "sample"
    SYNTHETIC = "synthetic"


class SimulatedDevice(DevicePlugin):
    """A device of the simulated session that gives numbered readings at a steady rate; to be mixed into a kind's base.

    Its settings have `head`, `seed`, `rate_hz` and `fail_after_s`.
    """

    device: ClassVar[str]  # what messages call it
    idle: ClassVar[str]  # what it does not do before it is started
    failure: ClassVar[type[Exception]]  # what the kind's devices raise

    def __init__(self, settings: Optional[Parameters] = None) -> None:
        super().__init__(settings)
        self._session: Optional[SimulatedSession] = None
        self._begin_s: Optional[float] = None  # not None: started
        self._number = 0  # of the last reading since the start

    def open(self) -> None:
        """Join the simulated session.

        Raises
        ------
        InputError
            The sample head is wanted and cannot be had.
        """
        self._session = current_session(self.settings.head.value, self.settings.seed)

    def start(self) -> None:
        """Begin to measure; raises `failure` when it is not open."""
        self._begin_s, self._number = self._joined().clock.now(), 0

    def stop(self) -> None:
        """End measuring."""
        self._begin_s = None

    def close(self) -> None:
        """Leave the session; it goes on for the other simulated device."""
        self._begin_s = self._session = None

    def _joined(self) -> SimulatedSession:
        if self._session is None:
            raise self.failure(f"the {self.device} is not open; open it first")
        return self._session

    def _started(self) -> tuple[SimulatedSession, float]:
        """The session and the time of the start; raises `failure` when it was not started or the link broke."""
        if self._session is None or self._begin_s is None:
            raise self.failure(f"the {self.device} {self.idle}; start it first")
        limit = self.settings.fail_after_s
        if limit is not None and self._session.clock.now() - self._begin_s >= limit:
            raise self.failure(f"the link to the {self.device} broke; open it again")
        return self._session, self._begin_s

    def _await_next(self, timeout_s: float, lost: int = 0) -> Optional[float]:
        """Wait for the next reading and count it. Its time in s, or None when it is not due in time.

        `lost` readings before it never arrive.
        """
        session, begin_s = self._started()
        clock, period = session.clock, 1 / self.settings.rate_hz
        # readings that nobody fetched in time are gone, as with a real device
        self._number = max(self._number + 1, int(np.ceil((clock.now() - begin_s) / period - 1e-6))) + lost
        due: float = begin_s + self._number * period
        if due - clock.now() > timeout_s:
            clock.wait_until(clock.now() + timeout_s)
            self._number -= 1
            return None
        clock.wait_until(due)
        return due
