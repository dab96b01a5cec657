"""OpenIGTLink messages as plain values; what goes over the wire is codec.py's matter.

Matrices are 4x4, act on column vectors, in mm; which frames they connect is told by the device name
(`ProbeToReference`). Times are Unix seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Optional

import numpy as np
import numpy.typing as npt

from CranioNavLib.rigid import Array

STATUS_WORDS = {
    0: "invalid packet",
    1: "OK",
    2: "unknown error",
    3: "panic",
    4: "not found",
    5: "access denied",
    6: "busy",
    7: "time-out",
    8: "overflow",
    9: "checksum error",
    10: "configuration error",
    11: "not enough resources",
    12: "unknown instruction",
    13: "not ready",
    14: "manual mode",
    15: "disabled",
    16: "not present",
    17: "unknown version",
    18: "hardware failure",
    19: "shutting down",
}


@dataclass(frozen=True, eq=False)
class Message:
    """What all messages have. `time_s` 0 means that the sender gave none."""

    device: str
    time_s: float = 0.0
    metadata: dict[str, str] = field(default_factory=dict)  # header version 2 only


@dataclass(frozen=True, eq=False)
class Transform(Message):
    """TRANSFORM: one matrix, as sent; it may not be rigid."""

    matrix: Array = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, eq=False)
class Position(Message):
    """POSITION: a position in mm and a quaternion."""

    position_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class TrackedTool:
    """One tool of TDATA. `kind`: 1 tracker, 2 six degrees of freedom, 3 position only, 4 five degrees."""

    name: str
    matrix: Array
    kind: int = 2


@dataclass(frozen=True, eq=False)
class TrackingData(Message):
    """TDATA, and QTDATA decoded to matrices: the tools that are seen. A tool that is missing is not in it."""

    tools: tuple[TrackedTool, ...] = ()


@dataclass(frozen=True, eq=False)
class StartTracking(Message):
    """STT_TDATA (or STT_QTDATA): please send tracking data, at most one in `interval_ms` (0: all)."""

    interval_ms: int = 0
    coordinate_name: str = ""


@dataclass(frozen=True, eq=False)
class StopTracking(Message):
    """STP_TDATA: please stop sending tracking data."""


@dataclass(frozen=True, eq=False)
class TrackingReply(Message):
    """RTS_TDATA: whether the request was granted."""

    granted: bool = True


@dataclass(frozen=True, eq=False)
class Image(Message):
    """IMAGE: voxels with axes (k, j, i) or (k, j, i, components). An A-line of N samples is (1, 1, N) int16."""

    voxels: npt.NDArray[Any] = field(default_factory=lambda: np.zeros((1, 1, 1), dtype=np.int16))
    ijk_to_ras: Array = field(default_factory=lambda: np.eye(4))  # of voxel centres; voxel (0, 0, 0) maps to its translation


@dataclass(frozen=True, eq=False)
class NdArray(Message):
    """NDARRAY: numbers of any shape."""

    values: npt.NDArray[Any] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class String(Message):
    """STRING: a text."""

    text: str = ""


@dataclass(frozen=True, eq=False)
class Status(Message):
    """STATUS: how the device is. Code 1 is OK; see STATUS_WORDS."""

    code: int = 1
    sub_code: int = 0
    error_name: str = ""
    text: str = ""

    @property
    def words(self) -> str:
        """The state for a person."""
        return ": ".join(part for part in (STATUS_WORDS.get(self.code, f"code {self.code}"), self.text) if part)


@dataclass(frozen=True, eq=False)
class GetStatus(Message):
    """GET_STATUS: how are you?"""


@dataclass(frozen=True, eq=False)
class GetCapability(Message):
    """GET_CAPABIL: which types do you speak?"""


@dataclass(frozen=True, eq=False)
class Capability(Message):
    """CAPABILITY: the types that a peer speaks."""

    types: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Unknown(Message):
    """A type that this codec does not speak; its body is left alone."""

    type_name: str = ""
    size: int = 0


@dataclass(frozen=True, eq=False)
class Rejected(Message):
    """A message that was not believed: a wrong CRC, or a body that does not fit its type."""

    type_name: str = ""
    reason: str = ""
    crc_error: bool = False


def a_line_image(device: str, samples: npt.NDArray[np.int16], time_s: float, spacing_mm: Optional[float] = None) -> Image:
    """One RF line as the IMAGE message that 3D Slicer shows: N x 1 x 1, int16, RAS.

    `spacing_mm` is the depth a sample stands for (c / 2 fs); 1 when None.
    """
    matrix = np.diag([1.0 if spacing_mm is None else spacing_mm, 1.0, 1.0, 1.0])
    return Image(device, time_s, voxels=np.asarray(samples, dtype="<i2").reshape(1, 1, -1), ijk_to_ras=matrix)
