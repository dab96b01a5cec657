import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.sequence_metafile import Acquisition, Recording
from ModuleUltrasoundLib.measurement.measure import LineMeasurements
from ModuleUltrasoundLib.measurement.speed_of_sound import estimate_if_pressed, estimate_speed


def pressed(rng, true_speed, spots=8, frames=40, noise_mm=0.0, press_mm=2.0, slope=0.0, drift_mm=0.0, echo_mm=0.01):
    """Lines of a probe that presses on flat bone at several spots; the depths as measured with 1540 m/s assumed."""
    poses, depths, points = [], [], []
    for spot in range(spots):
        turn = rng.uniform(-2, 2, 3)
        frame = rigid_from_vector(turn, rng.uniform(-60, 60, 3))
        thickness = rng.uniform(6, 9) - press_mm * 0.5 * (1 - np.cos(np.linspace(0, 6, frames)))
        side = drift_mm * np.linspace(-0.5, 0.5, frames)
        local = np.tile(np.eye(4), (frames, 1, 1))
        local[:, 0, 3] = side
        local[:, 2, 3] = -thickness + slope * side
        pose = frame @ local
        pose[:, :3, 3] += rng.normal(0, noise_mm, (frames, 3))
        poses.append(pose)
        depths.append(thickness * 1540 / true_speed + rng.normal(0, echo_mm, frames) * (noise_mm > 0))
        points.append(np.full(frames, spot))
    poses, depths = np.concatenate(poses), np.concatenate(depths)
    count = len(depths)
    recording = Recording(
        np.zeros((count, 8), dtype=np.int16),
        Acquisition(60e6, 5e6),
        poses,
        ("OK",) * count,
        np.arange(count) / 50,
        np.concatenate(points),
    )
    lines = LineMeasurements(
        depths_mm=depths,
        depth_sds_mm=np.full(count, 0.01),
        positions_mm=poses[:, :3, 3] + poses[:, :3, 2] * depths[:, None],
        covariances_mm2=np.tile(np.eye(3), (count, 1, 1)),
        beam_directions=poses[:, :3, 2],
        qualities=np.ones(count),
        accepted=np.ones(count, dtype=bool),
        reasons=("",) * count,
        alternative_depths_mm=np.empty((count, 0)),
        alternative_probabilities=np.empty((count, 0)),
        skin_times_s=np.zeros(count),
        speed_of_sound_m_s=1540.0,
        speed_of_sound_sd_m_s=52.0,
    )
    return recording, lines


@pytest.mark.parametrize("true_speed", [1450.0, 1540.0, 1630.0])
def test_pressing_without_noise_gives_the_speed_exactly(true_speed):
    estimate = estimate_speed(*pressed(np.random.default_rng(0), true_speed))
    assert estimate.pressed_m_s == pytest.approx(true_speed, abs=0.5)
    assert estimate.spots == 8


def test_stated_deviation_of_the_speed_matches_the_scatter():
    z = []
    for seed in range(24):
        estimate = estimate_speed(*pressed(np.random.default_rng(seed), 1580.0, noise_mm=0.1))
        z.append((estimate.pressed_m_s - 1580) / estimate.pressed_sd_m_s)
    assert 0.6 < np.std(z) < 1.4  # that of 24 unit normals lies within 0.7 and 1.3 with 95 %
    assert abs(np.mean(z)) < 0.6


@pytest.mark.parametrize(("noise_mm", "echo_mm"), [(0.03, 0.12), (0.08, 0.08), (0.12, 0.03)])
def test_noise_of_neither_depth_nor_way_passes_for_slow_or_fast_tissue(noise_mm, echo_mm):
    estimates = [
        estimate_speed(*pressed(np.random.default_rng(seed), 1540.0, noise_mm=noise_mm, echo_mm=echo_mm, press_mm=0.9))
        for seed in range(24)
    ]
    z = [(estimate.pressed_m_s - 1540) / estimate.pressed_sd_m_s for estimate in estimates]
    assert abs(np.mean(z)) < 0.7
    assert np.mean(np.abs(z) < 2) > 0.8
    assert np.median([estimate.pressed_sd_m_s for estimate in estimates]) < 60


def test_sliding_on_sloped_bone_while_pressing_is_not_taken_for_speed():
    estimate = estimate_speed(*pressed(np.random.default_rng(3), 1500.0, noise_mm=0.05, slope=0.04, drift_mm=3.0))
    assert abs(estimate.pressed_m_s - 1500) < 25


def test_prior_holds_what_the_pressing_leaves_open():
    estimate = estimate_speed(*pressed(np.random.default_rng(4), 1600.0, spots=1, frames=10, noise_mm=0.2, press_mm=0.9))
    assert estimate.speed_sd_m_s < 52
    assert abs(estimate.speed_m_s - 1540) < abs(estimate.pressed_m_s - 1540) + 1e-9


def test_steady_pressure_is_refused():
    with pytest.raises(InputError, match="vary the pressure"):
        estimate_speed(*pressed(np.random.default_rng(5), 1540.0, press_mm=0.1))


def test_a_probe_that_never_pressed_tells_no_speed_and_one_that_did_says_it_in_words():
    rng = np.random.default_rng(3)
    assert estimate_if_pressed(*pressed(rng, 1500.0, press_mm=0.1)) is None
    estimate = estimate_if_pressed(*pressed(rng, 1500.0, spots=1))
    assert str(estimate).startswith("1500 ± ")
    assert str(estimate).endswith("(1 spot)")
