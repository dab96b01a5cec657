"""The simulated session: the hand goes where it is told, and devices see and hear the same."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.phantom import constants, make_patient
from CranioNavLib.phantom.beam import look_at_bone
from CranioNavLib.phantom.motion import Path, Tremor
from CranioNavLib.phantom.session import RealClock, SimulatedSession, SteppedClock, current_session, use_session
from CranioNavLib.phantom.sites import outer_seats
from CranioNavLib.rigid import invert_rigid, rigid, rigid_from_vector, rotation_angle_deg, transform_points

SETTLED_S = constants.MOVE_S + 0.2


@pytest.fixture(scope="module")
def a_patient():
    return make_patient(None, 4)


@pytest.fixture
def a_session(a_patient):
    session = SimulatedSession(a_patient, 1, SteppedClock())
    points, normals = outer_seats(a_patient.bone, a_patient.skin, np.random.default_rng(0))
    session.set_plan(points[:5], normals[:5])
    return session


def tip_in_ras(session, tool, time_s):
    pose = session.tool_to_reference(tool, time_s)
    return transform_points(session.patient.true_reference_to_ras, pose[None, :3, 3])[0]


def test_the_stylus_tip_comes_to_rest_on_the_landmark(a_session, a_patient):
    a_session.touch_landmark(2)
    found = np.array([tip_in_ras(a_session, "Stylus", SETTLED_S + 0.1 * k) for k in range(20)])
    assert np.linalg.norm(found.mean(axis=0) - a_patient.landmarks_ras_mm[2]) < 4 * constants.LANDMARK_FLE_SD_MM
    assert found.std(axis=0).max() < 0.4


def test_the_sphere_tool_seats_on_a_target(a_session, a_patient):
    a_session.touch_target(6)
    assert np.linalg.norm(tip_in_ras(a_session, "Sphere", SETTLED_S) - a_patient.markers_ras_mm[6]) < 1.0


@pytest.mark.parametrize("tilt_deg", [0.0, 4.0])
def test_the_probe_is_held_at_the_tilt_told(a_session, tilt_deg):
    a_session.skill = type(a_session.skill)(tremor_tilt_sd_deg=0.0, tremor_position_sd_mm=0.0)
    a_session.hold_probe_at(2, tilt_deg=tilt_deg)
    pose = a_session.patient.true_reference_to_ras @ a_session.tool_to_reference("Probe", SETTLED_S)
    contact = pose @ rigid(np.eye(3), (0, 0, constants.FORERUN_LENGTH_MM))
    assert look_at_bone(a_session.patient.bone, contact[None]).tilt_deg[0] == pytest.approx(tilt_deg, abs=0.7)
    assert a_session.palpation_point == 2


def test_a_point_that_the_plan_lacks_is_refused(a_session):
    with pytest.raises(InputError, match="has 5 points, there is no number 7"):
        a_session.hold_probe_at(7)


def test_tools_not_in_hand_are_not_seen_and_the_base_always_is(a_session):
    seen = a_session.reported_poses(0.0)
    assert seen["Reference"] is not None
    assert seen["Probe"] is seen["Stylus"] is seen["Sphere"] is None
    a_session.touch_landmark(0)
    assert a_session.reported_poses(2.0)["Stylus"] is not None
    a_session.put_away("Stylus")
    assert a_session.reported_poses(2.1)["Stylus"] is None


def test_a_head_that_moves_takes_the_tools_in_reference_along(a_session):
    a_session.touch_landmark(0)
    a_session.clock.wait_until(2.0)
    before = a_session.reported_poses(2.0, noise=0.0)
    a_session.move_head((0.0, 0.2, 0.1), (30.0, -20.0, 10.0), duration_s=1.0)
    after = a_session.reported_poses(4.0, noise=0.0)
    assert np.linalg.norm(after["Reference"][:3, 3] - before["Reference"][:3, 3]) > 5
    assert rotation_angle_deg(after["Reference"], before["Reference"]) == pytest.approx(np.degrees(np.hypot(0.2, 0.1)), abs=0.01)
    relative = [invert_rigid(seen["Reference"]) @ seen["Stylus"] for seen in (before, after)]
    assert np.linalg.norm(relative[0][:3, 3] - relative[1][:3, 3]) < 0.5


def test_uncalibrated_tools_hide_their_tips_and_pivoting_shows_them(a_session):
    a_session.pivot("Stylus")
    times = np.arange(SETTLED_S, SETTLED_S + 20, 0.2)
    poses = []
    for moment in times:
        seen = a_session.reported_poses(moment, noise=0.0, calibrated=False)
        poses.append(invert_rigid(seen["Reference"]) @ seen["Stylus"])
    poses = np.array(poses)
    design = np.concatenate([poses[:, :3, :3], np.broadcast_to(-np.eye(3), (len(poses), 3, 3))], axis=2).reshape(-1, 6)
    solution = np.linalg.lstsq(design, -poses[:, :3, 3].ravel(), rcond=None)[0]
    assert solution[:3] == pytest.approx(constants.STYLUS_TIP_MM, abs=0.3)


def test_the_echo_comes_from_the_depth_at_which_the_probe_stands(a_session):
    a_session.skill = type(a_session.skill)(tremor_tilt_sd_deg=0.0, tremor_position_sd_mm=0.0)
    patient = a_session.patient
    hits = 0
    for point in range(5):
        a_session.clock.wait_until(a_session.clock.now() + 5)
        a_session.hold_probe_at(point, tilt_deg=0.0)
        moment = a_session.clock.now() + SETTLED_S
        pose = patient.true_reference_to_ras @ a_session.tool_to_reference("Probe", moment)
        contact = pose @ rigid(np.eye(3), (0, 0, constants.FORERUN_LENGTH_MM))
        depth = look_at_bone(patient.bone, contact[None]).center_mm[0]
        lines = np.array([a_session.rf_line(moment + 0.025 * k) for k in range(20)]).astype(float)
        skin_s = 2e-3 * constants.FORERUN_LENGTH_MM / patient.tissue.forerun_speed_m_s
        echo_s = skin_s + 2e-3 * depth / float(patient.tissue.speed_at(contact[None, :3, 3])[0])
        energy = np.abs(lines.mean(axis=0))
        first = int((skin_s + 1.5e-6) * constants.SAMPLING_HZ)
        # the strongest sound behind the forerun is bone
        found_s = (first + energy[first : first + 1100].argmax()) / constants.SAMPLING_HZ
        hits += abs(found_s - echo_s) < 0.5e-6
    assert hits >= 4


def test_what_is_to_be_done_later_is_done_in_time_and_order(a_session):
    a_session.play([(2.0, lambda: a_session.put_away("Probe")), (1.0, lambda: a_session.hold_probe_at(3))])
    visited = []
    for moment in (0.5, 1.1, 2.1):
        a_session.clock.wait_until(moment)
        a_session.tool_to_reference("Probe", moment)
        visited.append(a_session.palpation_point)
    assert visited == [-1, 3, -1]


def test_a_sweep_slides_over_every_point_of_the_plan_at_its_pace_and_with_the_skin(a_session, a_patient):
    places = outer_seats(a_patient.bone, a_patient.skin, np.random.default_rng(0))[0][:5]
    took = a_session.sweep_plan()
    begun = a_session.clock.now() + constants.MOVE_S
    times = np.arange(begun, begun - constants.MOVE_S + took, 0.05)
    poses = np.stack([a_session.tool_to_reference("Probe", time_s) for time_s in times])
    ras = transform_points(a_patient.true_reference_to_ras, poses[:, :3, 3])
    assert a_patient.skin.closest(ras).distances_mm.max() < constants.FORERUN_LENGTH_MM + 5
    for place in places:
        assert np.linalg.norm(ras - place, axis=1).min() < constants.FORERUN_LENGTH_MM + 25, (
            "the probe's face stands over each point"
        )
    speeds = np.linalg.norm(np.diff(ras, axis=0), axis=1) / 0.05
    assert 0.5 * constants.SWEEP_MM_S < np.median(speeds) < 2 * constants.SWEEP_MM_S
    assert a_session.palpation_point == -1
    with pytest.raises(InputError, match="a sweep needs two"):
        SimulatedSession(a_patient, clock=SteppedClock()).sweep_plan()


def test_reported_poses_scatter_by_the_noise_asked_for(a_session):
    for noise, low, high in ((0.0, -1e-9, 1e-9), (1.0, 0.03, 0.4)):
        base = np.array([a_session.reported_poses(0.05 * k, noise=noise)["Reference"][:3, 3] for k in range(100)])
        assert low <= base.std(axis=0).max() <= high


def test_devices_share_one_session(a_session):
    use_session(a_session)
    try:
        assert current_session("synthetic", 99) is a_session
    finally:
        use_session(None)


def test_clocks_wait():
    stepped = SteppedClock()
    stepped.wait_until(5.0)
    stepped.wait_until(3.0)
    assert stepped.now() == 5.0
    real = RealClock()
    begin = real.now()
    real.wait_until(begin + 0.02)
    assert real.now() >= begin + 0.02


def test_a_path_begins_and_ends_where_it_should_without_a_jerk():
    goal = rigid_from_vector((0.3, 0, 0), (100.0, 0, 0))
    path = Path(np.eye(4), goal, 10.0, 2.0, np.array([0.0, 0, 40.0]))
    assert np.allclose(path.at(9.0), np.eye(4))
    assert np.allclose(path.at(12.5), goal)
    assert path.at(11.0)[:3, 3] == pytest.approx((50.0, 0.0, 40.0))
    places = np.array([path.at(t)[:3, 3] for t in np.arange(10, 12, 0.01)])
    assert np.abs(np.diff(places, axis=0)).max() < 2.0  # below 200 mm/s everywhere


def test_tremor_over_time_has_unit_size():
    values = np.array([Tremor.draw(np.random.default_rng(seed), 2).at(seed * 0.37) for seed in range(3000)])
    assert values.std(axis=0) == pytest.approx((1.0, 1.0), abs=0.05)
