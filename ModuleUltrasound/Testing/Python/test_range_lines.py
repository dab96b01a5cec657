"""The family that covers the stated ranges evenly: its truth, its number of lines, and what it alone shows."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import range_lines, range_plan

LINES = 24


@pytest.fixture(scope="module")
def some_recordings():
    return [range_lines.simulate(np.random.default_rng(95_000_000 + index), LINES) for index in range(12)]


@pytest.fixture(scope="module")
def a_quiet_world():
    """Without anything that hides an echo."""
    drawn = (range_plan.draw_world(np.random.default_rng(seed)) for seed in range(200))
    world = next(one for one in drawn if not one.without and one.loss_db < 25 and one.acquisition.forerun_length_mm == 0)
    return replace(world, snr_db=40.0, static=False, hums=False, spikes=False, hot=False, jitter_us=0.0)


@pytest.mark.parametrize(("asked", "given"), [(1, 8), (12, 12), (40, 40)])
def test_recording_has_as_many_lines_as_asked_for_and_never_fewer_than_a_place_takes(asked, given):
    recording, truth, _ = range_lines.simulate(np.random.default_rng(asked), asked)
    assert len(recording) == given == len(recording.statuses) == len(recording.palpation_points)
    assert given == len(truth.depth_mm) == len(truth.snr_db) == len(truth.tilt_deg)


def test_peak_of_the_bones_envelope_stands_at_the_true_depth(some_recordings):
    off_mm = []
    for recording, truth, world in some_recordings:
        acquisition = recording.acquisition
        stated_us = 2e3 * acquisition.forerun_length_mm / (acquisition.forerun_speed_m_s or 1.0)
        skin_us = stated_us * (1 + world.tolerance + world.warming * np.linspace(0, 1, len(recording)))
        clear = np.flatnonzero((truth.snr_db > 20) & (truth.tilt_deg < 2))
        off_mm.extend(peaks_off_mm(recording, truth, clear, skin_us * 1e-6, 0.8e-6 / world.centre_mhz))
    assert len(off_mm) > 60
    assert abs(np.median(off_mm)) < 0.02
    assert np.quantile(np.abs(off_mm), 0.8) < 0.06


def test_lines_without_bone_have_no_truth_and_lost_poses_are_none(some_recordings):
    for recording, truth, world in some_recordings:
        bone = np.isfinite(truth.depth_mm)
        assert (truth.snr_db[~bone] == -np.inf).all()
        assert np.isfinite(truth.snr_db[bone]).all()
        assert not (world.without and bone.any())
        lost = np.array([status != "OK" for status in recording.statuses])
        np.testing.assert_array_equal(np.isnan(recording.probe_to_reference).any(axis=(1, 2)), lost)


def test_stated_signal_to_noise_is_that_of_the_perpendicular_lines(a_quiet_world):
    recording, truth, _ = range_lines.simulate(np.random.default_rng(3), 40, a_quiet_world)
    square = (truth.tilt_deg <= 3) & (truth.snr_db > 30)
    assert abs(np.median(truth.snr_db[square]) - a_quiet_world.snr_db) < 3
    assert len(recording) == 40


def test_ranges_are_covered_evenly_and_independently():
    worlds = [range_plan.draw_world(np.random.default_rng(seed)) for seed in range(400)]
    centre, speed, depth, attenuation = np.array(
        [(one.centre_mhz, one.speed_m_s, one.depth_mm, one.attenuation) for one in worlds]
    ).T
    for values, low, high in ((centre, 3, 10), (speed, 1450, 1630), (depth, 2, 15)):
        assert (np.histogram(values, 4, (low, high))[0] > 60).all()
    assert abs(np.corrcoef(centre, speed)[0, 1]) < 0.15
    assert max(one.loss_db for one in worlds) <= range_plan.MOST_LOSS_DB
    assert (attenuation * centre * depth * 0.2).max() <= range_plan.MOST_LOSS_DB + 1e-9
    assert 0.06 < np.mean([one.without != "" for one in worlds]) < 0.18


def test_bone_scatters_on_behind_its_surface(a_quiet_world):
    recording, truth, world = range_lines.simulate(np.random.default_rng(4), 40, a_quiet_world)
    codes = recording.lines - np.median(recording.lines)
    behind, far = [], []
    for row in np.flatnonzero(truth.snr_db > 35):
        bone = int(truth.depth_mm[row] * 2 / world.mm_us * world.sampling_mhz)
        early, late = (int(us * world.sampling_mhz) for us in (1.5, 3.5))
        behind.append(codes[row, bone + early : bone + late].std())
        far.append(codes[row, -200:].std())
    assert len(behind) > 5
    assert np.median(behind) > 1.5 * np.median(far)


@pytest.mark.parametrize("without", ["soft", "air", "cable"])
def test_recordings_wholly_without_bone_have_none_in_any_line(a_quiet_world, without):
    recording, truth, world = range_lines.simulate(np.random.default_rng(2), 16, replace(a_quiet_world, without=without))
    assert np.isnan(truth.depth_mm).all()
    first, last = (int(us * world.sampling_mhz) for us in (8, 14))
    codes = recording.lines - np.median(recording.lines)
    seen = codes[:, first:last].std() / codes[:, -200:].std()
    assert (seen > 1.5) == (without == "soft")
