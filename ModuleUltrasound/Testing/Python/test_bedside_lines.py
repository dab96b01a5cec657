"""Simulated lines of a patient's bed: echoes stand where the truth says, and the story is the one that was drawn."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert

from Testing.Studies.simulators import bedside_lines
from Testing.Studies.simulators.bedside_plan import draw_bedside


@pytest.fixture(scope="module")
def some_recordings():
    return [bedside_lines.simulate(np.random.default_rng(93_000_000 + index), 24) for index in range(10)]


def a_world(**changes):
    """Somebody with bone, palpated in one place without a delay line, and what is changed of that."""
    worlds = (draw_bedside(np.random.default_rng(seed), 24) for seed in range(100))
    found = next(one for one in worlds if not (one.whole or one.sweeps or one.acquisition.forerun_length_mm))
    plain = {"thick_mm": (6.0,), "hole": -1, "attenuation": 1.0, "snr_db": 35.0, "bits": 14, "left_justified": False}
    quiet = {"spikes": False, "artefact": 0.0, "headroom": 3.0, "drop": 0.0, "offset": 0.0, "drift": 0.0}
    return replace(found, **{**plain, **quiet, **changes})


def envelopes(recording):
    lines = recording.lines.astype(float)
    return np.abs(hilbert(lines - np.median(lines, axis=1, keepdims=True), axis=1))


@pytest.mark.parametrize("frames", [12, 24, 90])
def test_about_as_many_lines_as_asked_for(frames):
    for seed in range(2):
        recording, truth, _ = bedside_lines.simulate(np.random.default_rng(seed), frames)
        assert max(0.6 * frames, 8) <= len(recording) <= 1.5 * frames
        parts = (truth.depth_mm, truth.tilt_deg, truth.snr_db, recording.statuses, recording.timestamps_s)
        assert {len(part) for part in parts} == {len(recording)} == {len(recording.palpation_points)}


def test_bone_echo_stands_where_the_truth_says(some_recordings):
    off_mm = []
    for recording, truth, _ in some_recordings:
        acquisition, speed = recording.acquisition, truth.speed_m_s
        line_s = 2e-3 * acquisition.forerun_length_mm / (acquisition.forerun_speed_m_s or 1.0)
        clear = (truth.snr_db > 25) & (truth.tilt_deg < 2)
        depth_mm = (np.arange(recording.lines.shape[1]) / acquisition.sampling_hz - line_s) * speed * 500
        for true_mm, envelope in zip(truth.depth_mm[clear], envelopes(recording)[clear]):
            near = np.abs(depth_mm - true_mm) < 0.4
            off_mm.append(depth_mm[near][envelope[near].argmax()] - true_mm)
    assert len(off_mm) > 40
    assert abs(np.median(off_mm)) < 0.02
    assert np.quantile(np.abs(off_mm), 0.9) < 0.1


def test_lines_without_bone_have_no_truth(some_recordings):
    for recording, truth, world in some_recordings:
        bone = np.isfinite(truth.depth_mm)
        np.testing.assert_array_equal(np.isfinite(truth.tilt_deg), bone)
        np.testing.assert_array_equal(np.isfinite(truth.snr_db), bone)
        assert not (world.whole and bone.any())
        lost = np.array(recording.statuses) != "OK"
        np.testing.assert_array_equal(np.isnan(recording.probe_to_reference).any(axis=(1, 2)), lost)


def test_snr_is_the_one_drawn_for_an_upright_bone_in_the_deepest_place():
    world = a_world(snr_db=30.0, diffuse=0.0, focus_deg=0.0, disc_mm=1.0)  # hardly directive
    _, truth, _ = bedside_lines.simulate(np.random.default_rng(3), 20, world)
    upright = truth.snr_db[truth.tilt_deg < 2]
    assert len(upright) > 3
    assert np.median(upright) == pytest.approx(30, abs=2.5)


@pytest.mark.parametrize("whole", ["soft", "air", "cable"])
def test_recordings_without_bone_show_what_is_there(whole):
    world = a_world(whole=whole, speckle=0.03)
    recording, truth, _ = bedside_lines.simulate(np.random.default_rng(2), 16, world)
    assert np.isnan(truth.depth_mm).all()
    sampling = recording.acquisition.sampling_hz
    height = envelopes(recording)[4:-4]
    spans_us = ((0, 0.5), (6, 9), (11, 12))
    bang, tissue, end = (height[:, int(a * sampling * 1e-6) : int(b * sampling * 1e-6)].mean() for a, b in spans_us)
    assert (bang > 3 * end) == (whole != "cable")
    assert (tissue > 2 * end) == (whole == "soft")


def test_speckle_goes_on_in_a_hole_and_ends_at_bone():
    behind = {}
    for hole in (-1, 0):
        world = a_world(hole=hole, speckle=0.04, inner_db=-60.0, back=0.0, attenuation=0.5)
        recording, truth, _ = bedside_lines.simulate(np.random.default_rng(4), 20, world)
        depth_mm = np.arange(recording.lines.shape[1]) / recording.acquisition.sampling_hz * truth.speed_m_s * 500
        late = (depth_mm > 7.5) & (depth_mm < 9)
        behind[hole] = np.median(envelopes(recording)[6:-6, late]) / np.median(envelopes(recording)[:1, late])
    assert behind[0] > 1.4
    assert behind[-1] < 1.2


def test_codes_of_some_devices_are_justified_to_the_left():
    right, left = (
        bedside_lines.simulate(np.random.default_rng(1), 12, a_world(bits=12, snr_db=20.0, left_justified=one))[0].lines
        for one in (False, True)
    )
    np.testing.assert_array_equal(right.astype(int) * 16, left)
