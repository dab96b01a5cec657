"""Pivot calibration: where the tip of a pivoting tool is, how well that is known, and whether it was tilted enough."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array, check_rigid

FEWEST_POSES = 20
SAMPLE = 8  # poses of one random trial: enough tilt among them, and free of slips in 43 % of trials at 10 % slips
CHI1_MEDIAN, CHI2_MEDIAN, CHI3_MEDIAN = 0.6745, 1.1774, 1.5382  # median length of a vector of 1, 2, 3 unit normal numbers
SLIP_SDS = 4.0  # a miss beyond so many per-axis SDs is a slip...
CERTAIN_SDS = 5.0  # ...unless misses beyond 4 SDs are as few as chance gives, and none is beyond 5
MIN_SINGULAR_RATIO = 0.04  # simulated: poses spread over a cone of about 10 deg half-angle
WORTH_WEIGHTING = 0.75  # predicted SD of the tip, weighted against equal weights: less is gained than chance may cost
MOST_SLIPS = 0.45


class PivotMethod(str, Enum):
    """How the tip is computed from the poses that are kept."""

    ALGEBRAIC = "algebraic"  # tip and pivot point in one linear step
    SPHERE = "sphere"  # the marker's origin moves on a sphere about the pivot point


@dataclass(frozen=True)
class PivotSettings(Parameters):
    method: Annotated[PivotMethod, "algebraic: tip and pivot in one step; sphere: fit to the marker's origins"] = (
        PivotMethod.ALGEBRAIC
    )
    trials: Annotated[int, Limits(10, 10000), "random trials against slips"] = 200
    max_tip_sd_mm: Annotated[float, Limits(0.01, 5), "refuse a tip that is known less well, worst direction"] = 0.3


@dataclass(frozen=True, eq=False)
class ConeCoverage:
    """How far the tool was tilted, out of its mean direction."""

    half_angle_deg: float  # in the direction tilted least (2 SD; the cone's half-angle if poses fill it evenly)
    widest_half_angle_deg: float  # in the direction tilted most
    singular_ratio: float  # smallest over largest singular value of the algebraic system: 0 none, 1 best
    weakest_direction: Array  # (3,) unit, in the frame of the poses: tilt further along it


@dataclass(frozen=True, eq=False)
class PivotCalibration:
    """The tip, with what is known of its error."""

    tip_in_marker_mm: Array  # (3,)
    pivot_mm: Array  # (3,) in the frame of the poses
    covariance_mm2: Array  # (3, 3) of the tip; errors that all poses share (a bent marker) are not in it
    rms_mm: float  # length of the misses of the poses used; it is not the error of the tip
    used: npt.NDArray[np.bool_]  # (N,) False: a slip
    coverage: ConeCoverage
    method: PivotMethod

    @property
    def tip_sd_mm(self) -> float:
        """SD of the tip in its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance_mm2)[-1]))


def calibrate_pivot(
    marker_to_frame: npt.ArrayLike,
    rng: np.random.Generator,
    settings: PivotSettings = PivotSettings(),
    camera_mm: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> PivotCalibration:
    """Tip of a tool that was pivoted about a fixed point.

    Poses whose tip left the point (slips) are found by random trials and left out. Where the misses across the tool are
    much larger than along it, which an error of the tracked rotation makes them, they are weighted by their own variances.

    Parameters
    ----------
    marker_to_frame : array-like, shape (N, 4, 4), N >= 20
        Poses of the marker, mm, in a frame in which the pivot point rests (Tracker, or Reference).
    rng : Generator
        For the random trials.
    camera_mm : array-like, shape (3,)
        Where the camera is in that frame; only for the words of a refusal.

    Raises
    ------
    InputError
        Fewer than 20 poses, poses that are not rigid, tilted too little (the message says where to), too many slips, or
        a tip that is known less well than `max_tip_sd_mm`.

    References
    ----------
    Yaniv, "Which pivot calibration?", SPIE Medical Imaging 2015: algebraic one-step, sphere fitting, and RANSAC.
    """
    poses = _checked(marker_to_frame)
    _refuse_lazy(poses, np.asarray(camera_mm, dtype=float))
    used = _without_slips(poses, rng, settings.trials)
    if used.mean() < 1 - MOST_SLIPS:
        raise InputError(
            f"the tip slipped in {1 - used.mean():.0%} of the poses; put it in a divot, press lightly and record again"
        )
    _refuse_lazy(poses[used], np.asarray(camera_mm, dtype=float))
    tip, pivot, covariance, misses = _fit(poses[used], settings.method)
    result = PivotCalibration(
        tip_in_marker_mm=tip,
        pivot_mm=pivot,
        covariance_mm2=covariance,
        rms_mm=float(np.sqrt(np.mean(np.sum(misses**2, axis=1)))),
        used=used,
        coverage=_coverage(poses[used], tip),
        method=settings.method,
    )
    if result.tip_sd_mm > settings.max_tip_sd_mm:
        raise InputError(
            f"the tip is only known to {result.tip_sd_mm:.2f} mm (limit {settings.max_tip_sd_mm} mm); "
            f"tilt further {_words(result.coverage.weakest_direction, pivot, camera_mm)} and record longer"
        )
    return result


def _checked(marker_to_frame: npt.ArrayLike) -> Array:
    poses = np.asarray(marker_to_frame, dtype=float)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise InputError(f"expected poses of shape (N, 4, 4), got {poses.shape}")
    if len(poses) < FEWEST_POSES:
        raise InputError(f"expected at least {FEWEST_POSES} poses, got {len(poses)}; pivot for some seconds")
    turn = poses[:, :3, :3]
    with np.errstate(invalid="ignore"):
        off = np.abs(np.swapaxes(turn, 1, 2) @ turn - np.eye(3)).max(axis=(1, 2))
        last = np.abs(poses[:, 3] - (0, 0, 0, 1)).max(axis=1)
        doubtful = ~((off < 1e-6) & (last == 0) & (np.linalg.det(turn) > 0) & np.isfinite(poses).all(axis=(1, 2)))
    checked = poses.copy()
    for index in np.flatnonzero(doubtful):  # those few are mended, or refused with the reason
        checked[index] = check_rigid(poses[index], f"pose {index}")
    return checked


def _refuse_lazy(poses: Array, camera_mm: Array) -> None:
    ratio, directions, ratios = _spread(poses)
    if ratio >= MIN_SINGULAR_RATIO:
        return
    where = "to all sides"
    if ratios[1] >= MIN_SINGULAR_RATIO:  # turned about one axis only: is it the tool's own, or was it tilted to and fro?
        tip, pivot = _algebraic(poses, np.ones(3))[:2]
        lever = poses[:, :3, :3].mean(axis=0) @ tip
        across = lever - directions[0] * (directions[0] @ lever)
        if np.linalg.norm(across) > 20:  # mm; a marker sits farther from the tip, but close to the tool's own axis
            where = _words(directions[0], pivot, camera_mm)
    raise InputError(
        f"the tool was tilted too little to tell tip from pivot (spread {ratio:.3f}, need {MIN_SINGULAR_RATIO}); "
        f"tilt further {where}, more than 10 deg, and record again"
    )


def _spread(poses: Array) -> tuple[float, Array, Array]:
    """Smallest singular ratio of the algebraic system; its weak directions (rows, weakest first) and their ratios.

    The system's normal matrix is [[n, -sum R'], [-sum R, n]], so all follows from the mean rotation's singular values.
    """
    left, singular, _ = np.linalg.svd(poses[:, :3, :3].mean(axis=0))
    singular = np.minimum(singular, 1.0)
    ratios = np.sqrt((1 - singular) / (1 + singular[0]))
    return float(ratios[0]), left.T, ratios


def _words(direction: Array, pivot: Array, camera_mm: npt.ArrayLike) -> str:
    sight = np.asarray(pivot) - np.asarray(camera_mm, dtype=float)
    length = float(np.linalg.norm(sight))
    along = abs(float(direction @ sight)) / length if length > 0 else 0.0
    return "towards and away from the camera" if along > np.sqrt(0.5) else "to both sides, as seen from the camera"


def _algebraic(poses: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Tip, pivot and the inverse normal matrix of R tip - pivot = -t.

    `weights`: (3,) or (N, 3, 3) information of each pose's miss.
    """
    turn, origin = poses[:, :3, :3], poses[:, :3, 3]
    information = np.broadcast_to(np.diag(weights), turn.shape) if weights.ndim == 1 else weights
    pushed = np.einsum("nij,nj->ni", information, origin)
    right = np.concatenate([-np.einsum("nji,nj->i", turn, pushed), pushed.sum(axis=0)])
    inverse = np.asarray(np.linalg.pinv(_normal(turn, information), hermitian=True), dtype=float)
    solution: Array = inverse @ right
    return solution[:3], solution[3:], inverse


def _normal(turn: Array, weights: Array) -> Array:
    """(6, 6): the sum over the poses of [R, -1]' W [R, -1]."""
    turned = np.swapaxes(turn, 1, 2) @ weights
    normal: Array = np.block(
        [[(turned @ turn).sum(axis=0), -turned.sum(axis=0)], [-np.swapaxes(turned, 1, 2).sum(axis=0), weights.sum(axis=0)]]
    )
    return normal


def _misses(poses: Array, tip: Array, pivot: Array) -> Array:
    missed: Array = poses[:, :3, :3] @ tip + poses[:, :3, 3] - pivot
    return missed


def _without_slips(poses: Array, rng: np.random.Generator, trials: int) -> npt.NDArray[np.bool_]:
    """(N,) poses whose tip stayed: the trial with the least median miss, then refined until nothing changes."""
    tips, pivots = _trial_solutions(poses, rng, trials)
    medians = np.empty(trials)
    for start in range(0, trials, 50):  # 50 at once: fast, and memory stays small for long recordings
        chosen = slice(start, start + 50)
        ends = np.einsum("nij,kj->kni", poses[:, :3, :3], tips[chosen]) + poses[:, :3, 3] - pivots[chosen, None]
        medians[chosen] = np.median(np.sum(ends**2, axis=2), axis=1)
    best = int(np.argmin(medians))
    misses = np.linalg.norm(_misses(poses, tips[best], pivots[best]), axis=1)
    used: npt.NDArray[np.bool_] = misses <= SLIP_SDS * float(np.sqrt(medians[best])) / CHI3_MEDIAN
    for _ in range(50):
        tip, pivot, _ = _algebraic(poses[used], np.ones(3))
        misses = _in_sds(poses, tip, pivot, used)
        again = misses <= SLIP_SDS
        if np.array_equal(again, used):
            break
        used = again
    beyond = 1 - scipy.special.gammainc(1.5, SLIP_SDS**2 / 2)  # of normal misses
    by_chance = scipy.special.gammainc(float((~used).sum()), len(poses) * beyond)  # Poisson's P(that many or more)
    if by_chance > 1e-3 and misses.max() <= CERTAIN_SDS:
        used = np.ones(len(poses), dtype=bool)
    return used


def _in_sds(poses: Array, tip: Array, pivot: Array, used: npt.NDArray[np.bool_]) -> Array:
    """(N,) length of each miss in SDs of those used; along the tool and across it have SDs of their own."""
    misses, lever = _misses(poses, tip, pivot), _lever_directions(poses, tip)
    along = np.sum(misses * lever, axis=1)
    across = np.linalg.norm(misses - along[:, None] * lever, axis=1)
    sd_along = max(float(np.median(np.abs(along[used]))) / CHI1_MEDIAN, 1e-9)
    sd_across = max(float(np.median(across[used])) / CHI2_MEDIAN, 1e-9)
    return np.asarray(np.hypot(along / sd_along, across / sd_across))


def _trial_solutions(poses: Array, rng: np.random.Generator, trials: int) -> tuple[Array, Array]:
    """Algebraic solutions of random samples: tips and pivots, (trials, 3) each."""
    picks = np.argsort(rng.random((trials, len(poses))), axis=1)[:, :SAMPLE]
    turn, origin = poses[picks, :3, :3], poses[picks, :3, 3]
    design = np.concatenate([turn, np.broadcast_to(-np.eye(3), turn.shape)], axis=3).reshape(trials, -1, 6)
    solutions = np.einsum("kij,kj->ki", np.linalg.pinv(design), -origin.reshape(trials, -1))
    return solutions[:, :3], solutions[:, 3:]


def _fit(poses: Array, method: PivotMethod) -> tuple[Array, Array, Array, Array]:
    """Tip, pivot, tip covariance, misses."""
    if method is PivotMethod.SPHERE:
        return _sphere(poses)
    tip, pivot, inverse = _algebraic(poses, np.ones(3))
    misses = _misses(poses, tip, pivot)
    along, across = _variances(poses, tip, misses)
    lever = _lever_directions(poses, tip)
    covariance = inverse @ _normal(poses[:, :3, :3], _spread_out(lever, along, across)) @ inverse
    best = np.linalg.pinv(_normal(poses[:, :3, :3], _spread_out(lever, 1 / along, 1 / across)), hermitian=True)
    if np.trace(best[:3, :3]) > WORTH_WEIGHTING**2 * np.trace(covariance[:3, :3]):
        return tip, pivot, covariance[:3, :3], misses
    for _ in range(5):
        tip, pivot, inverse = _algebraic(poses, _spread_out(_lever_directions(poses, tip), 1 / along, 1 / across))
        misses = _misses(poses, tip, pivot)
        along, across = _variances(poses, tip, misses)
    return tip, pivot, inverse[:3, :3], misses


def _lever_directions(poses: Array, tip: Array) -> Array:
    """(N, 3) unit, from the marker's origin to the tip, in the frame of the poses."""
    length = max(float(np.linalg.norm(tip)), 1e-9)
    directions: Array = poses[:, :3, :3] @ (tip / length)
    return directions


def _variances(poses: Array, tip: Array, misses: Array) -> tuple[float, float]:
    """Variance of the misses along the lever from marker to tip, and across it (per axis), mm^2.

    An error of the tracked rotation moves the tip across the lever only.
    """
    along = np.sum(misses * _lever_directions(poses, tip), axis=1)
    across = np.sum(misses**2, axis=1) - along**2
    free = len(poses) - 2
    return max(float(np.sum(along**2)) / free, 1e-12), max(float(np.sum(across)) / (2 * free), 1e-12)


def _spread_out(lever: Array, along: float, across: float) -> Array:
    """(N, 3, 3) matrices with one eigenvalue along the lever (N, 3) and another across it."""
    outer = lever[:, :, None] * lever[:, None, :]
    matrices: Array = along * outer + across * (np.eye(3) - outer)
    return matrices


def _sphere(poses: Array) -> tuple[Array, Array, Array, Array]:
    """The marker's origins lie on a sphere about the pivot; the tip is the mean of the pivot seen from the marker."""
    origins, turn = poses[:, :3, 3], poses[:, :3, :3]
    middle = origins.mean(axis=0)
    centred = origins - middle
    design = np.column_stack([2 * centred, np.ones(len(poses))])
    solution, _, rank, _ = np.linalg.lstsq(design, np.sum(centred**2, axis=1), rcond=None)
    if rank < 4:
        raise InputError("the marker's origins lie in one plane; tilt to all sides, or use the algebraic method")
    centre, radius = solution[:3], 0.0
    for _ in range(20):  # Gauss-Newton on the distances: the algebraic start pulls the centre towards the points
        spokes = centred - centre
        lengths = np.linalg.norm(spokes, axis=1)
        radius = float(lengths.mean())
        jacobian = np.column_stack([-spokes / lengths[:, None], -np.ones(len(poses))])
        step = np.linalg.lstsq(jacobian, -(lengths - radius), rcond=None)[0]
        centre = centre + step[:3]
        if np.linalg.norm(step[:3]) < 1e-9:
            break
    pivot = middle + centre
    seen = np.einsum("nji,nj->ni", turn, pivot - origins)
    tip = seen.mean(axis=0)
    radial = np.linalg.norm(centred - centre, axis=1)
    variance = float(np.var(radial)) * len(poses) / max(len(poses) - 4, 1)
    of_pivot = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)[:3, :3] * variance
    mean_turn = turn.mean(axis=0)
    covariance = mean_turn.T @ of_pivot @ mean_turn + np.cov(seen.T) / len(poses)
    return tip, pivot, covariance, _misses(poses, tip, pivot)


def _coverage(poses: Array, tip: Array) -> ConeCoverage:
    ratio, directions, _ = _spread(poses)
    lever = _lever_directions(poses, tip)
    mean = lever.mean(axis=0)
    mean /= np.linalg.norm(mean)
    tilt = lever - np.outer(lever @ mean, mean)
    values, vectors = np.linalg.eigh(tilt.T @ tilt / len(poses))
    # the smallest of the three is along the mean itself, where tilt has no component
    weak, wide = (float(np.degrees(np.arcsin(min(2 * np.sqrt(max(value, 0.0)), 1.0)))) for value in values[1:])
    direction = vectors[:, 1] if ratio >= MIN_SINGULAR_RATIO else directions[0]
    return ConeCoverage(weak, wide, ratio, direction)
