from dataclasses import replace

import numpy as np
import pytest
from CranioNavLib.rigid import invert_rigid, rigid_from_vector
from ModuleRegistrationLib.registration.error_theory import length_statistics
from ModuleRegistrationLib.registration.global_search import draw_starts, search, stages, starts_for
from ModuleRegistrationLib.registration.likelihood import State, evaluate, outlier_laws, prepare
from ModuleRegistrationLib.registration.posterior import covariance_holding, motion_vector


def state_at(model, vector: np.ndarray) -> State:
    motion = rigid_from_vector(vector[None, :3], vector[None, 3:6], model.pivot)
    return State(motion, vector[None, 6], vector[None, 7], np.ones(1), np.full(1, 0.05))


def test_the_design_is_the_derivative_of_the_residuals(a_case) -> None:
    model = prepare(a_case(1, landmark_sd=0.5).problem)
    found = evaluate(model, state_at(model, np.zeros(8)))
    for k, size in enumerate([1e-4] * 3 + [1e-2] * 3 + [1e-2, 1e-3]):
        step = np.zeros(8)
        step[k] = size
        ahead, behind = (evaluate(model, state_at(model, sign * step)).residuals[0] for sign in (1, -1))
        slopes = (ahead - behind) / (2 * size)
        assert np.median(np.abs(slopes - found.design[0, :, k])) < 0.03 * max(1.0, np.abs(found.design[0, :, k]).max())


def test_many_poses_cost_what_each_costs_alone(a_case) -> None:
    model = prepare(a_case(1).problem)
    starts = draw_starts(model, 5, np.random.default_rng(0))
    together = evaluate(model, starts).cost
    alone = [evaluate(model, starts.take(np.array([k]))).cost[0] for k in range(5)]
    assert together == pytest.approx(alone, rel=1e-6)


def test_poor_landmarks_lose_their_weight_at_the_true_pose(a_case) -> None:
    weights = []
    for landmark_sd in (1.0, 8.0):
        case = a_case(1, landmark_sd=landmark_sd)
        model = prepare(case.problem)
        truth = case.true_reference_to_ras @ invert_rigid(case.problem.initial_reference_to_ras)
        state = State(truth[None], np.zeros(1), np.zeros(1), np.ones(1), np.full(1, 0.05))
        weights.append(evaluate(model, state).landmark_weight[0])
    assert weights[0] > 10 * weights[1]


def test_the_search_finds_the_true_minimum_from_poor_landmarks(a_case) -> None:
    found = 0
    for seed in range(8):
        case = a_case(seed, landmark_sd=6.9)
        minima, _, _ = search(prepare(case.problem), np.random.default_rng(0), stages(200))
        found += case.tre(minima.motion[0] @ case.problem.initial_reference_to_ras).mean() < 3
    assert found >= 7


def test_landmarks_that_leave_the_pose_open_ask_for_more_starts(a_case) -> None:
    assert starts_for(prepare(a_case(1, landmark_sd=1.0).problem), 200) == 200
    assert 300 < starts_for(prepare(a_case(1, landmark_sd=15.0).problem), 200) <= 800


def test_a_motions_vector_is_the_inverse_of_the_motion() -> None:
    rng = np.random.default_rng(3)
    vectors, pivot = rng.normal(0, 0.5, (20, 6)), np.array([10.0, -40, 25])
    assert np.allclose(motion_vector(rigid_from_vector(vectors[:, :3], vectors[:, 3:], pivot), pivot), vectors, atol=1e-9)


def test_an_outlier_lies_outside_inside_or_astray_with_probability_one() -> None:
    residuals = np.arange(-4000, 4000, 0.05)
    outside, inside, stray = outlier_laws(residuals)
    assert 0.05 * np.sum(outside / 2 + inside / 2 + stray) == pytest.approx(1, abs=1e-3)
    assert residuals[np.argmax(outside)] == pytest.approx(5, abs=0.1)


def test_outliers_on_one_side_are_likelier_than_on_both(a_case) -> None:
    case, moved = a_case(1, noise_sd=0.1, landmark_sd=0.5), [1, 5, 9, 13]
    truth = case.true_reference_to_ras @ invert_rigid(case.problem.initial_reference_to_ras)
    state = State(truth[None], np.zeros(1), np.zeros(1), np.ones(1), np.full(1, 0.2))

    def cost(sides: tuple[int, ...]) -> float:
        points = case.problem.points
        positions = points.positions_mm.copy()
        positions[moved] -= 5 * np.array(sides)[:, None] * points.beam_directions[moved]
        return float(evaluate(prepare(replace(case.problem, points=replace(points, positions_mm=positions))), state).cost[0])

    assert cost((1, 1, 1, 1)) < cost((1, -1, 1, -1)) - 1
    assert cost((1, -1, 1, -1)) < cost((-1, -1, -1, -1)) + 0.5


def test_the_95_percent_limit_reaches_a_second_minimum_of_a_tenth() -> None:
    rng = np.random.default_rng(5)
    vectors = np.zeros((4000, 6))
    vectors[:, 3:] = rng.normal(0, 0.3, (4000, 3))
    arms = np.array([[60.0, 0, 0], [0, 60, 0], [0, 0, 60]])
    share = np.full(4000, 1 / 4000)
    plain = covariance_holding(vectors, share, arms)
    assert np.sqrt(np.diagonal(plain)[3:]) == pytest.approx(0.3, rel=0.06)  # one minimum: the second moment as it is
    vectors[:400, 3] += 10
    limit = length_statistics(covariance_holding(vectors, share, arms)[3:, 3:]).p95_mm
    assert 10 < limit < 11.5
