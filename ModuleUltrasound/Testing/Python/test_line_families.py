"""What every family of simulated A-lines keeps to."""

import numpy as np
import pytest

from Testing.Studies.simulators.families import HARD, OFF_BONE, SESSIONS, TEXTBOOK, UNSEEN

FAMILIES = HARD | SESSIONS | TEXTBOOK | OFF_BONE | UNSEEN


@pytest.mark.parametrize("family", FAMILIES)
def test_recording_is_the_same_for_the_same_seed(family):
    (one, truth, world), (again, other, same) = (FAMILIES[family].simulate(np.random.default_rng(5), 12) for _ in range(2))
    np.testing.assert_array_equal(one.lines, again.lines)
    np.testing.assert_array_equal(one.probe_to_reference, again.probe_to_reference)
    np.testing.assert_array_equal(truth.depth_mm, other.depth_mm)
    np.testing.assert_array_equal(truth.snr_db, other.snr_db)
    assert one.statuses == again.statuses
    assert repr(world) == repr(same)
    assert one.lines.dtype == np.int16


@pytest.mark.parametrize("family", FAMILIES)
def test_truth_and_poses_fit_the_lines(family):
    for seed in range(4):
        recording, truth, _ = FAMILIES[family].simulate(np.random.default_rng(95_000_000 + seed), 16)
        for values in (truth.depth_mm, truth.snr_db, truth.tilt_deg, recording.statuses, recording.palpation_points):
            assert len(values) == len(recording)
        bone = np.isfinite(truth.depth_mm)
        assert (truth.snr_db[~bone] == -np.inf).all()
        lost = np.array([status != "OK" for status in recording.statuses])
        np.testing.assert_array_equal(np.isnan(recording.probe_to_reference).any(axis=(1, 2)), lost)
