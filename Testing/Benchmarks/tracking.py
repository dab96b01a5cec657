"""Tracking beside the Polaris driver: pivot calibration, OpenIGTLink, recording.

    python -m Testing.Benchmarks.tracking --seconds 10

Pivot: tips of simulated pivots against scikit-surgerycalibration on the same data. OpenIGTLink: from `publish` in a
process of its own to the pose in the main thread, through the `openigtlink` tracker and the pose stream. Recording: what
one frame costs, how fast a file is read, and how memory grows over an hour's frames.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import multiprocessing
import os
import random
import resource
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from CranioNavLib.openigtlink import IgtlServer
from CranioNavLib.openigtlink.messages import Transform
from CranioNavLib.rigid import rigid
from CranioNavLib.sequence_metafile import Acquisition, RecordingWriter, read_recording
from ModuleTrackingLib.calibration import PivotSettings, calibrate_pivot
from ModuleTrackingLib.plugins.openigtlink import OpenIGTLinkSettings, OpenIGTLinkTracker
from ModuleTrackingLib.pose_stream import PoseStream
from scipy.spatial.transform import Rotation
from sksurgerycalibration.algorithms.pivot import pivot_calibration

TOOLS = ("Probe", "Reference", "Stylus", "Sphere")


def pivoting(rng: np.random.Generator, slips: float, turn_noise_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """200 poses in a cone of 30 deg with 0.25 mm RMS, and the tip."""
    count, tip, pivot = 200, np.array([0, 0, -150.0]) + rng.normal(0, 5, 3), np.array([60.0, -80, -1400])
    azimuth, angle = rng.uniform(0, 2 * np.pi, count), np.radians(30) * np.sqrt(rng.uniform(0, 1, count))
    turn = Rotation.from_rotvec(
        np.column_stack([np.cos(azimuth) * angle, np.sin(azimuth) * angle, rng.uniform(-0.3, 0.3, count)])
    )
    away = rng.normal(size=(count, 3))
    away *= rng.uniform(2, 10, (count, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
    slipped = (rng.permutation(count) < round(slips * count))[:, None]
    origin = pivot - turn.apply(tip) + np.where(slipped, away, 0) + rng.normal(0, 0.25 / np.sqrt(3), (count, 3))
    noisy = Rotation.from_rotvec(rng.normal(0, np.radians(turn_noise_deg), (count, 3))) * turn
    return rigid(noisy.as_matrix(), origin), tip


def measure_pivot(trials: int) -> None:
    """One line for each kind of noise."""
    for slips in (0.0, 0.1):
        for turn_noise_deg in (0.0, 0.1):
            errors: dict[str, list[float]] = {"ours": [], "theirs": [], "theirs, RANSAC": []}
            for seed in range(trials):
                rng = np.random.default_rng(seed)
                poses, tip = pivoting(rng, slips, turn_noise_deg)
                random.seed(seed)
                with contextlib.redirect_stdout(io.StringIO()):
                    tips = {
                        "ours": calibrate_pivot(poses, rng, PivotSettings(max_tip_sd_mm=5)).tip_in_marker_mm,
                        "theirs": pivot_calibration(poses)[0].ravel(),
                        "theirs, RANSAC": pivot_calibration(poses, {"method": "ransac"})[0].ravel(),
                    }
                for name, found in tips.items():
                    errors[name].append(float(np.linalg.norm(found - tip)))
            ours = np.array(errors["ours"])
            words = ", ".join(
                f"{name} {np.median(values):.3f} mm (ratio {np.median(ours / values):.2f}, worst {np.max(ours / values):.2f})"
                for name, values in errors.items()
            )
            print(f"pivot, slips {slips:.0%}, rotation noise {turn_noise_deg} deg: {words}", flush=True)


def serve(rate_hz: float, seconds: float, tell: Connection) -> None:
    """The server's process: its port, then frames of four tools; the time of each is told by its x position."""
    with IgtlServer(port=0) as server:
        tell.send(server.port)
        while not server.clients:
            time.sleep(0.01)
        begin = time.monotonic()
        for frame in range(int(rate_hz * seconds)):
            time.sleep(max(begin + frame / rate_hz - time.monotonic(), 0))
            stamp = time.time()
            for tool in TOOLS:
                matrix = np.eye(4)
                matrix[0, 3] = frame
                server.publish(Transform(f"{tool}ToTracker", stamp, matrix=matrix))
        time.sleep(0.5)
        tell.send(sum(info.dropped for info in server.clients))


def measure_openigtlink(rate_hz: float, seconds: float) -> None:
    """Latency and loss of frames of four tools."""
    hear, tell = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("spawn").Process(target=serve, args=(rate_hz, seconds, tell))
    process.start()
    latency, numbers = [], []
    with PoseStream(OpenIGTLinkTracker(OpenIGTLinkSettings(port=hear.recv(), connect_timeout_s=1))) as stream:
        busy, begin = time.process_time(), time.monotonic()
        while time.monotonic() - begin < seconds + 1.5 and len(numbers) < rate_hz * seconds:
            for frame in stream.poll():
                if len(frame) == len(TOOLS) and frame[0].usable and frame[0].tool_to_tracker is not None:
                    latency.append(time.time() - frame[0].device_time_s)
                    numbers.append(int(frame[0].tool_to_tracker[0, 3]))
            time.sleep(0.002)
        share = (time.process_time() - busy) / (time.monotonic() - begin)
        dropped = stream.state.dropped_frames + hear.recv()
    process.join()
    middle, high = np.percentile(np.array(latency) * 1e3, [50, 99])
    lost = int(rate_hz * seconds) - len(set(numbers))
    print(
        f"OpenIGTLink {rate_hz:.0f} Hz, 4 tools: {len(numbers)} frames, {lost} lost, {dropped} dropped, median {middle:.2f} ms, "
        f"99 % {high:.2f} ms, processor {share:.1%} of one core",
        flush=True,
    )


def measure_recording(frames: int) -> None:
    """Cost of a frame, speed of reading, growth of memory."""
    acquisition, samples = Acquisition(50e6, 5e6), 3200
    line = np.arange(samples, dtype=np.int16)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.igs.mha"
        with RecordingWriter(path, samples, acquisition) as writer:
            for number in range(frames):
                if number == 1000:
                    early, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
                writer.append(number / 60, {"ProbeToReference": np.eye(4), "StylusToReference": np.eye(4)}, line=line)
            cost_us = (time.perf_counter() - begin) / (frames - 1000) * 1e6
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - early
        print(f"recording: {cost_us:.0f} us a frame, memory grew by {grown / 1024:.1f} MB in {frames} frames, joining included")
        with RecordingWriter(path, samples, acquisition) as writer:
            for number in range(5000):
                writer.append(number / 60, {"ProbeToReference": np.eye(4)}, line=line)
        begin = time.perf_counter()
        read_recording(path)
        print(f"reading: 5000 frames of {samples} samples in {time.perf_counter() - begin:.2f} s", flush=True)


def main() -> None:
    """Print one line a measurement."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--frames", type=int, default=216_000)
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    measure_recording(options.frames)
    measure_pivot(options.trials)
    for rate_hz in (60.0, 250.0):
        measure_openigtlink(rate_hz, options.seconds)


if __name__ == "__main__":
    main()
