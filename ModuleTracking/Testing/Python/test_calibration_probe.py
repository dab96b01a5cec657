"""Probe calibration on simulated echoes of points and planes in a water bath, whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import invert_rigid, rigid
from ModuleTrackingLib.calibration import (
    PlaneTarget,
    PointTarget,
    ProbeSettings,
    calibrate_probe,
    tool_to_marker,
    water_speed_m_s,
)
from scipy.spatial.transform import Rotation

LOOSE = ProbeSettings(max_face_sd_mm=5, max_beam_sd_deg=10)


def facing(rng, spread_deg, count):
    """Rotations that look along -z of the bath, tilted within a cone and turned about the beam."""
    azimuth, angle = rng.uniform(0, 2 * np.pi, count), np.radians(spread_deg) * np.sqrt(rng.uniform(0, 1, count))
    tilt = np.column_stack([np.cos(azimuth) * angle, np.sin(azimuth) * angle, np.zeros(count)])
    roll = Rotation.from_rotvec(np.outer(rng.uniform(-1.5, 1.5, count), [0, 0, 1]))
    return (Rotation.from_rotvec(tilt) * Rotation.from_rotvec([np.pi, 0, 0]) * roll).as_matrix()


def a_probe(rng):
    return rigid(Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix(), rng.normal(0, 60, 3))


def point_echoes(rng, probe_to_marker, target, count=60, depth_sd=0.3, lateral_sd=0.6, depths=(15, 60), cone=30.0):
    turn, depth = facing(rng, cone, count), rng.uniform(*depths, count)
    seen = np.column_stack([rng.normal(0, lateral_sd, (count, 2)), depth])
    poses = rigid(turn, target - np.einsum("nij,nj->ni", turn, seen)) @ invert_rigid(probe_to_marker)
    return poses, depth + rng.normal(0, depth_sd, count)


def plane_echoes(rng, probe_to_marker, normal, offset, count=80, depth_sd=0.3, cone=8.0):
    frame = tool_to_marker((0, 0, 0), normal)[:3, :3]
    turn, depth = frame @ facing(rng, cone, count), rng.uniform(15, 60, count)
    feet = np.column_stack([rng.uniform(-40, 40, (count, 2)), np.full(count, offset)]) @ frame.T
    poses = rigid(turn, feet - turn[:, :, 2] * depth[:, None]) @ invert_rigid(probe_to_marker)
    return poses, depth + rng.normal(0, depth_sd, count)


def guesses(rng, probe_to_marker):
    beam = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).apply(probe_to_marker[:3, 2])
    return beam, probe_to_marker[:3, 3] + rng.normal(0, 15, 3)


def misses(found, truth):
    """Of the face in the found Probe frame (mm), and of the beam about its x and y (rad)."""
    turn = found.probe_to_marker[:3, :3].T
    beam = turn @ truth[:3, 2]
    return np.array([*(turn @ (found.probe_to_marker[:3, 3] - truth[:3, 3])), beam[1], -beam[0]])


@pytest.fixture
def rng():
    return np.random.default_rng(8)


@pytest.mark.parametrize("known", [True, False])
def test_a_point_target_is_exact_without_noise(rng, known):
    truth, target = a_probe(rng), np.array([12.0, -30, 44])
    poses, depths = point_echoes(rng, truth, target, depth_sd=0, lateral_sd=0)
    found = calibrate_probe([PointTarget(poses, depths, target if known else None)], *guesses(rng, truth))
    np.testing.assert_allclose(misses(found, truth), 0, atol=1e-5)
    np.testing.assert_allclose(found.targets[0], target, atol=1e-5)
    assert found.rms_depth_mm < 1e-5


def test_a_plane_target_is_exact_without_noise(rng):
    truth, normal = a_probe(rng), np.array([0.6, 0, 0.8])
    poses, depths = plane_echoes(rng, truth, normal, 25.0, depth_sd=0)
    found = calibrate_probe([PlaneTarget(poses, depths, normal, 25.0)], *guesses(rng, truth), LOOSE)
    np.testing.assert_allclose(misses(found, truth), 0, atol=1e-4)


def test_point_and_plane_together_and_an_unknown_plane_is_found(rng):
    truth, normal = a_probe(rng), np.array([0, -0.6, 0.8])
    point = PointTarget(*point_echoes(rng, truth, np.zeros(3), depth_sd=0, lateral_sd=0))
    poses, depths = plane_echoes(rng, truth, normal, 30.0, depth_sd=0)
    rough = PlaneTarget(poses, depths, normal + [0.03, 0.05, 0], 33.0, known=False)
    found = calibrate_probe([point, rough], *guesses(rng, truth))
    np.testing.assert_allclose(misses(found, truth), 0, atol=1e-4)
    np.testing.assert_allclose(found.targets[1], [*normal, 30.0], atol=1e-3)


@pytest.mark.parametrize("kind", ["point", "plane", "both"])
def test_the_covariance_is_that_of_repeated_calibrations(kind):
    # A plane alone says little across the beam: with 0.3 mm its face and beam are too uncertain to be linear, and refused.
    settings = ProbeSettings(depth_sd_mm=0.1 if kind == "plane" else 0.3, max_face_sd_mm=1.0, max_beam_sd_deg=2.0)
    position, normal = np.array([5.0, 6, 7]), np.array([0, 0.6, 0.8])
    face, beam = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        truth, targets = a_probe(rng), []
        if kind != "plane":
            targets.append(PointTarget(*point_echoes(rng, truth, position), position, 0.01))
        if kind != "point":
            targets.append(PlaneTarget(*plane_echoes(rng, truth, normal, 20.0, depth_sd=settings.depth_sd_mm), normal, 20.0))
        found = calibrate_probe(targets, *guesses(rng, truth), settings)
        miss = misses(found, truth)
        face.append(miss[:3] @ np.linalg.solve(found.covariance[:3, :3], miss[:3]))
        beam.append(miss[3:] @ np.linalg.solve(found.covariance[3:, 3:], miss[3:]))
    # means of 40 chi-square numbers of 3 and 2 degrees: 3 and 2 with SDs of 0.39 and 0.32
    assert 1.7 < np.mean(face) < 4.3
    assert 1.0 < np.mean(beam) < 3.1


def test_wrong_echoes_are_left_out(rng):
    truth, target = a_probe(rng), np.zeros(3)
    poses, depths = point_echoes(rng, truth, target, 80)
    depths[:10] += rng.uniform(6, 25, 10)
    found = calibrate_probe([PointTarget(poses, depths)], *guesses(rng, truth), LOOSE)
    assert 9 <= found.left_out <= 13
    assert np.linalg.norm(misses(found, truth)[:3]) < 4 * found.face_sd_mm


def test_an_untilted_probe_before_a_plane_is_refused(rng):
    truth = a_probe(rng)
    poses, depths = plane_echoes(rng, truth, np.array([0, 0, 1.0]), 0.0, cone=0.5)
    with pytest.raises(InputError, match="(face is only known|do not settle).*tilt the probe"):
        calibrate_probe([PlaneTarget(poses, depths, np.array([0, 0, 1.0]), 0.0)], *guesses(rng, truth))


def test_one_depth_only_is_refused(rng):
    truth = a_probe(rng)
    poses, depths = point_echoes(rng, truth, np.zeros(3), depths=(30, 30.01), cone=10)
    with pytest.raises(InputError, match="vary the depth"):
        calibrate_probe([PointTarget(poses, depths)], *guesses(rng, truth))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda poses, depths: (poses[:5], depths[:5]), "at least 15 echoes, got 5"),
        (lambda poses, depths: (poses, depths[:-1]), "poses for 59 depths"),
        (lambda poses, depths: (poses, -depths), "positive numbers in mm"),
        (lambda poses, depths: (poses, depths * np.nan), "positive numbers in mm"),
        (lambda poses, depths: (poses * 2, depths), "a pose of target 1"),
        (lambda poses, depths: (poses, np.random.default_rng(0).uniform(10, 500, 60)), "echoes agree|only known"),
    ],
)
def test_what_is_no_echo_is_refused(rng, change, message):
    truth = a_probe(rng)
    poses, depths = change(*point_echoes(rng, truth, np.zeros(3)))
    with pytest.raises(InputError, match=message):
        calibrate_probe([PointTarget(poses, depths)], *guesses(rng, truth))


@pytest.mark.parametrize(("celsius", "speed"), [(0, 1402.39), (20, 1482.34), (25, 1496.69), (37, 1523.6), (74, 1555.1)])
def test_the_speed_of_sound_in_water(celsius, speed):
    assert water_speed_m_s(celsius) == pytest.approx(speed, abs=0.1)


def test_steam_is_refused():
    with pytest.raises(InputError, match="expected 0 to 95"):
        water_speed_m_s(101)
