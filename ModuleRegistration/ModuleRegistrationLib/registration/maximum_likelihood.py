"""From a problem to a result: search, then the posterior for a few points or shared errors for many."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

from ModuleRegistrationLib.registration.global_search import distinct, search, stages, starts_for
from ModuleRegistrationLib.registration.likelihood import Model, State, advance, evaluate, normal_equations, prepare
from ModuleRegistrationLib.registration.posterior import sample_posterior
from ModuleRegistrationLib.registration.problem import Minimum, RegistrationProblem, RegistrationResult
from ModuleRegistrationLib.registration.shared_errors import refine

DENSE = 60  # points; beyond, the posterior is Gaussian and what points share decides the accuracy
SEARCH_POINTS = 40
PLAUSIBLE_SCORE = 6.0  # a minimum e^6 less likely than the best is not looked at again
MOST_MINIMA = 8
POLISH_STEPS, POLISH_STEP_MM, POLISHED_MM = 12, 2.0, 1e-2
INLIER = 0.5
LEAST_EFFECTIVE, MOST_ROUNDS, MORE = 60, 2, 4  # posterior samples that have to count; else a search from them and more of them


@dataclass(frozen=True, eq=False)
class Solution:
    """The pose and everything estimated beside it, as a motion after the initial registration."""

    motion: Array  # (4, 4)
    covariance: Array  # (6, 6) about the model's pivot
    offset_mm: float
    speed: float  # relative error of the assumed speed of sound
    speed_sd: float
    motions: Array  # (K, 4, 4) the plausible minima, best first
    probabilities: Array  # (K,)
    scale: float
    outliers: float
    steps: int
    stop_reason: str
    degrees_of_freedom: Optional[float] = None


def solve(problem: RegistrationProblem, starts: int, samples: int) -> RegistrationResult:
    """Register by maximum likelihood; the random draws follow from the problem's seed."""
    model, rng = prepare(problem), np.random.default_rng(problem.seed)
    dense = len(model.points) > DENSE
    coarse = model.subset(spread_points(model.points, SEARCH_POINTS)) if dense else model
    minima, scores, steps = search(coarse, rng, stages(starts_for(model, starts)))
    minima = minima.take(np.flatnonzero(scores - scores[0] < PLAUSIBLE_SCORE)[:MOST_MINIMA])
    minima, scores, covariances, more = polish(coarse, minima)
    if dense:
        solution = _solve_dense(model, minima, scores, problem, steps + more)
    else:
        draws = np.random.default_rng((problem.seed, samples))  # not what the search left over: alike problems, alike draws
        solution = _solve_sparse(model, minima, scores, covariances, samples, draws, steps + more)
    return _result(problem, model, solution)


def spread_points(points: Array, count: int) -> npt.NDArray[np.int64]:
    """Indices of `count` points spread evenly over the cloud: each next one the farthest from those before."""
    chosen = [0]
    distances = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:  # over the points chosen, not over all: 60 passes of one vectorised line
        chosen.append(int(np.argmax(distances)))
        distances = np.minimum(distances, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def polish(model: Model, minima: State) -> tuple[State, Array, Array, int]:
    """The minima followed to their ends, best first, with scores, covariances (K, 8, 8) and the number of steps."""
    steps, moved = 0, np.inf
    while steps < POLISH_STEPS and moved > POLISHED_MM:
        minima, lengths = advance(model, minima, evaluate(model, minima), POLISH_STEP_MM)
        steps, moved = steps + 1, float(lengths.max())
    found = evaluate(model, minima)
    hessian, _ = normal_equations(model, minima, found)
    scores = found.cost + np.linalg.slogdet(hessian)[1] / 2
    order = distinct(model, minima, np.argsort(scores))
    covariances = np.asarray(np.linalg.inv(hessian[order]), dtype=np.float64)
    return minima.take(order), scores[order], covariances, steps


def _solve_sparse(
    model: Model, minima: State, scores: Array, covariances: Array, samples: int, rng: np.random.Generator, steps: int
) -> Solution:
    posterior = sample_posterior(model, minima, covariances, scores, samples, rng)
    for _ in range(MOST_ROUNDS):
        if posterior.effective_samples >= LEAST_EFFECTIVE:
            break
        # a few samples have all the weight: they lie where a minimum is that the search has missed, or beside a crooked one
        minima, scores, covariances, more = polish(model, minima.and_of(posterior.likeliest))
        kept = np.flatnonzero(scores - scores[0] < PLAUSIBLE_SCORE)[:MOST_MINIMA]
        minima, scores, covariances, steps = minima.take(kept), scores[kept], covariances[kept], steps + more
        posterior = sample_posterior(model, minima, covariances, scores, MORE * samples, rng)
    order = np.argsort(-posterior.probabilities)
    return Solution(
        motion=posterior.motion,
        covariance=posterior.covariance,
        offset_mm=posterior.offset_mm,
        speed=posterior.speed,
        speed_sd=posterior.speed_sd,
        motions=minima.motion[order],
        probabilities=posterior.probabilities[order],
        scale=float(minima.scale[order[0]]),
        outliers=float(minima.outliers[order[0]]),
        steps=steps,
        stop_reason=f"median of {samples} posterior samples around {len(order)} minima",
    )


def _solve_dense(model: Model, minima: State, scores: Array, problem: RegistrationProblem, steps: int) -> Solution:
    refined = refine(model, minima, problem.points.groups)
    probabilities = np.exp(scores.min() - scores)
    return Solution(
        motion=refined.state.motion[0],
        covariance=refined.covariance[:6, :6],
        offset_mm=float(refined.state.offset[0]),
        speed=float(refined.state.speed[0]),
        speed_sd=float(np.sqrt(refined.covariance[7, 7])),
        motions=np.concatenate([refined.state.motion, minima.motion[1:]]),
        probabilities=probabilities / probabilities.sum(),
        scale=float(refined.state.scale[0]),
        outliers=float(refined.state.outliers[0]),
        steps=steps + refined.steps,
        stop_reason="points moved less than 0.005 mm" if refined.converged else "step limit of the refinement",
        degrees_of_freedom=refined.degrees_of_freedom,
    )


def _result(problem: RegistrationProblem, model: Model, solution: Solution) -> RegistrationResult:
    initial = problem.initial_reference_to_ras
    state = State(
        solution.motion[None],
        np.array([solution.offset_mm]),
        np.array([solution.speed]),
        np.array([solution.scale]),
        np.array([solution.outliers]),
    )
    found = evaluate(model, state)
    used = found.inlier[0] > INLIER
    residuals = found.residuals[0]
    beams = model.beams @ solution.motion[:3, :3].T
    moved = model.points @ solution.motion[:3, :3].T + solution.motion[:3, 3]
    moved += beams * (model.depths * solution.speed + found.echoes[0])[:, None]
    normals = found.design[0, :, 3:6]
    speed = problem.points.speed_of_sound_m_s
    return RegistrationResult(
        method="cranionav",
        reference_to_ras=solution.motion @ initial,
        surface_rms_mm=float(np.sqrt(np.mean(residuals[used] ** 2))) if used.any() else float("nan"),
        residuals_mm=residuals,
        used=used,
        iterations=solution.steps,
        stop_reason=solution.stop_reason,
        points_ras_mm=moved - normals * solution.offset_mm,
        covariance=solution.covariance,
        pivot_ras_mm=model.pivot,
        speed_of_sound_m_s=speed * (1 + solution.speed),
        speed_of_sound_sd_m_s=speed * solution.speed_sd if model.speed_sd > 0 else problem.points.speed_of_sound_sd_m_s,
        surface_offset_mm=solution.offset_mm,
        degrees_of_freedom=solution.degrees_of_freedom,
        minima=tuple(Minimum(m @ initial, float(p)) for m, p in zip(solution.motions, solution.probabilities)),
    )
