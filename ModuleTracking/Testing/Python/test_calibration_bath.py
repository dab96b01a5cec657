"""Depths of echoes in a bath, from simulated lines whose echoes stand at known times; and the probe calibrated from them."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.recording import Acquisition, Recording
from ModuleTrackingLib.calibration import ProbeSettings, calibrate_probe
from ModuleTrackingLib.calibration.bath import bath_depths, plane_of, point_of
from test_calibration_probe import a_probe, guesses, misses, plane_echoes, point_echoes

SPEED = 1488.0
ACQUISITION = Acquisition(50e6, 5e6, 10.0, 2730.0)
LOOSE = ProbeSettings(max_face_sd_mm=5, max_beam_sd_deg=10)


def lines_of(rng, depths_mm, noise=20.0, samples=6000):
    """Short bursts at those depths, behind the forerun's ringing."""
    at_s = np.arange(samples) / ACQUISITION.sampling_hz
    forerun_s = 2e-3 * 10.0 / 2730.0
    echo_s = forerun_s + 2e-3 * np.asarray(depths_mm)[:, None] / SPEED

    def burst(centre_s, height):
        return height * np.exp(-(((at_s - centre_s) / 0.2e-6) ** 2)) * np.cos(2 * np.pi * 5e6 * (at_s - centre_s) + 0.7)

    lines = burst(echo_s, 3000.0) + burst(forerun_s, 20000.0) + rng.normal(0, noise, (len(depths_mm), samples))
    return np.rint(lines).astype(np.int16)


def a_recording(rng, poses, depths):
    statuses = ("MISSING",) * 3 + ("OK",) * (len(poses) - 3)
    times, none = np.arange(len(poses)) / 20, np.full(len(poses), -1)
    return Recording(lines_of(rng, depths), ACQUISITION, poses, statuses, times, none)


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def test_the_depth_is_where_the_echo_stands(rng):
    depths = rng.uniform(8, 70, 50)
    np.testing.assert_allclose(bath_depths(lines_of(rng, depths), ACQUISITION, SPEED), depths, atol=0.03)


def test_a_line_without_an_echo_has_no_depth(rng):
    quiet = rng.normal(0, 100, (200, 4000)).astype(np.int16)
    assert np.isnan(bath_depths(quiet, ACQUISITION, SPEED)).all()
    with pytest.raises(InputError, match="end before 5 mm"):
        bath_depths(quiet[:, :300], ACQUISITION, SPEED)


def test_points_and_a_plate_seen_in_recordings_give_the_probe(rng):
    truth = a_probe(rng)
    beam, face = guesses(rng, truth)
    points = [a_recording(rng, *point_echoes(rng, truth, place)) for place in ([10.0, -20, 40], [60.0, 5, -20])]
    plate = a_recording(rng, *plane_echoes(rng, truth, np.array([0.1, -0.2, 0.97]), 25.0))
    targets = [point_of(recording, SPEED, "point") for recording in points] + [plane_of(plate, SPEED, beam, face, "plate")]
    found = calibrate_probe(targets, beam, face, LOOSE)
    miss = misses(found, truth)
    assert miss @ np.linalg.solve(found.covariance, miss) < 20.5  # 0.1 % of a chi-square of 5
    assert np.linalg.norm(miss[:3]) < 0.6


def test_recordings_that_hold_too_little_are_refused(rng):
    poses, depths = point_echoes(rng, a_probe(rng), np.zeros(3), count=12)
    with pytest.raises(InputError, match="bead: only 9 lines"):
        point_of(a_recording(rng, poses, depths), SPEED, "bead")
