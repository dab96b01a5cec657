"""`cranionav tracker calibrate-probe`: face and beam of the A-mode probe from recordings of targets in a water bath."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording, read_recording
from ModuleTrackingLib.calibration import (
    ToolCalibration,
    ToolGeometry,
    calibrate_probe,
    save_calibration,
    water_speed_m_s,
)
from ModuleTrackingLib.calibration.bath import plane_of, point_of
from ModuleTrackingLib.calibration.probe import Target


def calibrate_from(
    points: list[Path], planes: list[Path], temperature_c: float, beam: str, face: str, output: Path
) -> dict[str, Any]:
    """Calibrate and save; each recording is of one target.

    Raises
    ------
    InputError
        No recording, recordings of different probes, or echoes that leave face or beam too uncertain.
    """
    if not points and not planes:
        raise InputError("no recording is given; record a bead (--point) or a plate (--plane) in a water bath")
    speed, along, at = water_speed_m_s(temperature_c), _vector("--beam", beam), _vector("--face", face)
    if not np.linalg.norm(along):
        raise InputError(f"--beam {beam}: expected a direction, such as 0,0,1")
    along = along / np.linalg.norm(along)
    recordings = {path: read_recording(path) for path in (*points, *planes)}
    targets: list[Target] = [point_of(recordings[path], speed, str(path)) for path in points]
    targets += [plane_of(recordings[path], speed, along, at, str(path)) for path in planes]
    found = calibrate_probe(targets, along, at)
    calibration = ToolCalibration(
        "Probe",
        ToolGeometry.of(_probe_id(recordings)),
        found.probe_to_marker,
        found.covariance,
        found.rms_depth_mm,
        "echoes in a water bath",
        found.used,
        datetime.now(timezone.utc).isoformat(timespec="seconds"),
    )
    save_calibration(output, calibration)
    return {
        "file": str(output),
        "face_mm": found.probe_to_marker[:3, 3].tolist(),
        "beam": found.probe_to_marker[:3, 2].tolist(),
        "face_sd_mm": found.face_sd_mm,
        "beam_sd_deg": found.beam_sd_deg,
        "rms_depth_mm": found.rms_depth_mm,
        "echoes_used": found.used,
        "echoes_left_out": found.left_out,
        "speed_of_sound_m_s": speed,
    }


def _probe_id(recordings: dict[Path, Recording]) -> str:
    known = {recording.fields.get("ProbeToolId", "Probe") for recording in recordings.values()}
    if len(known) > 1:
        raise InputError(f"the recordings are of different probes: {', '.join(sorted(known))}; give those of one")
    return known.pop()


def _vector(option: str, text: str) -> Array:
    try:
        vector = np.array([float(part) for part in text.split(",")])
    except ValueError:
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{option} {text}: expected three numbers with commas, such as 0,0,1")
    return vector
