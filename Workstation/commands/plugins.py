"""`cranionav plugins`: what is installed, by kind."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


def plugins(
    load: Annotated[
        Optional[list[Path]], typer.Option(metavar="FILE", help="a Python file that registers plugins; may be repeated")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="print the list as JSON")] = False,
) -> None:
    """List trackers, A-mode devices, registration and segmentation methods, and where each comes from."""
    from dataclasses import asdict

    from CranioNavLib.plugins import load_file
    from ModuleRegistrationLib.anatomy.segmentation import SEGMENTATIONS
    from ModuleRegistrationLib.registration.problem import METHODS
    from ModuleTrackingLib.tracker import TRACKERS
    from ModuleUltrasoundLib.devices.device import AMODE_DEVICES

    from Workstation.terminal import print_json, print_table

    for file in load or []:
        load_file(file)
    entries = [entry for kind in (TRACKERS, AMODE_DEVICES, METHODS, SEGMENTATIONS) for entry in kind.entries()]
    if json:
        print_json([asdict(entry) for entry in entries])
        return
    rows = [
        [entry.kind, entry.name, entry.source, f"cannot be used: {entry.problem}" if entry.problem else entry.title]
        for entry in entries
    ]
    print_table("Plugins", ["kind", "name", "from", "what it is"], rows)
