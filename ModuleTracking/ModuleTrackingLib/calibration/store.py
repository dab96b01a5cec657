"""A tool's calibration on disk: with the tool it belongs to, its date and its error; refused for any other tool."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.files import write_text
from CranioNavLib.rigid import Array, check_rigid

SAME_GEOMETRY_MM = 0.1  # tool definition files state marker positions to 0.01 mm; a bent or exchanged marker is off by more


@dataclass(frozen=True, eq=False)
class ToolGeometry:
    """What tells a tool from another: its identity and, where known, where its markers are."""

    tool_id: str  # part and serial number, or the name of its definition file
    markers_mm: Array  # (M, 3) marker positions in the tool's own frame; (0, 3): not known

    @classmethod
    def of(cls, tool_id: str, markers_mm: Optional[npt.ArrayLike] = None) -> ToolGeometry:
        """From an identity and marker positions, if known."""
        return cls(tool_id, np.zeros((0, 3)) if markers_mm is None else np.asarray(markers_mm, dtype=float).reshape(-1, 3))

    def difference(self, other: ToolGeometry) -> str:
        """In words, how `other` is another tool; empty if it is the same."""
        if self.tool_id != other.tool_id:
            return f"it is of tool {self.tool_id!r}, this is {other.tool_id!r}"
        if len(self.markers_mm) != len(other.markers_mm):
            return f"the tool had {len(self.markers_mm)} markers then and has {len(other.markers_mm)} now"
        if len(self.markers_mm):
            moved = float(np.linalg.norm(self.markers_mm - other.markers_mm, axis=1).max())
            if moved > SAME_GEOMETRY_MM:
                return f"a marker of the tool is {moved:.2f} mm from where it was"
        return ""


@dataclass(frozen=True, eq=False)
class ToolCalibration:
    """How the calibrated tool frame (tip, or transducer's face) lies in the frame that the tracker reports."""

    tool: str  # "Stylus", "Probe"...
    geometry: ToolGeometry
    tool_to_marker: Array  # (4, 4) mm
    covariance: Array  # of the origin (3, 3) mm^2, or with the axis' tilts (5, 5) mm and rad
    rms_mm: float  # of the fit; not the error of the tip
    method: str  # "pivot", "pivot and spin", "probe"...
    samples: int
    date: str = ""  # ISO 8601; set by `save` when empty

    @property
    def error_mm(self) -> float:
        """SD of the tool's origin in its worst direction."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[:3, :3])[-1], 0.0)))


def save_calibration(path: str | Path, calibration: ToolCalibration) -> None:
    """Write `calibration` as JSON, whole or not at all."""
    values = {
        "tool": calibration.tool,
        "tool_id": calibration.geometry.tool_id,
        "markers_mm": calibration.geometry.markers_mm.tolist(),
        "date": calibration.date or datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "method": calibration.method,
        "error_mm": calibration.error_mm,
        "rms_mm": calibration.rms_mm,
        "samples": calibration.samples,
        "tool_to_marker": calibration.tool_to_marker.tolist(),
        "covariance": calibration.covariance.tolist(),
    }
    write_text(path, json.dumps(values, indent=2) + "\n")


def load_calibration(path: str | Path, tool: str, geometry: ToolGeometry) -> ToolCalibration:
    """The calibration at `path`, if it is one of this very tool.

    Raises
    ------
    InputError
        Missing or damaged file, another tool's, or the tool's geometry has changed since.
    """
    try:
        values: dict[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"))
        calibration = ToolCalibration(
            tool=str(values["tool"]),
            geometry=ToolGeometry.of(str(values["tool_id"]), values["markers_mm"]),
            tool_to_marker=check_rigid(values["tool_to_marker"], "tool_to_marker"),
            covariance=_covariance(values["covariance"]),
            rms_mm=float(values["rms_mm"]),
            method=str(values["method"]),
            samples=int(values["samples"]),
            date=str(values["date"]),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: not a calibration ({type(error).__name__}: {error}); calibrate the {tool.lower()} again"
        ) from None
    if calibration.tool != tool:
        raise InputError(f"{path}: calibrates the {calibration.tool.lower()}, not the {tool.lower()}; choose another file")
    difference = calibration.geometry.difference(geometry)
    if difference:
        raise InputError(f"{path}: this calibration does not fit: {difference}; calibrate the {tool.lower()} again")
    return calibration


def _covariance(values: Any) -> Array:
    matrix = np.asarray(values, dtype=float)
    if matrix.shape not in ((3, 3), (5, 5)) or not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T):
        raise ValueError("the covariance is no symmetric 3x3 or 5x5 matrix")
    return matrix
