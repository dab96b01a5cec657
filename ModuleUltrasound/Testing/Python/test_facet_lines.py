"""The simulated A-lines over faceted bone: where the echo stands, what it loses by tilt, what is not bone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import facet_lines
from Testing.Studies.simulators.facet_plan import draw_world


@pytest.fixture(scope="module")
def some_recordings():
    return [facet_lines.simulate(np.random.default_rng(93_000_000 + index), 16) for index in range(8)]


@pytest.fixture(scope="module")
def a_plain_world():
    """A delay line and bone in every line."""
    drawn = (draw_world(np.random.default_rng(seed)) for seed in range(200))
    world = next(one for one in drawn if one.forerun.time_s and not one.forerun.short and not one.focused)
    return replace(world, without="", hole=False, hair=False, lifts=False, sweeps=True, snr_db=40.0)


@pytest.mark.parametrize("frames", [8, 12, 60])
def test_recording_has_as_many_lines_as_asked_for(frames):
    recording, truth, _ = facet_lines.simulate(np.random.default_rng(frames), frames)
    assert len(recording) == frames == len(truth.depth_mm) == len(truth.snr_db) == len(truth.tilt_deg)
    assert len(recording.statuses) == frames == len(recording.palpation_points) == len(recording.timestamps_s)
    lost = np.array([status != "OK" for status in recording.statuses])
    np.testing.assert_array_equal(np.isnan(recording.probe_to_reference).any(axis=(1, 2)), lost)


def off_mm(recording, truth, world):
    """Peak of the envelope near the bone minus the truth, of clear lines met squarely."""
    skin_s = world.forerun.time_s + world.forerun.warming_s * np.arange(len(recording)) / len(recording)
    clear = np.flatnonzero((truth.snr_db > 25) & (truth.tilt_deg < 3))
    return peaks_off_mm(recording, truth, clear, skin_s, 0.7 / world.shape.centre_hz)


def test_echo_stands_where_the_truth_says(some_recordings):
    off = np.concatenate([off_mm(*one) for one in some_recordings])
    assert len(off) > 20
    assert abs(np.median(off)) < 0.03
    assert np.median(np.abs(off)) < 0.05


def test_lines_without_bone_have_no_truth(some_recordings):
    for _, truth, _ in some_recordings:
        np.testing.assert_array_equal(np.isnan(truth.depth_mm), truth.snr_db == -np.inf)
    for without in ("soft", "water", "air", "noise"):
        world = replace(some_recordings[0][2], without=without)
        _, truth, _ = facet_lines.simulate(np.random.default_rng(3), 8, world)
        assert np.isnan(truth.depth_mm).all()


def test_snr_is_that_of_the_median_line_met_squarely(a_plain_world):
    _, truth, _ = facet_lines.simulate(np.random.default_rng(1), 40, replace(a_plain_world, snr_db=25.0))
    assert np.median(truth.snr_db[truth.tilt_deg < 3]) == pytest.approx(25.0, abs=0.5)


def test_echo_of_a_wide_footprint_is_lost_with_tilt_and_of_a_narrow_one_less(a_plain_world):
    lost = []
    for footprint in (2.5, 0.6):
        pairs = []
        for seed in range(2):
            world = replace(a_plain_world, sweeps=False, footprint_mm=footprint)
            _, truth, _ = facet_lines.simulate(np.random.default_rng(seed), 24, world)
            steep = truth.tilt_deg > 4
            pairs.append((truth.snr_db[truth.tilt_deg < 2], truth.snr_db[steep]))
        square, tilted = (np.median(np.concatenate(part)) for part in zip(*pairs))
        lost.append(square - tilted)
    assert lost[0] > lost[1] + 5


def test_bone_has_a_ghost_through_the_delay_line(a_plain_world):
    world = replace(a_plain_world, back=0.4, attenuation=0.3, speckle=0.0, behind_mm=45.0)
    recording, truth, _ = facet_lines.simulate(np.random.default_rng(2), 12, world)
    sampling = recording.acquisition.sampling_hz
    envelope = np.abs(hilbert(recording.lines.astype(float), axis=1))
    row = int(np.argmax(truth.snr_db))
    ghost = int((2 * world.forerun.time_s + 2e-3 * truth.depth_mm[row] / truth.speed_m_s) * sampling)
    cycle = int(sampling / world.shape.centre_hz)
    assert envelope[row, ghost - cycle : ghost + cycle].max() > 5 * np.median(envelope[row, ghost + 20 * cycle :])
