"""The simulated A-lines of rough bone under tilted layers: where the echo stands, what tilt and loss do to it; no bone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import hilbert
from simulated_peaks import peaks_off_mm

from Testing.Studies.simulators import rough_lines, rough_plan

LINES = 12


@pytest.fixture(scope="module")
def some_recordings():
    return [rough_lines.simulate(np.random.default_rng(99_000_012 + index), LINES) for index in range(10)]


@pytest.fixture(scope="module")
def a_plain_setup():
    """Bone in most lines, without a delay line, hardly any noise, not clipped behind the transmitted pulse."""
    drawn = (rough_plan.draw_setup(np.random.default_rng(seed)) for seed in range(500))
    found = next(one for one in drawn if not one.without and not one.delay and one.depth_mm > 6)
    return replace(found, snr_db=40.0, bits=14, fill=0.3)


@pytest.mark.parametrize("frames", [4, 12, 60, 90])
def test_recording_has_about_as_many_lines_as_asked_for(frames):
    for seed in range(3):
        hand, places = rough_plan.draw_hand(rng := np.random.default_rng(seed), rough_plan.draw_setup(rng), frames)
        assert max(8, 0.75 * frames) <= len(hand.kind) <= max(8, 1.25 * frames)
        assert hand.place.max() + 1 == len(places.depth_mm) <= 8


def test_recording_is_the_same_for_the_same_seed():
    (one, truth, world), (again, other, same) = (rough_lines.simulate(np.random.default_rng(8), 8) for _ in range(2))
    np.testing.assert_array_equal(one.lines, again.lines)
    np.testing.assert_array_equal(truth.snr_db, other.snr_db)
    assert repr(world) == repr(same)


def test_peak_of_the_bones_envelope_stands_at_the_true_depth(some_recordings):
    off_mm = []
    for recording, truth, world in some_recordings:
        clear = np.flatnonzero((truth.snr_db > 20) & (truth.tilt_deg < 2))
        off_mm.extend(peaks_off_mm(recording, truth, clear, world.skin_us * 1e-6, 1e-6 / world.centre_mhz))
    assert len(off_mm) > 25
    assert abs(np.median(off_mm)) < 0.05
    assert np.quantile(np.abs(off_mm), 0.8) < 0.15


def test_lines_without_bone_have_no_truth(some_recordings):
    for _, truth, world in some_recordings:
        np.testing.assert_array_equal(np.isfinite(truth.depth_mm), world.kind == "bone")
        np.testing.assert_array_equal(truth.snr_db == -np.inf, world.kind != "bone")
        assert not (world.without and (world.kind == "bone").any())
    kinds = np.concatenate([world.kind for _, _, world in some_recordings])
    assert {"bone", "tissue", "air", "empty"} == set(kinds)


def test_noise_is_as_far_under_the_median_bone_as_the_world_says(some_recordings):
    for _, truth, world in some_recordings:
        square = (truth.tilt_deg <= 3) & np.isfinite(truth.depth_mm)
        if square.any():
            assert np.median(10 ** (truth.snr_db[square] / 20)) == pytest.approx(10 ** (world.snr_db / 20))


def test_smooth_bone_met_by_a_disc_is_lost_at_one_frequency_and_heard_at_another(a_plain_setup):
    disc = rough_lines.Disc(a_plain_setup)
    band = rough_lines.Band(replace(a_plain_setup, disc_mm=3.0))
    leans = np.radians([0.0, 2.5])
    deeper = disc.deeper_mm(leans, np.zeros(2), 1e9, np.zeros((2, len(disc.parts_mm))))
    square, tilted = np.abs(band.surface(2 * deeper / 1.54, disc.share))
    np.testing.assert_allclose(square, 1, atol=1e-3)
    centre = a_plain_setup.centre_mhz
    across = 4 * np.pi * np.tan(leans[1]) / 1.54 * disc.parts_mm[:, 0]
    summed = np.abs(np.exp(-1j * np.outer(band.mhz, across)).mean(axis=1))
    np.testing.assert_allclose(tilted, summed, atol=1e-3)
    assert np.ptp(tilted[np.abs(band.mhz - centre) < 0.4 * centre]) > 0.2


def test_roughness_fills_what_the_tilt_takes(a_plain_setup):
    disc, band = rough_lines.Disc(a_plain_setup), rough_lines.Band(a_plain_setup)
    rough = rough_plan.draw_relief(np.random.default_rng(1), 0.05, 0.8)
    at = np.random.default_rng(2).uniform(0, 200, (60, 2))
    tilt = np.radians(np.full(60, 7.0))
    left = []
    for relief in (np.zeros((60, len(disc.parts_mm))), rough.heights(at, disc.parts_mm)):
        left.append(np.median(band.peaks(band.surface(2 * disc.deeper_mm(tilt, 0 * tilt, 80.0, relief) / 1.54, disc.share))))
    assert left[1] > 1.2 * left[0]


def test_true_plane_is_the_one_that_fits_the_rough_bone(a_plain_setup):
    disc = rough_lines.Disc(a_plain_setup)
    relief = rough_plan.draw_relief(np.random.default_rng(3), 0.03, 1.5).heights(np.array([[1.0, 2.0]]), disc.parts_mm)
    higher, slope = disc.plane(relief)
    design = np.column_stack([np.ones(len(disc.parts_mm)), disc.parts_mm])
    fitted = np.linalg.lstsq(design, relief[0], rcond=None)[0]
    np.testing.assert_allclose([higher[0], *slope[0]], fitted, atol=1e-12)


def test_deep_bone_arrives_below_the_frequency_that_the_pulse_left_with(a_plain_setup):
    lower = {}
    for attenuation in (0.3, 2.6):
        layers = a_plain_setup.layers
        nepers = layers.nepers * attenuation / a_plain_setup.attenuation
        setup = replace(a_plain_setup, attenuation=attenuation, layers=replace(layers, nepers=nepers), bandwidth=0.7, fill=0.05)
        recording, truth, world = rough_lines.simulate(np.random.default_rng(1), LINES, setup)
        row = int(np.argmax(truth.snr_db))
        at = int((world.skin_us[row] + 2e3 * truth.depth_mm[row] / truth.speed_m_s) * world.sampling_mhz)
        half = int(1.5 * world.sampling_mhz / world.centre_mhz)
        wave = hilbert(recording.lines[row].astype(float))[at - half : at + half]
        turn = np.angle((wave[1:] * wave[:-1].conj()).sum())
        lower[attenuation] = turn / (2 * np.pi) * world.sampling_mhz / world.centre_mhz
    assert 0.85 < lower[0.3] < 1.1
    assert lower[2.6] < 0.85 * lower[0.3]


def test_tissue_goes_on_where_an_unfired_probe_is_silent(a_plain_setup):
    shown = {}
    for without in ("tissue", "empty"):
        setup = replace(a_plain_setup, without=without, speckle=0.03)
        recording, truth, world = rough_lines.simulate(np.random.default_rng(4), 8, setup)
        behind = int(2e3 * (world.depth_mm + 2) / world.speed_m_s * world.sampling_mhz)
        beyond = int(2e3 * (world.depth_mm + 10) / world.speed_m_s * world.sampling_mhz)
        shown[without] = recording.lines[:, behind : (behind + beyond) // 2].std() / recording.lines[:, -200:].std()
        assert np.isnan(truth.depth_mm).all()
    assert shown["tissue"] > 1.5 * shown["empty"]
    assert shown["empty"] == pytest.approx(1, abs=0.15)


def test_face_of_the_delay_line_reflects_nearly_all_in_air():
    drawn = (rough_plan.draw_setup(np.random.default_rng(seed)) for seed in range(500))
    setup = next(one for one in drawn if one.delay and one.delay.impedance < 2)
    heights = {}
    for without in ("tissue", "air"):
        recording, _, world = rough_lines.simulate(np.random.default_rng(4), 8, replace(setup, without=without, fill=0.001))
        at, cycle = int(world.skin_us[0] * world.sampling_mhz), int(world.sampling_mhz / world.centre_mhz) + 1
        heights[without] = np.abs(recording.lines[0, at - cycle : at + cycle].astype(float)).max()
    assert heights["air"] > 4 * heights["tissue"]


def test_echoes_behind_the_lines_end_do_not_come_back_at_their_start(a_plain_setup):
    band = rough_lines.Band(a_plain_setup)
    late = np.array([[band.samples / a_plain_setup.sampling_mhz + rough_lines.GUARD_US + 2.0]])
    assert np.abs(band.echoes(late, np.ones((1, 1)), 0.0)).max() == 0


def test_beam_meets_the_bone_where_the_pose_and_the_depth_say(a_plain_setup):
    rng = np.random.default_rng(6)
    hand, _ = rough_plan.draw_hand(rng, a_plain_setup, 60)
    poses = rough_plan.draw_poses(rng, a_plain_setup, hand)
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)
    bone = poses[:, :3, 3] + hand.depth_mm[:, None] * poses[:, :3, 2]
    assert np.abs(np.linalg.norm(bone, axis=1) - a_plain_setup.round_mm).max() < 0.3
    cosine = -(poses[:, :3, 2] * bone).sum(axis=1) / np.linalg.norm(bone, axis=1)
    assert np.degrees(np.abs(np.arccos(np.clip(cosine, -1, 1)) - hand.lean[:, 0])).max() < 0.3
