"""The likelihood of a pose given bone points, landmarks and what is common to all points. Batched over poses.

A point's distance from the surface is Gaussian with a variance known up to a common factor, or, with a small
probability, an outlier: another interface some millimetres away, mostly outside the bone or on both sides alike, or a
stray point. Common to all points are an offset along the normal (threshold of the
CT, zero of the depth scale) and the relative error of the speed of sound; both have priors. The landmarks are
Gaussian with an unknown SD whose prior is broad, which makes them Student-t together: poor landmarks lose their
weight by themselves. Each unknown scale is solved for by expectation maximisation beside the pose's Gauss-Newton.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, rigid_from_vector, transform_points
from CranioNavLib.surface import Surface

from ModuleRegistrationLib.registration.closest_field import Feet, find_feet
from ModuleRegistrationLib.registration.landmarks import motion_jacobian
from ModuleRegistrationLib.registration.problem import RegistrationProblem

PARAMETERS = 8  # rotation, translation, offset, speed
INTERFACE_MM, INTERFACE_SD_MM = 5.0, 2.2  # of most outliers: another tissue interface lies 2-8 mm away
OUTSIDE_SHARES = (0.5, 0.9)  # of those outliers; which of the two, the points of a case tell
STRAY_SHARE, STRAY_WIDTH_MM, STRAY_FREEDOM = 0.2, 8.0, 3.0  # of the other outliers, which follow Student's law
OUTLIER_PRIOR = (1.0, 6.0)  # pseudo-counts of outliers and of points
SCALE_FREEDOM = 6.0  # what the stated variances are worth, in points: right to a factor of two or so
LEAST_SCALE = 0.2  # of the variances: nothing measures much better than it says
LANDMARK_SD_MM, LANDMARK_FREEDOM = 2.5, 1.0  # per axis; the prior is so broad that 1 mm and 8 mm are both likely
LEAST_QUALITY = 0.3
START_SD_MM = 10.0  # without landmarks the given start is believed to this, at the extent of a head


@dataclass(frozen=True, eq=False)
class Model:
    """What stays the same while poses are tried. All in RAS after the initial registration."""

    surface: Surface
    points: Array  # (N, 3)
    beams: Array  # (N, 3), zero where a point has no beam
    depths: Array  # (N,)
    covariances: Array  # (N, 3, 3)
    surface_variance: float
    inlier_prior: Array  # (N,)
    offset_sd: float
    speed_sd: float  # relative; 0: no sound, or its speed is known
    landmarks: Array  # (L, 3) as measured
    landmarks_ct: Array  # (L, 3)
    landmark_sd: float
    landmark_freedom: float
    pivot: Array  # (3,)
    alternatives: Array  # (N, K) mm along the beam from the chosen echo; NaN pads
    alternative_log_odds: Array  # (N, K) against the chosen echo
    feet: Callable[[Surface, Array], Feet] = find_feet
    shared: Optional[Array] = None  # (N,) mm, errors along the normal that points share, as far as they are known

    def subset(self, index: npt.NDArray[np.int64]) -> Model:
        """The same model with some of the points."""
        names = ("points", "beams", "depths", "covariances", "inlier_prior", "alternatives", "alternative_log_odds")
        return replace(self, **{name: getattr(self, name)[index] for name in names})


@dataclass(frozen=True, eq=False)
class State:
    """M poses being tried, as motions after the initial registration, with the unknowns of each."""

    motion: Array  # (M, 4, 4)
    offset: Array  # (M,) mm
    speed: Array  # (M,) relative error of the speed of sound
    scale: Array  # (M,) factor on the points' variances
    outliers: Array  # (M,) share

    def take(self, index: npt.NDArray[np.int64]) -> State:
        """Some of the poses."""
        return State(self.motion[index], self.offset[index], self.speed[index], self.scale[index], self.outliers[index])

    def and_of(self, other: State) -> State:
        """These poses and then those of `other`."""
        names = ("motion", "offset", "speed", "scale", "outliers")
        return State(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The model at the poses of a state."""

    cost: Array  # (M,) negative log posterior
    residuals: Array  # (M, N) mm, of the echo that is believed
    echoes: Array  # (M, N) mm along the beam from the chosen echo to the one that is believed
    weights: Array  # (M, N) 1/mm^2
    inlier: Array  # (M, N) probability
    variances: Array  # (M, N) mm^2, before the common factor
    design: Array  # (M, N, 8) derivative of the residuals
    landmark_weight: Array  # (M,) 1/mm^2
    landmark_misses: Array  # (M, L, 3)
    landmark_design: Array  # (M, L, 3, 6)


def prepare(problem: RegistrationProblem) -> Model:
    """The model of a problem."""
    moved = problem.points.transformed(problem.initial_reference_to_ras)
    beams = np.nan_to_num(moved.beam_directions)
    speed = problem.points.speed_of_sound_m_s
    if len(problem.landmarks_ct_mm) >= 3:
        landmarks = transform_points(problem.initial_reference_to_ras, problem.landmarks_patient_mm)
        landmarks_ct = problem.landmarks_ct_mm
        sd, freedom = (LANDMARK_SD_MM, LANDMARK_FREEDOM) if problem.landmark_sd_mm is None else (problem.landmark_sd_mm, 3.0)
    else:
        corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 50.0
        landmarks = landmarks_ct = moved.positions_mm.mean(axis=0) + corners
        sd, freedom = START_SD_MM, 3.0
    return Model(
        surface=problem.surface,
        points=moved.positions_mm,
        beams=beams,
        depths=moved.depths_mm,
        covariances=moved.covariances_mm2,
        surface_variance=problem.surface_sd_mm**2,
        inlier_prior=np.clip(moved.qualities, LEAST_QUALITY, 1.0),
        offset_sd=problem.surface_offset_sd_mm,
        speed_sd=problem.points.speed_of_sound_sd_m_s / speed if np.isfinite(speed) else 0.0,
        landmarks=landmarks,
        landmarks_ct=landmarks_ct,
        landmark_sd=sd,
        landmark_freedom=freedom,
        pivot=moved.positions_mm.mean(axis=0),
        alternatives=moved.alternative_depths_mm - moved.depths_mm[:, None],
        alternative_log_odds=_log_odds(moved.alternative_probabilities),
    )


def _log_odds(probabilities: Array) -> Array:
    chosen = np.clip(1 - np.nansum(probabilities, axis=1, keepdims=True), 0.05, 1)
    odds: Array = np.log(np.clip(np.nan_to_num(probabilities), 1e-6, 1) / chosen)
    return odds


def evaluate(model: Model, state: State) -> Evaluation:
    """Residuals, weights and cost of every pose: one query of the surface for all of them."""
    count, number = len(state.motion), len(model.points)
    turn = state.motion[:, None, :3, :3]
    beams = (turn @ model.beams[None, :, :, None])[..., 0]
    points = transform_points(state.motion, model.points) + beams * (model.depths * state.speed[:, None])[..., None]
    feet = model.feet(model.surface, points.reshape(-1, 3))
    normals = feet.directions.reshape(count, number, 3)
    residuals = feet.distances_mm.reshape(count, number) - state.offset[:, None]
    if model.shared is not None:
        residuals = residuals - model.shared
    back = (normals[..., None, :] @ turn)[..., 0, :]  # the normal as the measurement sees it
    variances = (back * (model.covariances @ back[..., None])[..., 0]).sum(axis=-1) + model.surface_variance
    slope = (normals * beams).sum(axis=-1)
    design = np.empty((count, number, PARAMETERS))
    design[..., :3] = _cross(points - model.pivot, normals)
    design[..., 3:6] = normals
    design[..., 6] = -1.0
    design[..., 7] = slope * model.depths
    inlier, residuals, echoes, log_likelihood = _inliers(model, state, residuals, variances, slope)
    # an outlier still pulls a little, as a stray point does, so that a search far off finds its way
    heavy = (STRAY_FREEDOM + 1) / (STRAY_FREEDOM * STRAY_WIDTH_MM**2 + residuals**2)
    weights = inlier / (state.scale[:, None] * variances) + (1 - inlier) * heavy
    moved = transform_points(state.motion, model.landmarks)
    misses = moved - model.landmarks_ct
    squares = (misses**2).sum(axis=(1, 2))
    total, believed = model.landmark_freedom + 3 * len(model.landmarks), model.landmark_freedom * model.landmark_sd**2
    cost = total / 2 * np.log1p(squares / believed) - log_likelihood
    cost += _prior_cost(model, state)
    return Evaluation(
        cost=cost,
        residuals=residuals,
        echoes=echoes,
        weights=weights,
        inlier=inlier,
        variances=variances,
        design=design,
        landmark_weight=total / (believed + squares),
        landmark_misses=misses,
        landmark_design=motion_jacobian(moved, model.pivot),
    )


def _cross(a: Array, b: Array) -> Array:
    """Cross products along the last axis; several times faster than numpy's on small arrays."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


def _prior_cost(model: Model, state: State) -> Array:
    cost: Array = state.offset**2 / (2 * model.offset_sd**2) + SCALE_FREEDOM / 2 * (np.log(state.scale) + 1 / state.scale)
    if model.speed_sd > 0:
        cost = cost + state.speed**2 / (2 * model.speed_sd**2)
    bad, points = OUTLIER_PRIOR
    return cost - bad * np.log(state.outliers) - (points - bad) * np.log1p(-state.outliers)


def _inliers(model: Model, state: State, residuals: Array, variances: Array, slope: Array) -> tuple[Array, Array, Array, Array]:
    """Probability of being an inlier, residual of the believed echo, its distance from the chosen one: (M, N); log likelihood."""
    echoes = np.zeros_like(residuals)
    spread = state.scale[:, None] * variances
    prior = (1 - state.outliers[:, None]) * model.inlier_prior
    if model.alternatives.shape[1]:
        options = residuals[..., None] + np.concatenate(
            [np.zeros((*residuals.shape, 1)), slope[..., None] * np.nan_to_num(model.alternatives)], axis=-1
        )
        log_odds = np.concatenate([np.zeros((len(model.points), 1)), model.alternative_log_odds], axis=1)
        log_odds = np.where(np.isfinite(np.pad(model.alternatives, ((0, 0), (1, 0)))), log_odds, -50.0)
        exponent = log_odds - options**2 / (2 * spread[..., None])
        top = exponent.max(axis=-1, keepdims=True)
        share = np.exp(exponent - top)
        total = share.sum(axis=-1)
        residuals = (share * options).sum(axis=-1) / total
        echoes = (share[..., 1:] * np.nan_to_num(model.alternatives)).sum(axis=-1) / total
        logarithm = top[..., 0] + np.log(total) - np.log(np.exp(log_odds).sum(axis=1))
    else:
        logarithm = -(residuals**2) / (2 * spread)
    good = prior * np.exp(np.maximum(logarithm, -600)) / np.sqrt(2 * np.pi * spread)
    outside, inside, stray = outlier_laws(residuals)
    densities = [good + (1 - prior) * (share * outside + (1 - share) * inside + stray) for share in OUTSIDE_SHARES]
    likelihoods = np.stack([np.log(density).sum(axis=1) for density in densities])
    log_likelihood = np.asarray(np.logaddexp.reduce(likelihoods, axis=0), dtype=np.float64) - np.log(len(OUTSIDE_SHARES))
    beliefs = np.exp(likelihoods - likelihoods.max(axis=0))
    beliefs = (beliefs / beliefs.sum(axis=0))[..., None]
    inlier: Array = sum((belief * good / density for belief, density in zip(beliefs, densities)), np.zeros_like(good))
    return inlier, residuals, echoes, log_likelihood


def outlier_laws(residuals: Array) -> tuple[Array, Array, Array]:
    """Densities of an outlier's residual: at an interface outside the bone, at one inside, astray; with their shares."""
    height = (1 - STRAY_SHARE) / (INTERFACE_SD_MM * np.sqrt(2 * np.pi))
    outside = height * np.exp(-((residuals - INTERFACE_MM) ** 2) / (2 * INTERFACE_SD_MM**2))
    inside = height * np.exp(-((residuals + INTERFACE_MM) ** 2) / (2 * INTERFACE_SD_MM**2))
    peak = STRAY_SHARE * 2 / (np.pi * np.sqrt(3) * STRAY_WIDTH_MM)
    return outside, inside, peak / (1 + residuals**2 / (STRAY_FREEDOM * STRAY_WIDTH_MM**2)) ** 2


def normal_equations(model: Model, state: State, found: Evaluation) -> tuple[Array, Array]:
    """Hessian (M, 8, 8) and gradient (M, 8) of the cost by pose, offset and speed, in Gauss and Newton's approximation."""
    weighted = found.design * found.weights[..., None]
    hessian = np.swapaxes(weighted, -1, -2) @ found.design
    gradient = (weighted * found.residuals[..., None]).sum(axis=1)
    flat = found.landmark_design.reshape(len(hessian), -1, 6)
    hessian[:, :6, :6] += found.landmark_weight[:, None, None] * (np.swapaxes(flat, -1, -2) @ flat)
    pull = (np.swapaxes(flat, -1, -2) @ found.landmark_misses.reshape(len(hessian), -1, 1))[..., 0]
    gradient[:, :6] += found.landmark_weight[:, None] * pull
    hessian[:, 6, 6] += 1 / model.offset_sd**2
    gradient[:, 6] += state.offset / model.offset_sd**2
    stiffness = 1 / model.speed_sd**2 if model.speed_sd > 0 else 1e12
    hessian[:, 7, 7] += stiffness
    gradient[:, 7] += state.speed * stiffness
    return hessian, gradient


def advance(
    model: Model, state: State, found: Evaluation, longest_step_mm: float, largest_scale: float = np.inf
) -> tuple[State, Array]:
    """The next state by one Gauss-Newton step and one update of the scales; and how far the points move (M,), RMS mm."""
    hessian, gradient = normal_equations(model, state, found)
    step = -np.linalg.solve(hessian, gradient[..., None])[..., 0]
    arm = model.points - model.pivot
    shift = _cross(np.asarray(step[:, None, :3], dtype=np.float64), arm[None]) + step[:, None, 3:6]
    length = np.sqrt((shift**2).sum(axis=-1).mean(axis=1))
    step = step * np.minimum(1, longest_step_mm / np.maximum(length, 1e-12))[:, None]
    motion = rigid_from_vector(step[:, :3], step[:, 3:6], model.pivot) @ state.motion
    scale, outliers = update_scales(model, found, hessian)
    scale = np.minimum(scale, largest_scale)
    return State(motion, state.offset + step[:, 6], state.speed + step[:, 7], scale, outliers), np.minimum(
        length, longest_step_mm
    )


def update_scales(model: Model, found: Evaluation, hessian: Array) -> tuple[Array, Array]:
    """The factor on the variances and the share of outliers that the residuals ask for."""
    inlier = found.inlier
    # residuals shrink by what the fit takes out of them: the trace of each point's leverage
    leverage = (found.design * np.swapaxes(np.linalg.solve(hessian, np.swapaxes(found.design, -1, -2)), -1, -2)).sum(axis=-1)
    taken = np.clip(leverage * found.weights, 0, 0.95)
    squares = (inlier * found.residuals**2 / found.variances).sum(axis=1)
    scale = (squares + SCALE_FREEDOM) / ((inlier * (1 - taken)).sum(axis=1) + SCALE_FREEDOM)
    scale = np.maximum(scale, LEAST_SCALE)
    bad, points = OUTLIER_PRIOR
    outliers = ((1 - inlier).sum(axis=1) + bad) / (len(model.points) + points)
    return scale, outliers
