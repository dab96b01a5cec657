"""What a recording is in memory: A-lines and tool poses over time."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from CranioNavLib.rigid import Array


@dataclass(frozen=True)
class Acquisition:
    """How the RF lines of a recording or device were taken. NaN rates: a recording of poses only."""

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
    statuses: tuple[str, ...]  # F times OK, INVALID, MISSING, OUT_OF_VIEW...; INVALID too where the line itself is
    timestamps_s: Array  # (F,)
    palpation_points: npt.NDArray[np.int64]  # (F,) which point of the protocol; -1: none given
    other_transforms: dict[str, Array] = field(default_factory=dict)  # further streams, e.g. "StylusToReference": (F, 4, 4)
    other_statuses: dict[str, tuple[str, ...]] = field(default_factory=dict)  # the statuses of those streams
    fields: dict[str, str] = field(default_factory=dict)  # further global fields of the file, as text

    def __len__(self) -> int:
        return len(self.lines)


def pixels_beside(path: str | Path) -> Path:
    """Where RecordingWriter keeps the pixels of the recording `path` until it is closed."""
    path = Path(path)
    stem = re.sub(r"(\.igs|\.seq)?\.mha$", "", path.name)
    return path.with_name(f"{stem}.part.raw")
