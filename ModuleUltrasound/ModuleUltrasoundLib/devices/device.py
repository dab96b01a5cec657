"""The A-mode device plugin kind: a pulser/receiver that gives RF lines."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.device_plugin import DevicePlugin
from CranioNavLib.plugins import PluginKind
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


class AModeDevice(DevicePlugin):
    """Base of A-mode device plugins. `with device:` opens, starts and always closes.

    All methods are called from one thread. They raise `DeviceError` for what the device does and
    `InputError` for what the user gave.
    """

    @abstractmethod
    def read(self, timeout_s: float = 1.0) -> Optional[RfLine]:
        """The next line, or None if none came in time."""

    @property
    @abstractmethod
    def acquisition(self) -> Acquisition:
        """Sampling rate, transducer frequency and forerun of the lines; known after `open`."""


AMODE_DEVICES: PluginKind[AModeDevice] = PluginKind("amode", AModeDevice, folder="ModuleUltrasoundLib.plugins")  # type: ignore[type-abstract]
