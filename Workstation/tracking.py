"""Listening to a tracker and recording it, for the command line: the loop on the main thread, and the live table."""

from __future__ import annotations

import contextlib
import math
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from CranioNavLib.device_stream import CONNECTING
from CranioNavLib.errors import InputError
from ModuleTrackingLib.pose_csv import PoseCsvWriter
from ModuleTrackingLib.pose_stream import PoseStream
from ModuleTrackingLib.recorder import SessionRecorder
from ModuleTrackingLib.tracker import TRACKERS, ToolPose, Tracker
from ModuleUltrasoundLib.devices.device import AMODE_DEVICES, AModeDevice, DeviceError

TURN_S = 0.01  # of the main loop: well under a frame at 60 Hz
REDRAW_HZ = 10


def describe_trackers() -> list[dict[str, Any]]:
    """Every tracker plugin with its parameters, for JSON."""
    described = []
    for entry in TRACKERS.entries():
        parameters = [] if entry.problem else TRACKERS.find(entry.name).Settings.describe()
        described.append(
            {
                "name": entry.name,
                "title": entry.title,
                "source": entry.source,
                "problem": entry.problem,
                "parameters": [
                    {
                        "name": info.name,
                        "type": info.kind.__name__,
                        "default": getattr(info.default, "value", info.default),
                        "unit": info.unit,
                        "help": info.help,
                    }
                    for info in parameters
                ],
            }
        )
    return described


def describe_ports() -> list[dict[str, str]]:
    """Serial ports of this computer, those a tracker is likely at first."""
    from ModuleTrackingLib.ndi.serial_port import list_ports

    return [{"port": port.device, "description": port.description, "hint": port.hint} for port in list_ports()]


def make_tracker(name: str, settings: list[str]) -> Tracker:
    """The tracker plugin `name` with `PARAMETER=VALUE` settings.

    Raises
    ------
    InputError
        Unknown plugin or parameter, or a value out of its limits.
    """
    plugin = TRACKERS.find(name)
    # Nobody is here to hold the simulated tools, and their tracking needs no CT.
    alone = {"hand": "round", "head": "synthetic"} if name == "simulated" else {}
    return plugin(plugin.Settings.from_strings({**alone, **_pairs(settings)}))


def make_device(name: str, settings: list[str]) -> AModeDevice:
    """The A-mode device plugin `name` with `PARAMETER=VALUE` settings."""
    plugin = AMODE_DEVICES.find(name)
    return plugin(plugin.Settings.from_strings(_pairs(settings)))


def _pairs(settings: list[str]) -> dict[str, str]:
    pairs = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or not name:
            raise InputError(f"expected PARAMETER=VALUE, got {setting!r}")
        pairs[name.strip()] = value
    return pairs


class _Tally:
    """How often each tool was seen."""

    def __init__(self) -> None:
        self.frames: Counter[str] = Counter()
        self.seen: Counter[str] = Counter()
        self.last: dict[str, ToolPose] = {}

    def add(self, frames: list[list[ToolPose]]) -> None:
        for frame in frames:
            for pose in frame:
                self.frames[pose.tool] += 1
                self.seen[pose.tool] += pose.usable
                self.last[pose.tool] = pose

    def rows(self, duration_s: float) -> list[dict[str, Any]]:
        rows = []
        for tool, pose in self.last.items():
            matrix = pose.tool_to_tracker if pose.usable else None
            rows.append(
                {
                    "tool": tool,
                    "status": pose.status.value,
                    "position_mm": None if matrix is None else [float(value) for value in matrix[:3, 3]],
                    "error_mm": None if math.isnan(pose.error_mm) else pose.error_mm,
                    "seen": self.seen[tool] / self.frames[tool],
                    "rate_hz": self.frames[tool] / duration_s,
                }
            )
        return rows


def listen(tracker: Tracker, seconds: float, timeout_s: float) -> dict[str, Any]:
    """Connect, listen for `seconds`, and report what came.

    Raises
    ------
    InputError
        The tracker does not connect within `timeout_s`, or sends nothing.
    """
    tally = _Tally()
    with PoseStream(tracker) as stream, live_table(stream) as redraw:
        connect(stream, timeout_s)
        begin = time.monotonic()
        while time.monotonic() - begin < seconds:
            tally.add(stream.poll())
            redraw()
            stream.wait(TURN_S)
        state = stream.state
        if not tally.frames:
            raise InputError(
                f"{tracker.name}: connected, but no tool was reported in {seconds:g} s; {state.problem or 'is it tracking?'}"
            )
        jitter = state.clock.jitter_ms
        return {
            "tracker": tracker.name,
            "rate_hz": state.frames / seconds,
            "frames": state.frames,
            "dropped_frames": state.dropped_frames,
            "reconnections": state.reconnections,
            "jitter_ms": None if math.isnan(jitter) else jitter,
            "tools": tally.rows(seconds),
        }


def record_session(
    tracker: Tracker,
    device: AModeDevice | None,
    output: Path | None,
    csv: Path | None,
    seconds: float | None,
    timeout_s: float,
) -> dict[str, Any]:
    """Record until `seconds` are over or the user interrupts; the files are finished either way."""
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(PoseStream(tracker))
        redraw = stack.enter_context(live_table(stream))
        interrupted = stack.enter_context(interruption())
        connect(stream, timeout_s, interrupted)
        table = stack.enter_context(PoseCsvWriter(csv)) if csv is not None else None
        recorder = stack.enter_context(SessionRecorder(output, stream)) if output is not None and device is None else None
        if device is not None:
            open_device(device, stack)
        begin = time.monotonic()
        frames_in_table = 0
        while not interrupted and (seconds is None or time.monotonic() - begin < seconds):
            line = read_device(device)
            frames = stream.poll()
            if recorder is None and line is not None and output is not None and device is not None:
                recorder = stack.enter_context(SessionRecorder(output, stream, device.acquisition, len(line.samples)))
            if recorder is not None:
                if line is not None:
                    recorder.add_line(line.samples, line.host_time_s)
                recorder.add_frames(frames)
            if table is not None:
                for frame in frames:
                    table.write(frame[0].host_time_s - begin, frame)
                frames_in_table += len(frames)
            redraw()
            if not frames and getattr(tracker, "finished", False):  # a replay at its end
                break
            if device is None:
                stream.wait(TURN_S)
        duration_s = time.monotonic() - begin
        state = stream.state
        if recorder is not None:
            recorder.flush(everything=True)
        frames_recorded = recorder.state.frames if recorder is not None else frames_in_table
    if not frames_recorded:
        raise InputError(f"{tracker.name}: nothing came in {duration_s:.1f} s; {state.problem or 'is it tracking?'}")
    return {
        "tracker": tracker.name,
        "files": [str(path) for path in (output, csv) if path is not None],
        "frames": frames_recorded,
        "duration_s": duration_s,
        "dropped_frames": state.dropped_frames,
        "reconnections": state.reconnections,
    }


def connect(stream: PoseStream, timeout_s: float, interrupted: list[int] | None = None) -> None:
    """Wait until the tracker is connected.

    Raises
    ------
    InputError
        It cannot be had, or not in time.
    """
    deadline = time.monotonic() + timeout_s
    while not stream.state.connected and not interrupted:
        stream.poll()
        if not stream.state.connected and stream.state.problem != CONNECTING:  # drivers are patient by themselves
            raise InputError(f"{stream.tracker.name}: {stream.state.problem}")
        if time.monotonic() > deadline:
            raise InputError(
                f"{stream.tracker.name}: no connection in {timeout_s:g} s; check the device, or wait longer: --timeout"
            )
        stream.wait(TURN_S)


def open_device(device: AModeDevice, stack: contextlib.ExitStack) -> None:
    """Open and start an A-mode device; the stack closes it."""
    try:
        stack.enter_context(device)
    except DeviceError as error:
        raise InputError(f"{device.name}: {error}") from None


def read_device(device: AModeDevice | None) -> Any:
    """The device's next line, or None."""
    if device is None:
        return None
    try:
        return device.read(TURN_S)
    except DeviceError as error:
        raise InputError(f"{device.name}: {error}") from None


@contextlib.contextmanager
def interruption() -> Iterator[list[int]]:
    """A list that is no longer empty once the user or the system asked to end; the files are then finished in order."""
    asked: list[int] = []
    before = {name: signal.signal(name, lambda number, _: asked.append(number)) for name in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)


@contextlib.contextmanager
def live_table(stream: PoseStream) -> Iterator[Any]:
    """A function that redraws the tools on stderr when that is a terminal; else it does nothing."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.live import Live

    with Live(console=Console(stderr=True), refresh_per_second=REDRAW_HZ, transient=True) as live:
        last = [0.0]

        def redraw() -> None:
            if time.monotonic() - last[0] > 1 / REDRAW_HZ:
                last[0] = time.monotonic()
                live.update(tool_table(stream))

        yield redraw


def tool_table(stream: PoseStream) -> Any:
    """The tools as they are now: status, position, error, rate, age."""
    from rich.table import Table

    state = stream.state
    title = (
        f"{stream.tracker.name}: {state.rate_hz:.0f} frames/s, {state.dropped_frames} dropped"
        if state.connected
        else state.problem
    )
    table = Table(title=title, title_justify="left")
    for column in ("tool", "status", "x mm", "y mm", "z mm", "error mm", "rate 1/s", "age ms"):
        table.add_column(column, justify="left" if column in ("tool", "status") else "right")
    now = time.monotonic()
    for tool in stream.tool_names:
        pose = stream.current(tool)
        position = np.full(3, np.nan) if pose.tool_to_tracker is None else pose.tool_to_tracker[:3, 3]
        numbers = [*position, pose.error_mm if pose.usable else math.nan]
        cells = ["–" if math.isnan(value) else f"{value:.2f}" for value in numbers]
        style = "" if pose.usable else "red"
        age_ms = (now - pose.host_time_s) * 1e3
        table.add_row(tool, pose.status.value, *cells, f"{stream.rate_hz(tool):.0f}", f"{age_ms:.0f}", style=style)
    return table
