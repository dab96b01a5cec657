"""Global search: many starts from the uncertainty of the landmarks, all moved together, the poor ones dropped early."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array, rigid_from_vector

from ModuleRegistrationLib.registration.landmarks import motion_jacobian
from ModuleRegistrationLib.registration.likelihood import Model, State, advance, evaluate, normal_equations

FIRST_SCALE = 25.0  # the search begins with five times the stated SDs, so that a start 10 mm off feels the surface
LONGEST_STEP_MM = 8.0
SAME_PLACE_MM = 0.3  # RMS distance between the points of two poses that are one minimum


@dataclass(frozen=True)
class Stage:
    """Keep the best `keep` poses and move them once for each of `scales`, the largest factor on the variances allowed then."""

    keep: int
    scales: tuple[float, ...]


STAGES = (Stage(96, (25, 25, 16, 16)), Stage(32, (9, 9, 4, 4)), Stage(12, (1, 1, 1, 4, 4, 4)))


def draw_starts(model: Model, count: int, rng: np.random.Generator) -> State:
    """The landmark registration itself and `count - 1` draws from its uncertainty, with the landmarks' SD unknown."""
    design = motion_jacobian(model.landmarks_ct, model.pivot).reshape(-1, 6)
    information = np.linalg.inv(design.T @ design)
    misses = model.landmarks - model.landmarks_ct
    freedom = max(misses.size - 6, 0) + model.landmark_freedom
    squares = float((misses**2).sum()) + model.landmark_freedom * model.landmark_sd**2
    sd = np.sqrt(squares / rng.chisquare(freedom + 2, count))
    draws = rng.multivariate_normal(np.zeros(6), information, count) * sd[:, None]
    draws[0] = 0
    motion = rigid_from_vector(draws[:, :3], draws[:, 3:], model.pivot)
    return State(motion, np.zeros(count), np.zeros(count), np.full(count, FIRST_SCALE), np.full(count, 0.1))


def search(model: Model, rng: np.random.Generator, stages: tuple[Stage, ...] = STAGES) -> tuple[State, Array, int]:
    """The distinct minima found, best first, their scores (negative log evidence) and the number of steps."""
    state = draw_starts(model, stages[0].keep, rng)
    cost: Array = np.zeros(stages[0].keep)
    steps = 0
    for stage in stages:
        state = state.take(np.argsort(cost, kind="stable")[: stage.keep])
        for largest in stage.scales:
            found = evaluate(model, state)
            state, _ = advance(model, state, found, LONGEST_STEP_MM, largest)
            cost, steps = found.cost, steps + 1  # of the pose before the step: good enough to drop the poor ones
    found = evaluate(model, state)
    hessian, _ = normal_equations(model, state, found)
    score = found.cost + np.linalg.slogdet(hessian)[1] / 2
    order = distinct(model, state, np.argsort(score))
    return state.take(order), score[order], steps


def distinct(model: Model, state: State, order: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Of the poses in `order`, those that are not within SAME_PLACE_MM of a better one."""
    points = model.points @ np.swapaxes(state.motion[order, :3, :3], -1, -2) + state.motion[order, None, :3, 3]
    apart = np.sqrt(((points[:, None] - points[None]) ** 2).sum(axis=-1).mean(axis=-1))
    kept: list[int] = []
    for i in range(len(order)):
        if not kept or apart[i, kept].min() > SAME_PLACE_MM:
            kept.append(i)
    chosen: npt.NDArray[np.int64] = order[np.array(kept)]
    return chosen
