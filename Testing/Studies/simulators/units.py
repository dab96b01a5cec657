"""Frequencies of a simulated set-up in the units that its lines are made in: microseconds and megahertz."""

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
