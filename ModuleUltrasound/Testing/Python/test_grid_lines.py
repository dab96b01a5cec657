"""The family that the detector is judged by: its truth, its number of lines, and which lines it demands."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import grid_lines, grid_plan

LINES = 24


@pytest.fixture(scope="module")
def some_recordings():
    return [grid_lines.simulate(np.random.default_rng(96_000_000 + index), LINES) for index in range(16)]


@pytest.fixture(scope="module")
def a_quiet_setup():
    """Bone under thick skin, heard well, without a delay line."""
    drawn = (grid_plan.draw_setup(np.random.default_rng(seed)) for seed in range(500))
    found = next(one for one in drawn if not (one.without or one.sweeps or one.material or one.blanked) and one.depth_mm > 8)
    return replace(found, snr_db=40.0)


def skin_us(recording):
    """Where the stated delay line ends."""
    acquisition = recording.acquisition
    return 2e3 * acquisition.forerun_length_mm / (acquisition.forerun_speed_m_s or 1.0)


@pytest.mark.parametrize(("asked", "given"), [(1, 8), (12, 12), (90, 90)])
def test_recording_has_as_many_lines_as_asked_for_and_never_fewer_than_a_place_takes(asked, given):
    recording, truth, world = grid_lines.simulate(np.random.default_rng(asked), asked)
    assert len(recording) == given == len(recording.statuses) == len(recording.palpation_points)
    assert given == len(truth.depth_mm) == len(truth.snr_db) == len(truth.tilt_deg)
    assert given == len(world.must) == len(world.kind) == len(world.ignore)


def test_peak_of_the_bones_envelope_stands_at_the_true_depth(some_recordings):
    off_mm = []
    for recording, truth, world in some_recordings:
        skin_s = np.full(len(recording), skin_us(recording) * 1e-6)
        clear = np.flatnonzero(world.must & (truth.snr_db > 20))
        off_mm.extend(peaks_off_mm(recording, truth, clear, skin_s, 1e-7 + 0.8e-6 / world.centre_mhz))
    assert len(off_mm) > 60
    assert abs(np.median(off_mm)) < 0.03
    assert np.quantile(np.abs(off_mm), 0.8) < 0.12  # the delay line is warmer or colder than stated


def test_lines_without_bone_have_no_truth_and_lost_poses_are_none(some_recordings):
    for recording, truth, world in some_recordings:
        bone = np.isfinite(truth.depth_mm)
        np.testing.assert_array_equal(bone, ~np.isin(world.kind, ["air", "soft", "cable"]))
        assert (truth.snr_db[~bone] == -np.inf).all()
        assert np.isfinite(truth.snr_db[bone]).all()
        assert not (world.without and bone.any())
        lost = np.array([status != "OK" for status in recording.statuses])
        np.testing.assert_array_equal(np.isnan(recording.probe_to_reference).any(axis=(1, 2)), lost)


def test_only_plain_bone_of_a_tracked_probe_is_demanded(some_recordings):
    demanded = 0
    for recording, truth, world in some_recordings:
        must = world.must
        demanded += must.sum()
        assert (world.kind[must] == "bone").all()
        assert (truth.snr_db[must] >= 12).all()
        assert (truth.tilt_deg[must] <= 3).all()
        assert not (must & world.ignore).any()
        assert all(recording.statuses[row] == "OK" for row in np.flatnonzero(must))
    assert 0.2 < demanded / (LINES * len(some_recordings)) < 0.7


def test_every_quantity_covers_its_range_whatever_the_others_are():
    setups = [grid_plan.draw_setup(np.random.default_rng(seed)) for seed in range(400)]
    centre, speed, snr, attenuation = np.array([(one.centre_mhz, one.speed_m_s, one.snr_db, one.attenuation) for one in setups]).T
    for values, low, high in ((centre, 3, 10), (speed, 1450, 1630), (snr, 12, 40), (attenuation, 0.3, 2.6)):
        assert (np.histogram(values, 4, (low, high))[0] > 70).all()
    assert abs(np.corrcoef(centre, attenuation)[0, 1]) < 0.15
    loss_db = [0.2 * one.attenuation * one.centre_mhz * one.depth_mm for one in setups]
    assert max(loss_db) <= grid_plan.MOST_LOSS_DB + 1e-9
    assert min(one.sampling_mhz / one.centre_mhz for one in setups) >= grid_plan.LEAST_SAMPLES
    assert 0.1 < np.mean([one.without != "" for one in setups]) < 0.22
    assert 0.2 < np.mean([one.sweeps for one in setups]) < 0.36
    assert 0.08 < np.mean([one.short for one in setups]) < 0.22


def test_element_that_is_not_blanked_rings_on_after_the_transmitted_pulse(a_quiet_setup):
    heights = []
    for blanked in (False, True):
        recording, _, world = grid_lines.simulate(np.random.default_rng(3), 8, replace(a_quiet_setup, blanked=blanked))
        early = recording.lines[:, : int(2 / world.centre_mhz * world.sampling_mhz)].astype(float)
        heights.append(np.abs(early).max())
    assert heights[0] > 5 * heights[1]


def test_skull_is_a_sphere_that_beam_and_depth_lead_to(a_quiet_setup):
    recording, truth, _ = grid_lines.simulate(np.random.default_rng(4), 60, a_quiet_setup)
    seen = np.isfinite(truth.depth_mm) & np.isfinite(recording.probe_to_reference[:, 0, 0])
    poses = recording.probe_to_reference[seen]
    bone = poses[:, :3, 3] + truth.depth_mm[seen, None] * poses[:, :3, 2]
    radius = np.linalg.norm(bone, axis=1)
    assert abs(np.median(radius) - grid_plan.HEAD_MM) < 0.1
    assert np.abs(radius - grid_plan.HEAD_MM).max() < 0.5
    assert len(set(recording.palpation_points)) == 3


@pytest.mark.parametrize("without", ["soft", "air", "cable"])
def test_recordings_wholly_without_bone_have_none_in_any_line(a_quiet_setup, without):
    recording, truth, world = grid_lines.simulate(np.random.default_rng(2), 16, replace(a_quiet_setup, without=without))
    assert np.isnan(truth.depth_mm).all()
    assert not world.must.any()
    first, last = (int(us * world.sampling_mhz) for us in (4, 10))
    codes = recording.lines - np.median(recording.lines)
    seen = codes[:, first:last].std() / codes[:, -100:].std()
    assert (seen > 1.5) == (without == "soft")
