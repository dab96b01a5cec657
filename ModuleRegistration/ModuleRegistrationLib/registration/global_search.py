"""Global search: many starts from the uncertainty of the landmarks, all moved together, the poor ones dropped early."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, rigid_from_vector

from ModuleRegistrationLib.registration.closest_field import find_feet_on_planes
from ModuleRegistrationLib.registration.landmarks import motion_jacobian
from ModuleRegistrationLib.registration.likelihood import Model, State, advance, evaluate, normal_equations

FIRST_SCALE = 25.0  # the first step goes with five times the stated SDs, so that a start 10 mm off feels the surface
WHOLE = 4  # one pose in so many follows all points all the time
SHARE = 0.6  # of the points that a pose follows at first
LONGEST_STEP_MM = 8.0
SAME_PLACE_MM = 0.3  # RMS distance between the points of two poses that are one minimum
ON_ONE_WAY_MM = 1.5  # and of two that are on their way to one: else the widest minimum crowds out the others
SURE_START_MM, MOST_STARTS = 10.0, 4.0  # landmarks that leave the points farther off than this ask for more starts


@dataclass(frozen=True)
class Stage:
    """Keep the best `keep` poses and move them once for each of `scales`, the largest factor on the variances allowed then.

    With a `share` below 1 each pose follows points of its own choice: a choice without the outliers leads to the minimum
    that all of them together would hide.
    """

    keep: int
    scales: tuple[float, ...]
    share: float = 1.0
    apart_mm: float = SAME_PLACE_MM  # kept poses are that far from each other


def stages(starts: int) -> tuple[Stage, ...]:
    """The search from so many starts."""
    return (
        Stage(starts, (9, 4, 1), SHARE),
        Stage(max(starts // 4, 1), (1, 1, 1), apart_mm=ON_ONE_WAY_MM),
        Stage(max(starts // 10, 1), (1, 1, 2, 4)),
    )


def starts_for(model: Model, starts: int) -> int:
    """`starts`, or more in proportion where the landmarks leave it open by more than SURE_START_MM where the points lie."""
    information, squares, freedom = _landmark_uncertainty(model)
    arms = motion_jacobian(model.points, model.pivot)
    spread = np.sqrt(np.einsum("nij,jk,nik->", arms, information, arms) / len(arms) * squares / freedom)
    return int(starts * np.clip(spread / SURE_START_MM, 1, MOST_STARTS))


def _landmark_uncertainty(model: Model) -> tuple[Array, float, float]:
    """Covariance (6, 6) of the landmark registration in units of the landmarks' variance, whose sum of squares and freedom."""
    design = motion_jacobian(model.landmarks_ct, model.pivot).reshape(-1, 6)
    misses = model.landmarks - model.landmarks_ct
    freedom = max(misses.size - 6, 0) + model.landmark_freedom
    squares = float((misses**2).sum()) + model.landmark_freedom * model.landmark_sd**2
    return np.asarray(np.linalg.inv(design.T @ design), dtype=np.float64), squares, freedom


def draw_starts(model: Model, count: int, rng: np.random.Generator) -> State:
    """The landmark registration itself and `count - 1` draws from its uncertainty, with the landmarks' SD unknown."""
    information, squares, freedom = _landmark_uncertainty(model)
    sd = np.sqrt(squares / rng.chisquare(freedom + 2, count))
    draws = rng.multivariate_normal(np.zeros(6), information, count) * sd[:, None]
    draws[0] = 0
    motion = rigid_from_vector(draws[:, :3], draws[:, 3:], model.pivot)
    return State(motion, np.zeros(count), np.zeros(count), np.full(count, FIRST_SCALE), np.full(count, 0.1))


def search(model: Model, rng: np.random.Generator, stages: tuple[Stage, ...]) -> tuple[State, Array, int]:
    """The distinct minima found, best first, their scores (negative log evidence) and the number of steps."""
    model = replace(model, feet=find_feet_on_planes)
    state = draw_starts(model, stages[0].keep, rng)
    cost: Array = np.zeros(stages[0].keep)
    steps = 0
    for stage in stages:
        best = np.argsort(cost, kind="stable")
        state = state.take(distinct(model, state, best, stage.apart_mm)[: stage.keep] if steps else best)
        followed = rng.random((len(state.motion), len(model.points))) < stage.share
        followed[: len(followed) // WHOLE] = True
        for largest in stage.scales:
            found = evaluate(model, state)
            found = replace(found, weights=found.weights * followed, inlier=found.inlier * followed)
            state, _ = advance(model, state, found, LONGEST_STEP_MM, largest)
            cost, steps = found.cost, steps + 1  # of the pose before the step: good enough to drop the poor ones
    found = evaluate(model, state)
    hessian, _ = normal_equations(model, state, found)
    score = found.cost + np.linalg.slogdet(hessian)[1] / 2
    order = distinct(model, state, np.argsort(score))
    return state.take(order), score[order], steps


def distinct(model: Model, state: State, order: npt.NDArray[np.int64], apart_mm: float = SAME_PLACE_MM) -> npt.NDArray[np.int64]:
    """Of the poses in `order`, those that are not within `apart_mm` (RMS over the points) of a better one."""
    points = (model.points - model.pivot) @ np.swapaxes(state.motion[order, :3, :3], -1, -2)
    points += (state.motion[order, :3, :3] @ model.pivot + state.motion[order, :3, 3] - model.pivot)[:, None]
    flat = points.reshape(len(order), -1)
    lengths = (flat**2).sum(axis=1)
    apart = lengths[:, None] + lengths - 2 * flat @ flat.T  # squared, summed over the points
    kept: list[int] = []
    for i in range(len(order)):
        if not kept or apart[i, kept].min() > apart_mm**2 * len(model.points):
            kept.append(i)
    chosen: npt.NDArray[np.int64] = order[np.array(kept)]
    return chosen
