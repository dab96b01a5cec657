"""Points left out of a registration: what the linear equations promise, and what registering without them shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from CranioNavLib.rigid import invert_rigid, transform_points
from ModuleRegistrationLib.registration.error_theory import predict_tre, predict_tre_of
from ModuleRegistrationLib.registration.problem import METHODS
from ModuleRegistrationLib.verification.held_out import check_held_out, leave_one_out, leverages
from ModuleRegistrationLib.verification.linear_model import linear_model

METHOD = METHODS.create("cranionav", starts=16, samples=200)


@pytest.fixture(scope="module")
def a_registered_case(a_case):
    case = a_case(4)
    return case, METHOD.register(case.problem)


@pytest.mark.parametrize("name", ["cranionav", "icp"])
def test_the_models_covariance_predicts_what_the_registration_predicts(a_case, name):
    case = a_case(4)
    result = METHODS.create(name).register(case.problem)
    model = linear_model(case.problem, result)  # about another pivot
    moved = predict_tre(model.covariance[:6, :6], model.pivot_ras_mm, case.targets)
    assert moved.p95_mm == pytest.approx(predict_tre_of(result, case.targets).p95_mm, rel=1e-6)
    assert np.linalg.eigvalsh(model.covariance).min() > 0


def test_the_design_is_the_derivative_of_the_residuals(a_registered_case):
    from CranioNavLib.rigid import rigid_from_vector

    case, result = a_registered_case
    model = linear_model(case.problem, result)
    for column in range(6):
        step = np.zeros(6)
        step[column] = 1e-5 if column < 3 else 1e-3
        motion = rigid_from_vector(step[:3], step[3:], model.pivot_ras_mm)
        other = replace(result, reference_to_ras=motion @ result.reference_to_ras)
        change = (linear_model(case.problem, other).residuals_mm - model.residuals_mm) / step[column]
        # at an edge between facets the derivative jumps; most points are away from one
        assert np.median(np.abs(change - model.design[:, column])) < 0.05 * np.abs(model.design[:, column]).max()


def test_leaving_one_out_is_least_squares_without_the_point(a_registered_case):
    case, result = a_registered_case
    model, found = linear_model(case.problem, result), leave_one_out(case.problem, result, case.targets)
    used = np.flatnonzero(result.used)
    data = model.design.T @ (model.weights[:, None] * model.design)
    prior = np.linalg.inv(model.fit_covariance) - data
    for place, point in enumerate(used):
        rest = np.arange(len(model.weights)) != point
        information = prior + model.design[rest].T @ (model.weights[rest, None] * model.design[rest])
        gradient = model.design[rest].T @ (model.weights[rest] * model.residuals_mm[rest])
        all_of_them = model.design.T @ (model.weights * model.residuals_mm)
        step = -np.linalg.solve(information, gradient - all_of_them)  # from a solution, where all of them balance the prior
        assert found.residuals_mm[place] == pytest.approx(model.residuals_mm[point] + model.design[point] @ step, abs=1e-9)


def test_leaving_one_out_foresees_a_registration_without_the_point(a_case):
    case = a_case(4, noise_sd=0.3)
    result = METHOD.register(case.problem)
    found = leave_one_out(case.problem, result, case.targets)
    foreseen, seen = [], []
    for place in (found.most_influential, int(np.argmin(found.shifts_mm))):
        keep = np.arange(len(result.used)) != np.flatnonzero(result.used)[place]
        without = METHOD.register(replace(case.problem, points=case.problem.points.subset(keep)))
        back = transform_points(invert_rigid(result.reference_to_ras), case.targets)
        seen.append(np.linalg.norm(transform_points(without.reference_to_ras, back) - case.targets, axis=1).max())
        foreseen.append(found.shifts_mm[place])
    assert seen[0] > seen[1]
    assert foreseen == pytest.approx(seen, abs=0.35)  # the posterior's mean, sampled, moves by itself by 0.1 mm


def test_leverages_are_shares_and_sum_to_what_is_estimated(a_registered_case):
    case, result = a_registered_case
    shares = leverages(linear_model(case.problem, result))
    assert (shares > 0).all()
    assert (shares < 1).all()
    assert 4 < shares.sum() < 8  # six of the pose, less what landmarks hold, and part of the common offset


def test_right_errors_give_no_alarm_and_too_small_ones_do(a_case):
    right, small = [], []
    for seed in range(5):
        for noise, chances in ((0.4, right), (1.0, small)):  # 0.4 mm are stated
            case = a_case(seed, noise_sd=noise)
            chances.append(check_held_out(case.problem, METHOD.register(case.problem), METHOD))
    assert all(check.as_expected for check in right)
    assert np.median([check.p_value for check in right]) > 0.1
    assert sum(not check.as_expected for check in small) >= 3
    worst = min(small, key=lambda check: check.p_value)
    assert "further off than expected" in worst.words("the held-out points")
    assert "the stated error is too small" in worst.words("the held-out points")
    assert right[0].words("the held-out points").startswith("the held-out points lie as far off as expected (p = 0.")


def test_each_point_is_held_out_once(a_registered_case):
    case, result = a_registered_case
    check = check_held_out(case.problem, result, METHOD)
    assert check.labels == tuple(np.array(case.problem.points.labels)[result.used])
    assert (np.abs(check.distances_mm) > 0).all()
    assert (check.expected_sd_mm > 0.3).all()
    assert np.abs(check.distances_mm).mean() > np.abs(result.residuals_mm[result.used]).mean()  # not what the fit has seen


def test_sweeps_and_few_points_are_not_judged_by_single_points(a_case):
    sweep = a_case(1, repeats=5)
    result = METHOD.register(sweep.problem)
    assert check_held_out(sweep.problem, result, METHOD) is None
    assert leave_one_out(sweep.problem, result, sweep.targets) is None
    case = a_case(1)
    few = replace(case.problem, points=case.problem.points.subset(np.arange(0, 18, 3)))
    result = METHOD.register(few)
    assert check_held_out(few, result, METHOD) is None
    assert leave_one_out(few, result, case.targets) is None


def test_a_method_without_uncertainty_is_not_judged(a_registered_case):
    case, result = a_registered_case
    assert check_held_out(case.problem, replace(result, covariance=None), METHOD) is None
