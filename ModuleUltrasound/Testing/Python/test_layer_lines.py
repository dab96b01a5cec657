"""Simulated A-lines over layered tissue: what the truth says of them stands in the lines."""

import numpy as np
import pytest
from scipy.signal import hilbert
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import layer_lines
from Testing.Studies.simulators.layer_medium import Band
from Testing.Studies.simulators.layer_plan import draw_transducer


@pytest.fixture(scope="module")
def some_recordings():
    return [layer_lines.simulate(np.random.default_rng(93_000_000 + index), 20) for index in range(12)]


def arrivals_us(recording, truth, world):
    """When the bone's echo arrives in each line (n,)."""
    delay_us = world.forerun.delay_us(len(recording)) if world.forerun else 0.0
    return delay_us + truth.depth_mm * 2e3 / truth.speed_m_s


@pytest.mark.parametrize("frames", [1, 8, 12, 90])
def test_recording_over_layers_has_about_as_many_lines_as_asked_for(frames):
    recording, truth, _ = layer_lines.simulate(np.random.default_rng(frames), frames)
    assert max(8, 0.6 * frames) <= len(recording) <= max(12, 1.5 * frames)
    assert len(recording) == len(truth.depth_mm) == len(truth.tilt_deg) == len(truth.snr_db)
    assert len(recording) == len(recording.statuses) == len(recording.timestamps_s) == len(recording.palpation_points)
    assert recording.lines.dtype == np.int16


def test_echo_of_bone_under_layers_stands_where_the_truth_says(some_recordings):
    off_mm = []
    for recording, truth, world in some_recordings:
        skin_s = (arrivals_us(recording, truth, world) - truth.depth_mm * 2e3 / truth.speed_m_s) * 1e-6
        clear = np.flatnonzero((truth.snr_db > 20) & (truth.tilt_deg < 3))
        off_mm.extend(peaks_off_mm(recording, truth, clear, skin_s, 1.5e-6 / world.transducer.centre_mhz))
    assert len(off_mm) > 40
    assert abs(np.median(off_mm)) < 0.03
    assert np.quantile(np.abs(off_mm), 0.8) < 0.12


def test_lines_without_bone_have_no_truth(some_recordings):
    for _, truth, world in some_recordings:
        bone = np.isfinite(truth.depth_mm)
        assert (truth.snr_db[~bone] == -np.inf).all()
        assert np.isfinite(truth.snr_db[bone]).all()
        assert np.isfinite(truth.tilt_deg).all()
        assert not bone[[0, -1]].any()  # the probe comes from the air and goes there
        assert not (world.head.without and bone.any())


def test_poses_are_missing_where_the_status_says_so(some_recordings):
    missing = 0
    for recording, _, _ in some_recordings:
        known = np.array([status == "OK" for status in recording.statuses])
        np.testing.assert_array_equal(np.isnan(recording.probe_to_reference).any(axis=(1, 2)), ~known)
        turned = recording.probe_to_reference[known, :3, :3]
        np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turned.shape), atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(turned), 1.0)
        missing += (~known).sum()
    assert missing > 0


def test_delay_line_answers_more_loudly_in_air(some_recordings):
    seen = 0
    for recording, truth, world in some_recordings:
        if world.forerun is None or world.head.without == "unplugged":
            continue
        time_us = np.arange(recording.lines.shape[1]) / recording.acquisition.sampling_hz * 1e6
        level = np.abs(hilbert(recording.lines - recording.lines.mean(axis=1, keepdims=True), axis=1))
        near = np.abs(time_us - world.forerun.delay_us(len(recording))[:, None]) < 1 / world.transducer.centre_mhz
        face = np.where(near, level, 0).max(axis=1)
        assert face[0] > 10 * world.noise_codes
        bone = np.isfinite(truth.depth_mm)
        if bone.any():
            assert face[0] >= np.median(face[bone])  # equal where the gain clips it
        seen += 1
    assert seen > 3


def test_pulse_has_its_peak_at_time_zero_and_height_one():
    for seed in range(5):
        transducer = draw_transducer(np.random.default_rng(seed))
        band = Band(transducer, 2048)
        at = 8.0
        line = band.lines((band.pulse * band.delay(np.array([at]))), band.bins)[0]
        level = np.abs(hilbert(line))
        peak = int(level.argmax())
        assert peak / transducer.sampling_mhz == pytest.approx(at, abs=0.6 / transducer.sampling_mhz)
        assert level[peak] == pytest.approx(1.0, abs=0.1)  # the samples may miss the peak
        assert band.heights(np.ones((1, len(band.mhz)), dtype=np.complex64))[0] == pytest.approx(1.0, abs=0.03)


def test_way_through_a_layer_loses_what_its_attenuation_says():
    transducer = draw_transducer(np.random.default_rng(3))
    band = Band(transducer, 1024)
    lost_db = -20 * np.log10(np.abs(band.through(np.array([10.0]), 1.54, 0.8)[0]))
    np.testing.assert_allclose(lost_db, 2 * 0.8 * band.mhz, rtol=1e-3)


def test_beam_listens_less_to_what_is_tilted():
    band = Band(draw_transducer(np.random.default_rng(4)), 1024)
    lobe = np.abs(band.lobe(np.array([0.0, 1.0, 2.0]), 1.54))
    np.testing.assert_allclose(lobe[0], 1.0)
    middle = lobe.shape[1] // 2
    assert (np.diff(lobe[:, middle]) < 0).all()
