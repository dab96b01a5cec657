"""Accuracy and throughput of the echo detector on simulated lines of many kinds.

    python -m Testing.Benchmarks.echo --worlds 300 --seed 7

The recordings are drawn like those of the calibration, from each of its families (Testing/Studies/simulators), with other
seeds, and from one that no network is fitted to (latency_lines; other recordings of it are among those that
calibrate the stated quality). Depths are judged with the true speed of sound given.
"""

from __future__ import annotations

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from CranioNavLib.sequence_metafile import Acquisition, Recording
from ModuleUltrasoundLib.measurement.measure import EchoSettings, measure_lines

from Testing.Studies.simulators import bench_lines
from Testing.Studies.simulators.echo_lines import draw_world, simulate
from Testing.Studies.simulators.families import HARD, OFF_BONE, SESSIONS, TEXTBOOK, UNSEEN

Array = npt.NDArray[np.float64]
FRAMES = 40
SYMMETRIC = ("gauss", "ricker", "hann", "chirp", "symmetric")
SIMULATORS = HARD | SESSIONS | TEXTBOOK | OFF_BONE | UNSEEN


@dataclass(frozen=True, eq=False)
class Judged:
    """One simulated recording, measured."""

    family: str
    acquisition: Acquisition
    pulse: str
    attenuation: float  # dB/cm/MHz
    stated_snr_db: float
    each_line: bool  # the SNR is that of each line's own bone echo
    errors_mm: Array  # depth minus truth; NaN without bone or without an echo
    has_bone: npt.NDArray[np.bool_]
    tilt_deg: Array
    quality: Array
    accepted: npt.NDArray[np.bool_]
    snr_db: Array


def measure_world(seed: int, family: str = "echo_lines") -> Judged:
    """Simulate and measure one recording."""
    rng = np.random.default_rng(seed)
    if family == "echo_lines":
        recording, truth, world = simulate(rng, FRAMES)
        each_line = world.snr_per_line
    else:
        recording, truth, world = SIMULATORS[family].simulate(rng, FRAMES)
        each_line = getattr(world, "snr_of", "line") == "line"
    lines = measure_lines(recording, EchoSettings(speed_of_sound_m_s=truth.speed_m_s))
    return Judged(
        family,
        recording.acquisition,
        pulse_of(world),
        world.attenuation,
        world.snr_db,
        each_line,
        lines.depths_mm - truth.depth_mm,
        np.isfinite(truth.depth_mm),
        truth.tilt_deg,
        lines.qualities,
        lines.accepted,
        truth.snr_db,
    )


def pulse_of(world: Any) -> str:
    """The kind of its pulse."""
    if isinstance(world, bench_lines.Bench):
        return "symmetric" if world.symmetric else "struck"
    return str(getattr(world, "pulse", "gauss"))


def rates(judged: list[Judged]) -> dict[str, float]:
    """The figures that matter, over all lines of some recordings."""
    errors = np.concatenate([one.errors_mm for one in judged])
    accepted = np.concatenate([one.accepted for one in judged])
    bone = np.concatenate([one.has_bone for one in judged])
    near = bone & (np.concatenate([one.tilt_deg for one in judged]) < 3)
    heard = near & (np.concatenate([one.snr_db for one in judged]) >= 12)
    right = np.abs(np.nan_to_num(errors, nan=99.0))
    count = max(int(accepted.sum()), 1)
    return {
        "lines": float(len(errors)),
        "within 0.5 mm": float((accepted & (right < 0.5)).sum() / count),
        "within 0.25 mm": float((accepted & (right < 0.25)).sum() / count),
        "accepted < 3 deg": float((near & accepted).sum() / max(int(near.sum()), 1)),
        "and SNR >= 12 dB": float((heard & accepted).sum() / max(int(heard.sum()), 1)),
        "accepted without bone": float((accepted & ~bone).sum() / max(int((~bone).sum()), 1)),
    }


def calibration(judged: list[Judged], bins: int = 10) -> list[tuple[float, float, int]]:
    """Stated and observed probability that the depth is right to 0.5 mm, and number of lines, of each bin."""
    quality = np.concatenate([one.quality for one in judged])
    right = np.abs(np.nan_to_num(np.concatenate([one.errors_mm for one in judged]), nan=99.0)) < 0.5
    which = np.minimum((quality * bins).astype(int), bins - 1)
    return [
        (float(quality[which == b].mean()), float(right[which == b].mean()), int((which == b).sum()))
        for b in range(bins)
        if (which == b).any()
    ]


def throughput(lines: int = 4096, samples: int = 3200) -> float:
    """Lines a second of one core's time, for lines of `samples` samples at 60 MHz with a forerun."""
    rng = np.random.default_rng(0)
    world = replace(draw_world(rng), acquisition=Acquisition(60e6, 5e6, 20.0, 2340.0), samples=samples)
    recording, _, _ = simulate(rng, 128, world)
    index = np.arange(lines) % 128
    many = Recording(
        recording.lines[index],
        recording.acquisition,
        recording.probe_to_reference[index],
        ("OK",) * lines,
        np.arange(lines) / 50,
        recording.palpation_points[index],
    )
    measure_lines(recording)
    seconds = []
    for _ in range(3):
        start = time.process_time()
        measure_lines(many)
        seconds.append(time.process_time() - start)
    return lines / min(seconds)


def latency(repeats: int = 50) -> float:
    """Median seconds of processor time from one line of 3200 samples to its bone point."""
    rng = np.random.default_rng(0)
    world = replace(draw_world(rng), acquisition=Acquisition(60e6, 5e6, 20.0, 2340.0), samples=3200)
    recording, _, _ = simulate(rng, 1, world)
    times = []
    for _ in range(repeats):
        start = time.process_time()
        measure_lines(recording)
        times.append(time.process_time() - start)
    return float(np.median(times))


def groups(judged: list[Judged]) -> dict[str, list[Judged]]:
    """The recordings sorted by what makes them hard."""
    return {
        "all": judged,
        "with forerun": [one for one in judged if one.acquisition.forerun_length_mm > 0],
        "without forerun": [one for one in judged if one.acquisition.forerun_length_mm == 0],
        "symmetric pulse": [one for one in judged if one.pulse in SYMMETRIC],
        "causal pulse": [one for one in judged if one.pulse not in SYMMETRIC],
        "SNR 12-20 dB": [one for one in judged if one.stated_snr_db < 20],
        "SNR 20-40 dB": [one for one in judged if one.stated_snr_db >= 20],
        "3-6 MHz": [one for one in judged if one.acquisition.transducer_hz < 6e6],
        "6-10 MHz": [one for one in judged if one.acquisition.transducer_hz >= 6e6],
        "attenuation < 1": [one for one in judged if one.attenuation < 1],
        "attenuation > 1": [one for one in judged if one.attenuation >= 1],
        "SNR of each line": [one for one in judged if one.each_line],
        "SNR of another": [one for one in judged if not one.each_line],
    }


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=300)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    for family in SIMULATORS:
        seeds = [options.seed * 1_000_003 + i for i in range(options.worlds)]
        with ProcessPoolExecutor(options.jobs) as pool:
            judged = list(pool.map(partial(measure_world, family=family), seeds, chunksize=4))
        print(f"simulated lines of the family {family}, true speed of sound given")
        for name, some in groups(judged).items():
            if some:
                print(f"{name:20}", "  ".join(f"{key} {value:.4g}" for key, value in rates(some).items()))
        print("quality stated / observed / lines:")
        for stated, observed, count in calibration(judged):
            print(f"  {stated:.3f}  {observed:.3f}  {count}")
    print(f"throughput {throughput():.0f} lines/s of 3200 samples on one core; one line alone {1e3 * latency():.2f} ms")


if __name__ == "__main__":
    main()
