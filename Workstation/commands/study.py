"""`cranionav study`: the chapter's studies on virtual patients."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


def study(
    kind: Annotated[str, typer.Argument(metavar="phantom|cadaver|patient", help="the condition of the simulated sessions")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="where trials.csv and summary.csv go")],
    trials: Annotated[int, typer.Option(min=1, help="seeds, each in every mode")] = 30,
    jobs: Annotated[int, typer.Option(min=1, help="trials at the same time")] = 1,
    seed: Annotated[int, typer.Option(help="the first seed")] = 0,
    method: Annotated[str, typer.Option(help="registration plugin for modes IIb and III")] = "cranionav",
    mode: Annotated[Optional[list[str]], typer.Option(help="only this mode; may be repeated")] = None,
    ct: Annotated[Optional[Path], typer.Option(metavar="PATH", help="another head CT instead of the sample head")] = None,
    json: Annotated[bool, typer.Option("--json", help="print the summary as JSON")] = False,
) -> None:
    """Repeat a simulated study in the five modes; every number that comes out is simulated."""
    from dataclasses import asdict

    from CranioNavLib.errors import InputError
    from CranioNavLib.files import output_folder
    from CranioNavLib.phantom import MODES
    from ModuleRegistrationLib.registration.problem import METHODS
    from ModuleRegistrationLib.verification.studies import run_study, summarise, write_table
    from ModuleRegistrationLib.verification.study_figure import write_figure

    from Workstation.demo_case import choose_head
    from Workstation.terminal import number, print_json, print_table, progress_bar

    METHODS.find(method)
    known = {name.lower(): name for name in MODES}
    if unknown := [name for name in mode or [] if name.lower() not in known]:
        raise InputError(f"unknown mode {unknown[0]!r}; choose one of {', '.join(MODES)}")
    folder = output_folder(output)
    volume, head = choose_head(ct)
    with progress_bar() as say:
        rows = run_study(
            kind,
            trials=trials,
            jobs=jobs,
            seed0=seed,
            volume=volume,
            modes=[known[name.lower()] for name in mode] if mode else MODES,
            method=method,
            progress=lambda done, all_of_them: say(f"trial {done} of {all_of_them}", done / all_of_them),
        )
    summaries = summarise(rows)
    write_table(folder / "trials.csv", rows)
    write_table(folder / "summary.csv", summaries)
    write_figure(folder / "study.png", rows)
    if json:
        print_json([asdict(summary) for summary in summaries])
        return
    table = [
        [one.mode, one.method, number(one.tre_mean_mm), number(one.tre_sd_mm), number(one.tre_min_mm), number(one.tre_max_mm),
         f"{100 * one.share_above_3_mm:.0f} %", number(one.predicted_tre_mm), f"{one.refused}", f"{one.failed}"]
        for one in summaries
    ]  # fmt: skip
    columns = ["mode", "method", "TRE mean", "SD", "min", "max", "above 3 mm", "predicted", "refused", "failed"]
    print_table(f"Simulated {kind} study, {trials} trials from seed {seed} (mm)", columns, table)
    print(f"head: {head}; files: {folder}")
