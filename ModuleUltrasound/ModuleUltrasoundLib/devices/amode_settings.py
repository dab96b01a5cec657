"""The parameters that every A-mode pulser/receiver has in common. A driver's Settings add its own."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Optional

from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.sequence_metafile import Acquisition


class Trigger(str, Enum):
    """What fires the transmit pulse."""

    FREE = "free"  # the device, at its own rate
    SOFTWARE = "software"  # the computer, one line a request
    EXTERNAL = "external"  # a signal at the device's trigger input


@dataclass(frozen=True)
class AModeSettings(Parameters):
    """Gain, delay, range, sampling, averaging and trigger, and what the lines are to be read with."""

    gain_db: Annotated[float, Limits(-20, 120), "receiver gain"] = 30.0
    delay_us: Annotated[float, Limits(0, 1000), "from the transmit pulse to the first sample kept"] = 0.0
    range_us: Annotated[float, Limits(1, 1000), "length of a line"] = 60.0
    sampling_hz: Annotated[Optional[float], Limits(1e6, 1e9), "sampling rate; none: the device's own"] = None
    averaging: Annotated[int, Limits(1, 64), "shots averaged into one line"] = 1
    trigger: Annotated[Trigger, "what fires the transmit pulse"] = Trigger.FREE
    transducer_hz: Annotated[float, Limits(5e5, 5e7), "centre frequency of the transducer"] = 5e6
    forerun_length_mm: Annotated[float, Limits(0, 100), "delay line between transducer and skin; 0: none"] = 0.0
    forerun_speed_m_s: Annotated[float, Limits(0, 7000), "speed of sound in the delay line; 0: none"] = 0.0

    def acquisition(self, sampling_hz: float) -> Acquisition:
        """How lines sampled at `sampling_hz` were taken."""
        return Acquisition(sampling_hz, self.transducer_hz, self.forerun_length_mm, self.forerun_speed_m_s)
