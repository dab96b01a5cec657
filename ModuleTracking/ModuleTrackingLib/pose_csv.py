"""Tool poses as a table: `timestamp_s,tool,status,qw,qx,qy,qz,tx_mm,ty_mm,tz_mm,error_mm`, in the Tracker frame."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import LARGEST_COORDINATE_MM, Array, rigid
from scipy.spatial.transform import Rotation

from ModuleTrackingLib.tracker import PoseStatus, ToolPose

COLUMNS = ("timestamp_s", "tool", "status", "qw", "qx", "qy", "qz", "tx_mm", "ty_mm", "tz_mm", "error_mm")
QUATERNION_TOLERANCE = 0.01  # four decimals a component give 1e-4; a length off by more is no rotation


@dataclass(frozen=True, eq=False)
class PoseRow:
    """One tool at one time of a recording."""

    timestamp_s: float
    tool: str
    status: PoseStatus
    tool_to_tracker: Optional[Array]  # (4, 4) mm; None unless OK
    error_mm: float


def read_pose_csv(path: str | Path) -> list[list[PoseRow]]:
    """Frames in order of time; a frame is all rows of one time stamp.

    Raises
    ------
    InputError
        Missing file, other columns, no row, or a row that cannot be read; the message gives its line.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            if tuple(header) != COLUMNS:
                raise InputError(f"{path}: not a pose table; its first line must be {','.join(COLUMNS)}")
            rows = [_parse(path, reader.line_num, cells) for cells in reader if cells]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise InputError(f"{path}: cannot be read ({reason}); give a pose table (.csv)") from None
    if not rows:
        raise InputError(f"{path}: holds no pose; record again")
    frames: list[list[PoseRow]] = []
    for row in rows:
        if frames and row.timestamp_s < frames[-1][0].timestamp_s:
            raise InputError(f"{path}: time goes back at {row.timestamp_s} s; rows must be in order of time")
        if frames and row.timestamp_s == frames[-1][0].timestamp_s:
            frames[-1].append(row)
        else:
            frames.append([row])
    return frames


def _parse(path: Path, line: int, cells: list[str]) -> PoseRow:
    if len(cells) != len(COLUMNS):
        raise InputError(f"{path}, line {line}: {len(cells)} columns, expected {len(COLUMNS)}")
    tool, status = cells[1].strip(), cells[2].strip().upper()
    try:
        time, error = float(cells[0]), float(cells[10]) if cells[10].strip() else math.nan
        if status != "OK":
            known = status in PoseStatus.__members__
            return PoseRow(_finite(time), tool, PoseStatus(status) if known else PoseStatus.MISSING, None, math.nan)
        quaternion, origin = np.array(cells[3:7], dtype=float), np.array(cells[7:10], dtype=float)
        _finite(time, *quaternion, *origin)
    except ValueError:
        raise InputError(
            f"{path}, line {line}: a number is missing or cannot be read; a tool without pose has status MISSING"
        ) from None
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > QUATERNION_TOLERANCE:
        raise InputError(f"{path}, line {line}: the quaternion has length {length:.3f}, expected 1")
    if np.abs(origin).max() > LARGEST_COORDINATE_MM:
        raise InputError(f"{path}, line {line}: the tool is more than 100 m away; positions are expected in mm")
    return PoseRow(time, tool, PoseStatus.OK, rigid(Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix(), origin), error)


def _finite(*values: float) -> float:
    if not all(math.isfinite(value) for value in values):
        raise ValueError("not finite")
    return values[0]


class PoseCsvWriter:
    """A pose table that grows row by row; every frame is on its way to the disk before `write` returns."""

    def __init__(self, path: str | Path) -> None:
        try:
            self._file = Path(path).open("w", newline="", encoding="utf-8")  # noqa: SIM115 - closed by `close`
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}; choose a folder that exists and is writable") from None
        self._file.write(",".join(COLUMNS) + "\n")

    def write(self, timestamp_s: float, poses: Iterable[ToolPose]) -> None:
        """Add one frame. A tool that is not OK gets MISSING and no numbers."""
        for pose in poses:
            self._file.write(",".join(_cells(timestamp_s, pose)) + "\n")
        self._file.flush()

    def close(self) -> None:
        """May be called twice."""
        self._file.close()

    def __enter__(self) -> PoseCsvWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _cells(timestamp_s: float, pose: ToolPose) -> list[str]:
    start = [f"{timestamp_s:.6f}", pose.tool]
    if not pose.usable or pose.tool_to_tracker is None:
        return [*start, "MISSING", *[""] * 8]
    x, y, z, w = Rotation.from_matrix(pose.tool_to_tracker[:3, :3]).as_quat()
    numbers = [w, x, y, z, *pose.tool_to_tracker[:3, 3]]
    error = "" if math.isnan(pose.error_mm) else f"{pose.error_mm:.4f}"
    return [*start, "OK", *(f"{value:.9g}" for value in numbers), error]
