"""`cranionav echo`: bone depth of every line of an A-mode recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


def echo(
    recording: Annotated[Path, typer.Argument(metavar="REC.igs.mha", help="A-mode recording")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="depths.csv", help="table to write")],
    speed_of_sound: Annotated[
        Optional[float], typer.Option(metavar="M_S", help="speed of sound in the tissue; default: the prior's mean")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="print a summary as JSON")] = False,
) -> None:
    """Find the bone echo in every line and write its depth, position and quality; refused lines say why."""
    from collections import Counter
    from dataclasses import asdict

    from CranioNavLib.errors import InputError
    from CranioNavLib.sequence_metafile import read_recording
    from ModuleUltrasoundLib.echo.search import check_length
    from ModuleUltrasoundLib.measurement.forerun_check import forerun_remark
    from ModuleUltrasoundLib.measurement.measure import EchoSettings, measure_lines
    from ModuleUltrasoundLib.measurement.speed_of_sound import estimate_if_pressed
    from ModuleUltrasoundLib.measurement.table import write_depths_csv

    from Workstation.terminal import print_json, progress_bar

    if output.resolve() == recording.resolve():
        raise InputError(f"{output} is the recording itself; give the table another name (-o depths.csv)")
    with progress_bar() as say:
        say("reading the recording", 0.0)
        lines = read_recording(recording)
        say("looking for bone", 0.3)
        settings = EchoSettings() if speed_of_sound is None else EchoSettings(speed_of_sound_m_s=speed_of_sound)
        check_length(lines, settings.speed_of_sound_m_s, settings.least_depth_mm)
        remark = forerun_remark(lines)
        measured = measure_lines(lines, settings)
        say("writing", 0.95)
        write_depths_csv(output, lines, measured)
        pressed = estimate_if_pressed(lines, measured)
    reasons = Counter(reason for reason, accepted in zip(measured.reasons, measured.accepted) if not accepted)
    if json:
        summary = {"depths": str(output), "lines": len(lines), "accepted": int(measured.accepted.sum()), "refused": dict(reasons)}
        print_json({**summary, "remark": remark, "speed_by_pressing": None if pressed is None else asdict(pressed)})
        return
    print(f"{output}: {int(measured.accepted.sum())} of {len(lines)} lines show bone")
    for reason, count in reasons.most_common():
        print(f"  {count} refused: {reason}")
    if remark:
        print(remark)
    if pressed is not None:
        print(f"speed of sound by pressing: {pressed}")
