"""A-mode recordings and pose recordings as PLUS/IGSIO sequence metafiles (.igs.mha).

One RF line a frame (`DimSize = N 1 F`, MET_SHORT), with pose, status and time as text fields of each frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from CranioNavLib.rigid import Array


@dataclass(frozen=True)
class Acquisition:
    """How the RF lines of a recording or device were taken."""

    sampling_hz: float
    transducer_hz: float
    forerun_length_mm: float = 0.0  # delay line between transducer and skin; 0: none
    forerun_speed_m_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Recording:
    """A-lines with the probe's pose. F frames of N samples; N is 0 in a recording of poses only."""

    lines: npt.NDArray[np.int16]  # (F, N)
    acquisition: Acquisition
    probe_to_reference: Array  # (F, 4, 4) mm; NaN where the status is not OK
    statuses: tuple[str, ...]  # F times OK, INVALID, MISSING, OUT_OF_VIEW...; MISSING when the file has none
    timestamps_s: Array  # (F,)
    palpation_points: npt.NDArray[np.int64]  # (F,) which point of the protocol; -1: none given
    other_transforms: dict[str, Array] = field(default_factory=dict)  # further streams, e.g. "StylusToReference": (F, 4, 4)

    def __len__(self) -> int:
        return len(self.lines)
