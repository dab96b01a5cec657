"""A simulated set-up in the units that its lines are made in: microseconds, megahertz and millimetres."""

from __future__ import annotations

from CranioNavLib.sequence_metafile import Acquisition


class InMicroseconds:
    """What has an acquisition."""

    acquisition: Acquisition

    @property
    def centre_mhz(self) -> float:
        """The transducer's frequency as the header states it."""
        return self.acquisition.transducer_hz * 1e-6

    @property
    def sampling_mhz(self) -> float:
        """Samples a microsecond."""
        return self.acquisition.sampling_hz * 1e-6


class ThroughScalp:
    """What has a speed of sound in the scalp."""

    speed_m_s: float

    @property
    def mm_us(self) -> float:
        """Speed of sound in the scalp."""
        return self.speed_m_s * 1e-3
