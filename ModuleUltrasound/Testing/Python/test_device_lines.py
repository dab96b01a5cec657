"""Simulated A-lines of a pulser and its board: what their lines say against what was simulated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert

from Testing.Studies.simulators import device_lines
from Testing.Studies.simulators.device_plan import USUAL_LINES, draw_hand, draw_setup


@pytest.fixture(scope="module")
def some_recordings():
    return [device_lines.simulate(np.random.default_rng(94_000_000 + index), 16) for index in range(8)]


def a_setup(wanted):
    """The first set-up that is as wanted."""
    return next(one for seed in range(2000) if wanted(one := draw_setup(np.random.default_rng(seed))))


def envelope(recording, row):
    line = recording.lines[row].astype(float)
    return np.abs(hilbert(line - np.median(line)))


def a_quiet_dwell(**wanted):
    """A recording of plain bone without a delay line, in which only what is wanted is out of the ordinary."""
    plain = a_setup(lambda one: not one.without and not one.face_r and 4 < one.about_mm < 8 and one.attenuation < 1)
    return replace(plain, style="dwell", snr_db=40.0, speckle=0.001, **wanted)


@pytest.mark.parametrize("frames", [1, 8, 12, 40, 90])
def test_recording_has_as_many_lines_as_asked_for(frames):
    for style in ("dwell", "burr"):
        hand = draw_hand(np.random.default_rng(frames), replace(a_setup(lambda one: True), style=style), frames)
        assert len(hand.kind) == max(frames, 8)


def test_envelope_peaks_where_the_truth_says():
    off_mm = []
    for seed in range(9):
        rng = np.random.default_rng(seed)
        setup = replace(draw_setup(rng), style="sweep", without="", snr_db=40.0, speckle=0.001, floor=0.003)
        recording, truth, world = device_lines.simulate(rng, 8, setup)
        arrival_us = setup.delay_us + world.late_us + truth.depth_mm / setup.mm_us
        time_us = np.arange(recording.lines.shape[1]) / setup.sampling_mhz
        clear = world.must & (truth.snr_db > 25) & (truth.depth_mm > 5)
        for row in np.flatnonzero(clear):
            near = np.abs(time_us - arrival_us[row]) < 1.5 / setup.centre_mhz
            level = envelope(recording, row)[near]
            off_mm.append((time_us[near][level.argmax()] - arrival_us[row]) * setup.mm_us)
    assert len(off_mm) > 15
    assert abs(np.median(off_mm)) < 0.04


def test_bone_is_as_loud_over_the_noise_as_the_truth_says():
    off_db = []
    for seed in range(5):
        setup = replace(a_quiet_dwell(floor=0.003), snr_db=30.0)
        recording, truth, world = device_lines.simulate(np.random.default_rng(seed), 8, setup)
        late = recording.lines[:, -int(4 * setup.sampling_mhz) :].astype(float)
        for row in np.flatnonzero(world.must & (truth.snr_db > 20)):
            at = int((world.late_us + truth.depth_mm[row] / setup.mm_us) * setup.sampling_mhz)
            height = envelope(recording, row)[at - 4 : at + 6].max()
            off_db.append(20 * np.log10(height / late[row].std()) - truth.snr_db[row])
    assert len(off_db) > 5
    assert abs(np.median(off_db)) < 1.5


def test_lines_without_bone_have_no_truth(some_recordings):
    for _, truth, world in some_recordings:
        bone = world.kind == "bone"
        np.testing.assert_array_equal(np.isfinite(truth.depth_mm), bone)
        np.testing.assert_array_equal(np.isfinite(truth.snr_db), bone)
        assert not world.must[~bone].any()
        assert not (world.must & world.ignore).any()
        assert not (world.without and bone.any())
    assert sum(np.isnan(truth.depth_mm).any() for _, truth, _ in some_recordings) > 4


def test_line_starts_with_what_the_board_puts_there_and_has_ten_bits(some_recordings):
    for recording, _, _ in some_recordings:
        assert recording.lines.min() >= -512
        assert recording.lines.max() <= 511
        assert (recording.lines[:, 6:10] == (150, -160, 90, -40)).all()


def test_pulse_is_silent_before_it_is_fired_and_peaks_soon_after():
    for seed in range(20):
        setup = draw_setup(np.random.default_rng(seed))
        pulse = device_lines.Pulse(setup)
        assert pulse.time_us[0] == -pulse.late_us
        assert 0.3 < pulse.late_us * setup.centre_mhz < 3.5
        assert np.abs(pulse.height).max() == pytest.approx(1, abs=0.15)


def test_hand_passes_a_burr_hole_however_few_the_lines():
    setup = replace(a_setup(lambda one: not one.without), style="burr")
    for frames in (10, USUAL_LINES[0], 90):
        hands = [draw_hand(np.random.default_rng(seed), setup, frames) for seed in range(40)]
        assert 0.1 < np.mean([(hand.covered == 0).mean() for hand in hands]) < 0.6


def test_gain_turned_up_raises_bone_and_noise_alike():
    setup = a_quiet_dwell()
    for seed in range(200):
        rng = np.random.default_rng(seed)
        if draw_hand(rng, setup, 12).gain_db[-1] == 12:
            break
    recording, truth, world = device_lines.simulate(np.random.default_rng(seed), 12, setup)
    turned = world.gain_db == 12
    assert set(world.gain_db) == {0, 12}
    late = recording.lines[:, -int(4 * setup.sampling_mhz) :].astype(float).std(axis=1)
    assert np.median(late[turned]) / np.median(late[~turned]) == pytest.approx(4, rel=0.35)
    assert np.isfinite(truth.snr_db[world.must]).all()


def test_air_returns_the_whole_pulse_from_the_delay_line():
    setup = a_setup(lambda one: one.face_r < -0.1 and one.without == "air")
    face = []
    for without in ("air", "water"):
        rng = np.random.default_rng(3)
        scene = device_lines.Scene(rng, replace(setup, without=without), draw_hand(rng, replace(setup, without=without), 8))
        rf = np.zeros((8, scene.samples), dtype=np.float32)
        device_lines._add_probe(scene, rf)
        near = np.abs(np.arange(scene.samples) / setup.sampling_mhz - scene.skin_us.mean()) < 1
        face.append(np.abs(rf[:, near]).max())
    assert face[0] / face[1] == pytest.approx(0.97 / abs(setup.face_r), rel=0.15)
