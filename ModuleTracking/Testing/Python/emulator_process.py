"""The Polaris emulator in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

START = "import sys; from Workstation.commands.emulate_polaris import run; run({})"


@dataclass
class RunningEmulator:
    """Its port, and its side channel."""

    url: str
    process: subprocess.Popen

    def control(self, line: str) -> str:
        """Say something on the side channel; the answer."""
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()
        return self.process.stderr.readline().strip()


@contextmanager
def emulator(**arguments) -> Iterator[RunningEmulator]:
    """`run(...)` with these arguments, until the block ends."""
    written = ", ".join(
        f"{name}=__import__('pathlib').Path({str(value)!r})" if name in ("replay", "link") else f"{name}={value!r}"
        for name, value in arguments.items()
    )
    process = subprocess.Popen(
        [sys.executable, "-c", START.format(written)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        url = process.stdout.readline().strip()
        assert url, process.stderr.read()
        yield RunningEmulator(url, process)
    finally:
        process.terminate()
        process.wait(10)


def write_poses(path, tools, frames: int, rate_hz: float, seed: int = 0) -> dict[str, np.ndarray]:
    """A pose CSV of arbitrary poses; per tool its rows qw..tz and error, NaN where missing."""
    rng = np.random.default_rng(seed)
    rows = {tool: np.full((frames, 8), np.nan) for tool in tools}
    lines = ["timestamp_s,tool,status,qw,qx,qy,qz,tx_mm,ty_mm,tz_mm,error_mm"]
    for frame in range(frames):
        for tool in tools:
            if frame % 7 == 3 and tool == tools[-1]:
                lines.append(f"{frame / rate_hz:.6f},{tool},MISSING,,,,,,,,")
                continue
            x, y, z, w = Rotation.random(random_state=int(rng.integers(2**31))).as_quat()
            rows[tool][frame] = [w, x, y, z, *rng.uniform([-400, -400, -2000], [400, 400, -900]), rng.uniform(0.02, 0.4)]
            lines.append(f"{frame / rate_hz:.6f},{tool},OK," + ",".join(f"{value:.7f}" for value in rows[tool][frame]))
    path.write_text("\n".join(lines) + "\n")
    return rows
