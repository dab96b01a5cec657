"""`cranionav emulate`: stand-ins for devices, each served until interrupted."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from Workstation.commands import emulate_amode, emulate_polaris

app = typer.Typer(help="Stand-ins for devices: a Polaris, a pulser/receiver.", no_args_is_help=True, rich_markup_mode=None)

Faults = Annotated[Optional[list[str]], typer.Option("--fault", metavar="NAME", help="a fault on demand; may be repeated")]
Tcp = Annotated[bool, typer.Option("--tcp", help="serve socket://127.0.0.1:N instead of a pseudo-terminal")]
Port = Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 takes a free one")]


@app.command("polaris")
def polaris(
    replay: Annotated[Optional[Path], typer.Option(metavar="POSES.csv", help="tool poses, played in a loop")] = None,
    fault: Faults = None,
    tcp: Tcp = False,
    port: Port = 0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="frames a second; of a pose table: its own")] = 60.0,
    patient: Annotated[bool, typer.Option("--patient", help="tools of a simulated operation on the virtual patient")] = False,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="of faults and virtual patient")] = 0,
    link: Annotated[Optional[Path], typer.Option(metavar="PATH", help="a link of that name to the pseudo-terminal")] = None,
    keep_state: Annotated[bool, typer.Option("--keep-state", help="closing the port does not reset the device")] = False,
    paced: Annotated[bool, typer.Option("--paced", help="replies take the time that the line's speed gives them")] = False,
    text_only: Annotated[bool, typer.Option("--text-only", help="a device that knows TX but not BX")] = False,
) -> None:
    """An NDI Polaris. The first line on stdout is the port to open; it is served until Ctrl-C.

    Without a pose table four tools move as if by hand: Reference, Probe, Stylus, Sphere. While it runs, lines on standard
    input change it: fault NAME, clear [NAME], reset, unplug SECONDS.

    Faults: byte-loss, bit-errors, stray-bytes, truncate, silence, delays, errors (each NAME=SHARE of the replies); missing,
    out-of-volume, partly-out-of-volume, interference, too-few-markers, disabled, unplugged (each NAME=SHARE of the time);
    bumped; disconnect=EVERY_S:OUT_S; brown-out=EVERY_S; delays=SHARE:SECONDS.
    """
    emulate_polaris.run(
        replay,
        fault,
        tcp,
        port=port,
        patient=patient,
        rate_hz=rate,
        seed=seed,
        link=link,
        keep_state=keep_state,
        paced=paced,
        text_only=text_only,
    )


@app.command("amode")
def amode(
    replay: Annotated[Optional[Path], typer.Option(metavar="REC.igs.mha", help="lines of a recording, played in a loop")] = None,
    fault: Faults = None,
    tcp: Tcp = False,
    port: Port = 0,
    protocol: Annotated[str, typer.Option(metavar="serial|pic0rick", help="which device's language it speaks")] = "serial",
    rate: Annotated[
        float, typer.Option(metavar="HZ", min=0.1, max=1000, help="lines a second; a pic0rick fires on request")
    ] = 20,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="of faults and virtual patient")] = 0,
) -> None:
    """An A-mode pulser/receiver. The first line on stdout is the port to open; it is served until Ctrl-C.

    Without a recording it gives the lines of a probe on the virtual patient, with a forerun of 23 mm at 2340 m/s.

    Faults, each NAME or NAME=SHARE of the answers: byte-loss, bit-errors, stall, disconnect, stale-fragment; of a pic0rick also
    split-prompts, extra-prompts, adc-timeout, bang-jitter, pulser-off.
    """
    emulate_amode.run(replay, fault, protocol, port=port, pty=not tcp, rate_hz=rate, seed=seed)
