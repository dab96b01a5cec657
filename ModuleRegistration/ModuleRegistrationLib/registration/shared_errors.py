"""Refinement with many points: the errors that points of one sweep, or of one spot of the skull, have in common.

Two thousand samples are not two thousand independent measurements. A sweep shares its coupling, its tilt and the
drift of the tracker; neighbouring points share the segmentation's error. Both are random effects beside the pose,
and how large they are is learnt from the residuals (expectation maximisation, Dempster 1977; restricted likelihood).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, rigid_from_vector

from ModuleRegistrationLib.registration.likelihood import (
    OUTLIER_PRIOR,
    PARAMETERS,
    SCALE_FREEDOM,
    Evaluation,
    Model,
    State,
    evaluate,
    normal_equations,
)

Index = npt.NDArray[np.int64]

PATCH_MM = 12.0  # points closer than this see the same slices of the CT
LEAST_MEMBERS = 3.0  # on average; with fewer a shared error cannot be told from the points' own
JUMP_MM, JUMP_RATIO = 10.0, 6.0  # a step between consecutive samples that ends a sweep
EFFECT_SD_MM, EFFECT_FREEDOM = 0.15, 2.0  # broad prior of a shared error
ENOUGH_MM = 1e-3


@dataclass(frozen=True, eq=False)
class Refined:
    """The end of the refinement."""

    state: State  # one pose
    covariance: Array  # (8, 8) of rotation, translation, offset and speed
    residuals_mm: Array  # (N,), shared errors left in
    inlier: Array  # (N,)
    effect_sds_mm: tuple[float, ...]  # of sweeps and patches
    steps: int
    converged: bool


def find_sweeps(positions_mm: Array, groups: Index) -> Index:
    """(N,) number of each point's sweep: as recorded, or, where nothing was recorded, by the jumps between samples."""
    names, sweeps = np.unique(groups, return_inverse=True)
    if len(names) < len(positions_mm) and len(names) > 1:
        return np.asarray(sweeps, dtype=np.int64)
    steps = np.linalg.norm(np.diff(positions_mm, axis=0), axis=1)
    jumps = steps > max(JUMP_MM, JUMP_RATIO * float(np.median(steps)))
    return np.concatenate([[0], np.cumsum(jumps)]).astype(np.int64)


def find_patches(points_mm: Array) -> Index:
    """(N,) number of the cube of PATCH_MM that each point lies in."""
    cells = np.floor(points_mm / PATCH_MM).astype(np.int64)
    return np.asarray(np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1), dtype=np.int64)


def refine(model: Model, state: State, groups: Index, most_steps: int = 25) -> Refined:
    """Maximum of the posterior near the first pose of `state`, with shared errors estimated beside it."""
    sets = [members for members in (find_sweeps(model.points, groups), find_patches(model.points)) if _worth_it(members)]
    sizes = [int(members.max()) + 1 for members in sets]
    owners = [slice(start, start + size) for start, size in zip(np.cumsum([PARAMETERS, *sizes]), sizes)]
    membership = np.zeros((len(model.points), sum(sizes)))
    for members, owner in zip(sets, owners):
        membership[np.arange(len(members)), members + owner.start - PARAMETERS] = -1.0
    variances = [EFFECT_SD_MM**2] * len(sets)
    effects = np.zeros(sum(sizes))
    state, steps, converged = state.take(np.array([0])), 0, False
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    found = evaluate(model, state)
    while steps < most_steps and not converged:
        steps += 1
        hessian, gradient = _extended(model, state, found, membership, effects, variances, owners)
        covariance = np.linalg.inv(hessian)
        step = -covariance @ gradient
        effects = effects + step[PARAMETERS:]
        for k, owner in enumerate(owners):
            spread = np.diagonal(covariance)[owner]
            own = effects[owner.start - PARAMETERS : owner.stop - PARAMETERS]
            variances[k] = float((own**2 + spread).sum() + EFFECT_FREEDOM * EFFECT_SD_MM**2) / (len(own) + EFFECT_FREEDOM)
        scale, outliers = _scales(model, found, membership, covariance)
        motion = rigid_from_vector(step[:3], step[3:6], model.pivot) @ state.motion
        state = State(motion, state.offset + step[6], state.speed + step[7], scale, outliers)
        model = replace(model, bias=-membership @ effects)
        found = evaluate(model, state)
        shift = np.cross(step[:3], model.points - model.pivot) + step[3:6]
        converged = bool(np.sqrt((shift**2).sum(axis=1).mean()) < ENOUGH_MM)
    return Refined(
        state=state,
        covariance=covariance[:PARAMETERS, :PARAMETERS],
        residuals_mm=found.residuals[0] + model.bias,
        inlier=found.inlier[0],
        effect_sds_mm=tuple(float(np.sqrt(value)) for value in variances),
        steps=steps,
        converged=converged,
    )


def _worth_it(members: Index) -> bool:
    return int(members.max()) > 0 and len(members) / (int(members.max()) + 1) >= LEAST_MEMBERS


def _extended(
    model: Model,
    state: State,
    found: Evaluation,
    membership: Array,
    effects: Array,
    variances: list[float],
    owners: list[slice],
) -> tuple[Array, Array]:
    """Hessian and gradient of the pose's eight parameters followed by the shared errors."""
    small, pull = normal_equations(model, state, found)
    weights, design, residuals = found.weights[0], found.design[0], found.residuals[0]
    weighted = membership * weights[:, None]
    size = PARAMETERS + membership.shape[1]
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    hessian[:PARAMETERS, :PARAMETERS], gradient[:PARAMETERS] = small[0], pull[0]
    hessian[PARAMETERS:, :PARAMETERS] = weighted.T @ design
    hessian[:PARAMETERS, PARAMETERS:] = hessian[PARAMETERS:, :PARAMETERS].T
    hessian[PARAMETERS:, PARAMETERS:] = weighted.T @ membership
    gradient[PARAMETERS:] = weighted.T @ residuals
    for variance, owner in zip(variances, owners):
        index = np.arange(owner.start, owner.stop)
        hessian[index, index] += 1 / variance
        gradient[index] += effects[index - PARAMETERS] / variance
    return hessian, gradient


def _scales(model: Model, found: Evaluation, membership: Array, covariance: Array) -> tuple[Array, Array]:
    """Factor on the points' variances and share of outliers, after what the fit and the shared errors take out."""
    design = np.concatenate([found.design[0], membership], axis=1)
    inlier, weights = found.inlier[0], found.weights[0]
    taken = np.clip(((design @ covariance) * design).sum(axis=1) * weights, 0, 0.95)
    squares = (inlier * found.residuals[0] ** 2 / found.variances[0]).sum()
    scale = (squares + SCALE_FREEDOM) / ((inlier * (1 - taken)).sum() + SCALE_FREEDOM)
    bad, points = OUTLIER_PRIOR
    return np.array([scale]), np.array([((1 - inlier).sum() + bad) / (len(inlier) + points)])
