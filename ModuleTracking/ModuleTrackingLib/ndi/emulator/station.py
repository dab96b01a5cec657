"""The emulated device on its line: speeds that must match, replies that take time, and the faults between."""

from __future__ import annotations

import heapq
from typing import Optional

from CranioNavLib.errors import InputError

from ModuleTrackingLib.ndi.emulator.device import EmulatedPolaris
from ModuleTrackingLib.ndi.emulator.faults import Faults, garble

BITS_A_BYTE = 10  # start bit, eight data bits, stop bit
CONTROL_HELP = "fault NAME[=NUMBER[:NUMBER]] | clear [NAME] | reset | unplug SECONDS"


class Station:
    """A device, its faults and the bytes on their way to the host. Time is given from outside (s)."""

    def __init__(self, device: EmulatedPolaris, paced: bool = False) -> None:
        self.device, self.faults, self.paced = device, device.faults, paced
        self._waiting: list[tuple[float, int, bytes, int]] = []  # due, order, bytes, speed
        self._sent = 0
        self._line_free_s = 0.0
        self._brown_outs = 0
        self._started_s: Optional[float] = None
        self._unplugged_until_s = 0.0

    def receive(self, data: bytes, host_speed: Optional[int], now_s: float) -> None:
        """Bytes from the host, sent at `host_speed` (None: a line without speeds)."""
        self.tick(now_s)
        if self.cable_out(now_s) or host_speed not in (None, self.device.speed):
            return
        speed = self.device.speed
        for reply in self.device.receive(data, now_s):
            delay_s, spoilt = self.faults.spoil(reply)
            self._send(spoilt, now_s + delay_s, speed)

    def tick(self, now_s: float) -> None:
        """Let time pass: power failures strike, and a booted device announces itself."""
        if self._started_s is None:
            self._started_s = now_s
        brown_outs = self.faults.brown_outs(now_s - self._started_s)
        if brown_outs > self._brown_outs:
            self.device.power_cycle(now_s)
            self._waiting.clear()
        self._brown_outs = brown_outs
        for message in self.device.booted(now_s):
            self._send(message, now_s, self.device.speed)

    def take_due(self, now_s: float, host_speed: Optional[int] = None) -> bytes:
        """What reaches the host now; noise, where it listens at another speed."""
        self.tick(now_s)
        data = b""
        while self._waiting and self._waiting[0][0] <= now_s:
            _, _, piece, speed = heapq.heappop(self._waiting)
            data += piece if host_speed in (None, speed) else garble(piece, self.faults.rng)
        return b"" if self.cable_out(now_s) else data

    def wakes_at_s(self) -> Optional[float]:
        """When `take_due` should be asked next, if nothing is received before."""
        times = [time for time in (self._waiting[0][0] if self._waiting else None, self.device.wakes_at_s) if time is not None]
        return min(times, default=None)

    def cable_out(self, now_s: float) -> bool:
        """Whether nothing passes, by a fault or by `unplug`."""
        started = self._started_s if self._started_s is not None else now_s
        return now_s < self._unplugged_until_s or self.faults.cable_out(now_s - started)

    def reset(self, now_s: float) -> None:
        """Break, by side channel: a pseudo-terminal carries none."""
        self._waiting.clear()
        self.device.power_cycle(now_s)

    def hang_up(self) -> None:
        """The host closed the line: the device starts afresh, and nothing is left for the next host to read."""
        self._waiting.clear()
        self.device.start_afresh()

    def unplug(self, now_s: float, seconds: float) -> None:
        """Take the cable out for a while."""
        self._waiting.clear()
        self._unplugged_until_s = now_s + seconds

    def control(self, line: str, now_s: float) -> str:
        """Do what a line of the side channel says, and answer it in one line."""
        verb, _, rest = line.strip().partition(" ")
        try:
            if verb == "fault":
                self.faults.switch_on(rest)
            elif verb == "clear":
                self.faults.switch_off(rest.strip())
            elif verb == "reset":
                self.reset(now_s)
            elif verb == "unplug":
                self.unplug(now_s, float(rest or 2.0))
            else:
                return f"unknown {verb!r}; known: {CONTROL_HELP}"
        except (InputError, ValueError) as error:
            return f"refused: {error}"
        return f"done: {line.strip()}"

    def _send(self, data: bytes, when_s: float, speed: int) -> None:
        if self.paced:
            when_s = max(when_s, self._line_free_s) + len(data) * BITS_A_BYTE / speed
            self._line_free_s = when_s
        self._sent += 1
        if data:
            heapq.heappush(self._waiting, (when_s, self._sent, data, speed))


def make_faults(specs: list[str], seed: int = 0) -> Faults:
    """Faults switched on from `NAME[=NUMBER[:NUMBER]]` texts."""
    faults = Faults(seed)
    for spec in specs:
        faults.switch_on(spec)
    return faults
