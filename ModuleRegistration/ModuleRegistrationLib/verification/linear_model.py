"""A registration near its solution: how pose, common offset and speed of sound answer to each point's error.

The equations are those of `likelihood`, taken where any method has ended, so that points can be left out of a
registration, or judged after it, without registering again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, invert_rigid

from ModuleRegistrationLib.registration.likelihood import (
    OUTLIER_PRIOR,
    Evaluation,
    Model,
    State,
    evaluate,
    normal_equations,
    prepare,
    update_scales,
)
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult

SCALE_STEPS = 4  # of the common factor on the variances; it settles to 1% in three


@dataclass(frozen=True, eq=False)
class LinearModel:
    """What points (N) say at a solution. The unknowns are rotation (rad) about the pivot, translation, offset (mm), speed."""

    residuals_mm: Array  # (N,) signed distance to the bone, offset and speed of sound corrected
    variances_mm2: Array  # (N,) of each point's own error along the normal, as stated
    weights: Array  # (N,) 1/mm^2, what each had in the registration
    design: Array  # (N, 8) derivative of the residuals by the unknowns
    fit_covariance: Array  # (8, 8) of the unknowns by these equations alone
    covariance: Array  # (8, 8) the same, with the pose's block that the registration states
    pivot_ras_mm: Array  # (3,)


def linear_model(problem: RegistrationProblem, result: RegistrationResult) -> LinearModel:
    """The model of the points that `problem` was registered with, at `result`."""
    model = prepare(problem)
    state, found = _settled(model, _state_of(problem, result))
    hessian, _ = normal_equations(model, state, found)
    inverse = np.asarray(np.linalg.inv(hessian[0]), dtype=np.float64)
    return LinearModel(
        residuals_mm=found.residuals[0],
        variances_mm2=found.variances[0],
        weights=found.weights[0],
        design=found.design[0],
        fit_covariance=inverse,
        covariance=_as_stated(inverse, result, model.pivot),
        pivot_ras_mm=model.pivot,
    )


def seen_from(problem: RegistrationProblem, result: RegistrationResult, fitted: LinearModel) -> LinearModel:
    """All points of `problem` under a registration that has not used them all: `result`, with its own model `fitted`."""
    model = replace(prepare(problem), pivot=fitted.pivot_ras_mm)
    found = evaluate(model, _state_of(problem, result))
    return replace(
        fitted,
        residuals_mm=found.residuals[0],
        variances_mm2=found.variances[0],
        weights=found.weights[0],
        design=found.design[0],
    )


def expected_covariance(model: LinearModel, which: npt.NDArray[np.int64]) -> Array:
    """(n, n) of the residuals of points that the registration has not used: their own error and the registration's."""
    rows = model.design[which]
    covariance: Array = np.diag(model.variances_mm2[which]) + rows @ model.covariance @ rows.T
    return covariance


def _state_of(problem: RegistrationProblem, result: RegistrationResult) -> State:
    speed, assumed = result.speed_of_sound_m_s, problem.points.speed_of_sound_m_s
    relative = speed / assumed - 1 if np.isfinite(speed) and np.isfinite(assumed) else 0.0
    bad, points = OUTLIER_PRIOR
    return State(
        motion=(result.reference_to_ras @ invert_rigid(problem.initial_reference_to_ras))[None],
        offset=np.array([result.surface_offset_mm]),
        speed=np.array([relative]),
        scale=np.ones(1),
        outliers=np.array([bad / points]),
    )


def _settled(model: Model, state: State) -> tuple[State, Evaluation]:
    """The state with the scale and the share of outliers that the residuals ask for, and the model there."""
    found = evaluate(model, state)
    for _ in range(SCALE_STEPS):
        hessian, _ = normal_equations(model, state, found)
        scale, outliers = update_scales(model, found, hessian)
        state = replace(state, scale=scale, outliers=outliers)
        found = evaluate(model, state)
    return state, found


def _as_stated(covariance: Array, result: RegistrationResult, pivot: Array) -> Array:
    """The covariance with the pose's block replaced by the registration's own; offset and speed follow the pose as before."""
    if result.covariance is None:
        return covariance
    apart = pivot - result.pivot_ras_mm
    shift = np.eye(6)
    shift[3:, :3] = [[0, apart[2], -apart[1]], [-apart[2], 0, apart[0]], [apart[1], -apart[0], 0]]  # rotation x apart
    stated = shift @ result.covariance @ shift.T
    follow = covariance[6:, :6] @ np.linalg.inv(covariance[:6, :6])
    left = covariance[6:, 6:] - follow @ covariance[:6, 6:]
    return np.block([[stated, stated @ follow.T], [follow @ stated, left + follow @ stated @ follow.T]])
