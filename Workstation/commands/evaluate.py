"""`cranionav evaluate`: TRE of any transform at ground-truth markers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


def evaluate(
    transform: Annotated[Path, typer.Option(metavar="T", help="ReferenceToRas (.tfm or .h5)")],
    targets_ct: Annotated[Path, typer.Option(metavar="A", help="markers in the CT (.mrk.json or .fcsv)")],
    targets_patient: Annotated[Path, typer.Option(metavar="B", help="the same, digitised, Reference frame")],
    output: Annotated[
        Optional[Path], typer.Option("-o", "--output", metavar="DIR", help="also write evaluation.json and evaluation.csv")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Target registration error: mean, SD, max, min over the markers."""
    from CranioNavLib.slicer_files import read_points, read_transform
    from ModuleRegistrationLib.registration.pairing import pair_points
    from ModuleRegistrationLib.verification.tre import target_errors

    from Workstation.outputs import write_table
    from Workstation.terminal import number, print_json, print_table

    planned, touched = read_points(targets_ct), read_points(targets_patient)
    patient, ct, labels = pair_points(touched.labels, touched.positions_mm, planned.labels, planned.positions_mm)
    tre = target_errors(read_transform(transform), ct, patient)
    record = {
        "transform": str(transform), "labels": list(labels), "tre_mm": tre.errors_mm.tolist(), "tre_mean_mm": tre.mean_mm,
        "tre_sd_mm": tre.sd_mm, "tre_max_mm": tre.max_mm, "tre_min_mm": tre.min_mm, "tre_rms_mm": tre.rms_mm,
    }  # fmt: skip
    if output:
        write_table(output, "evaluation", record, ["target", "tre_mm"], list(zip(labels, tre.errors_mm.tolist())))
    if json:
        print_json(record)
        return
    print_table(
        "Target registration error (mm)",
        ["target", "TRE"],
        [[label, number(error)] for label, error in zip(labels, tre.errors_mm)],
    )
    print(f"mean {tre.mean_mm:.2f}, SD {tre.sd_mm:.2f}, max {tre.max_mm:.2f}, min {tre.min_mm:.2f} mm over {len(labels)} targets")
