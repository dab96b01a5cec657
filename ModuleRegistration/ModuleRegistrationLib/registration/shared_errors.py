"""Refinement with many points, whose errors are not independent: what a sweep or a spot of the skull has in common.

A sweep shares its coupling, its tilt and the drift of the tracker; neighbouring points share the segmentation's error.
Each sweep and each spot gets an error of its own, a Gaussian whose variance is estimated from the data (a mixed
model, its variances by the fixed point of MacKay, Neural Computation 4:415, 1992). Pose and shared errors are solved
for together, so that the shape of the skull within a sweep counts and its bias does not; the pose's covariance has the
shared errors in it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, rigid_from_vector

from ModuleRegistrationLib.registration.likelihood import (
    LEAST_SCALE,
    PARAMETERS,
    SCALE_FREEDOM,
    Evaluation,
    Model,
    State,
    advance,
    evaluate,
    normal_equations,
    update_scales,
)

Index = npt.NDArray[np.int64]

# Sides of the cubes whose points share a segmentation error: the same slices; the same thickness and slant of the bone
PATCHES_MM = (12.0, 40.0)
MOST_FLAT = 0.9
JUMP_MM, JUMP_RATIO, SMOOTHED = 12.0, 4.0, 5  # a step between the medians of so many samples that ends a sweep
EFFECT_SD_MM, EFFECT_FREEDOM = 0.17, 3.0  # what a shared error usually is, and how many groups that belief is worth
THINNED = 250  # points to converge with, before all of them
MOST_STEPS, STEP_MM, ENOUGH_MM = 25, 2.0, 5e-3
MIXED_STEPS, PATCH_STEPS, VARIANCE_STEPS = 15, 3, 6


@dataclass(frozen=True, eq=False)
class Refined:
    """The end of the refinement."""

    state: State  # one pose
    covariance: Array  # (8, 8) of rotation, translation, offset and speed
    shared_sds_mm: tuple[float, ...]  # of sweeps and of patches
    steps: int
    converged: bool
    degrees_of_freedom: float  # behind the variance that sweeps share


@dataclass(frozen=True, eq=False)
class Mixed:
    """Pose and shared errors solved for together, at a fixed linearisation."""

    step: Array  # (8,)
    effects: Array  # (E,) mm, the shared errors, set after set
    shared: Array  # (S,) mm^2, variance of each set's errors
    scale: float = 1.0  # factor on the points' own variances
    covariance: Array = field(default_factory=lambda: np.zeros((PARAMETERS, PARAMETERS)))
    gain: Array = field(default_factory=lambda: np.empty((PARAMETERS, 0)))  # (8, N) what a point's error does to the pose


def find_sweeps(positions_mm: Array, groups: Index) -> Index:
    """(N,) number of each point's sweep: as recorded, or, where nothing was recorded, by the jumps between samples."""
    names, sweeps = np.unique(groups, return_inverse=True)
    if 1 < len(names) < len(positions_mm):
        return np.asarray(sweeps, dtype=np.int64)
    count, width = len(positions_mm), SMOOTHED
    padded = np.pad(positions_mm, ((width - 1, width), (0, 0)), mode="edge")
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(padded, width, axis=0), axis=-1)  # outliers are no jumps
    jumps = np.linalg.norm(smooth[width : width + count - 1] - smooth[: count - 1], axis=1)
    steps: Array = np.linalg.norm(np.diff(positions_mm, axis=0), axis=1)
    steps[jumps <= max(JUMP_MM, JUMP_RATIO * float(np.median(jumps)))] = 0
    around: Array = np.lib.stride_tricks.sliding_window_view(np.pad(steps, width), 2 * width + 1).max(axis=1)
    return np.concatenate([[0], np.cumsum((steps > 0) & (steps == around))]).astype(np.int64)


def find_patches(points_mm: Array, side_mm: float) -> Index:
    """(N,) number of the cube of `side_mm` that each point lies in."""
    cells = np.floor(points_mm / side_mm).astype(np.int64)
    return np.asarray(np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1), dtype=np.int64)


def refine(model: Model, state: State, groups: Index) -> Refined:
    """Maximum of the posterior near the first pose of `state`, shared errors included, and its covariance."""
    state, steps, moved = state.take(np.array([0])), 0, float("inf")
    thin = model.subset(np.unique(np.linspace(0, len(model.points) - 1, THINNED).astype(np.int64)))
    while steps < MOST_STEPS and moved > ENOUGH_MM:
        state, lengths = advance(thin, state, evaluate(thin, state), STEP_MM)
        steps, moved = steps + 1, float(lengths[0])
    sets = [find_sweeps(model.points, groups)]
    mixed = Mixed(np.zeros(PARAMETERS), np.zeros(int(sets[0].max()) + 1), np.full(1, EFFECT_SD_MM**2))
    for _ in range(MIXED_STEPS):
        found = evaluate(replace(model, shared=known_errors(sets, mixed)), state)
        mixed = solve_mixed(model, state, found, sets, mixed)
        step, arm = mixed.step, model.points - model.pivot
        moved = float(np.sqrt(((np.cross(step[:3], arm) + step[3:6]) ** 2).sum(axis=1).mean()))
        state = State(
            rigid_from_vector(step[:3], step[3:6], model.pivot)[None] @ state.motion,
            state.offset + step[6],
            state.speed + step[7],
            np.array([mixed.scale]),
            update_scales(model, found, normal_equations(model, state, found)[0])[1],
        )
        steps += 1
        if moved < ENOUGH_MM:
            break
    covariance, sds = _with_patches(model, state, mixed, sets)
    return Refined(state, covariance, sds, steps, moved < ENOUGH_MM, EFFECT_FREEDOM + int(sets[0].max()) + 1)


def known_errors(sets: list[Index], mixed: Mixed) -> Array:
    """(N,) the shared errors of each point, as solved for."""
    starts = np.cumsum([0, *(int(members.max()) + 1 for members in sets)])
    return np.asarray(sum(mixed.effects[start + members] for start, members in zip(starts, sets)), dtype=np.float64)


def _with_patches(model: Model, state: State, mixed: Mixed, sweeps: list[Index]) -> tuple[Array, tuple[float, ...]]:
    """Covariance with the errors that points close to each other share, which the fit takes for independent.

    Weighing the points by these errors, too, would give up more than it wins: their scale and shape are only guessed.
    """
    patches = [find_patches(model.points, side) for side in PATCHES_MM]
    sets = sweeps + patches
    numbers = [int(members.max()) + 1 for members in patches]
    every = Mixed(
        np.zeros(PARAMETERS),
        np.concatenate([mixed.effects, np.zeros(sum(numbers))]),
        np.concatenate([mixed.shared, np.full(len(patches), EFFECT_SD_MM**2)]),
    )
    for _ in range(PATCH_STEPS):
        every = solve_mixed(model, state, evaluate(replace(model, shared=known_errors(sets, every)), state), sets, every)
    covariance = mixed.covariance
    for members, variance in zip(patches, every.shared[1:]):
        reach = np.stack([np.bincount(members, row) for row in mixed.gain])
        covariance = covariance + variance * reach @ reach.T
    return covariance, tuple(float(sd) for sd in np.sqrt(every.shared))


def solve_mixed(model: Model, state: State, found: Evaluation, sets: list[Index], before: Mixed) -> Mixed:
    """One Gauss-Newton step of pose, offset and speed beside the shared errors, and the variances that the data ask for.

    `found` is the evaluation with the shared errors of `before` taken out: an outlier is what stands out of its sweep.
    """
    hessian, gradient = normal_equations(model, state, found)
    # an outlier law flattens the likelihood near its border: the curvature is less than the weights say
    weights, residuals, inlier = found.weights[0], found.residuals[0], found.inlier[0]
    curvature = weights * (1 - np.minimum((1 - inlier) * weights * residuals**2, MOST_FLAT))
    sizes = [int(members.max()) + 1 for members in sets]
    member = np.concatenate([[-1] * PARAMETERS, np.repeat(np.arange(len(sets)), sizes)])
    design = np.concatenate([found.design[0], *(-np.eye(size)[members] for size, members in zip(sizes, sets))], axis=1)
    priors = hessian[0] - found.design[0].T @ (found.design[0] * weights[:, None])
    pull = gradient[0] - found.design[0].T @ (weights * residuals)
    information = design.T @ (design * curvature[:, None])
    slope = design.T @ (weights * residuals)
    start, shared = float(state.scale[0]), before.shared
    scale = start
    for _ in range(VARIANCE_STEPS):
        full = information * (start / scale)
        full[:PARAMETERS, :PARAMETERS] += priors
        precision = 1 / np.repeat(shared, sizes)
        full[range(PARAMETERS, len(full)), range(PARAMETERS, len(full))] += precision
        right = slope * (start / scale)
        right[:PARAMETERS] += pull
        right[PARAMETERS:] += precision * before.effects
        covariance = np.asarray(np.linalg.inv(full), dtype=np.float64)
        solution = -covariance @ right
        effects = before.effects + solution[PARAMETERS:]
        spread = np.diagonal(covariance)[PARAMETERS:]
        free = float(np.sum(covariance * information) * start / scale)  # parameters that the points have paid for
        left = residuals + design @ solution
        squares = float(np.sum(inlier * left**2 / found.variances[0]))
        scale = max((squares + SCALE_FREEDOM) / (max(float(inlier.sum()) - free, 0.0) + SCALE_FREEDOM), LEAST_SCALE)
        shared = shared.copy()
        for k in range(len(sets)):
            mine = member[PARAMETERS:] == k
            known = sizes[k] - float(spread[mine].sum()) / shared[k]
            shared[k] = (float(np.sum(effects[mine] ** 2)) + EFFECT_FREEDOM * EFFECT_SD_MM**2) / (known + EFFECT_FREEDOM)
    gain = covariance[:PARAMETERS] @ (design * curvature[:, None]).T * (start / scale)
    return Mixed(solution[:PARAMETERS], effects, shared, scale, covariance[:PARAMETERS, :PARAMETERS], gain)
