"""A simulated A-mode probe: it hears the head of the simulated session wherever the simulated hand holds it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.phantom.session import SimulatedSession, current_session
from CranioNavLib.sequence_metafile import Acquisition

from ModuleUltrasoundLib.device import AMODE_DEVICES, AModeDevice, DeviceError, RfLine


class Head(str, Enum):
    """Which head lies on the simulated table, if no session runs yet."""

    SAMPLE = "sample"
    SYNTHETIC = "synthetic"


@dataclass(frozen=True)
class SimulatedAModeSettings(Parameters):
    rate_hz: Annotated[float, Limits(1, 1000), "lines a second"] = 40.0
    lost_share: Annotated[float, Limits(0, 1), "share of lines that never arrive"] = 0.0
    fail_after_s: Annotated[Optional[float], Limits(0, 1e6), "the link breaks after this time; not given: never"] = None
    head: Annotated[Head, "head on the table if no session runs yet"] = Head.SAMPLE
    seed: Annotated[int, Limits(0, 2**31), "of the session, if none runs yet, and of lost lines"] = 0


@AMODE_DEVICES.register
class SimulatedAMode(AModeDevice):
    """The probe of the simulated session (see CranioNavLib.phantom.session)."""

    name = "simulated"
    title = "Simulated A-mode probe on the simulated patient"
    Settings = SimulatedAModeSettings

    def __init__(self, settings: Optional[Parameters] = None) -> None:
        super().__init__(settings)
        self._session: Optional[SimulatedSession] = None
        self._rng = np.random.default_rng([self.settings.seed, 0x7D])
        self._begin_s: Optional[float] = None  # not None: lines are taken
        self._line = 0

    def open(self) -> None:
        """Join the simulated session.

        Raises
        ------
        InputError
            The sample head is wanted and cannot be had.
        """
        self._session = current_session(self.settings.head.value, self.settings.seed)

    def start(self) -> None:
        """Begin to take lines.

        Raises
        ------
        DeviceError
            It is not open.
        """
        if self._session is None:
            raise DeviceError("the simulated probe is not open; open it first")
        self._begin_s, self._line = self._session.clock.now(), 0

    def read(self, timeout_s: float = 1.0) -> Optional[RfLine]:
        """The next line, when it is due.

        Raises
        ------
        DeviceError
            It was not started, or the simulated link broke.
        """
        if self._session is None or self._begin_s is None:
            raise DeviceError("the simulated probe takes no lines; start it first")
        clock, period = self._session.clock, 1 / self.settings.rate_hz
        limit = self.settings.fail_after_s
        if limit is not None and clock.now() - self._begin_s >= limit:
            raise DeviceError("the link to the simulated probe broke; open it again")
        self._line = max(self._line + 1, int(np.ceil((clock.now() - self._begin_s) / period - 1e-6)))
        while self._rng.random() < self.settings.lost_share:
            self._line += 1
        due = self._begin_s + self._line * period
        if due - clock.now() > timeout_s:
            clock.wait_until(clock.now() + timeout_s)
            self._line -= 1
            return None
        clock.wait_until(due)
        samples = self._session.rf_line(due)
        return RfLine(samples, due, self._line, self._saturated(samples))

    def stop(self) -> None:
        """End taking lines."""
        self._begin_s = None

    def close(self) -> None:
        """Leave the session; it goes on for the other simulated device."""
        self._begin_s = self._session = None

    def _saturated(self, samples: npt.NDArray[np.int16]) -> bool:
        """Whether an echo stands at the end of the converter's range; the main bang always does and is left out."""
        flight_s = 1e-3 * self.acquisition.forerun_length_mm / self.acquisition.forerun_speed_m_s  # half way to the skin
        echoes = samples[int(flight_s * self.acquisition.sampling_hz) :]
        low, high = SimulatedSession.CONVERTER_RANGE
        return bool(echoes.min() <= low or echoes.max() >= high)

    @property
    def acquisition(self) -> Acquisition:
        if self._session is None:
            raise DeviceError("the simulated probe is not open; open it first")
        return self._session.acquisition
