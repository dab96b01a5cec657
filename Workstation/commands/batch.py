"""`cranionav batch`: many case folders."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Optional

import typer


def batch(
    cases: Annotated[list[Path], typer.Argument(metavar="CASES...", help="case folders")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="where the results go")],
    method: Annotated[Optional[str], typer.Option(help="registration plugin")] = None,
    mode: Annotated[Optional[str], typer.Option(help="Ia, Ib, IIa, IIb or III; default: the richest each case allows")] = None,
    series: Annotated[Optional[str], typer.Option(help="which series, where a CT is a DICOM folder with several")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="cases at the same time")] = 1,
    scenes: Annotated[bool, typer.Option("--scenes", help="write scene.mrb for each case too")] = False,
    pdf: Annotated[bool, typer.Option("--pdf", help="write report.pdf for each case too")] = False,
    json: Annotated[bool, typer.Option("--json", help="print the summary as JSON")] = False,
) -> int:
    """Register many cases; one folder a case and DIR/summary.csv. A case that fails does not stop the others.

    Exit status 0 when at least one case was registered, 1 after a defect, 2 when every case was refused.
    """
    from CranioNavLib.errors import InputError
    from CranioNavLib.files import output_folder
    from joblib import Parallel, delayed

    from Workstation.outputs import print_result
    from Workstation.results import summary_row, write_summary
    from Workstation.terminal import print_json, progress_bar

    names = [case.resolve().name for case in cases]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"two cases are named {', '.join(twice)}, and each would overwrite the other's results; rename one folder"
        )
    folder = output_folder(output)
    records: list[dict[str, Any]] = []
    with progress_bar() as say:
        work = (delayed(register_one)(case, folder / name, method, mode, scenes, pdf, series) for case, name in zip(cases, names))
        for record in Parallel(n_jobs=jobs, return_as="generator")(work):
            records.append(record)
            say(f"{record['case']}: {record['status']}", len(records) / len(cases))
    write_summary([summary_row(record) for record in records], folder / "summary.csv")
    print_json(records) if json else print_result(records, folder)
    if any(record["status"] == "defect" for record in records):
        return 1
    return 2 if all(record["status"] == "refused" for record in records) else 0


def register_one(
    case: Path,
    folder: Path,
    method: Optional[str],
    mode: Optional[str],
    scenes: bool = False,
    pdf: bool = False,
    series: Optional[str] = None,
) -> dict[str, Any]:
    """The record of one case; one that cannot be registered gives a record that says why."""
    from CranioNavLib.case import read_case
    from CranioNavLib.errors import InputError
    from CranioNavLib.files import output_folder
    from ModuleRegistrationLib.procedure import register_case

    from Workstation.outputs import write_failure, write_outputs

    try:
        output_folder(folder)
        return write_outputs(register_case(read_case(case), mode, method, series=series), folder, scene=scenes, pdf=pdf)
    except InputError as error:
        return write_failure(case, folder, "refused", str(error))
    except Exception as error:  # a defect in one case must not cost the others
        return write_failure(case, folder, "defect", f"{type(error).__name__}: {error}")
