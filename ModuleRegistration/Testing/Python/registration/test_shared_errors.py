from dataclasses import replace

import numpy as np
from ModuleRegistrationLib.registration.error_theory import predict_tre_of
from ModuleRegistrationLib.registration.likelihood import State, prepare
from ModuleRegistrationLib.registration.problem import METHODS
from ModuleRegistrationLib.registration.shared_errors import find_patches, find_sweeps, refine

METHOD = METHODS.create("cranionav")


def test_sweeps_are_those_recorded() -> None:
    assert find_sweeps(np.zeros((4, 3)), np.array([7, 7, 3, 3])).tolist() == [1, 1, 0, 0]


def test_sweeps_that_were_not_recorded_end_where_the_probe_jumps() -> None:
    positions = np.concatenate([np.linspace([0, 0, 0], [30, 0, 0], 31), np.linspace([80, 0, 0], [80, 30, 0], 31)])
    assert find_sweeps(positions, np.arange(62)).tolist() == [0] * 31 + [1] * 31


def test_points_of_one_cube_are_one_patch() -> None:
    assert find_patches(np.array([[1.0, 1, 1], [2, 2, 2], [30, 1, 1]]), 12.0).tolist() == [0, 0, 1]


def test_outliers_do_not_end_a_sweep() -> None:
    rng = np.random.default_rng(0)
    positions = np.concatenate([np.linspace([0, 0, 0], [60, 0, 0], 120), np.linspace([20, 40, 0], [20, 90, 0], 120)])
    positions[:, 2] += (rng.random(240) < 0.2) * rng.uniform(2, 8, 240)
    assert find_sweeps(positions, np.arange(240)).tolist() == [0] * 120 + [1] * 120


def test_the_spread_of_the_sweeps_biases_is_estimated(a_case) -> None:
    found = []
    for bias_sd, outlier_share in ((0.0, 0.0), (0.5, 0.0), (0.5, 0.25)):
        problem = a_case(1, repeats=20, group_bias_sd=bias_sd, landmark_sd=1.0, outlier_share=outlier_share).problem
        model = prepare(problem)
        state = State(np.eye(4)[None], *(np.array([value]) for value in (0.0, 0.0, 1.0, 0.1)))
        found.append(refine(model, state, problem.points.groups).shared_sds_mm[0])
    assert found[0] < 0.15
    assert 0.2 < found[1] < 0.8
    assert abs(found[2] - found[1]) < 0.2 * found[1]  # a sweep's samples are no outliers because its bias is large


def test_the_bias_of_sweeps_hardly_moves_the_pose(a_case) -> None:
    errors = []
    for bias_sd in (0.0, 0.4):
        cases = [a_case(seed, repeats=60, group_bias_sd=bias_sd) for seed in range(6)]
        errors.append(np.mean([case.tre(METHOD.register(case.problem).reference_to_ras).mean() for case in cases]))
    # taken for independent, the points would follow their sweeps: 0.4 mm in each of five regions makes over 0.6 mm
    assert errors[1] < errors[0] + 0.2


def test_many_points_register_better_than_few(a_case) -> None:
    few = np.mean([a_case(s).tre(METHOD.register(a_case(s).problem).reference_to_ras).mean() for s in range(5)])
    many = np.mean(
        [a_case(s, repeats=30).tre(METHOD.register(a_case(s, repeats=30).problem).reference_to_ras).mean() for s in range(5)]
    )
    assert many < 0.5 * few


def test_predicted_error_covers_the_true_one_with_shared_biases(a_case) -> None:
    inside = []
    for seed in range(14):
        case = a_case(seed, repeats=20, group_bias_sd=0.25)
        result = METHOD.register(case.problem)
        inside.append(np.mean(case.tre(result.reference_to_ras) < predict_tre_of(result, case.targets).p95_mm))
    assert np.mean(inside) > 0.8


def test_points_that_do_not_fit_at_all_still_give_a_finite_error(a_case) -> None:
    case = a_case(6, repeats=4, noise_sd=0.2)
    points = case.problem.points
    middle = points.positions_mm.mean(axis=0)
    larger = replace(points, positions_mm=middle + 1.07 * (points.positions_mm - middle))
    result = METHOD.register(replace(case.problem, points=larger))
    assert np.isfinite(result.covariance).all()
