"""The simulated A-lines of surfaces summed over the footprint: where the echo stands, what is demanded, holes, soft places."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import kirchhoff_lines
from Testing.Studies.simulators.kirchhoff_plan import draw_world


@pytest.fixture(scope="module")
def some_recordings():
    return [kirchhoff_lines.simulate(np.random.default_rng(94_000_000 + index), 16) for index in range(10)]


@pytest.fixture(scope="module")
def a_plain_world():
    """A delay line that is long enough, bone everywhere, dwells."""
    drawn = (draw_world(np.random.default_rng(seed)) for seed in range(200))
    world = next(one for one in drawn if one.acquisition.forerun_length_mm > 20 and one.depth_mm > 5)
    return replace(world, without="", hole=False, steep=False, sweeps=False, snr_db=35.0, fill=0.3)


@pytest.mark.parametrize("frames", [8, 12, 60, 90])
def test_recording_has_about_as_many_lines_as_asked_for(frames):
    for seed in range(2):
        recording, truth, world = kirchhoff_lines.simulate(np.random.default_rng(1000 * seed + frames), frames)
        assert max(8, 0.6 * frames) <= len(recording) <= 1.5 * frames
        for values in (truth.depth_mm, truth.snr_db, truth.tilt_deg, world.must, world.ignore, recording.statuses):
            assert len(values) == len(recording)
        lost = np.array([status != "OK" for status in recording.statuses])
        np.testing.assert_array_equal(np.isnan(recording.probe_to_reference).any(axis=(1, 2)), lost)


def off_mm(recording, truth, world):
    """Peak of the envelope near the bone minus the truth, of clear lines that have to be accepted."""
    line = world.forerun
    skin_s = line.time_s / (1 + line.faster + line.drift * np.arange(len(recording)) / len(recording))
    return peaks_off_mm(recording, truth, np.flatnonzero(world.must & (truth.snr_db > 25)), skin_s, 0.5e-6)


def test_echo_stands_where_the_truth_says(some_recordings):
    off = np.concatenate([off_mm(*one) for one in some_recordings])
    assert len(off) > 20
    assert abs(np.median(off)) < 0.04
    assert np.median(np.abs(off)) < 0.05


def test_lines_without_bone_have_no_truth_and_are_not_demanded(some_recordings):
    for _, truth, world in some_recordings:
        np.testing.assert_array_equal(np.isnan(truth.depth_mm), truth.snr_db == -np.inf)
        assert not (world.must & (np.isnan(truth.depth_mm) | world.ignore)).any()
    for without in ("soft", "gel", "air"):
        world = replace(some_recordings[0][2], without=without)
        _, truth, world = kirchhoff_lines.simulate(np.random.default_rng(3), 8, world)
        assert np.isnan(truth.depth_mm).all()
        assert not world.must.any()


def test_lines_that_are_demanded_are_met_squarely_and_heard(some_recordings):
    demanded = 0
    for recording, truth, world in some_recordings:
        assert (truth.tilt_deg[world.must] <= 3).all()
        assert (truth.snr_db[world.must] >= 12).all()
        assert all(recording.statuses[row] == "OK" for row in np.flatnonzero(world.must))
        demanded += int(world.must.sum())
    assert demanded > 30


def test_leaning_over_loses_the_echo_by_the_sum_over_the_footprint(a_plain_world):
    lost = []
    for seed in range(20):
        _, truth, _ = kirchhoff_lines.simulate(np.random.default_rng(seed), 19, replace(a_plain_world, steep=True))
        square = truth.snr_db[np.isfinite(truth.depth_mm) & (truth.tilt_deg < 2)]
        steep = truth.snr_db[np.isfinite(truth.depth_mm) & (truth.tilt_deg > 7)]
        if len(square) and len(steep):
            lost.append(np.median(square) - np.median(steep))
        if len(lost) == 2:
            break
    assert lost
    assert min(lost) > 10


def test_hole_of_a_sweep_ends_the_bone_with_the_footprint(a_plain_world):
    world = replace(a_plain_world, sweeps=True, hole=True, rate_hz=20.0, footprint_mm=3.0)
    found = (kirchhoff_lines.simulate(np.random.default_rng(seed), 50, world) for seed in range(20))
    _, truth, world = next(one for one in found if one[2].ignore.any())
    assert np.isfinite(truth.depth_mm[world.ignore]).any()  # a part of the face is over bone
    edge = np.isfinite(truth.depth_mm) & world.ignore
    whole = np.isfinite(truth.depth_mm) & ~world.ignore & (truth.tilt_deg < 3)
    assert truth.snr_db[edge].min() < np.median(truth.snr_db[whole]) - 3


def test_speckle_goes_on_behind_the_depth_of_the_bone_only_in_soft_places(a_plain_world):
    shown = {}
    for without in ("soft", ""):
        world = replace(a_plain_world, without=without, speckle_db=-30.0, attenuation=0.5)
        recording, truth, world = kirchhoff_lines.simulate(np.random.default_rng(2), 12, world)
        rate, to_s = recording.acquisition.sampling_hz, 2e-3 / truth.speed_m_s
        skin = world.forerun.time_s
        early, late = (slice(*(int((skin + to_s * end) * rate) for end in ends)) for ends in ((10.5, 13.5), (18.0, 20.0)))
        lines = recording.lines[4:].astype(float)
        shown[without] = np.median(lines[:, early].std(axis=1)) / np.median(lines[:, late].std(axis=1))
        assert np.isfinite(truth.depth_mm).any() == (without == "")
    assert shown["soft"] > 1.2
