"""Latency, lost frames and processor share of the Polaris driver against the emulator in a process of its own.

    python -m Testing.Benchmarks.polaris_latency --seconds 20

Latency is counted from the moment at which the emulator has written the last byte of a reply to the pseudo-terminal
until the tool poses leave the driver, and until the tools' transform nodes are written (driver in its own thread; the main
thread is woken by the stream or, with --poll-ms, looks every so often as a Qt timer does). The line takes the time that
the bytes need at its speed. Frames between the first and the last that are lost are told apart: not asked for while the
device had them (it keeps the newest only, for 4 ms at 250 Hz), and sent but not delivered. Both processes share this
computer's monotonic clock.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np
from ModuleTrackingLib.ndi.emulator.device import EmulatedPolaris
from ModuleTrackingLib.ndi.emulator.motion import HandMotion
from ModuleTrackingLib.ndi.emulator.server import TerminalLine, serve
from ModuleTrackingLib.ndi.emulator.station import Station
from ModuleTrackingLib.ndi.poll import OPTIONS
from ModuleTrackingLib.ndi.replies import BadReplyError
from ModuleTrackingLib.ndi.tracking import parse_bx
from ModuleTrackingLib.pose_stream import PoseStream
from ModuleTrackingLib.tracker import TRACKERS, Tracker

SKIPPED_FRAMES = 100  # the driver learns the device's pace


class WatchedLine(TerminalLine):
    """Notes when each reply has been written; the newest frame's first reply counts."""

    def __init__(self) -> None:
        super().__init__()
        self.written: list[tuple[float, bytes]] = []

    def write(self, data: bytes) -> None:
        super().write(data)
        self.written.append((time.monotonic(), data))


def emulate(rate_hz: float, tell: Connection) -> None:
    """The emulator's process: its port first, and when it is ended the time of every frame's first reply."""
    sys.stdin = open(os.devnull)  # noqa: SIM115, PTH123  (no side channel)
    line = WatchedLine()
    tell.send(line.url)
    serve(Station(EmulatedPolaris(HandMotion(rate_hz)), paced=True), line)
    times: dict[int, float] = {}
    for at_s, data in line.written:
        try:
            frames = [entry.frame for entry in parse_bx(data, OPTIONS).handles if entry.frame is not None]
        except BadReplyError:
            continue  # a reply of the set-up
        if frames:
            times.setdefault(frames[0], at_s)
    tell.send((times, time.process_time()))


@dataclass
class Emulator:
    """The running emulator; `times` and `busy_s` are known once it has ended."""

    url: str
    times: dict[int, float]
    busy_s: float = 0.0


@contextmanager
def emulator(rate_hz: float) -> Iterator[Emulator]:
    """The emulator in a process of its own."""
    hear, tell = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("spawn").Process(target=emulate, args=(rate_hz, tell))
    process.start()
    running = Emulator(hear.recv(), {})
    try:
        yield running
    finally:
        process.terminate()
        running.times, running.busy_s = hear.recv()
        process.join()


@dataclass(frozen=True)
class Result:
    """One line of the table."""

    what: str
    rate_hz: float
    frames: int
    not_asked: int
    not_delivered: int
    latency_ms: np.ndarray
    processor: float  # share of one core

    def __str__(self) -> str:
        middle, high, worst = np.percentile(self.latency_ms, [50, 99, 100])
        return (
            f"{self.what:<28} {self.rate_hz:5.0f} Hz {self.frames:7d} frames, lost: {self.not_asked:4d} not asked for, "
            f"{self.not_delivered} sent but not delivered   "
            f"median {middle:6.2f} ms   99 % {high:6.2f} ms   worst {worst:7.2f} ms   processor {100 * self.processor:5.1f} %"
        )


def judge(what: str, rate_hz: float, arrivals: dict[int, float], sent: dict[int, float], processor: float) -> Result:
    """Latencies of the frames that both sides know."""
    arrivals.pop(-1, None)  # "no answer" has no frame number
    frames = sorted(arrivals)[SKIPPED_FRAMES:]
    missed = set(range(frames[0], frames[-1] + 1)).difference(frames)
    latency = np.array([arrivals[frame] - sent[frame] for frame in frames if frame in sent])
    return Result(what, rate_hz, len(frames), len(missed - sent.keys()), len(missed & sent.keys()), 1e3 * latency, processor)


def measure_driver(rate_hz: float, seconds: float) -> Result:
    """From the last byte to the tool poses."""
    with emulator(rate_hz) as running:
        arrivals: dict[int, float] = {}
        with TRACKERS.create("polaris", port=running.url) as tracker:
            began_s, busy_s = time.monotonic(), time.process_time()
            while time.monotonic() < began_s + seconds:
                for pose in tracker.read()[:1]:
                    arrivals[pose.frame_number] = time.monotonic()
            share = (time.process_time() - busy_s) / (time.monotonic() - began_s)
    return judge("to the tool poses", rate_hz, arrivals, running.times, share)


def measure_node(rate_hz: float, seconds: float, poll_ms: float) -> Result:
    """From the last byte to the transform nodes, as the tracking module writes them."""
    from CranioNavLib import host, scene_data

    host.scene()
    with emulator(rate_hz) as running:
        tracker: Tracker = TRACKERS.create("polaris", port=running.url)
        arrivals: dict[int, float] = {}
        with PoseStream(tracker) as stream:
            while not stream.poll():
                time.sleep(0.01)
            began_s, busy_s = time.monotonic(), time.process_time()
            while time.monotonic() < began_s + seconds:
                for frame in stream.poll():
                    for pose in frame:
                        role = f"{pose.tool}ToReference"
                        relative = stream.in_reference_at(pose.tool, pose.host_time_s)
                        if pose.tool != "Reference":
                            scene_data.set_pose(role, relative.tool_to_reference, relative.status.value, pose.host_time_s)
                        elif pose.usable:
                            scene_data.set_transform("ReferenceToTracker", pose.tool_to_tracker)
                    arrivals[frame[0].frame_number] = time.monotonic()
                if poll_ms:
                    time.sleep(poll_ms / 1e3)
                else:
                    stream.wait(0.1)
            share = (time.process_time() - busy_s) / (time.monotonic() - began_s)
    return judge(f"to the nodes, {f'poll {poll_ms:g} ms' if poll_ms else 'woken'}", rate_hz, arrivals, running.times, share)


def main() -> None:
    """Print one line a measurement."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--poll-ms", type=float, default=5.0, help="of the third line; the second is woken")
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; 4 tools")
    for rate_hz in (60.0, 250.0):
        print(measure_driver(rate_hz, options.seconds), flush=True)
        for poll_ms in (0.0, options.poll_ms):
            print(measure_node(rate_hz, options.seconds, poll_ms), flush=True)


if __name__ == "__main__":
    main()
