"""`cranionav demo`: a whole Mode III registration with simulated devices."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


def demo(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="where everything goes")] = Path("cranionav-demo"),
    seed: Annotated[int, typer.Option(help="seed of the simulated patient and devices")] = 0,
    ct: Annotated[Optional[Path], typer.Option(metavar="PATH", help="another head CT instead of the sample head")] = None,
    method: Annotated[Optional[str], typer.Option(help="registration plugin")] = None,
    json: Annotated[bool, typer.Option("--json", help="print registration.json on stdout")] = False,
) -> int:
    """Segment, register and verify a simulated patient from a real head CT; write the case, the scene and the report.

    Tracker, probe and patient are simulated; the head is the sample head CT where it could be fetched, the CT
    given with --ct, or else a synthetic head. The table says which.
    """
    import sys
    import time
    from dataclasses import replace

    from CranioNavLib.case import read_case
    from CranioNavLib.files import output_folder
    from ModuleRegistrationLib.procedure import register_case

    from Workstation.demo_case import SIMULATED, choose_head, make_case
    from Workstation.outputs import print_result, write_outputs
    from Workstation.terminal import print_json, progress_bar

    started = time.monotonic()
    folder = output_folder(output)
    volume, head = choose_head(ct)
    with progress_bar() as say:
        say("simulating patient and devices", 0.0)
        case_folder = make_case(volume, seed, folder / "case")
        case = replace(read_case(case_folder), note=f"{SIMULATED}, seed {seed}")
        result = register_case(case, "III", method, progress=lambda step, share: say(step, 0.3 + 0.4 * share))
        notes = {"head": head, "devices": "simulated tracker and A-mode probe", "seed": str(seed)}
        record = write_outputs(result, folder, notes=notes, progress=lambda step, share: say(step, 0.7 + 0.3 * share))
    if json:
        print_json(record)
    else:
        print_result([record], folder)
        print(f"head: {head}; tracker, probe and patient simulated, seed {seed}; {time.monotonic() - started:.0f} s in all")
        print(f"report: {folder / 'report.html'}")
    if result.verdict.status == "refused":
        print(f"cranionav: registration refused: {'; '.join(result.verdict.messages)}", file=sys.stderr)
        return 2
    return 0
