"""The hand and the palpation: on the skin, over the bone, as tilted and unsteady as told, some frames lost."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.phantom import constants, make_patient, palpate, sweep
from CranioNavLib.phantom.beam import look_at_bone
from CranioNavLib.phantom.hand import Skill, bone_below, hold, stand_at, tremor
from CranioNavLib.phantom.sites import outer_seats

STEADY = Skill(aim_sd_mm=0.0, tilt_sd_deg=0.0, tremor_tilt_sd_deg=0.0, tremor_position_sd_mm=0.0)


@pytest.fixture(scope="module")
def a_patient():
    return make_patient(None, 3)


@pytest.fixture(scope="module")
def places(a_patient):
    points, normals = outer_seats(a_patient.bone, a_patient.skin, np.random.default_rng(0))
    return points[:60], normals[:60]


def contact_frames(patient, poses_ras):
    frames = poses_ras.copy()
    frames[:, :3, 3] += poses_ras[:, :3, 2] * constants.FORERUN_LENGTH_MM
    return frames


def test_a_steady_guided_probe_stands_square_on_the_bone_and_presses_the_skin(a_patient, places):
    rng = np.random.default_rng(1)
    poses = hold(stand_at(a_patient, *places, rng, STEADY), 1, rng, STEADY)[:, 0]
    frames = contact_frames(a_patient, poses)
    seen = look_at_bone(a_patient.bone, frames)
    assert np.median(seen.tilt_deg) < 0.5
    pressed = -a_patient.skin.signed_distance(frames[:, :3, 3])
    assert pressed.min() > 0.0
    share = pressed / (pressed + seen.center_mm)
    low, high = constants.COMPRESSION_RANGE
    assert low - 0.05 < share.min()
    assert share.max() < high + 0.1


def test_tilts_have_the_spread_of_the_hand(a_patient, places):
    rng = np.random.default_rng(2)
    many = [np.repeat(part, 20, axis=0) for part in places]
    hand = Skill(aim_sd_mm=0.0, tilt_sd_deg=2.0, tremor_tilt_sd_deg=0.0, tremor_position_sd_mm=0.0)
    stand = stand_at(a_patient, *many, rng, hand)
    straight = stand_at(a_patient, *many, rng, STEADY)
    cosine = (stand.beams * straight.beams).sum(axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.sqrt((angle**2).mean()) == pytest.approx(2.0 * np.sqrt(2), rel=0.08)


def test_aim_moves_along_the_skin_and_ends_on_bone(a_patient, places):
    hand = Skill(aim_sd_mm=3.0, tilt_sd_deg=0.0)
    stand = stand_at(a_patient, *places, np.random.default_rng(3), hand)
    assert np.abs(a_patient.bone.signed_distance(stand.bone_points_mm)).max() < 0.3
    moved = np.linalg.norm(stand.bone_points_mm - places[0], axis=1)
    assert 2.0 < moved.mean() < 6.0


def test_bone_below_is_the_footprint_the_beam_covers(a_patient, places):
    points, normals = bone_below(a_patient, *places)
    assert np.abs(a_patient.bone.signed_distance(points)).max() < 0.2
    assert ((normals * places[1]).sum(axis=1) > 0.98).all()


def test_tremor_has_unit_size_and_starts_settled():
    moves = tremor(np.random.default_rng(0), 2000, 30, 2)
    assert moves[:, 0].std() == pytest.approx(1.0, abs=0.05)
    assert moves[:, -1].std() == pytest.approx(1.0, abs=0.05)


def test_a_palpation_is_a_whole_recording_with_lost_frames(a_patient, places):
    made = palpate(a_patient, places[0][:6], places[1][:6], np.random.default_rng(5), lines_per_point=50, missing_share=0.1)
    recording = made.recording
    assert recording.lines.shape == (300, constants.LINE_SAMPLES)
    assert recording.lines.dtype == np.int16
    lost = np.array([status != "OK" for status in recording.statuses])
    assert set(recording.statuses) == {"OK", "MISSING"}
    assert 10 < lost.sum() < 60
    assert np.isnan(recording.probe_to_reference[lost]).all()
    assert np.isfinite(recording.probe_to_reference[~lost]).all()
    assert np.array_equal(recording.palpation_points, np.repeat(np.arange(6), 50))
    assert (np.diff(recording.timestamps_s) > 0).all()
    error = recording.probe_to_reference[~lost, :3, 3] - made.true_probe_to_reference[~lost, :3, 3]
    assert 0.1 < np.sqrt((error**2).sum(axis=1).mean()) < 1.5
    again = palpate(a_patient, places[0][:6], places[1][:6], np.random.default_rng(5), lines_per_point=50, missing_share=0.1)
    assert np.array_equal(again.recording.lines, recording.lines)


def test_a_sweep_slides_over_the_head_without_jumps_and_names_no_points(a_patient, places):
    by_height = np.argsort(places[0][:, 2])[-6:]
    made = sweep(a_patient, places[0][by_height], places[1][by_height], np.random.default_rng(6), lines=400)
    recording = made.recording
    assert recording.lines.shape == (400, constants.LINE_SAMPLES)
    assert set(recording.palpation_points) == {-1}
    assert np.diff(recording.timestamps_s) == pytest.approx(np.full(399, 1 / constants.LINE_RATE_HZ))
    poses = a_patient.true_reference_to_ras @ made.true_probe_to_reference
    frames = contact_frames(a_patient, poses)
    length = np.linalg.norm(np.diff(places[0][by_height], axis=0), axis=1).sum()
    # the contact tilts with the hand: a few millimetres a line beyond the even way along the plan
    assert np.linalg.norm(np.diff(frames[:, :3, 3], axis=0), axis=1).max() < 3 * length / 400 + 2.0
    assert a_patient.skin.signed_distance(frames[:, :3, 3]).max() < 0.3
    tilt = look_at_bone(a_patient.bone, frames).tilt_deg
    assert 2.0 < np.nanmedian(tilt) < 12.0
