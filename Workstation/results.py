"""What a registered case becomes on disk: registration.json, ReferenceToRas.tfm, summary.csv."""

from __future__ import annotations

import csv
import json
import math
import platform
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from CranioNavLib.files import write_text, written_whole

if TYPE_CHECKING:
    from ModuleRegistrationLib.procedure import CaseResult

SUMMARY_COLUMNS = (
    "case,mode,method,status,fre_mm,surface_rms_mm,tre_mean_mm,tre_max_mm,"
    "predicted_tre_mm,points_used,speed_of_sound_m_s,duration_s,message"
).split(",")

RECORD_KEYS = (
    "case mode method status messages reference_to_ras fre_mm surface_rms_mm iterations points_used points_rejected "
    "speed_of_sound_m_s predicted_tre_mm predicted_tre_p95_mm tre_mm tre_mean_mm tre_max_mm duration_s versions"
).split()

VERSIONED = ("numpy", "scipy", "SimpleITK", "vtk", "open3d-cpu", "open3d", "slicer-core")


def versions() -> dict[str, str]:
    """CranioNav's own version and those of the libraries that numbers may depend on."""
    found = {"python": platform.python_version()}
    for name in ("cranionav", *VERSIONED):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def registration_record(result: CaseResult) -> dict[str, Any]:
    """registration.json as a dictionary: exactly the keys of the format, numbers that are unknown as None."""
    registration, tre = result.registration, result.tre
    named_targets = result.case.targets_ct is not None and result.predicted is not None
    record = {
        "case": result.case.name,
        "mode": result.mode,
        "method": registration.method,
        "status": result.verdict.status,
        "messages": list(result.verdict.messages),
        "reference_to_ras": registration.reference_to_ras.tolist(),
        "fre_mm": result.landmarks.fre_mm,
        "surface_rms_mm": registration.surface_rms_mm,
        "iterations": registration.iterations,
        "points_used": int(registration.used.sum()),
        "points_rejected": int((~registration.used).sum()),
        "speed_of_sound_m_s": registration.speed_of_sound_m_s,
        "predicted_tre_mm": result.predicted.mean_mm.tolist() if named_targets and result.predicted else [],
        "predicted_tre_p95_mm": result.predicted.p95_mm.tolist() if named_targets and result.predicted else [],
        "tre_mm": tre.errors_mm.tolist() if tre else [],
        "tre_mean_mm": tre.mean_mm if tre else None,
        "tre_max_mm": tre.max_mm if tre else None,
        "duration_s": result.duration_s,
        "versions": versions(),
    }
    return {key: _known(value) for key, value in record.items()}


def _known(value: Any) -> Any:
    """NaN and infinity are no JSON: what is not known is null."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_registration(result: CaseResult, folder: Path) -> dict[str, Any]:
    """Write registration.json, and ReferenceToRas.tfm unless the registration is refused; return the record.

    A refused registration leaves no transform file that navigation could load by accident.
    """
    from CranioNavLib.slicer_files import write_transform

    record = registration_record(result)
    write_text(folder / "registration.json", json.dumps(record, indent=2) + "\n")
    transform = folder / "ReferenceToRas.tfm"
    if result.verdict.status == "refused":
        transform.unlink(missing_ok=True)
    else:
        write_transform(transform, result.registration.reference_to_ras, name="ReferenceToRas")
    return record


def summary_row(record: dict[str, Any]) -> dict[str, Any]:
    """One row of summary.csv from a registration record."""
    row = {column: record.get(column) for column in SUMMARY_COLUMNS}
    predicted = record.get("predicted_tre_mm") or []
    row["predicted_tre_mm"] = sum(predicted) / len(predicted) if predicted else None
    row["message"] = "; ".join(record.get("messages", []))
    return {column: f"{value:.6g}" if isinstance(value, float) else value for column, value in row.items()}


def write_summary(rows: Iterable[dict[str, Any]], path: Path) -> None:
    """summary.csv, whole or not at all."""
    with written_whole(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, SUMMARY_COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
