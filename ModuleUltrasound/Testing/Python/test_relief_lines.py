"""Simulated lines over a skull in relief: what they say against what was simulated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert

from Testing.Studies.simulators import relief_lines
from Testing.Studies.simulators.relief_echoes import Band, answer_of_surface, draw_scene
from Testing.Studies.simulators.relief_plan import draw_ground, draw_hand, draw_poses, draw_setup


@pytest.fixture(scope="module")
def some_recordings():
    return [relief_lines.simulate(np.random.default_rng(96_000_000 + index), 16) for index in range(12)]


def a_setup(wanted):
    """The first set-up that is as wanted."""
    return next(one for seed in range(2000) if wanted(one := draw_setup(np.random.default_rng(seed))))


def envelope(recording, row):
    line = recording.lines[row].astype(float)
    return np.abs(hilbert(line - line.mean()))


def arrivals_us(truth, world):
    return world.skin_us + truth.depth_mm * world.us_mm


def test_recording_is_the_same_for_the_same_seed():
    (one, truth, world), (again, other, same) = (relief_lines.simulate(np.random.default_rng(4), 12) for _ in range(2))
    np.testing.assert_array_equal(one.lines, again.lines)
    np.testing.assert_array_equal(truth.depth_mm, other.depth_mm)
    assert repr(world) == repr(same)


@pytest.mark.parametrize("sweeps", [False, True])
@pytest.mark.parametrize("without", ["", "gel"])
def test_hand_takes_about_as_many_lines_as_asked_for(sweeps, without):
    setup = replace(draw_setup(np.random.default_rng(1)), sweeps=sweeps, without=without)
    for frames in (12, 15, 18, 23, 36, 60, 90):
        for seed in range(5):
            count = len(draw_hand(np.random.default_rng(seed), setup, frames).kind)
            assert max(0.6 * frames, 8) <= count <= 1.5 * frames
    assert len(draw_hand(np.random.default_rng(1), setup, 1).kind) >= 8


def test_echo_of_bone_stands_where_the_truth_says(some_recordings):
    off_mm = []
    for recording, truth, world in some_recordings:
        time_us = np.arange(recording.lines.shape[1]) / world.sampling_mhz
        for row in np.flatnonzero((world.kind == "bone") & (truth.snr_db > 22) & (truth.depth_mm > 3)):
            arrival_us = arrivals_us(truth, world)[row]
            near = np.abs(time_us - arrival_us) < 1 / world.centre_mhz
            level = envelope(recording, row)[near]
            off_mm.append((time_us[near][level.argmax()] - arrival_us) / world.us_mm)
    assert len(off_mm) > 30
    assert abs(np.median(off_mm)) < 0.03
    assert np.quantile(np.abs(off_mm), 0.9) < 0.15


def test_bone_is_as_loud_over_the_noise_as_the_truth_says(some_recordings):
    off_db = []
    for recording, truth, world in some_recordings:
        noise = np.median(recording.lines[:, -int(2 * world.sampling_mhz) :].astype(float).std(axis=1))
        for row in np.flatnonzero((world.kind == "bone") & (truth.snr_db > 18) & (truth.depth_mm > 3)):
            at = int(arrivals_us(truth, world)[row] * world.sampling_mhz)
            off_db.append(20 * np.log10(envelope(recording, row)[at - 3 : at + 5].max() / noise) - truth.snr_db[row])
    assert abs(np.median(off_db)) < 2


def test_lines_without_bone_have_no_truth(some_recordings):
    for _, truth, world in some_recordings:
        bone = np.isfinite(truth.depth_mm)
        np.testing.assert_array_equal(truth.snr_db > -np.inf, bone)
        assert not bone[np.isin(world.kind, ["air", "soft", "gel", "defect", "hair"])].any()
        assert bone[np.isin(world.kind, ["bone", "bone-oblique", "bone-faint", "clipped"])].all()
        assert not (world.without and bone.any())


def test_most_lines_that_are_judged_on_bone_can_be_read(some_recordings):
    snr_db = np.concatenate([truth.snr_db[(world.kind == "bone") & ~world.ignore] for _, truth, world in some_recordings])
    assert snr_db.min() >= 12


def test_delay_line_is_not_quite_as_stated_and_its_second_echo_comes_after_the_bone():
    for seed in range(200):
        setup = draw_setup(np.random.default_rng(seed))
        if setup.delay_line is None:
            assert setup.acquisition.forerun_length_mm == 0
            continue
        face_us = setup.face_us(50)
        stated_us = 2e3 * setup.acquisition.forerun_length_mm / setup.acquisition.forerun_speed_m_s
        assert 0 < np.abs(face_us / stated_us - 1).max() < 0.012
        assert (face_us > setup.depth_mm * setup.us_mm).all()


def a_surface(lean_deg, seed=3):
    """Band, and the answer of the bone of some lines that all lean alike."""
    rng = np.random.default_rng(seed)
    setup = replace(a_setup(lambda one: not one.without and 1 < one.beam_mm < 1.6), sweeps=True)
    hand = draw_hand(rng, setup, 16)
    hand = replace(hand, kind=np.full(len(hand.kind), "bone"), lean_deg=np.full(hand.lean_deg.shape, [lean_deg, 0.0]))
    scene, _ = draw_scene(rng, setup, hand, draw_ground(rng, setup, hand))
    return scene.band, answer_of_surface(rng, scene, np.arange(len(hand.kind)))[0]


def test_bone_met_squarely_answers_nearly_like_a_mirror_and_obliquely_less():
    band, square = a_surface(0.0)
    _, oblique = a_surface(6.0)
    centre = np.abs(band.mhz - band.setup.centre_mhz).argmin()
    low = np.abs(square[:, 0])
    assert low.max() <= 1.0001
    assert np.median(low) > 0.95
    assert 0.4 < np.median(np.abs(square[:, centre])) <= 1
    assert np.median(np.abs(oblique[:, centre])) < 0.5 * np.median(np.abs(square[:, centre]))


def test_pulse_peaks_at_time_zero_with_an_envelope_of_one():
    for seed in range(5):
        band = Band(draw_setup(np.random.default_rng(seed)), np.random.default_rng(seed), 2000)
        time_us = np.linspace(-1, 1, 201) / band.setup.centre_mhz
        height = np.abs(np.exp(2j * np.pi * np.outer(time_us, band.mhz)) @ band.pulse)
        assert abs(time_us[height.argmax()]) < 0.03 / band.setup.centre_mhz
        assert abs(height.max() - 1) < 0.03


def test_probe_stands_a_delay_line_and_the_depth_away_from_the_skull():
    setup = a_setup(lambda one: one.delay_line is not None and one.moves)
    hand = draw_hand(np.random.default_rng(2), setup, 40)
    depth_mm = np.full(len(hand.kind), 6.0)
    poses = draw_poses(np.random.default_rng(3), setup, hand, depth_mm)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1, atol=1e-9)
    bone = poses[:, :3, 3] + poses[:, :3, 2] * (depth_mm + setup.acquisition.forerun_length_mm)[:, None]
    np.testing.assert_allclose(np.linalg.norm(bone[hand.touching], axis=1), 85, atol=0.6)
