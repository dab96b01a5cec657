"""What may be wrong with a registration: one function a suspicion, each with its words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, transform_points
from scipy import special

from ModuleRegistrationLib.registration.closest_field import find_feet
from ModuleRegistrationLib.registration.landmark_checks import check_landmarks
from ModuleRegistrationLib.registration.landmarks import motion_jacobian
from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult

ACCEPTED, WARNING, REFUSED = "accepted", "warning", "refused"
ORDER = (ACCEPTED, WARNING, REFUSED)

HEAD_RADIUS_MM = 75.0  # turns a rotation into a distance at the skull
AMBIGUOUS_PROBABILITY, AMBIGUOUS_MM = 0.1, 1.5
LARGE_RMS_MM, HUGE_RMS_MM = 1.5, 3.0  # of the points used: A-mode and stylus points scatter by 0.3-0.8 mm
REJECTED_WARNED, REJECTED_REFUSED = 0.3, 0.45  # share of the points
SCALE_FOUND, SCALE_P = 0.01, 1e-3
SHARED_SD_MM, SHARED_SPOTS = 0.15, 10  # neighbouring points share errors that look like a scale, however many points there are
MOVED_MM, MOVED_P = 1.0, 1e-3
SWEEP_POINTS, SWEEP_MOVED_MM = 60, 2.0  # the biases of single sweeps look like small jumps
LEAST_PER_SIDE, MOST_SPLITS = 5, 40
LANDMARK_FAR_MM = 15.0
ONE_SIDED = 0.2  # of the skull's half size: how far points must reach beyond its middle to see the other side
SPHERE_MM = 0.8  # a sphere through the points that misses them by less is as good as the skull itself
LEAST_CHECKED = 10  # points used: six degrees of freedom and the common offset take seven, the others show whether they agree
MOST_OFFSET_SDS = 4.0  # of the common offset's prior
AXES = ("left-right", "front-back", "head-foot")


@dataclass(frozen=True)
class Finding:
    """One reason, and how serious it is."""

    status: str
    message: str


def find_weak_direction(result: RegistrationResult) -> list[Finding]:
    """The motion that is known worst, in words."""
    if result.covariance is None:
        return []
    lengths = np.array([HEAD_RADIUS_MM] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(result.covariance * np.outer(lengths, lengths))
    weakest = vectors[:, -1]
    size, kind = float(np.sqrt(values[-1])), "rotation" if np.linalg.norm(weakest[:3]) > np.linalg.norm(weakest[3:]) else "shift"
    part = weakest[:3] if kind == "rotation" else weakest[3:]
    axis = AXES[int(np.argmax(np.abs(part)))]
    where = f"rotation about the {axis} axis" if kind == "rotation" else f"shift along the {axis} axis"
    angle = f" ({np.degrees(size / HEAD_RADIUS_MM):.1f} deg)" if kind == "rotation" else ""
    return [Finding(ACCEPTED, f"{where} is poorly held: SD {size:.1f} mm at the skull{angle}")]


def find_ambiguity(result: RegistrationResult, targets_ras_mm: Array) -> list[Finding]:
    """Whether another pose explains the points nearly as well."""
    for other in result.minima[1:]:
        here = transform_points(other.reference_to_ras @ np.linalg.inv(result.reference_to_ras), targets_ras_mm)
        apart = float(np.linalg.norm(here - targets_ras_mm, axis=1).mean())
        if other.probability > AMBIGUOUS_PROBABILITY and apart > AMBIGUOUS_MM:
            return [
                Finding(
                    WARNING,
                    f"ambiguous: another pose, {apart:.1f} mm away at the targets, "
                    f"fits too (probability {other.probability:.0%}); palpate where the skull is curved",
                )
            ]
    return []


def find_one_sidedness(problem: RegistrationProblem, result: RegistrationResult) -> list[Finding]:
    """Whether the points see one side of the head only, or a part that a sphere describes as well."""
    points = result.points_ras_mm[result.used]
    centre, half = problem.surface.center_mm, np.ptp(problem.surface.vertices_mm, axis=0) / 2
    place = (points - centre) / half
    findings = []
    side = "right" if place[:, 0].min() > -ONE_SIDED else "left" if place[:, 0].max() < ONE_SIDED else ""
    if side:
        text = f"all points lie on the {side} side: rotation about the front-back axis is poorly held; add points opposite"
        findings.append(Finding(WARNING, text))
    end = "front" if place[:, 1].min() > ONE_SIDED else "back" if place[:, 1].max() < -ONE_SIDED else ""
    if end and not side:
        text = f"all points lie on the {end} of the head: the other end is poorly held; add points above and behind the ears"
        findings.append(Finding(WARNING, text))
    if place[:, 2].min() > ONE_SIDED:
        text = (
            "all points lie on the vault: rotation about the head-foot axis is poorly held; add forehead and periorbital points"
        )
        findings.append(Finding(WARNING, text))
    elif _misses_sphere(points) < SPHERE_MM:
        text = "all points lie on one sphere: every rotation about its centre is poorly held; add periorbital points"
        findings.append(Finding(WARNING, text))
    return findings


def find_large_offset(problem: RegistrationProblem, result: RegistrationResult) -> list[Finding]:
    """Whether all points together lie farther from the bone than its segmentation explains."""
    offset = result.surface_offset_mm
    if abs(offset) <= MOST_OFFSET_SDS * problem.surface_offset_sd_mm:
        return []
    side = "outside" if offset > 0 else "inside"
    text = (
        f"all points together lie {abs(offset):.1f} mm {side} the segmented bone, which it leaves open to "
        f"{problem.surface_offset_sd_mm:.1f} mm (SD); check the tip's radius, the calibration and the threshold"
    )
    return [Finding(WARNING, text)]


def find_few_points(result: RegistrationResult, least: int = LEAST_CHECKED) -> list[Finding]:
    """Whether so few points were used that a wrong pose would fit them as well as the right one."""
    count = int(result.used.sum())
    if count >= least:
        return []
    text = f"only {count} points are used, too few to show an error among them; palpate {least - count} more"
    return [Finding(WARNING, text)]


def _misses_sphere(points: Array) -> float:
    """RMS distance of points (N, 3) from their best sphere (algebraic fit), freed of the four parameters it takes."""
    design = np.column_stack([2 * points, np.ones(len(points))])
    solution = _fit(design, np.sum(points**2, axis=1))
    radius = np.sqrt(max(float(solution[3] + solution[:3] @ solution[:3]), 0.0))
    misses = np.linalg.norm(points - solution[:3], axis=1) - radius
    return float(np.sqrt(np.sum(misses**2) / max(len(points) - 4, 1)))


def find_bad_fit(result: RegistrationResult) -> list[Finding]:
    """Whether the points used lie too far from the surface altogether."""
    rms = float(np.sqrt(np.mean(result.residuals_mm[result.used] ** 2)))
    if rms > LARGE_RMS_MM:
        status = REFUSED if rms > HUGE_RMS_MM else WARNING
        text = f"the points scatter by {rms:.1f} mm (RMS) about the surface; check the CT, the calibration and the landmarks"
        return [Finding(status, text)]
    return []


def find_inconsistent_points(problem: RegistrationProblem, result: RegistrationResult) -> list[Finding]:
    """Which points contradict the others, and which of those hang over a hole."""
    rejected = np.flatnonzero(~result.used)
    if not len(rejected):
        return []
    share = len(rejected) / len(result.used)
    status = REFUSED if share > REJECTED_REFUSED else WARNING if share > REJECTED_WARNED else ACCEPTED
    text = f"{len(rejected)} of {len(result.used)} points contradict the others: {_names(problem, rejected)}"
    over = rejected[find_feet(problem.surface, result.points_ras_mm[rejected]).at_edge]
    if len(over):
        text += f"; of these over an opening or beyond the edge of the bone: {_names(problem, over)}"
    return [Finding(status, text)]


def _names(problem: RegistrationProblem, which: npt.NDArray[np.int64]) -> str:
    """Labels of points, not all of them where they are many."""
    more = f" and {len(which) - 6} more" if len(which) > 6 else ""
    return ", ".join(problem.points.labels[i] for i in which[:6]) + more


def _linearised(problem: RegistrationProblem, result: RegistrationResult) -> tuple[Array, Array, Array, Array]:
    """Used points in RAS, normals, residuals and the design of pose and offset (n, 7)."""
    points = result.points_ras_mm[result.used]
    feet = find_feet(problem.surface, points)
    rows = np.einsum("ni,nij->nj", feet.directions, motion_jacobian(points, result.pivot_ras_mm))
    return points, feet.directions, feet.distances_mm, np.column_stack([rows, np.ones(len(points))])


def find_scale_error(problem: RegistrationProblem, result: RegistrationResult) -> list[Finding]:
    """Whether the cloud of points is larger or smaller than the skull."""
    points, normals, residuals, design = _linearised(problem, result)
    if len(points) < design.shape[1] + 4:
        return []
    stretched = np.column_stack([design, np.einsum("ni,ni->n", normals, points - points.mean(axis=0))])
    solution, freedom = _fit(stretched, residuals), len(points) - stretched.shape[1]
    variance = float(np.sum((residuals - stretched @ solution) ** 2)) / freedom + SHARED_SD_MM**2 * len(points) / SHARED_SPOTS
    sd = np.sqrt(variance * np.linalg.pinv(stretched.T @ stretched)[-1, -1])
    stretch = float(solution[-1])
    if abs(stretch) > SCALE_FOUND and abs(stretch) > special.stdtrit(freedom, 1 - SCALE_P / 2) * sd:
        return [
            Finding(WARNING, f"the points are {1 + stretch:.3f} times the size of the skull; check the unit and the calibration")
        ]
    return []


def _fit(design: Array, values: Array) -> Array:
    return np.asarray(np.linalg.lstsq(design, values, rcond=None)[0], dtype=np.float64)


def find_moved_reference(problem: RegistrationProblem, result: RegistrationResult) -> list[Finding]:
    """Whether the residuals jump at one moment, as they do when the reference base is knocked.

    For each moment between two points, in their order, the points after it get a shift of their own; an F-test tells
    whether that explains more than chance, corrected for the number of moments tried.
    """
    points, normals, residuals, design = _linearised(problem, result)
    if len(points) < 2 * LEAST_PER_SIDE + 2:
        return []
    splits = np.unique(np.linspace(LEAST_PER_SIDE, len(points) - LEAST_PER_SIDE, MOST_SPLITS).astype(int))
    plain = float(np.sum((residuals - design @ _fit(design, residuals)) ** 2))
    best = (1.0, 0, 0.0)
    for split in splits:
        after = (np.arange(len(points)) >= split)[:, None] * normals
        extended = np.column_stack([design, after])
        solution, freedom = _fit(extended, residuals), len(points) - extended.shape[1]
        left = float(np.sum((residuals - extended @ solution) ** 2))
        chance = float(special.fdtrc(3, freedom, max(plain - left, 0.0) / 3 / max(left / freedom, 1e-12)))
        best = min(best, (chance, int(split), float(np.linalg.norm(solution[-3:]))))
    chance, split, shift = best
    enough = MOVED_MM if len(points) <= SWEEP_POINTS else SWEEP_MOVED_MM
    if chance * len(splits) < MOVED_P and shift > enough:
        label = problem.points.labels[int(np.flatnonzero(result.used)[split])]
        return [
            Finding(
                WARNING,
                f"the residuals jump by {shift:.1f} mm from point {label} on: the reference base may have moved; "
                "check it and palpate again",
            )
        ]
    return []


def find_landmark_conflict(problem: RegistrationProblem, result: RegistrationResult) -> list[Finding]:
    """Whether landmarks look swapped, or one lies far from where the surface registration puts it."""
    if len(problem.landmarks_ct_mm) < 3:
        return []
    try:
        _, _, warnings = check_landmarks(problem.landmarks_patient_mm, problem.landmarks_ct_mm)
    except InputError as error:
        return [Finding(REFUSED, str(error))]
    moved = transform_points(result.reference_to_ras, problem.landmarks_patient_mm)
    misses = np.linalg.norm(moved - problem.landmarks_ct_mm, axis=1)
    findings = [Finding(WARNING, text) for text in warnings]
    far = np.flatnonzero(misses > LANDMARK_FAR_MM)
    if len(far):
        names = ", ".join(f"number {i + 1} ({misses[i]:.0f} mm)" for i in far)
        findings.append(Finding(WARNING, f"landmarks far from their place after the surface registration: {names}; check them"))
    return findings
