"""The report for people: one HTML file with everything in it."""

from __future__ import annotations

import base64
import datetime
import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Optional

import numpy as np
from CranioNavLib import host
from CranioNavLib.case import FILES
from CranioNavLib.files import write_text

from ModuleRegistrationLib.verification import report_figures

if TYPE_CHECKING:
    from ModuleRegistrationLib.procedure import CaseResult

TEMPLATE = "report.html.j2"


def write_report(
    result: CaseResult,
    path: str | Path,
    versions: Mapping[str, str],
    notes: Mapping[str, str] | None = None,
    progress: Optional[Callable[[str, float], None]] = None,
) -> None:
    """Write the self-contained report of a registered case.

    Parameters
    ----------
    result : what the case became
    path : the .html to write
    versions : library -> version, for the provenance
    notes : further provenance, such as the seed of a simulation
    progress : told (step, share done)
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folder = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader(folder), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["mm"] = _number
    page = environment.get_template(TEMPLATE).render(
        result=result,
        figures=_figures(result, progress or (lambda step, share: None)),
        landmarks=_landmark_rows(result),
        targets=_target_rows(result),
        points=_point_rows(result),
        plausibility=_plausibility_rows(result),
        files=_file_rows(result),
        matrix=[[f"{value:.6f}" for value in row] for row in result.registration.reference_to_ras],
        versions=versions,
        notes=notes or {},
        date=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
    )
    write_text(path, page)


def _figures(result: CaseResult, say: Callable[[str, float], None]) -> dict[str, Optional[str]]:
    drawn: dict[str, Optional[str]] = {}
    drawings = {
        "skull": report_figures.skull_with_points,
        "error_map": report_figures.error_map,
        "error_slices": report_figures.error_slices,
        "slices": report_figures.slices_with_points,
        "lines": report_figures.lines_with_echo,
    }
    with host.quiet():  # VTK says on stderr that there is no display before it draws without one
        for number, (name, draw) in enumerate(drawings.items()):
            say("drawing the report", number / len(drawings))
            picture = draw(result)
            drawn[name] = None if picture is None else "data:image/png;base64," + base64.b64encode(picture).decode("ascii")
    return drawn


def _number(value: Any, digits: int = 2) -> str:
    """A number for people; a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def _landmark_rows(result: CaseResult) -> list[dict[str, Any]]:
    labels = result.landmarks.labels or tuple(str(number + 1) for number in range(len(result.landmarks.residuals_mm)))
    return [{"label": label, "residual": residual} for label, residual in zip(labels, result.landmarks.residuals_mm)]


def _target_rows(result: CaseResult) -> list[dict[str, Any]]:
    count = len(result.targets_ras_mm)
    return [
        {
            "label": result.target_labels[index],
            "measured": result.tre.errors_mm[index] if result.tre else None,
            "mean": result.predicted.mean_mm[index] if result.predicted else None,
            "p95": result.predicted.p95_mm[index] if result.predicted else None,
            "below": None if result.confidence.below_limit is None else 100 * result.confidence.below_limit[index],
        }
        for index in range(count)
    ]


def _point_rows(result: CaseResult) -> list[dict[str, Any]]:
    points, registration = result.points, result.registration
    deviations = np.sqrt(np.trace(points.covariances_mm2, axis1=1, axis2=2)) if len(points) else np.empty(0)
    held_out, left_out = result.confidence.held_out, result.confidence.left_out
    distances = {} if held_out is None else dict(zip(held_out.labels, zip(held_out.distances_mm, held_out.expected_sd_mm)))
    shifts = {} if left_out is None else dict(zip(left_out.labels, left_out.shifts_mm))
    return [
        {
            "label": points.labels[index],
            "residual": registration.residuals_mm[index],
            "used": bool(registration.used[index]),
            "depth": points.depths_mm[index] if points.has_beam[index] else None,
            "quality": points.qualities[index],
            "sd": deviations[index],
            "held_out": distances.get(points.labels[index], (None, None))[0],
            "expected": distances.get(points.labels[index], (None, None))[1],
            "shift": shifts.get(points.labels[index]),
        }
        for index in range(len(points))
    ]


def _plausibility_rows(result: CaseResult) -> list[dict[str, Any]]:
    if result.plausibility is None or result.case.plausibility is None:
        return []
    touched, count = result.confidence.touched, len(result.plausibility.distances_mm)
    expected = [None] * count if touched is None else touched.expected_sd_mm
    return [
        {"label": label, "distance": distance, "expected": sd}
        for label, distance, sd in zip(result.case.plausibility.labels, result.plausibility.distances_mm, expected)
    ]


def _file_rows(result: CaseResult) -> list[dict[str, str]]:
    """What was read, with the start of its SHA-256, so that a result can be traced to its input."""
    from CranioNavLib.case import find_files

    rows = []
    for thing, path in find_files(result.case.folder).items():
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else "folder"
        rows.append(
            {
                "thing": thing,
                "name": path.name if path.name in FILES[thing] else f"{path.parent.name}/{path.name}",
                "hash": digest,
            }
        )
    return rows
