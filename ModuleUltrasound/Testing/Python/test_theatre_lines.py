"""Simulated sessions of the operating theatre: what their lines say against what was simulated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert

from Testing.Studies.simulators import theatre_lines
from Testing.Studies.simulators.theatre_plan import draw_hand, draw_theatre, holes_visible


@pytest.fixture(scope="module")
def some_sessions():
    return [theatre_lines.simulate(np.random.default_rng(93_000_000 + index), 20) for index in range(20)]


def a_theatre(wanted):
    """The first set-up that is as wanted."""
    return next(one for seed in range(2000) if wanted(one := draw_theatre(np.random.default_rng(seed))))


def envelope(recording, row):
    line = recording.lines[row].astype(float)
    return np.abs(hilbert(line - line.mean()))


@pytest.mark.parametrize("mode", ["dwell", "eighteen", "sweep"])
def test_session_has_about_as_many_lines_as_asked_for(mode):
    theatre = replace(draw_theatre(np.random.default_rng(1)), mode=mode)
    for frames in (12, 15, 17, 23, 24, 40, 61, 90):
        count = len(draw_hand(theatre, np.random.default_rng(frames), frames).place)
        assert max(0.6 * frames, 8) <= count <= 1.5 * frames


def test_echo_of_bone_stands_where_the_truth_says(some_sessions):
    off_mm = []
    for recording, truth, theatre in some_sessions:
        arrival_us = theatre.face_us(len(recording)) + truth.depth_mm / theatre.mm_per_us
        time_us = np.arange(recording.lines.shape[1]) / theatre.sampling_mhz
        for row in np.flatnonzero((truth.snr_db > 25) & (truth.tilt_deg < 3) & (truth.depth_mm > 3)):
            near = np.abs(time_us - arrival_us[row]) < 1 / theatre.centre_mhz
            level = envelope(recording, row)[near]
            off_mm.append((time_us[near][level.argmax()] - arrival_us[row]) * theatre.mm_per_us)
    assert len(off_mm) > 50
    assert abs(np.median(off_mm)) < 0.03
    assert np.quantile(np.abs(off_mm), 0.9) < 0.15


def test_bone_is_as_loud_over_the_noise_as_the_truth_says(some_sessions):
    off_db = []
    for recording, truth, theatre in some_sessions:
        arrival_us = theatre.face_us(len(recording)) + truth.depth_mm / theatre.mm_per_us
        late = recording.lines[:, -int(2 * theatre.sampling_mhz) :].astype(float)
        noise = np.median(late.std(axis=1))
        for row in np.flatnonzero((truth.snr_db > 20) & (truth.tilt_deg < 3) & (truth.depth_mm > 3)):
            at = int(arrival_us[row] * theatre.sampling_mhz)
            off_db.append(20 * np.log10(envelope(recording, row)[at - 3 : at + 5].max() / noise) - truth.snr_db[row])
    assert abs(np.median(off_db)) < 1.5


def test_lines_without_bone_have_no_truth(some_sessions):
    for _, truth, theatre in some_sessions:
        bone = np.isfinite(truth.depth_mm)
        assert (truth.snr_db[~bone] == -np.inf).all()
        assert np.isfinite(truth.snr_db[bone]).all()
        assert np.isfinite(truth.tilt_deg).all()
        assert not (theatre.without and bone.any())
    assert sum(np.isnan(truth.depth_mm).any() for _, truth, _ in some_sessions) > 5


def test_pose_is_missing_where_the_tracker_lost_the_probe(some_sessions):
    for recording, _, _ in some_sessions:
        lost = np.array(recording.statuses) != "OK"
        np.testing.assert_array_equal(np.isnan(recording.probe_to_reference).any(axis=(1, 2)), lost)


def test_poses_lie_a_delay_line_and_the_depth_away_from_an_ellipsoid():
    theatre = a_theatre(lambda one: one.acquisition.forerun_length_mm and not one.without and one.mode == "sweep")
    hand = draw_hand(theatre, np.random.default_rng(2), 40)
    poses = theatre_lines.draw_poses(theatre, np.random.default_rng(3), hand)
    far = hand.about_mm + theatre.acquisition.forerun_length_mm + hand.lifted_mm
    bone = poses[:, :3, 3] + poses[:, :3, 2] * far[:, None]
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1, atol=1e-9)
    step = np.linalg.norm(np.diff(bone, axis=0), axis=1)[hand.bone[1:] & hand.bone[:-1]]
    along = np.linalg.norm(np.diff(hand.aside_mm, axis=0), axis=1)[hand.bone[1:] & hand.bone[:-1]]
    assert np.median(np.abs(step - along)) < 0.2


def test_face_echo_grows_and_turns_over_as_the_hair_takes_the_gel_away():
    theatre = a_theatre(lambda one: one.face_r > 0 and not one.without)
    wet = np.array([1.0, 0.85, 0.6, 0.3, 0.0])
    count = len(wet)
    hand = replace(
        draw_hand(theatre, np.random.default_rng(1), 24),
        place=np.zeros(count, dtype=int),
        kind=np.full(count, "vertex"),
        depth_mm=np.full(count, 5.0),
        wet=wet,
    )
    scene = theatre_lines.Scene(theatre, hand, theatre.face_us(count), np.zeros(count), np.zeros((count, 8)))
    echoes = theatre_lines.Echoes(theatre_lines.Pulse(theatre, 4096), count, 60.0)
    theatre_lines._face(scene, echoes, np.random.default_rng(1))
    face = next(height for time, height, _ in echoes.parts if np.allclose(time, scene.skin_us))
    assert face[0] > 0
    assert face[-1] < 0
    assert (np.diff(face) <= 0).all()
    assert abs(face[-1]) > 5 * face[0]


def test_sweep_over_a_burr_hole_loses_the_bone_between_two_edges():
    theatre = a_theatre(lambda one: one.mode == "sweep" and not one.without and holes_visible(one) and one.beam_mm < 0.8)
    hands = (draw_hand(theatre, np.random.default_rng(seed), 80) for seed in range(100))
    hand = next(one for one in hands if (one.kind == "burr").sum() > 5)
    hole = np.flatnonzero(hand.kind == "burr")
    assert (np.diff(hole) <= 4).all()
    assert not hand.bone[hole].any()
    assert np.ptp(hand.aside_mm[hole, 0]) < 14


def test_tilt_takes_six_decibels_at_the_stated_angle():
    theatre = replace(draw_theatre(np.random.default_rng(4)), without="", mode="dwell", rough_mm=1e-6, round_mm=1e6)
    hand = draw_hand(theatre, np.random.default_rng(1), 24)
    count = len(hand.place)
    tilt = np.column_stack([np.where(np.arange(count) % 2, theatre.lobe_deg, 0.0), np.zeros(count)])
    hand = replace(hand, tilt_deg=tilt)
    scene = theatre_lines.Scene(theatre, hand, np.zeros(count), np.zeros(count), np.zeros((count, 8)))
    pulse = theatre_lines.Pulse(theatre, 4096)
    answer = np.abs(theatre_lines._facets(scene, pulse, np.random.default_rng(1)))
    centre = np.abs(pulse.mhz - theatre.acquisition.transducer_hz * 1e-6).argmin()
    assert 20 * np.log10(answer[1, centre] / answer[0, centre]) == pytest.approx(-6, abs=1)
