"""The coach: what protocol, guidance and palpation do together."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import invert_rigid, rigid_from_vector, transform_directions, transform_points
from CranioNavLib.surface import Surface
from ModuleUltrasoundLib.coach import Coach
from ModuleUltrasoundLib.guidance import covariance_with, motion_rows, rms_tre_mm
from ModuleUltrasoundLib.measure import LineMeasurements
from ModuleUltrasoundLib.palpation import PalpationLine, lines_of
from ModuleUltrasoundLib.protocol import ProtocolPoints
from vtkmodules.vtkFiltersSources import vtkSphereSource

REFERENCE_TO_RAS = rigid_from_vector([0.2, -0.4, 0.9], [30.0, -200.0, 500.0])
LANDMARK_COVARIANCE = np.diag([0.03**2] * 3 + [1.5**2] * 3)


@pytest.fixture(scope="module")
def a_skull() -> Surface:
    source = vtkSphereSource()
    source.SetRadius(1.0)
    source.SetThetaResolution(80)
    source.SetPhiResolution(80)
    source.Update()
    ball = Surface.from_polydata(source.GetOutput())
    return Surface(ball.vertices_mm * (70.0, 90.0, 75.0), ball.triangles)


@pytest.fixture
def a_plan(a_skull) -> ProtocolPoints:
    directions = np.random.default_rng(2).normal(size=(400, 3))
    places = a_skull.closest(90 * directions / np.linalg.norm(directions, axis=1, keepdims=True)).points_mm
    spread = [0]  # each the farthest from those before
    for _ in range(11):
        gaps = np.linalg.norm(places[:, None] - places[spread][None], axis=2).min(axis=1)
        spread.append(int(np.argmax(gaps)))
    some = [int(np.argmin(np.linalg.norm(a_skull.vertices_mm - place, axis=1))) for place in places[spread]]
    labels = tuple(f"P{k}" for k in range(12))
    return ProtocolPoints(labels, a_skull.vertices_mm[some], a_skull.vertex_normals[some], labels)


def rest_at(coach: Coach, target: int, start_s: float, registration=REFERENCE_TO_RAS) -> list:
    place = transform_points(invert_rigid(registration), coach.plan.positions_ras_mm[target][None])[0]
    return coach.add([PalpationLine(start_s + 0.05 * k, True, 0.95, position_mm=place) for k in range(14)])


def palpate_all(coach: Coach) -> list[int]:
    order, now = [], 0.0
    while (target := coach.target) is not None:
        order.append(target)
        assert any(status.new_point for status in rest_at(coach, target, now))
        now += 2.0
    return order


def test_without_a_registration_the_points_come_in_order_and_nothing_is_said_of_tilt(a_skull, a_plan):
    coach = Coach(a_plan, a_skull)
    assert coach.guide(np.eye(4)) is None
    assert palpate_all(coach) == list(range(12))


def test_each_next_point_is_the_one_that_brings_most(a_skull, a_plan):
    coach = Coach(a_plan, a_skull)
    coach.use_registration(REFERENCE_TO_RAS, LANDMARK_COVARIANCE)
    predicted = [coach.next_target.tre_now_mm]
    now = 0.0
    while (target := coach.target) is not None:
        predicted.append(coach.next_target.tre_then_mm)
        assert any(status.new_point for status in rest_at(coach, target, now))
        now += 2.0
    rows = motion_rows(a_plan.positions_ras_mm, a_plan.normals, np.zeros(3)) / 0.6
    everything = np.linalg.inv(np.linalg.inv(LANDMARK_COVARIANCE) + rows.T @ rows)
    assert predicted[-1] == pytest.approx(rms_tre_mm(everything, np.zeros(3), a_plan.positions_ras_mm), rel=1e-6)
    assert np.all(np.diff(predicted) < 0)
    in_order = [
        rms_tre_mm(
            np.linalg.inv(np.linalg.inv(LANDMARK_COVARIANCE) + rows[:k].T @ rows[:k]), np.zeros(3), a_plan.positions_ras_mm
        )
        for k in range(13)
    ]
    assert predicted[4] < in_order[4]
    assert sum(predicted) < sum(in_order)


def test_one_more_point_is_one_more_row_of_least_squares(a_plan):
    position, normal, pivot = a_plan.positions_ras_mm[0], a_plan.normals[0], np.array([3.0, -20.0, 8.0])
    row = motion_rows(position[None], normal[None], pivot)
    expected = np.linalg.inv(np.linalg.inv(LANDMARK_COVARIANCE) + row.T @ row / 0.5**2)
    assert covariance_with(LANDMARK_COVARIANCE, position, normal, pivot, 0.5) == pytest.approx(expected, abs=1e-9)


def test_points_out_of_reach_are_never_asked_for(a_skull, a_plan):
    down = np.array([0.0, -1.0, 0.0])
    coach = Coach(a_plan, a_skull, table_direction_ras=down)
    behind = np.flatnonzero(~coach.reachable)
    assert len(behind)
    coach.use_registration(REFERENCE_TO_RAS, LANDMARK_COVARIANCE)
    assert set(palpate_all(coach)) == set(range(12)) - set(behind)
    with pytest.raises(InputError, match="within reach"):
        Coach(a_plan, a_skull, clamp_ras_mm=a_plan.positions_ras_mm + 40 * a_plan.normals)


def test_the_probe_is_guided_in_the_frame_of_the_patient(a_skull, a_plan):
    coach = Coach(a_plan, a_skull)
    coach.use_registration(REFERENCE_TO_RAS, LANDMARK_COVARIANCE)
    target = coach.target
    beam = -transform_directions(invert_rigid(REFERENCE_TO_RAS), a_plan.normals[target][None])[0]
    place = transform_points(invert_rigid(REFERENCE_TO_RAS), a_plan.positions_ras_mm[target][None])[0]
    pose = np.eye(4)
    pose[:3, 2] = beam
    pose[:3, 0] = np.cross(beam, [0.3, 0.2, 0.9]) / np.linalg.norm(np.cross(beam, [0.3, 0.2, 0.9]))
    pose[:3, 1] = np.cross(beam, pose[:3, 0])
    pose[:3, 3] = place - 20 * beam
    seen = coach.guide(pose)
    assert seen.on_target
    assert seen.angle_deg < 2.0
    assert 0.0 < seen.angle_sd_deg <= np.degrees(0.03 * np.sqrt(2)) + 1e-9


def test_a_point_palpated_away_from_the_target_does_not_count(a_skull, a_plan):
    coach = Coach(a_plan, a_skull)
    coach.use_registration(REFERENCE_TO_RAS, LANDMARK_COVARIANCE)
    other = (coach.target + 1) % 12
    assert {status.reason for status in rest_at(coach, other, 0.0)} == {"away from the target"}


def test_undo_skip_and_a_choice_of_the_user(a_skull, a_plan):
    coach = Coach(a_plan, a_skull)
    rest_at(coach, 0, 0.0)
    assert coach.target == 1
    coach.undo()
    assert coach.target == 0
    coach.skip()
    assert coach.target == 1
    coach.aim(7)
    assert coach.target == 7
    rest_at(coach, 7, 10.0)
    assert coach.target == 8


def test_measured_frames_become_lines():
    measured = LineMeasurements(
        depths_mm=np.array([5.0, np.nan]),
        depth_sds_mm=np.array([0.1, np.nan]),
        positions_mm=np.array([[1.0, 2, 3], [np.nan] * 3]),
        covariances_mm2=np.tile(np.eye(3), (2, 1, 1)),
        beam_directions=np.tile([0.0, 0, 1], (2, 1)),
        qualities=np.array([0.97, 0.0]),
        accepted=np.array([True, False]),
        reasons=("", "no echo"),
        alternative_depths_mm=np.empty((2, 0)),
        alternative_probabilities=np.empty((2, 0)),
        skin_times_s=np.zeros(2),
        speed_of_sound_m_s=1540.0,
        speed_of_sound_sd_m_s=52.0,
    )
    good, bad = lines_of(measured, [10.0, 10.1], first_frame=40)
    assert (good.accepted, good.quality, good.depth_mm, good.frame, good.time_s) == (True, 0.97, 5.0, 40, 10.0)
    assert (bad.accepted, bad.reason, bad.frame) == (False, "no echo", 41)
    with pytest.raises(InputError, match="one time for each of 2"):
        lines_of(measured, [1.0])
