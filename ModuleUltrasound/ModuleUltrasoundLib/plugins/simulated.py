"""A simulated A-mode probe: it hears the head of the simulated session wherever the simulated hand holds it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.phantom.session import SimulatedSession
from CranioNavLib.phantom.simulated_device import Head, SimulatedDevice
from CranioNavLib.sequence_metafile import Acquisition

from ModuleUltrasoundLib.devices.device import AMODE_DEVICES, AModeDevice, DeviceError, RfLine


@dataclass(frozen=True)
class SimulatedAModeSettings(Parameters):
    rate_hz: Annotated[float, Limits(1, 1000), "lines a second"] = 40.0
    lost_share: Annotated[float, Limits(0, 0.99), "share of lines that never arrive"] = 0.0
    fail_after_s: Annotated[Optional[float], Limits(0, 1e6), "the link breaks after this time; not given: never"] = None
    head: Annotated[Head, "head on the table if no session runs yet"] = Head.SAMPLE
    seed: Annotated[int, Limits(0, 2**31), "of the session, if none runs yet, and of lost lines"] = 0


@AMODE_DEVICES.register
class SimulatedAMode(SimulatedDevice, AModeDevice):
    """The probe of the simulated session (see CranioNavLib.phantom.session)."""

    name = "simulated"
    title = "Simulated A-mode probe on the simulated patient"
    Settings = SimulatedAModeSettings
    device, idle, failure = "simulated probe", "takes no lines", DeviceError

    def __init__(self, settings: Optional[Parameters] = None) -> None:
        super().__init__(settings)
        self._rng = np.random.default_rng([self.settings.seed, 0x7D])

    def read(self, timeout_s: float = 1.0) -> Optional[RfLine]:
        """The next line, when it is due.

        Raises
        ------
        DeviceError
            It was not started, or the simulated link broke.
        """
        session, _ = self._started()
        lost = 0
        while self._rng.random() < self.settings.lost_share:
            lost += 1
        due = self._await_next(timeout_s, lost)
        if due is None:
            return None
        samples = session.rf_line(due)
        return RfLine(samples, due, self._number, self._saturated(samples))

    def _saturated(self, samples: npt.NDArray[np.int16]) -> bool:
        """Whether an echo stands at the end of the converter's range; the main bang always does and is left out."""
        flight_s = 1e-3 * self.acquisition.forerun_length_mm / self.acquisition.forerun_speed_m_s  # half way to the skin
        echoes = samples[int(flight_s * self.acquisition.sampling_hz) :]
        low, high = SimulatedSession.CONVERTER_RANGE
        return bool(echoes.min() <= low or echoes.max() >= high)

    @property
    def acquisition(self) -> Acquisition:
        return self._joined().acquisition
