"""The A-mode device plugin kind: a pulser/receiver that gives RF lines."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from types import TracebackType
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.plugins import Plugin, PluginKind
from CranioNavLib.sequence_metafile import Acquisition


@dataclass(frozen=True, eq=False)
class RfLine:
    """One RF line as it came. Time zero is the transmit pulse."""

    samples: npt.NDArray[np.int16]  # (N,)
    host_time_s: float  # time.monotonic() clock of this computer, at the transmit pulse
    sequence_number: int = -1
    saturated: bool = False  # a sample stands at the end of the converter's range
    gain_db: float = float("nan")


class DeviceError(RuntimeError):
    """The pulser/receiver failed or was lost; the message says what happened and what to do."""


class AModeDevice(Plugin):
    """Base of A-mode device plugins. `with device:` opens, starts and always closes.

    All methods are called from one thread. They raise `DeviceError` for what the device does and
    `InputError` for what the user gave.
    """

    @abstractmethod
    def open(self) -> None:
        """Connect and set the device up."""

    @abstractmethod
    def start(self) -> None:
        """Begin to take lines."""

    @abstractmethod
    def read(self, timeout_s: float = 1.0) -> Optional[RfLine]:
        """The next line, or None if none came in time."""

    @abstractmethod
    def stop(self) -> None:
        """End taking lines; may be called twice."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the device; may be called twice, and after a failure."""

    @property
    @abstractmethod
    def acquisition(self) -> Acquisition:
        """Sampling rate, transducer frequency and forerun of the lines; known after `open`."""

    def __enter__(self) -> AModeDevice:
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


AMODE_DEVICES: PluginKind[AModeDevice] = PluginKind("amode", AModeDevice, folder="ModuleUltrasoundLib.plugins")  # type: ignore[type-abstract]
