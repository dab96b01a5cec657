"""`cranionav register`: one case folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


def register(
    case: Annotated[Path, typer.Argument(metavar="CASE", help="case folder")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="where the result goes")],
    method: Annotated[Optional[str], typer.Option(help="registration plugin; see `cranionav plugins`")] = None,
    mode: Annotated[Optional[str], typer.Option(help="Ia, Ib, IIa, IIb or III; default: the richest the case allows")] = None,
    segmentation: Annotated[str, typer.Option(help="segmentation plugin")] = "threshold",
    series: Annotated[Optional[str], typer.Option(help="which series, where the CT is a DICOM folder with several")] = None,
    limit: Annotated[float, typer.Option(metavar="MM", min=0.1, help="tell the probability that the error is below this")] = 2.0,
    load: Annotated[Optional[list[Path]], typer.Option(metavar="FILE", help="a Python file that registers plugins")] = None,
    json: Annotated[bool, typer.Option("--json", help="print registration.json on stdout")] = False,
) -> int:
    """Register a case; write the transform, registration.json, scene.mrb, report.html and report.pdf.

    A registration that is refused ends with exit status 2 and leaves no transform file, not even an
    earlier one's.
    """
    from CranioNavLib.case import read_case
    from CranioNavLib.errors import InputError
    from CranioNavLib.files import output_folder
    from CranioNavLib.plugins import load_file
    from ModuleRegistrationLib.procedure import register_case

    from Workstation.outputs import write_failure, write_outputs
    from Workstation.terminal import print_json, progress_bar

    folder = output_folder(output)
    with progress_bar() as say:
        try:
            for file in load or []:
                load_file(file)
            result = register_case(
                read_case(case),
                mode,
                method,
                segmentation,
                lambda step, share: say(step, 0.7 * share),
                limit_mm=limit,
                series=series,
            )
        except Exception as error:  # whatever ends this call, an earlier one's files must not pass for its result
            write_failure(case, folder, "refused" if isinstance(error, InputError) else "defect", str(error))
            raise
        record = write_outputs(result, folder, progress=lambda step, share: say(step, 0.7 + 0.3 * share))
    if json:
        print_json(record)
    else:
        _say(record, folder)
    return 2 if result.verdict.status == "refused" else 0


def _say(record: dict[str, object], folder: Path) -> None:
    import sys

    from Workstation.outputs import print_result

    print_result([record], folder)
    if record["status"] == "refused":
        print(f"cranionav: registration refused: {'; '.join(map(str, record['messages']))}", file=sys.stderr)  # type: ignore[call-overload]
