"""A port straight into an emulated device, with a clock that jumps: hours of tracking in seconds, no waiting."""

from __future__ import annotations

import math
from collections.abc import Callable

from ModuleTrackingLib.ndi.emulator.station import Station
from ModuleTrackingLib.ndi.steps import PortLostError


class JumpingClock:
    """Time that passes only when somebody waits; however short the wait, it does pass."""

    def __init__(self) -> None:
        self.time_s = 1000.0

    def now(self) -> float:
        """See Clock.now."""
        return self.time_s

    def sleep(self, seconds: float) -> None:
        """See Clock.sleep."""
        self.time_s = self.after(seconds)

    def after(self, seconds: float) -> float:
        """The time in so many seconds: later than now even where the sum rounds to now."""
        return max(self.time_s + seconds, math.nextafter(self.time_s, math.inf)) if seconds > 0 else self.time_s


class LoopbackPort:
    """See Port; the other end is a Station. `adapter_present` False: the USB adapter itself is pulled."""

    has_speeds = True

    def __init__(
        self, station: Station, clock: JumpingClock, adapter_present: Callable[[], bool] = lambda: True, has_break: bool = True
    ) -> None:
        self.station, self.clock, self.adapter_present, self.has_break = station, clock, adapter_present, has_break
        self.speed = 9600
        self.pending = b""
        self.exchanges = 0
        self._check()

    def _check(self) -> None:
        if not self.adapter_present():
            raise PortLostError("the emulated adapter is gone")

    def write(self, data: bytes) -> None:
        """See Port.write."""
        self._check()
        self.exchanges += 1
        self.clock.sleep(len(data) * 10 / self.speed)
        self.station.receive(data, self.speed, self.clock.now())

    def read(self, timeout_s: float) -> bytes:
        """See Port.read."""
        until_s = self.clock.after(timeout_s)
        while True:
            self._check()
            self.pending += self.station.take_due(self.clock.now(), self.speed)
            if self.pending:
                data, self.pending = self.pending, b""
                return data
            wakes = self.station.wakes_at_s()
            if self.clock.now() >= until_s:
                return b""
            soon = until_s if wakes is None else min(until_s, max(wakes, self.clock.now() + 1e-6))
            self.clock.time_s = min(soon, self.clock.now() + 0.05)

    def flush_input(self) -> None:
        """See Port.flush_input."""
        self._check()
        self.station.take_due(self.clock.now(), self.speed)
        self.pending = b""

    def set_speed(self, baud: int) -> None:
        """See Port.set_speed."""
        self._check()
        self.speed = baud

    def send_break(self) -> None:
        """See Port.send_break."""
        self._check()
        self.clock.sleep(0.3)
        if self.has_break and not self.station.cable_out(self.clock.now()):
            self.station.reset(self.clock.now())

    def close(self) -> None:
        """See Port.close."""
