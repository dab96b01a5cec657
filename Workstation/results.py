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

import numpy as np
import numpy.typing as npt
from CranioNavLib.files import write_text, written_whole

if TYPE_CHECKING:
    from ModuleRegistrationLib.procedure import CaseResult
    from ModuleRegistrationLib.verification.checks import StatedError
    from ModuleRegistrationLib.verification.held_out import DistanceCheck

SUMMARY_COLUMNS = (
    "case,mode,method,status,fre_mm,surface_rms_mm,tre_mean_mm,tre_max_mm,"
    "predicted_tre_mm,points_used,speed_of_sound_m_s,duration_s,message"
).split(",")

RECORD_KEYS = (
    "case mode method status messages reference_to_ras fre_mm surface_rms_mm iterations points_used points_rejected "
    "speed_of_sound_m_s predicted_tre_mm predicted_tre_p95_mm tre_mm tre_mean_mm tre_max_mm duration_s versions verification"
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
        "verification": verification_record(result),
    }
    return {key: _known(value) for key, value in record.items()}


def verification_record(result: CaseResult) -> dict[str, Any]:
    """What the registration says of itself beyond the predicted TRE, and what points it has not used say of it."""
    registration, confidence = result.registration, result.confidence
    below, left_out = confidence.below_limit, confidence.left_out
    return {
        "summary": confidence.sentences(),
        "limit_mm": confidence.limit_mm,
        "targets_ras_mm": result.targets_ras_mm.tolist(),
        "probability_below_limit": None if below is None else below.tolist(),
        "held_out": check_record(confidence.held_out),
        "plausibility": check_record(confidence.touched),
        "leave_one_out": None
        if left_out is None
        else {
            "labels": list(left_out.labels),
            "residuals_mm": left_out.residuals_mm.tolist(),
            "expected_sd_mm": left_out.expected_sd_mm.tolist(),
            "target_shift_mm": left_out.shifts_mm.tolist(),
            "most_influential": left_out.labels[left_out.most_influential],
        },
        # of a small motion: rotation (rad) about the pivot, then translation (mm), RAS axes
        "covariance": None if registration.covariance is None else registration.covariance.tolist(),
        "pivot_ras_mm": registration.pivot_ras_mm.tolist(),
        "degrees_of_freedom": registration.degrees_of_freedom,
        "speed_of_sound": speed_record(result),
        "bone_surface": {
            "threshold_hu": result.bone.threshold_hu,
            "position_sd_mm": result.bone.position_sd_mm,
            "offset_sd_mm": result.bone.offset_sd_mm,
        },
    }


def speed_record(result: CaseResult) -> dict[str, Any] | None:
    """The speed of sound by each way that tells of it, with its SD; None without ultrasound."""
    if result.ultrasound is None:
        return None
    assumed, pressed = result.ultrasound.measurements, result.ultrasound.pressed
    return {
        "prior": {"m_s": assumed.speed_of_sound_m_s, "sd_m_s": assumed.speed_of_sound_sd_m_s},
        "with_the_registration": {
            "m_s": _known(result.registration.speed_of_sound_m_s),
            "sd_m_s": _known(result.registration.speed_of_sound_sd_m_s),
        },
        "by_pressing": None
        if pressed is None
        else {"m_s": pressed.pressed_m_s, "sd_m_s": pressed.pressed_sd_m_s, "spots": pressed.spots},
    }


def read_stated_error(transform: Path, reference_to_ras: npt.ArrayLike) -> StatedError | None:
    """What the registration.json beside a transform states of its error; None if there is none, or of another transform."""
    from ModuleRegistrationLib.verification.checks import StatedError

    try:
        record = json.loads((transform.parent / "registration.json").read_text(encoding="utf-8"))
        stated, bone = record["verification"], record["verification"]["bone_surface"]
        covariance, pivot = np.array(stated["covariance"], dtype=float), np.array(stated["pivot_ras_mm"], dtype=float)
        if not np.allclose(record["reference_to_ras"], reference_to_ras, atol=1e-4):
            return None
        freedom, sds = stated["degrees_of_freedom"], (float(bone["position_sd_mm"]), float(bone["offset_sd_mm"]))
        known = covariance.shape == (6, 6) and pivot.shape == (3,) and np.isfinite([*covariance.flat, *pivot, *sds]).all()
        return StatedError(covariance, pivot, None if freedom is None else float(freedom), *sds) if known else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def check_record(check: DistanceCheck | None) -> dict[str, Any] | None:
    if check is None:
        return None
    return {
        "labels": list(check.labels),
        "distances_mm": check.distances_mm.tolist(),
        "expected_sd_mm": check.expected_sd_mm.tolist(),
        "chi_square": check.chi_square,
        "degrees_of_freedom": check.degrees_of_freedom,
        "p_value": check.p_value,
        "as_expected": check.as_expected,
    }


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
