"""Median and covariance of the pose over its posterior, by importance sampling around the minima of the search.

With 18 points on a rough surface the likelihood is no paraboloid: its curvature at the best minimum promises too
much, and neighbouring minima share the probability. Samples weighted by the posterior see both, and give each
minimum its probability.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.rigid import Array, invert_rigid, rigid_from_vector

from ModuleRegistrationLib.registration.error_theory import length_statistics
from ModuleRegistrationLib.registration.landmarks import motion_jacobian
from ModuleRegistrationLib.registration.likelihood import OUTLIER_PRIOR, PARAMETERS, Model, State, evaluate

PROPOSAL_FREEDOM = 5.0  # tails of the proposal: heavier than the posterior's
PROPOSAL_STRETCH = 1.3  # its width beside the curvature's
LOG_SCALE_SD = 0.35  # of the proposal for the common factor on the variances
WEISZFELD_STEPS, CORE_MM = 12, 0.3
CAUTION = 0.9  # power of the posterior: real errors follow no model to the letter (Miller and Dunson, JASA 114, 2019)
TOLD_SHARE, TOLD_AT = 0.95, 3  # share of the samples that the covariance's 95% limit holds, at every so many-th point
LEAST_SHARE = 0.08  # of the samples that each minimum gets
FOLLOWED = 20  # of the likeliest samples, where they are to be followed to a minimum that the search has not found


@dataclass(frozen=True, eq=False)
class Posterior:
    """Moments over the weighted samples, as a motion after the initial registration."""

    motion: Array  # (4, 4) geometric median
    covariance: Array  # (6, 6) about the model's pivot, second moment about `motion`, widened where its 95% limit holds less
    offset_mm: float
    speed: float
    speed_sd: float
    probabilities: Array  # (K,) of the minima
    effective_samples: float
    likeliest: State  # of the samples, the best first


def motion_vector(motion: Array, pivot: Array) -> Array:
    """(..., 6) rotation vector about the pivot and translation of motions (..., 4, 4); inverse of rigid_from_vector."""
    turn = (
        scipy.spatial.transform.Rotation.from_matrix(motion[..., :3, :3].reshape(-1, 3, 3))
        .as_rotvec()
        .reshape(*motion.shape[:-2], 3)
    )
    shift = motion[..., :3, 3] + motion[..., :3, :3] @ pivot - pivot
    return np.concatenate([turn, shift], axis=-1)


def sample_posterior(
    model: Model, minima: State, covariances: Array, scores: Array, count: int, rng: np.random.Generator
) -> Posterior:
    """Weigh `count` samples drawn around `minima`, the best first.

    Parameters
    ----------
    minima : State of K poses
    covariances : ndarray, shape (K, 8, 8)
        Inverse Hessians there.
    scores : ndarray, shape (K,)
        Negative log evidence of each, which divides the samples between them.
    """
    size = covariances.shape[-1] if model.speed_sd > 0 else covariances.shape[-1] - 1  # a known speed is not drawn
    share = np.maximum(np.exp(scores.min() - scores), LEAST_SHARE)
    share = share / share.sum()
    # in pairs to both sides of a minimum: their mean is that of the minimum itself but for what is not symmetric
    pairs = (count + 1) // 2
    origin = np.repeat(np.searchsorted(np.cumsum(share)[:-1], (np.arange(pairs) + 0.5) / pairs), 2)
    count = len(origin)
    roots = np.asarray(np.linalg.cholesky(covariances[:, :size, :size] * PROPOSAL_STRETCH**2), dtype=np.float64)
    sides = np.tile([1.0, -1.0], pairs) * np.repeat(np.sqrt(PROPOSAL_FREEDOM / rng.chisquare(PROPOSAL_FREEDOM, pairs)), 2)
    draws = (roots[origin] @ np.repeat(rng.standard_normal((pairs, size, 1)), 2, axis=0))[..., 0] * sides[:, None]
    state = State(
        rigid_from_vector(draws[:, :3], draws[:, 3:6], model.pivot) @ minima.motion[origin],
        minima.offset[origin] + draws[:, 6],
        minima.speed[origin] + (draws[:, 7] if size == PARAMETERS else 0.0),
        minima.scale[origin] * np.exp(np.repeat(rng.normal(0, LOG_SCALE_SD, pairs), 2)),
        np.clip(rng.beta(*(exponents[origin] for exponents in _outlier_law(model, minima))), 1e-6, 1 - 1e-6),
    )
    proposal = np.stack([_log_density(model, minima, roots, k, state) + np.log(share[k]) for k in range(len(share))])
    cost = evaluate(model, state).cost
    log_weight = -CAUTION * cost - scipy.special.logsumexp(proposal, axis=0)
    weight = np.exp(log_weight - log_weight.max())
    weight = np.minimum(weight, weight.mean() * np.sqrt(count))  # truncated: one lucky sample decides nothing
    weight = weight / weight.sum()
    return _moments(model, minima, state, weight, np.argmax(proposal, axis=0), np.argsort(cost))


def _outlier_law(model: Model, minima: State) -> tuple[Array, Array]:
    """Exponents (K,) of the Beta law of the share of outliers: how many there seem to be at each minimum, and the prior."""
    weight = len(model.points) + OUTLIER_PRIOR[1]
    return 1 + weight * minima.outliers, 1 + weight * (1 - minima.outliers)


def _log_density(model: Model, minima: State, roots: Array, k: int, state: State) -> Array:
    """Log density of the proposal around minimum k at the samples (S,), up to a common constant."""
    vector = motion_vector(state.motion @ invert_rigid(minima.motion[k]), model.pivot)
    apart = np.column_stack([vector, state.offset - minima.offset[k], state.speed - minima.speed[k]])
    size = roots.shape[-1]
    white = np.linalg.solve(roots[k], apart[:, :size].T)
    narrow = np.log(np.diagonal(roots[k])).sum()
    scale = np.log(state.scale / minima.scale[k]) / LOG_SCALE_SD
    bad, good = (exponents[k] for exponents in _outlier_law(model, minima))
    share = (bad - 1) * np.log(state.outliers) + (good - 1) * np.log1p(-state.outliers) - scipy.special.betaln(bad, good)
    distance = (PROPOSAL_FREEDOM + size) / 2 * np.log1p((white**2).sum(axis=0) / PROPOSAL_FREEDOM)
    density: Array = share - distance - narrow - scale**2 / 2
    return density


def _moments(
    model: Model, minima: State, state: State, weight: Array, nearest: Array, likeliest: npt.NDArray[np.int64]
) -> Posterior:
    probabilities = np.bincount(nearest, weight, len(minima.motion))
    origin = minima.motion[int(np.argmax(probabilities))]
    vectors = motion_vector(state.motion @ invert_rigid(origin), model.pivot)
    middle = geometric_median(vectors, weight, model.points - model.pivot)
    motion = rigid_from_vector(middle[:3], middle[3:], model.pivot) @ origin
    left = motion_vector(state.motion @ invert_rigid(motion), model.pivot)
    speed = float(weight @ state.speed)
    return Posterior(
        motion=motion,
        covariance=covariance_holding(left, weight, (model.points - model.pivot)[::TOLD_AT]),
        offset_mm=float(weight @ state.offset),
        speed=speed,
        speed_sd=float(np.sqrt(weight @ (state.speed - speed) ** 2)),
        probabilities=np.asarray(probabilities, dtype=np.float64),
        effective_samples=float(1 / np.sum(weight**2)),
        likeliest=state.take(likeliest[:FOLLOWED]),
    )


def covariance_holding(vectors: Array, weight: Array, arms: Array) -> Array:
    """(6, 6) second moment of weighted motions (S, 6), widened until its 95% limit at `arms` (P, 3) holds 95% of them.

    A second, less likely minimum lies beyond the limit that a Gaussian of the same second moment has.
    """
    covariance = (weight[:, None] * vectors).T @ vectors
    design = motion_jacobian(arms, np.zeros(3))
    lengths = np.linalg.norm(np.einsum("pij,sj->psi", design, vectors), axis=2)
    order = np.argsort(lengths, axis=1)
    reached = np.cumsum(weight[order], axis=1) >= TOLD_SHARE
    limit = np.take_along_axis(lengths, order, axis=1)[np.arange(len(arms)), np.argmax(reached, axis=1)]
    told = length_statistics(design @ covariance @ np.swapaxes(design, -1, -2)).p95_mm
    return np.asarray(covariance * max(float(limit.mean() / told.mean()), 1.0) ** 2, dtype=np.float64)


def geometric_median(vectors: Array, weight: Array, arms: Array) -> Array:
    """(6,) the small motion whose mean distance from weighted motions (S, 6) is least.

    A distance is the RMS shift of points at `arms` (N, 3). The
    expected error is least there, also where the posterior has several peaks (Weiszfeld's iteration).
    """
    design = motion_jacobian(arms, np.zeros(3)).reshape(-1, 6)
    metric = design.T @ design / len(arms)
    middle = weight @ vectors
    for _ in range(WEISZFELD_STEPS):
        apart = vectors - middle
        pull = weight / np.sqrt(np.einsum("si,ij,sj->s", apart, metric, apart) + CORE_MM**2)
        middle = pull @ vectors / pull.sum()
    return np.asarray(middle, dtype=np.float64)
