from dataclasses import replace

import numpy as np
import pytest
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.sequence_metafile import Acquisition, Recording
from ModuleUltrasoundLib.measurement.measure import LineMeasurements
from ModuleUltrasoundLib.measurement.points import HAND_SD_MM, SPACING_MM, bone_points, thin
from scipy.spatial.distance import pdist, squareform


def measured(positions, points, beams=None, accepted=None, quality=0.95, along_sd=0.05):
    """A recording and measurements whose bone points are given; the probe stands 6 mm above them."""
    count = len(positions)
    beams = np.tile([0.0, 0, -1], (count, 1)) if beams is None else beams
    turn = rigid_from_vector(np.tile([np.pi, 0.0, 0.0], (count, 1)), positions - 6 * beams)
    outer = beams[:, :, None] * beams[:, None, :]
    recording = Recording(
        np.zeros((count, 4), dtype=np.int16),
        Acquisition(60e6, 5e6),
        turn,
        ("OK",) * count,
        np.arange(count) / 50,
        np.asarray(points),
    )
    accepted = np.ones(count, dtype=bool) if accepted is None else accepted
    lines = LineMeasurements(
        depths_mm=np.full(count, 6.0),
        depth_sds_mm=np.full(count, along_sd),
        positions_mm=np.where(accepted[:, None], positions, np.nan),
        covariances_mm2=along_sd**2 * outer + 0.25 * (np.eye(3) - outer),
        beam_directions=beams,
        qualities=np.full(count, quality),
        accepted=accepted,
        reasons=tuple("" if ok else "no echo" for ok in accepted),
        alternative_depths_mm=np.full((count, 2), np.nan),
        alternative_probabilities=np.full((count, 2), np.nan),
        skin_times_s=np.zeros(count),
        speed_of_sound_m_s=1540.0,
        speed_of_sound_sd_m_s=52.0,
    )
    return recording, lines


def test_each_dwell_gives_one_point_at_the_mean_of_its_good_frames():
    rng = np.random.default_rng(0)
    places = rng.uniform(-50, 50, (5, 3))
    points = np.repeat(np.arange(5), 30)
    positions = places[points] + rng.normal(0, [0.3, 0.3, 0.05], (150, 3))
    accepted = rng.random(150) < 0.8
    result = bone_points(*measured(positions, points, accepted=accepted))
    assert result.labels == ("P0", "P1", "P2", "P3", "P4")
    assert result.groups.tolist() == [0, 1, 2, 3, 4]
    assert np.abs(result.positions_mm - places)[:, 2].max() < 0.06
    assert np.linalg.norm(result.positions_mm - places, axis=1).max() < 0.35


def test_outlier_along_the_beam_does_not_move_a_dwell():
    rng = np.random.default_rng(1)
    positions = rng.normal(0, [0.2, 0.2, 0.03], (20, 3))
    positions[[3, 7, 11]] += [0, 0, 3.0]  # a galea echo for bone
    result = bone_points(*measured(positions, np.zeros(20, dtype=int)))
    assert abs(result.positions_mm[0, 2]) < 0.05


def test_scatter_along_the_beam_widens_the_covariance_and_across_stays_the_beams():
    rng = np.random.default_rng(2)
    calm = bone_points(*measured(rng.normal(0, [0.2, 0.2, 0.02], (10, 3)), np.zeros(10, dtype=int)))
    shaky = bone_points(*measured(rng.normal(0, [0.2, 0.2, 0.6], (10, 3)), np.zeros(10, dtype=int)))
    assert shaky.covariances_mm2[0, 2, 2] > 3 * calm.covariances_mm2[0, 2, 2]
    assert calm.covariances_mm2[0, 0, 0] == pytest.approx(0.25)


def sweep(rng, count=3000):
    along = np.linspace(0, 80, count)
    return np.column_stack([along, 5 * np.sin(along / 10), rng.normal(0, 0.05, count)])


def test_frames_around_a_point_of_a_sweep_sharpen_it_down_to_what_they_share():
    rng = np.random.default_rng(5)
    noisy = sweep(rng)
    noisy[:, 2] += rng.normal(0, 0.3, len(noisy))
    recording, lines = measured(noisy, np.full(len(noisy), -1), along_sd=0.3)
    lines = replace(lines, depths_mm=6 - noisy[:, 2])  # the beam points down
    result = bone_points(recording, lines)
    error = result.positions_mm[:, 2]
    assert np.sqrt(np.mean(error**2)) < 0.1  # of 0.3 mm a frame
    own = result.covariances_mm2[:, 2, 2] - HAND_SD_MM**2  # without what the frames share, which does not average out
    assert own.min() >= 0
    assert 0.7 < np.sqrt(np.mean(error**2 / own)) < 1.3


def test_frames_of_another_layer_do_not_move_a_point_of_a_sweep():
    rng = np.random.default_rng(6)
    some = sweep(rng)
    some[::7, 2] += 0.9  # a galea echo
    result = bone_points(*measured(some, np.full(len(some), -1)))
    assert (np.abs(result.positions_mm[:, 2]) < 0.2).mean() > 0.85


@pytest.mark.parametrize("point", [-1, 4])
def test_sweep_is_thinned_to_an_even_density(point):
    rng = np.random.default_rng(3)
    result = bone_points(*measured(sweep(rng), np.full(3000, point)))
    assert 30 < len(result) < 60
    assert pdist(result.positions_mm).min() >= 0.6 * SPACING_MM  # means lie off the frames they were taken around
    assert np.median(np.sort(squareform(pdist(result.positions_mm)), axis=1)[:, 1]) > 0.9 * SPACING_MM
    assert set(result.groups.tolist()) == {point}
    assert all(label.startswith("S") for label in result.labels)


def test_thinning_leaves_no_place_bare():
    positions = sweep(np.random.default_rng(4))
    kept = positions[thin(positions, np.ones(len(positions)))]
    nearest = np.linalg.norm(positions[:, None] - kept[None], axis=2).min(axis=1)
    assert nearest.max() <= SPACING_MM


def test_nothing_accepted_gives_no_points():
    result = bone_points(*measured(np.zeros((4, 3)), np.arange(4), accepted=np.zeros(4, dtype=bool)))
    assert len(result) == 0


def test_speed_of_sound_travels_with_the_points():
    result = bone_points(*measured(np.zeros((4, 3)), np.zeros(4, dtype=int)))
    assert (result.speed_of_sound_m_s, result.speed_of_sound_sd_m_s) == (1540.0, 52.0)
    assert result.depths_mm[0] == pytest.approx(6.0)
    assert result.at_speed(1617.0).positions_mm[0] == pytest.approx([0, 0, -0.3])
