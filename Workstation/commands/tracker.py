"""`cranionav tracker`: what trackers there are, whether one answers, and a recording of its tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

app = typer.Typer(help="Trackers: list them, test one, record its tools.", no_args_is_help=True, rich_markup_mode=None)

Name = Annotated[str, typer.Argument(metavar="NAME", help="tracker plugin, see `cranionav tracker list`")]
Set = Annotated[
    Optional[list[str]], typer.Option("--set", "-s", metavar="PARAMETER=VALUE", help="a parameter of the plugin; may be repeated")
]
Json = Annotated[bool, typer.Option("--json", help="print the result as JSON")]


@app.command("list")
def list_trackers(json: Json = False) -> None:
    """List tracker plugins with their parameters, and the serial ports a tracker may be at."""
    from Workstation.terminal import print_json
    from Workstation.tracking import describe_ports, describe_trackers

    trackers, ports = describe_trackers(), describe_ports()
    if json:
        print_json({"trackers": trackers, "ports": ports})
        return
    for tracker in trackers:
        print(f"{tracker['name']}: {'cannot be used: ' + tracker['problem'] if tracker['problem'] else tracker['title']}")
        for parameter in tracker["parameters"]:
            value = "" if parameter["default"] is None else parameter["default"]
            print(f"    {parameter['name']}={value}   {parameter['help']}")
    print("serial ports:" if ports else "serial ports: none")
    for port in ports:
        print(f"    {port['port']}   {port['description']}: {port['hint']}")


@app.command("probe")
def probe(
    name: Name,
    set_: Set = None,
    seconds: Annotated[float, typer.Option(min=0.2, help="how long to listen")] = 3.0,
    timeout: Annotated[float, typer.Option(min=0.5, help="longest wait for the connection, in s")] = 30.0,
    json: Json = False,
) -> None:
    """Connect to a tracker, listen, and tell what it sees."""
    from Workstation.terminal import print_json, print_table
    from Workstation.tracking import listen, make_tracker

    report = listen(make_tracker(name, set_ or []), seconds, timeout)
    if json:
        print_json(report)
        return
    print_table(
        f"{name}: {report['rate_hz']:.1f} frames/s, {report['dropped_frames']} dropped, jitter {report['jitter_ms']:.2f} ms"
        if report["jitter_ms"] is not None
        else f"{name}: {report['rate_hz']:.1f} frames/s, {report['dropped_frames']} dropped",
        ["tool", "status", "x mm", "y mm", "z mm", "error mm", "seen", "rate 1/s"],
        [
            [
                tool["tool"],
                tool["status"],
                *(f"{value:.2f}" for value in tool["position_mm"] or []),
                *([] if tool["position_mm"] else ["–"] * 3),
                "–" if tool["error_mm"] is None else f"{tool['error_mm']:.3f}",
                f"{tool['seen']:.0%}",
                f"{tool['rate_hz']:.1f}",
            ]
            for tool in report["tools"]
        ],
    )


@app.command("record")
def record(
    name: Name,
    set_: Set = None,
    output: Annotated[
        Optional[Path], typer.Option("--output", "-o", metavar="FILE.igs.mha", help="recording of all tools, and of A-lines")
    ] = None,
    csv: Annotated[Optional[Path], typer.Option("--csv", metavar="FILE.csv", help="table of tool poses")] = None,
    seconds: Annotated[Optional[float], typer.Option(min=0.1, help="length; without it until Ctrl-C")] = None,
    amode: Annotated[
        Optional[str], typer.Option("--amode", metavar="NAME", help="A-mode device whose lines are recorded")
    ] = None,
    amode_set: Annotated[
        Optional[list[str]], typer.Option("--amode-set", metavar="PARAMETER=VALUE", help="a parameter of that device")
    ] = None,
    timeout: Annotated[float, typer.Option(min=0.5, help="longest wait for the connection, in s")] = 30.0,
    json: Json = False,
) -> None:
    """Record all tools, and A-lines where a device is named, frame by frame; Ctrl-C ends it."""
    from CranioNavLib.errors import InputError

    from Workstation.terminal import print_json
    from Workstation.tracking import make_device, make_tracker, record_session

    if output is None and csv is None:
        raise InputError("nothing to record to; give -o FILE.igs.mha, --csv FILE.csv, or both")
    if amode is not None and output is None:
        raise InputError("A-lines are recorded into an .igs.mha file; give -o FILE.igs.mha")
    device = make_device(amode, amode_set or []) if amode is not None else None
    report = record_session(make_tracker(name, set_ or []), device, output, csv, seconds, timeout)
    if json:
        print_json(report)
        return
    for file in report["files"]:
        print(f"{file}: {report['frames']} frames in {report['duration_s']:.1f} s")


@app.command("serve")
def serve(
    name: Name,
    set_: Set = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 takes a free one")] = 18944,
    host: Annotated[
        str, typer.Option(help="address to serve at; others than this computer's own loopback only if you say so")
    ] = ("127.0.0.1"),
    seconds: Annotated[Optional[float], typer.Option(min=0.1, help="length; without it until Ctrl-C")] = None,
    amode: Annotated[
        Optional[str], typer.Option("--amode", metavar="NAME", help="A-mode device whose lines are served too")
    ] = None,
    amode_set: Annotated[
        Optional[list[str]], typer.Option("--amode-set", metavar="PARAMETER=VALUE", help="a parameter of that device")
    ] = None,
    timeout: Annotated[float, typer.Option(min=0.5, help="longest wait for the connection, in s")] = 30.0,
) -> None:
    """Serve poses, and A-lines, over OpenIGTLink to 3D Slicer and others; the first line on stdout is the address."""
    from Workstation.sharing import serve_session
    from Workstation.tracking import make_device, make_tracker

    device = make_device(amode, amode_set or []) if amode is not None else None
    serve_session(make_tracker(name, set_ or []), device, host, port, seconds, timeout)


@app.command("calibrate-probe")
def calibrate_probe(
    point: Annotated[
        Optional[list[Path]],
        typer.Option(metavar="REC.igs.mha", help="a small target, e.g. a bead, seen from many sides"),
    ] = None,
    plane: Annotated[Optional[list[Path]], typer.Option(metavar="REC.igs.mha", help="a flat plate; may be repeated, too")] = None,
    temperature: Annotated[float, typer.Option(metavar="DEG_C", help="of the water bath")] = 20.0,
    beam: Annotated[str, typer.Option(metavar="X,Y,Z", help="rough direction of the beam in the marker's frame")] = "0,0,1",
    face: Annotated[str, typer.Option(metavar="X,Y,Z", help="rough centre of the face in the marker's frame, mm")] = "0,0,0",
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.json", help="the calibration")] = Path(
        "probe.calibration.json"
    ),
    json: Json = False,
) -> None:
    """Find the A-mode probe's face and beam from recordings of targets in a water bath, made by `tracker record --amode`."""
    from Workstation.probe_calibration import calibrate_from
    from Workstation.terminal import print_json

    report = calibrate_from(point or [], plane or [], temperature, beam, face, output)
    if json:
        print_json(report)
        return
    print(
        f"{output}: face known to {report['face_sd_mm']:.2f} mm, beam to {report['beam_sd_deg']:.2f} deg (SD, worst direction), "
        f"from {report['echoes_used']} echoes, {report['echoes_left_out']} left out"
    )


@app.command("recover")
def recover_recording(
    recording: Annotated[Path, typer.Argument(metavar="FILE.igs.mha", help="the recording that was interrupted")],
    json: Json = False,
) -> None:
    """Join a recording whose process was killed or whose computer lost power into one file."""
    from CranioNavLib.sequence_metafile import recover

    from Workstation.terminal import print_json

    frames = recover(recording)
    print_json({"files": [str(recording)], "frames": frames}) if json else print(f"{recording}: {frames} frames")
