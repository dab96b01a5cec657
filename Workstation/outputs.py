"""Everything that `register` and `batch` write for a case, and what they print."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Optional

from CranioNavLib.files import output_folder, write_text, written_whole

from Workstation.results import RECORD_KEYS, versions, write_registration

if TYPE_CHECKING:
    from ModuleRegistrationLib.procedure import CaseResult


def write_outputs(
    result: CaseResult,
    folder: Path,
    scene: bool = True,
    pdf: bool = True,
    notes: Mapping[str, str] | None = None,
    progress: Optional[Callable[[str, float], None]] = None,
) -> dict[str, Any]:
    """Write transform, registration.json, report.html and, if asked, scene.mrb and report.pdf; return the registration record."""
    from ModuleRegistrationLib.verification.report import write_report

    say = progress or (lambda step, share: None)
    record = write_registration(result, folder)
    if scene:
        from CranioNavLib.slicer_files import save_scene

        from Workstation.case_scene import fill_scene

        say("writing the scene", 0.1)
        fill_scene(result)
        save_scene(folder / "scene.mrb")
    else:
        (folder / "scene.mrb").unlink(missing_ok=True)  # an earlier call's is not this one's
    write_report(result, folder / "report.html", versions(), notes, progress=lambda step, share: say(step, 0.4 + 0.5 * share))
    if pdf:
        from Workstation.report_pdf import write_report_pdf

        say("printing the report", 0.9)
        write_report_pdf(folder / "report.html", folder / "report.pdf")
    else:
        (folder / "report.pdf").unlink(missing_ok=True)
    return record


def write_failure(case: Path, folder: Path, status: str, message: str) -> dict[str, Any]:
    """The record of a case that could not be registered: every key there, nothing claimed."""
    record: dict[str, Any] = dict.fromkeys(RECORD_KEYS)
    record.update(
        case=case.resolve().name,
        status=status,
        messages=[message],
        predicted_tre_mm=[],
        predicted_tre_p95_mm=[],
        tre_mm=[],
        versions=versions(),
    )
    if folder.is_dir():
        # an earlier call's result is not this one's
        for left_over in ("ReferenceToRas.tfm", "report.html", "report.pdf", "scene.mrb"):
            (folder / left_over).unlink(missing_ok=True)
        write_text(folder / "registration.json", json.dumps(record, indent=2) + "\n")
    return record


def write_table(
    folder: Path, name: str, record: Mapping[str, Any], columns: Sequence[str], rows: Sequence[Sequence[Any]]
) -> None:
    """`name`.json with the whole record and `name`.csv with its rows."""
    output_folder(folder)
    write_text(folder / f"{name}.json", json.dumps(record, indent=2) + "\n")
    with written_whole(folder / f"{name}.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def print_result(records: Sequence[Mapping[str, Any]], folder: Path) -> None:
    """One case as a list that fits 80 columns, several as one line each; then messages and where the files are."""
    from Workstation.terminal import print_table

    quantities = [_quantities(record) for record in records]
    title = "Registration (TRE in mm; 95%: at the worst target)"
    if len(records) == 1:
        print_table(title, ["quantity", "value"], [[name, value] for name, value in quantities[0].items()])
    else:
        print_table(title, list(quantities[0]), [list(row.values()) for row in quantities])
    for record in records:
        for message in record["messages"]:
            print(f"{record['case']}: {message}")
    if len(records) == 1 and records[0]["verification"]:
        for sentence in records[0]["verification"]["summary"]:
            print(sentence)
    print(f"files: {folder}")


def _quantities(record: Mapping[str, Any]) -> dict[str, str]:
    """What people look at first, by name."""
    from statistics import stdev

    from Workstation.terminal import number

    errors, predicted = record["tre_mm"], record["predicted_tre_mm"]
    return {
        "case": str(record["case"]),
        "mode": record["mode"] or "–",
        "method": record["method"] or "–",
        "status": str(record["status"]),
        "TRE mean": number(record["tre_mean_mm"]),
        "SD": number(stdev(errors) if len(errors) > 1 else None),
        "max": number(record["tre_max_mm"]),
        "predicted": number(sum(predicted) / len(predicted) if predicted else None),
        "95%": number(max(record["predicted_tre_p95_mm"], default=None)),
        "points": "–" if record["points_used"] is None else str(record["points_used"]),
        "c (m/s)": number(record["speed_of_sound_m_s"], 0),
        "time (s)": number(record["duration_s"], 1),
    }
