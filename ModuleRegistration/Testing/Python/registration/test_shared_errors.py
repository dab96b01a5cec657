import numpy as np
from ModuleRegistrationLib.registration.error_theory import predict_tre_of
from ModuleRegistrationLib.registration.problem import METHODS
from ModuleRegistrationLib.registration.shared_errors import find_patches, find_sweeps

METHOD = METHODS.create("cranionav")


def test_sweeps_are_those_recorded() -> None:
    assert find_sweeps(np.zeros((4, 3)), np.array([7, 7, 3, 3])).tolist() == [1, 1, 0, 0]


def test_sweeps_that_were_not_recorded_end_where_the_probe_jumps() -> None:
    positions = np.concatenate([np.linspace([0, 0, 0], [30, 0, 0], 31), np.linspace([80, 0, 0], [80, 30, 0], 31)])
    assert find_sweeps(positions, np.arange(62)).tolist() == [0] * 31 + [1] * 31


def test_points_of_one_cube_are_one_patch() -> None:
    assert find_patches(np.array([[1.0, 1, 1], [2, 2, 2], [30, 1, 1]]), 12.0).tolist() == [0, 0, 1]


def test_a_bias_that_sweeps_share_widens_the_predicted_error(a_case) -> None:
    calm, biased = a_case(1, repeats=20), a_case(1, repeats=20, group_bias_sd=0.4)
    errors = [predict_tre_of(METHOD.register(case.problem), case.targets).p95_mm.mean() for case in (calm, biased)]
    assert errors[1] > 1.5 * errors[0]


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
