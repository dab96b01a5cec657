"""Refinement with many points, and what points of one sweep or one spot of the skull have in common.

Two thousand samples are not two thousand independent measurements. A sweep shares its coupling, its tilt and the
drift of the tracker; neighbouring points share the segmentation's error. The pose is fitted as if they were
independent, which costs little; its covariance is not: the variances of the shared errors are estimated from the
residuals by their moments and carried through the fit (a sandwich with modelled clusters).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array
from scipy.optimize import nnls

from ModuleRegistrationLib.registration.likelihood import Evaluation, Model, State, advance, evaluate, normal_equations

Index = npt.NDArray[np.int64]

# Sides of the cubes whose points share a segmentation error: the same slices; the same thickness and slant of the bone
PATCHES_MM = (12.0, 40.0)
INLIER = 0.5  # probability
MOST_FLAT = 0.9
LEAST_MEMBERS = 3.0  # on average; with fewer a shared error cannot be told from the points' own
JUMP_MM, JUMP_RATIO = 10.0, 6.0  # a step between consecutive samples that ends a sweep
EFFECT_SD_MM, EFFECT_FREEDOM = 0.12, 4.0  # what a shared error usually is, and how many groups that belief is worth
MOST_STEPS, STEP_MM, ENOUGH_MM = 25, 2.0, 1e-3


@dataclass(frozen=True, eq=False)
class Refined:
    """The end of the refinement."""

    state: State  # one pose
    covariance: Array  # (8, 8) of rotation, translation, offset and speed
    shared_sds_mm: tuple[float, ...]  # of sweeps and patches, where there were enough points to tell
    steps: int
    converged: bool


def find_sweeps(positions_mm: Array, groups: Index) -> Index:
    """(N,) number of each point's sweep: as recorded, or, where nothing was recorded, by the jumps between samples."""
    names, sweeps = np.unique(groups, return_inverse=True)
    if 1 < len(names) < len(positions_mm):
        return np.asarray(sweeps, dtype=np.int64)
    steps = np.linalg.norm(np.diff(positions_mm, axis=0), axis=1)
    jumps = steps > max(JUMP_MM, JUMP_RATIO * float(np.median(steps)))
    return np.concatenate([[0], np.cumsum(jumps)]).astype(np.int64)


def find_patches(points_mm: Array, side_mm: float) -> Index:
    """(N,) number of the cube of `side_mm` that each point lies in."""
    cells = np.floor(points_mm / side_mm).astype(np.int64)
    return np.asarray(np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1), dtype=np.int64)


def refine(model: Model, state: State, groups: Index) -> Refined:
    """Maximum of the posterior near the first pose of `state`, and its covariance with shared errors in it."""
    state, steps, moved = state.take(np.array([0])), 0, np.inf
    while steps < MOST_STEPS and moved > ENOUGH_MM:
        state, lengths = advance(model, state, evaluate(model, state), STEP_MM)
        steps, moved = steps + 1, float(lengths[0])
    found = evaluate(model, state)
    hessian, _ = normal_equations(model, state, found)
    sets = [find_sweeps(model.points, groups), *(find_patches(model.points, side) for side in PATCHES_MM)]
    sets = [members for members in sets if _worth_it(members)]
    covariance, sds = shared_covariance(found, hessian[0], float(state.scale[0]), sets)
    return Refined(state, covariance, sds, steps, moved <= ENOUGH_MM)


def _worth_it(members: Index) -> bool:
    return int(members.max()) > 0 and len(members) / (int(members.max()) + 1) >= LEAST_MEMBERS


def shared_covariance(found: Evaluation, hessian: Array, scale: float, sets: list[Index]) -> tuple[Array, tuple[float, ...]]:
    """(8, 8) covariance of the fit when points of a group share an error, and the SD of each set's shared error.

    The fit takes `gain @ error` out of the errors, so the residuals are `(1 - design @ gain) error`. The mean square of
    their group means is linear in the variances of the shared errors, which gives one equation a set.
    """
    design, weights, residuals = found.design[0], found.weights[0], found.residuals[0]
    own = scale * found.variances[0]
    # an outlier law flattens the likelihood near its border: the curvature is less than the weights say
    flat = weights * (1 - found.inlier[0]) * residuals**2 / own
    inverse = np.linalg.inv(hessian - (design * np.minimum(flat, MOST_FLAT * weights)[:, None]).T @ design)
    gain = inverse @ (design * weights[:, None]).T  # (8, N)
    members = [np.eye(int(group.max()) + 1)[group] for group in sets]  # (N, G)
    trust = (found.inlier[0] > INLIER).astype(float)
    members = [m[:, trust @ m >= LEAST_MEMBERS] for m in members]  # a patch of outliers alone tells nothing
    averages = [(m * trust[:, None]).T / (trust @ m)[:, None] for m in members]  # (G, N)
    left = [m - design @ (gain @ m) for m in members]
    table, right = np.zeros((len(sets), len(sets))), np.zeros(len(sets))
    for i, average in enumerate(averages):
        passed = average - (average @ design) @ gain
        right[i] = ((average @ residuals) ** 2).sum() - ((passed**2) @ own).sum()
        table[i] = [((average @ other) ** 2).sum() for other in left]
    estimated = nnls(table, np.maximum(right, 0))[0] if sets else np.zeros(0)
    covariance = inverse @ (hessian - (design * weights[:, None]).T @ design) @ inverse  # what the priors leave
    covariance = covariance + (gain * own) @ gain.T
    sds = []
    for variance, m in zip(estimated, members):
        count = m.shape[1]
        # estimated from few groups, it may be larger: divided as the mean of an inverse chi-square is
        shared = (count * variance + EFFECT_FREEDOM * EFFECT_SD_MM**2) / (count + EFFECT_FREEDOM - 3)
        reach = gain @ m
        covariance = covariance + shared * reach @ reach.T
        sds.append(float(np.sqrt(shared)))
    return covariance, tuple(sds)
