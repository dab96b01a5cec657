"""The base of plugins that stand for a device: opened, started, read, stopped, and always closed."""

from __future__ import annotations

from abc import abstractmethod
from types import TracebackType
from typing import TypeVar

from CranioNavLib.plugins import Plugin

D = TypeVar("D", bound="DevicePlugin")


class DevicePlugin(Plugin):
    """A device; each kind's base adds what is read from it. `with device:` opens, starts and always closes."""

    @abstractmethod
    def open(self) -> None:
        """Connect and set the device up."""

    @abstractmethod
    def start(self) -> None:
        """Begin to measure."""

    @abstractmethod
    def stop(self) -> None:
        """End measuring; may be called twice."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the device; may be called twice, and after a failure."""

    def __enter__(self: D) -> D:
        try:
            self.open()
            self.start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self.stop()
        finally:
            self.close()
