"""Simulated A-lines of a flat disc: where their echoes stand, how they answer tilt, and what the world says of each line."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import piston_lines
from Testing.Studies.simulators.piston_plan import HEAD_MM, LEAST_LINES, draw_hand, draw_poses, draw_setup
from Testing.Studies.simulators.piston_pulse import Pulse

LINES = 20
NO_BONE = ["air", "hair", "soft", "hole", "gel", "cable"]


@pytest.fixture(scope="module")
def some_recordings():
    return [piston_lines.simulate(np.random.default_rng(97_000_000 + index), LINES) for index in range(16)]


def a_setup(wanted):
    """The first set-up that is as wanted."""
    return next(one for seed in range(2000) if wanted(one := draw_setup(np.random.default_rng(seed))))


def test_recording_has_about_as_many_lines_as_asked_for():
    for sweeps in (False, True):
        setup = replace(draw_setup(np.random.default_rng(1)), sweeps=sweeps)
        for frames in (1, 8, 12, 18, 31, 60, 90):
            count = len(draw_hand(np.random.default_rng(frames), setup, frames).place)
            wanted = max(frames, LEAST_LINES)
            assert max(0.6 * wanted, LEAST_LINES) <= count <= 1.5 * wanted


def test_same_seed_gives_the_same_recording(some_recordings):
    again, _, _ = piston_lines.simulate(np.random.default_rng(97_000_003), LINES)
    np.testing.assert_array_equal(again.lines, some_recordings[3][0].lines)


def test_peak_of_the_bones_envelope_stands_at_the_true_depth(some_recordings):
    off_mm = []
    for recording, truth, world in some_recordings:
        clear = ~world.ignore & (truth.snr_db > 22) & (truth.tilt_deg < 3) & (truth.depth_mm > 3)
        near_s = 0.5e-6 / world.centre_mhz
        off_mm.extend(peaks_off_mm(recording, truth, np.flatnonzero(clear), world.skin_us * 1e-6, near_s))
    assert len(off_mm) > 40
    assert abs(np.median(off_mm)) < 0.03
    assert np.quantile(np.abs(off_mm), 0.8) < 0.1


def test_lines_without_bone_have_no_truth(some_recordings):
    for _, truth, world in some_recordings:
        bone = np.isfinite(truth.depth_mm)
        np.testing.assert_array_equal(np.isfinite(truth.snr_db), bone)
        assert not bone[np.isin(world.kind, NO_BONE)].any()
        assert not (world.without and bone.any())
        assert bone[~np.isin(world.kind, [*NO_BONE, "landing", "hole-edge"])].all()
        assert world.ignore[np.isin(world.kind, ["landing", "faint", "clipped", "hole-edge"])].all()


def test_noise_is_as_far_below_bone_as_the_truth_says():
    setup = a_setup(lambda one: not (one.without or one.sweeps or one.face_r or one.overdriven) and one.typical_mm > 8)
    recording, truth, world = piston_lines.simulate(np.random.default_rng(2), LINES, replace(setup, snr_db=20.0))
    assert world.snr_db == pytest.approx(20, abs=0.01)
    clear = np.flatnonzero((truth.tilt_deg < 1.5) & ~world.ignore)
    codes = recording.lines[:, -int(1.5 * world.sampling_mhz) :].astype(float)
    arrival = (world.skin_us + truth.depth_mm / world.mm_per_us) * world.sampling_mhz
    near = [
        recording.lines[row, int(arrival[row]) - 5 : int(arrival[row]) + 6] - np.median(recording.lines[row]) for row in clear
    ]
    loud = 20 * np.log10(np.array([np.abs(one).max() for one in near]) / np.median(codes.std(axis=1)))
    assert abs(np.median(loud - truth.snr_db[clear])) < 2.5


def test_envelope_of_the_pulse_is_one_at_time_zero():
    for seed in range(5):
        setup = draw_setup(np.random.default_rng(seed))
        pulse = Pulse(setup, 2000)
        kernel, zero = pulse.kernel(0.0)
        analytic = np.fft.fft(kernel, 4096)
        analytic[2048:] = 0
        envelope = np.abs(np.fft.ifft(2 * analytic))
        assert abs(envelope[:-100].argmax() - zero) <= 1 + 0.1 * setup.sampling_mhz / setup.centre_mhz
        assert envelope.max() == pytest.approx(1, abs=0.03)
        assert pulse.energy == pytest.approx(np.linalg.norm(kernel), rel=0.02)


def test_tilted_mirror_answers_each_frequency_as_a_disc_hears_it():
    setup = draw_setup(np.random.default_rng(3))
    pulse = Pulse(setup, 1500)
    angle = np.radians([0.0, 2.0, 8.0])
    waves = 2e3 * np.pi * pulse.mhz * setup.aperture_mm * np.sin(angle[1:, None]) / setup.speed_m_s
    answer = pulse.mirror(angle, setup.aperture_mm)
    np.testing.assert_allclose(answer[0], 1, atol=1e-4)
    np.testing.assert_allclose(answer[1:], 2 * j1(waves) / waves, atol=3e-3)


def test_bone_in_reference_stays_on_the_sphere_of_its_place():
    setup = a_setup(lambda one: one.face_r and not one.sweeps and not one.without)
    hand = draw_hand(np.random.default_rng(4), setup, 60)
    poses = draw_poses(np.random.default_rng(5), setup, hand)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1, atol=1e-9)
    far = hand.depth_mm + setup.acquisition.forerun_length_mm
    bone = poses[:, :3, 3] + poses[:, :3, 2] * far[:, None]
    off = np.linalg.norm(bone, axis=1)[hand.touching] - HEAD_MM
    assert abs(np.median(off)) < 0.1
    assert np.abs(off).max() < 0.6
    assert (hand.square_mm <= hand.depth_mm + 1e-9).all()
