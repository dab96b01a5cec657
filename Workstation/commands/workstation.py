"""`cranionav workstation`: the whole procedure in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer


def workstation(
    port: Annotated[int, typer.Option(min=0, max=65535, help="of the page; 0: any free one")] = 0,
    case: Annotated[
        Optional[Path],
        typer.Option(metavar="DIR", help="the session's folder; a case in it is loaded, an interrupted session goes on"),
    ] = None,
    data: Annotated[
        Optional[Path],
        typer.Option(metavar="DIR", help="a folder of CTs that the page may choose from", exists=True, file_okay=False),
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="open the page")] = True,
    host: Annotated[str, typer.Option(help="another interface than loopback; its address then carries a token")] = "127.0.0.1",
) -> int:
    """Open the workstation: CT, bone, devices, landmarks, ultrasound, verification, navigation, report.

    The first line on stdout is the page's address. Works with no hardware through simulated devices.
    """
    from Workstation.web.server import serve

    serve(port, case, browser, host, data)
    return 0
