"""An A-mode device behind a port: what all such drivers do alike when the port opens, fails and comes back."""

from __future__ import annotations

import queue
import time
from abc import abstractmethod
from collections import Counter
from typing import Any, Optional

from ModuleUltrasoundLib.devices.connection import ByteLink, DeviceState, LinkLostError
from ModuleUltrasoundLib.devices.device import AModeDevice, DeviceError, RfLine

RETRY_S = 1.0  # between two attempts to reach a lost device


class LinkedDevice(AModeDevice):
    """Base of drivers over a `ByteLink`.

    A port that vanishes raises DeviceError once; from then on `state` is LOST, `read` returns None and tries
    to reach the device again, and goes on with lines when it is back. `counters` tells what was dropped and why.
    """

    def __init__(self, settings: Any = None) -> None:
        super().__init__(settings)
        self.state = DeviceState.CLOSED
        self.counters: Counter[str] = Counter()
        self._link: Optional[ByteLink] = None
        self._retry_at = 0.0
        self._wanted_gain: queue.Queue[float] = queue.Queue()

    @abstractmethod
    def _connect(self) -> ByteLink:
        """Open the port, find the device behind it and set it up."""

    @abstractmethod
    def _begin(self) -> None:
        """Make the device take lines."""

    @abstractmethod
    def _end(self) -> None:
        """Make the device stop taking lines."""

    @abstractmethod
    def _next_line(self, timeout_s: float) -> Optional[RfLine]:
        """The next good line, or None if none came in time."""

    @abstractmethod
    def _apply_gain(self, gain_db: float) -> None:
        """Set the receiver's gain on the device."""

    def set_gain_db(self, gain_db: float) -> None:
        """Change the gain before the next line. May be called from any thread: `read` applies it."""
        self._wanted_gain.put(float(gain_db))

    @property
    def link(self) -> ByteLink:
        """The open port.

        Raises
        ------
        DeviceError
            The device is not open.
        """
        if self._link is None:
            raise DeviceError(f"the {self.name} device is not open; open it first")
        return self._link

    def open(self) -> None:
        """Connect and set the device up."""
        if self.state in (DeviceState.CONNECTED, DeviceState.RUNNING):
            return
        self._link = None
        try:
            self._link = self._connect()
        except BaseException:
            self.close()
            raise
        self.state = DeviceState.CONNECTED

    def start(self) -> None:
        """Begin to take lines."""
        if self.state is DeviceState.CONNECTED:
            self._begin()
            self.state = DeviceState.RUNNING

    def read(self, timeout_s: float = 1.0) -> Optional[RfLine]:
        """The next line; None if none came in time, or while a lost device is away.

        Raises
        ------
        DeviceError
            The device was lost just now, or was never started.
        """
        if self.state is DeviceState.LOST and not self._came_back(timeout_s):
            return None
        if self.state is not DeviceState.RUNNING:
            raise DeviceError(f"the {self.name} device is {self.state.value}; open and start it before reading lines")
        try:
            while not self._wanted_gain.empty():
                self._apply_gain(self._wanted_gain.get_nowait())
            line = self._next_line(timeout_s)
        except LinkLostError:
            self._drop()
            self.counters["lost"] += 1
            self.state, self._retry_at = DeviceState.LOST, time.monotonic() + RETRY_S
            raise
        return line

    def stop(self) -> None:
        """End taking lines; may be called twice."""
        if self.state is DeviceState.RUNNING:
            self.state = DeviceState.CONNECTED
            try:
                self._end()
            except DeviceError:
                self.counters["failed stops"] += 1  # the port is gone or silent: there is nothing left to stop

    def close(self) -> None:
        """Let go of the device; may be called twice, and after a failure."""
        self._drop()
        self.state = DeviceState.CLOSED

    def _drop(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _came_back(self, timeout_s: float) -> bool:
        wait = self._retry_at - time.monotonic()
        if wait > 0:
            time.sleep(min(wait, timeout_s))
        if time.monotonic() < self._retry_at:
            return False
        self._retry_at = time.monotonic() + RETRY_S
        try:
            self._link = self._connect()
            self._begin()
        except DeviceError:
            self._drop()
            return False
        self.counters["reconnects"] += 1
        self.state = DeviceState.RUNNING
        return True
