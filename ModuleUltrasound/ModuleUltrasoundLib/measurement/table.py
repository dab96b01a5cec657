"""The table of bone depths, one row a frame, as `cranionav echo` writes it."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from CranioNavLib.files import write_text
from CranioNavLib.sequence_metafile import Recording

from ModuleUltrasoundLib.measurement.measure import LineMeasurements

COLUMNS = (
    "frame",
    "timestamp_s",
    "palpation_point",
    "tissue_depth_mm",
    "bone_x_mm",
    "bone_y_mm",
    "bone_z_mm",
    "quality",
    "accepted",
    "reason",
)


def write_depths_csv(path: str | Path, recording: Recording, measurements: LineMeasurements) -> None:
    """One row a frame: depth of the bone under the skin, bone point in Reference, quality, and why not if not.

    A cell stays empty where there is nothing to say: no palpation point, no echo, no pose. `accepted` is 1 or 0.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for frame in range(len(measurements)):
        point = int(recording.palpation_points[frame])
        writer.writerow(
            [
                frame,
                _number(recording.timestamps_s[frame], 6),
                point if point >= 0 else "",
                _number(measurements.depths_mm[frame], 4),
                *(_number(value, 4) for value in measurements.positions_mm[frame]),
                _number(measurements.qualities[frame], 4),
                int(measurements.accepted[frame]),
                measurements.reasons[frame],
            ]
        )
    write_text(path, text.getvalue())


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else ""
