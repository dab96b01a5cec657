"""The simulated hand: its unrest has the stated size, it acts only after it saw, and guidance squares it in time."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from CranioNavLib.surface import Surface
from ModuleUltrasoundLib.palpation.hand_model import (
    DIFFUSE_FLOOR_DB,
    GuidedUser,
    Hand,
    HandParameters,
    UnguidedUser,
    echo_db,
)
from ModuleUltrasoundLib.palpation.protocol import ProtocolPoints, plan_protocol
from vtkmodules.vtkFiltersSources import vtkSphereSource

STEP_S = 0.01
STILL = np.zeros(2)


@pytest.fixture(scope="module")
def the_study():
    path = Path(__file__).resolve().parents[3] / "Testing" / "Studies" / "guided_alignment.py"
    spec = importlib.util.spec_from_file_location("guided_alignment_study", path)
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules[spec.name] = module  # its dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_an_idle_hand_wanders_and_trembles_by_the_stated_sizes():
    parameters = HandParameters(tremor_sd_deg=0.3, drift_sd_deg=0.8, drift_time_s=0.5)
    tilts = np.array([Hand(parameters, STILL, np.random.default_rng(k)).turn(STILL, STEP_S) for k in range(3000)])
    assert tilts.std(axis=0) == pytest.approx([np.hypot(0.3, 0.8)] * 2, rel=0.06)
    hand = Hand(HandParameters(drift_sd_deg=0.0, tremor_sd_deg=0.3), STILL, np.random.default_rng(0))
    tremor = np.array([hand.turn(STILL, STEP_S) for _ in range(4000)])
    assert tremor.std(axis=0) == pytest.approx([0.3, 0.3], rel=0.05)
    spectrum = np.abs(np.fft.rfft(tremor[:, 0]))
    assert np.fft.rfftfreq(len(tremor), STEP_S)[np.argmax(spectrum)] == pytest.approx(9.0, abs=0.5)


def test_a_steady_turn_goes_as_far_as_speed_and_time_say_and_no_faster_than_the_hand():
    calm = HandParameters(tremor_sd_deg=0.0, drift_sd_deg=0.0, fastest_deg_s=20.0)
    hand = Hand(calm, np.array([5.0, 0.0]), np.random.default_rng(0))
    for _ in range(100):
        tilt = hand.turn(np.array([-3.0, 4.0]), STEP_S)
    assert tilt == pytest.approx([2.0, 4.0])
    hand = Hand(calm, STILL, np.random.default_rng(0))
    for _ in range(100):
        tilt = hand.turn(np.array([300.0, 400.0]), STEP_S)
    assert tilt == pytest.approx([12.0, 16.0])


def test_a_guided_user_does_nothing_before_the_reaction_time_and_then_turns_against_the_error():
    exact = HandParameters(reaction_s=0.3, reading_sd_deg=0.0, reading_share=0.0, crossover_rad_s=2.0)
    user = GuidedUser(exact, np.random.default_rng(0))
    user.see(np.array([4.0, -1.0]), 0.0)
    assert np.array_equal(user.speed(0.29), STILL)
    assert user.speed(0.3) == pytest.approx([-8.0, 2.0])


def test_the_loop_of_hand_and_eye_is_the_crossover_models():
    """Without unrest, the error after a delay decays as a first-order loop with a dead time does."""
    calm = HandParameters(
        tremor_sd_deg=0, drift_sd_deg=0, reading_sd_deg=0, reading_share=0, reaction_s=0.1, crossover_rad_s=1.0, fastest_deg_s=200
    )
    hand, user = Hand(calm, np.array([10.0, 0.0]), np.random.default_rng(0)), GuidedUser(calm, np.random.default_rng(0))
    tilt, step = hand.tilt_deg, 0.002
    for k in range(1500):
        user.see(tilt, k * step)
        tilt = hand.turn(user.speed(k * step), step)
    root = -1.118  # of s + exp(-0.1 s) = 0: the slowest mode
    assert np.log(tilt[0] / 10.0) == pytest.approx(root * (3.0 - 0.1), abs=0.12)


def test_an_unguided_user_searches_until_an_echo_shows_then_stays_at_a_good_one():
    parameters = HandParameters(amplitude_sd_db=0.0)
    hand, user = (
        Hand(parameters, np.array([7.0, -5.0]), np.random.default_rng(1)),
        UnguidedUser(parameters, np.random.default_rng(1)),
    )
    for k in range(6000):
        user.see(echo_db(hand.tilt_deg), k * STEP_S)
        hand.turn(user.speed(k * STEP_S, STEP_S), STEP_S)
        if user.satisfied:
            break
    assert user.satisfied
    assert np.linalg.norm(hand.tilt_deg) < 4.0


def test_an_echo_loses_six_decibels_at_the_half_amplitude_angle():
    assert echo_db(np.array([0.0, 0.0])) == 0.0
    assert echo_db(np.array([0.0, 1.2])) == pytest.approx(-6.0)
    assert echo_db(np.array([9.0, 0.0])) == DIFFUSE_FLOOR_DB


def an_egg() -> Surface:
    source = vtkSphereSource()
    source.SetRadius(1.0)
    source.SetThetaResolution(120)
    source.SetPhiResolution(120)
    source.Update()
    ball = Surface.from_polydata(source.GetOutput())
    return Surface(ball.vertices_mm * (70.0, 90.0, 75.0), ball.triangles)


def test_guided_alignment_is_under_three_degrees_in_under_four_seconds(the_study):
    surface = an_egg()
    some = np.random.default_rng(0).choice(len(surface.vertices_mm), 18, replace=False)
    names = tuple(str(k) for k in range(18))
    plan = ProtocolPoints(names, surface.vertices_mm[some], surface.vertex_normals[some], names)
    hand, error_deg = the_study.HANDS["typical hand"], the_study.NORMAL_ERRORS_DEG["landmarks only"]
    guided = [the_study.guided_trial(surface, plan, error_deg, np.random.default_rng((7, k)), hand) for k in range(15)]
    unguided = [the_study.unguided_trial(np.random.default_rng((7, k)), hand) for k in range(15)]
    assert np.median([trial.time_s for trial in guided]) < 4.0
    assert np.median([trial.final_deg for trial in guided]) < 3.0
    assert np.median([trial.time_s for trial in guided]) < np.median([trial.time_s for trial in unguided])


@pytest.mark.slow
def test_guidance_meets_its_goal_for_slow_hands_too(the_study):
    surface = the_study.a_head()
    results = the_study.study(60, 3, surface, plan_protocol(surface))
    for name, outcomes in results.items():
        if ", guided" in name:
            assert np.median([trial.time_s for trial in outcomes]) < 4.0, name


def test_a_held_goal_is_timed_from_its_beginning(the_study):
    step, held = the_study.STEP_S, round(the_study.HELD_S / the_study.STEP_S)
    tilts = [9.0] * 10 + [1.0] * (held - 1) + [4.0] * 5 + [2.9] * held
    assert the_study.outcome(tilts).time_s == pytest.approx((10 + held - 1 + 5) * step)
    assert the_study.outcome([9.0] * 200).time_s == float("inf")
    assert the_study.reached(tilts)
    assert not the_study.reached(tilts[:-1])
