"""`cranionav emulate`: stand-ins for devices, each served until interrupted."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from Workstation.commands import emulate_amode, emulate_polaris

app = typer.Typer(help="Stand-ins for devices: a Polaris, a pulser/receiver.", no_args_is_help=True, rich_markup_mode=None)

Faults = Annotated[Optional[list[str]], typer.Option("--fault", metavar="NAME", help="a fault on demand; may be repeated")]
Tcp = Annotated[bool, typer.Option("--tcp", help="serve socket://127.0.0.1:N instead of a pseudo-terminal")]
Port = Annotated[int, typer.Option(help="TCP port; 0 takes a free one")]


@app.command("polaris")
def polaris(
    replay: Annotated[Optional[Path], typer.Option(metavar="POSES.csv", help="tool poses, played in a loop")] = None,
    fault: Faults = None,
    tcp: Tcp = False,
    port: Port = 0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="frames a second")] = 60.0,
) -> None:
    """An NDI Polaris. The first line on stdout is the port to open."""
    emulate_polaris.run(replay, fault, tcp, port=port, rate_hz=rate)


@app.command("amode")
def amode(
    replay: Annotated[Optional[Path], typer.Option(metavar="REC.igs.mha", help="lines of a recording, played in a loop")] = None,
    fault: Faults = None,
    tcp: Tcp = False,
    port: Port = 0,
    protocol: Annotated[str, typer.Option(metavar="serial|pic0rick", help="which device's language it speaks")] = "serial",
) -> None:
    """An A-mode pulser/receiver. The first line on stdout is the port to open."""
    emulate_amode.run(replay, fault, protocol, port=port, pty=not tcp)
