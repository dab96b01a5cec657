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
    quaternion: Optional[tuple[float, float, float, float]] = None  # scalar first, with the sign that the table gives it


def read_pose_csv(path: str | Path) -> list[list[PoseRow]]:
    """Frames in order of time; a frame is all rows of one time stamp. Columns may stand in any order, rows too.

    Raises
    ------
    InputError
        Missing file or columns, no row, a row that cannot be read (the message gives its line), or a tool twice at one time.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            names = [name.strip() for name in next(reader, [])]
            missing = [name for name in COLUMNS if name not in names]
            if missing:
                raise InputError(f"{path}: not a pose table; its first line must be {','.join(COLUMNS)}; missing: {missing[0]}")
            order = [names.index(name) for name in COLUMNS]
            rows = [_parse(path, reader.line_num, cells, order) for cells in reader if any(map(str.strip, cells))]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file"
        raise InputError(
            f"{path}: cannot be read ({reason}); give a pose table (.csv) as `tracker record --csv` writes"
        ) from None
    if not rows:
        raise InputError(f"{path}: holds no pose; record again")
    frames: dict[float, dict[str, PoseRow]] = {}
    for row in rows:
        frame = frames.setdefault(row.timestamp_s, {})
        if row.tool in frame:
            raise InputError(f"{path}: tool {row.tool!r} stands twice at {row.timestamp_s} s; leave one row of them out")
        frame[row.tool] = row
    return [list(frames[time_s].values()) for time_s in sorted(frames)]


def _parse(path: Path, line: int, cells: list[str], order: list[int]) -> PoseRow:
    texts = [cells[index].strip() if index < len(cells) else "" for index in order]
    tool, status = texts[1], texts[2].upper()
    if status == "OK" and len(cells) <= max(order):  # a tool without pose needs no more columns
        raise InputError(f"{path}, line {line}: {len(cells)} columns, expected {max(order) + 1}")
    if not tool:
        raise InputError(f"{path}, line {line}: no tool is named")
    try:
        time = _finite(float(texts[0]))
        if status != "OK":
            known = status in PoseStatus.__members__
            return PoseRow(time, tool, PoseStatus(status) if known else PoseStatus.MISSING, None, math.nan)
        error = float(texts[10]) if texts[10] else math.nan
        w, x, y, z, *origin = (_finite(float(text)) for text in texts[3:10])
    except ValueError:
        raise InputError(
            f"{path}, line {line}: a number is missing or cannot be read; a tool without pose has status MISSING"
        ) from None
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if abs(length - 1) > QUATERNION_TOLERANCE:
        raise InputError(f"{path}, line {line}: the quaternion has length {length:.3f}, expected 1")
    if max(map(abs, origin)) > LARGEST_COORDINATE_MM:
        raise InputError(f"{path}, line {line}: the tool is more than 100 m away; positions are expected in mm")
    quaternion = (w / length, x / length, y / length, z / length)
    return PoseRow(time, tool, PoseStatus.OK, rigid(quaternion_matrix(quaternion), origin), error, quaternion)


def quaternion_matrix(quaternion: tuple[float, float, float, float]) -> Array:
    """The rotation (3, 3) of a quaternion of length 1, scalar first."""
    w, x, y, z = quaternion
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("not finite")
    return value


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
