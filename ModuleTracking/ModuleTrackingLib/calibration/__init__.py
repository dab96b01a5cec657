"""Calibration of tools: tip (pivot), axis (spin), transducer (probe), and their storage."""

from __future__ import annotations

from ModuleTrackingLib.calibration.pivot import PivotCalibration, PivotMethod, PivotSettings, calibrate_pivot
from ModuleTrackingLib.calibration.probe import (
    PlaneTarget,
    PointTarget,
    ProbeCalibration,
    ProbeSettings,
    calibrate_probe,
    water_speed_m_s,
)
from ModuleTrackingLib.calibration.spin import SpinCalibration, calibrate_spin, tool_to_marker
from ModuleTrackingLib.calibration.store import ToolCalibration, ToolGeometry, load_calibration, save_calibration

__all__ = [
    "PivotCalibration",
    "PivotMethod",
    "PivotSettings",
    "PlaneTarget",
    "PointTarget",
    "ProbeCalibration",
    "ProbeSettings",
    "SpinCalibration",
    "ToolCalibration",
    "ToolGeometry",
    "calibrate_pivot",
    "calibrate_probe",
    "calibrate_spin",
    "load_calibration",
    "save_calibration",
    "tool_to_marker",
    "water_speed_m_s",
]
