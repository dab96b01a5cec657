"""`cranionav selftest`: the modules' self-tests, as 3D Slicer runs them."""

from __future__ import annotations

from typing import Annotated, Optional

import typer


def selftest(
    module: Annotated[Optional[str], typer.Argument(metavar="MODULE", help="one module; default: all three")] = None,
    json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> int:
    """Run each module's own test on a fresh scene; the exit status is 1 if one fails."""
    from CranioNavLib.errors import InputError
    from CranioNavLib.selftest import MODULES, run_selftests

    from Workstation.terminal import print_json

    if module is not None and module not in MODULES:
        raise InputError(f"unknown module {module!r}; choose one of {', '.join(MODULES)}")
    outcomes = run_selftests([module] if module else list(MODULES))
    if json:
        print_json(
            [
                {"module": one.module, "passed": one.passed, "message": one.message, "duration_s": one.duration_s}
                for one in outcomes
            ]
        )
    else:
        for one in outcomes:
            print(f"{'passed' if one.passed else 'FAILED'}  {one.module}  {one.duration_s:.1f} s  {one.message}".rstrip())
    return 0 if all(one.passed for one in outcomes) else 1
