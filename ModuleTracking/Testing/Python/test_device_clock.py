"""Device to host time against a clock whose offset, drift and delays are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleTrackingLib.device_clock import DeviceClock


def arrivals(rng: np.random.Generator, seconds: float, drift_ppm: float, offset_s: float = 100.0):
    device = np.arange(0, seconds, 1 / 60)
    taken = offset_s + device * (1 + drift_ppm * 1e-6)
    return device, taken, taken + 0.002 + rng.exponential(0.003, len(device))


@pytest.mark.parametrize("drift_ppm", [0, 80, -80])
def test_offset_drift_and_times_are_found(drift_ppm):
    device, taken, arrived = arrivals(np.random.default_rng(3), 90, drift_ppm)
    clock = DeviceClock()
    mapped = np.array([clock.map(d, a) for d, a in zip(device, arrived, strict=True)])
    late = (mapped - taken)[len(taken) // 2 :]
    assert late.min() > 0.0018
    assert late.max() < 0.0028
    report = clock.report()
    assert report.drift_ppm == pytest.approx(drift_ppm, abs=5)
    assert report.offset_s == pytest.approx(taken[-1] + 0.002 - device[-1], abs=5e-4)
    assert report.jitter_ms == pytest.approx(3.0, rel=0.25)  # SD of the exponential delay


def test_a_long_delay_makes_a_pose_old_not_late():
    clock = DeviceClock()
    for k in range(60):
        clock.map(k / 60, 10 + k / 60)
    assert clock.map(1.0, 13.0) == pytest.approx(11.0, abs=1e-3)


@given(st.lists(st.floats(0, 5), min_size=1, max_size=200))
@settings(max_examples=50, deadline=None)
def test_no_pose_is_taken_after_it_arrived(delays):
    clock = DeviceClock()
    for k, delay in enumerate(delays):
        assert clock.map(k / 60, 50 + k / 60 + delay) <= 50 + k / 60 + delay


def test_without_device_time_the_arrival_counts():
    clock = DeviceClock()
    assert clock.map(math.nan, 7.0) == 7.0
    assert clock.report().samples == 0


def test_a_restarted_device_is_followed():
    clock = DeviceClock()
    for k in range(100):
        clock.map(1000 + k / 60, 10 + k / 60)
    assert clock.map(0.0, 20.0) == pytest.approx(20.0)
    assert clock.report().restarts == 1
