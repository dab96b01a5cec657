"""`cranionav test`: the test suite of a checkout."""

from __future__ import annotations

import typer


def test(context: typer.Context) -> int:
    """Run the everyday test suite; further words go to pytest (for example `-m slow`)."""
    import os
    import subprocess
    import sys
    from pathlib import Path

    from CranioNavLib.errors import InputError

    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / "Testing").is_dir():
        raise InputError("the tests come with the source checkout, not with the installed package; run ./cranionav test there")
    environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}  # two workers share the cores
    command = [sys.executable, "-m", "pytest", "-n", str(min(os.cpu_count() or 1, 4)), "--dist", "loadgroup", "-q", *context.args]
    return subprocess.run(command, cwd=checkout, env=environment, check=False).returncode
