"""What can be wrong with paired landmarks before any fit: said by name."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, check_points, transform_points

DUPLICATE_MM = 1.0  # two landmarks closer than this are one landmark measured twice
COLLINEAR_MM = 3.0  # RMS distance from the best line; below it the turn about that line is lost in the landmarks' own error
COLLINEAR_RATIO = 0.05
SCALE_LIMIT = 1.6  # ratio of the lists' sizes; landmark errors of 10 mm on a face change it by less than 1.3
UNITS = {"metres": 1e-3, "centimetres": 0.1, "inches": 1 / 25.4, "micrometres": 1e3}
UNIT_TOLERANCE = 1.35
SMALLEST_SIZE_MM, LARGEST_SIZE_MM = 5.0, 500.0  # RMS distance from the centroid of landmarks on a head
MOST_PERMUTED = 6  # all permutations up to this number of landmarks, exchanges of two beyond
REFUSED_FRE_RATIO, WARNED_FRE_RATIO = 3.0, 2.0  # how much better another pairing must fit
LEAST_FRE_MM = 4.0  # a fit this good needs no other pairing
MISFIT_RATIO = 2.5  # of the usual error of a pair: an FRE above it has less than one chance in a thousand with four pairs


def check_landmarks(
    patient_mm: npt.ArrayLike, ct_mm: npt.ArrayLike, labels: Sequence[str] = ()
) -> tuple[Array, Array, tuple[str, ...]]:
    """The two lists as arrays, and warnings; anything that cannot give a registration is refused.

    Raises
    ------
    InputError
        Fewer than 3 pairs, unequal numbers, another unit or scale, duplicates, collinear points, swapped landmarks.
    """
    patient, ct = check_points(patient_mm, "patient landmarks"), check_points(ct_mm, "CT landmarks")
    if len(patient) != len(ct):
        raise InputError(f"expected one CT point per patient point, got {len(patient)} patient and {len(ct)} CT landmarks")
    if len(ct) < 3:
        raise InputError(f"expected at least 3 landmark pairs, got {len(ct)}; measure more landmarks")
    names = [labels[i] if i < len(labels) else f"number {i + 1}" for i in range(len(ct))]
    _check_units(patient, ct)
    for where, points in (("patient", patient), ("CT", ct)):
        _check_distinct(points, where, names)
        _check_spread(points, where)
    return patient, ct, _check_pairing(patient, ct, names)


def misfit(
    patient_mm: npt.ArrayLike, ct_mm: npt.ArrayLike, labels: Sequence[str], usual_fle_mm: float
) -> tuple[str, tuple[str, ...]]:
    """What a fit leaves that is too far off to be the usual error of landmarks, in words; and which landmark alone it is.

    Parameters
    ----------
    patient_mm, ct_mm : array-like, shape (N >= 3, 3), paired
    labels : sequence of str, N names
    usual_fle_mm : float
        Root mean square 3D localisation error of one pair.

    Returns
    -------
    text : str
        "" if the fit is as good as such landmarks usually are, which says little of the error at a target.
    names : tuple of str
        The one landmark without which all others fit, if there is one.
    """
    patient, ct = np.asarray(patient_mm, dtype=float), np.asarray(ct_mm, dtype=float)
    limit, given = MISFIT_RATIO * usual_fle_mm, fit_rms_mm(patient, ct)
    if given <= limit:
        return "", ()
    left = [fit_rms_mm(np.delete(patient, i, axis=0), np.delete(ct, i, axis=0)) for i in range(len(ct))] if len(ct) > 3 else []
    if left and min(left) * REFUSED_FRE_RATIO <= given and min(left) <= limit:
        name = labels[int(np.argmin(left))]
        said = f"{name} does not fit the other landmarks ({given:.1f} mm RMS with it, {min(left):.1f} mm without)"
        return f"{said}; touch it again", (name,)
    return f"the landmarks do not fit those of the CT ({given:.1f} mm RMS, usual are {usual_fle_mm:g} mm); touch them again", ()


def fit_rms_mm(patient: Array, ct: Array) -> float:
    """What the best rigid fit of paired points (N, 3) leaves, root mean square."""
    from ModuleRegistrationLib.registration.landmarks import fit_rigid

    misses = transform_points(fit_rigid(patient, ct), patient) - ct
    return float(np.sqrt(np.mean(np.sum(misses**2, axis=1))))


def _size(points: Array) -> float:
    """Root mean square distance from the centroid."""
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))


def _check_units(patient: Array, ct: Array) -> None:
    sizes = {"patient": _size(patient), "CT": _size(ct)}
    if min(sizes.values()) <= 0:
        raise InputError("all landmarks of a list lie on one spot (duplicates); measure each landmark at its own place")
    ratio = sizes["patient"] / sizes["CT"]
    for unit, factor in UNITS.items():
        for where, value in (("patient", ratio), ("CT", 1 / ratio)):
            if 1 / UNIT_TOLERANCE < value / factor < UNIT_TOLERANCE:
                raise InputError(f"the {where} landmarks look like {unit} (they are {value:.4g} times the size); give them in mm")
    for where, size in sizes.items():
        if not SMALLEST_SIZE_MM < size < LARGEST_SIZE_MM:
            guess = "; they look like metres" if 1e-3 * SMALLEST_SIZE_MM < size < 1e-3 * LARGEST_SIZE_MM else ""
            raise InputError(f"the {where} landmarks spread over {size:.3g} mm, which is no head{guess}; give them in mm")
    if not 1 / SCALE_LIMIT < ratio < SCALE_LIMIT:
        raise InputError(f"the patient landmarks are {ratio:.2f} times the size of the CT's; check the pairing and the unit (mm)")


def _check_distinct(points: Array, where: str, names: Sequence[str]) -> None:
    for a, b in combinations(range(len(points)), 2):
        if np.linalg.norm(points[a] - points[b]) < DUPLICATE_MM:
            raise InputError(
                f"{where} landmarks {names[a]} and {names[b]} are duplicates (less than {DUPLICATE_MM:g} mm apart); "
                "measure each landmark at its own place"
            )


def _check_spread(points: Array, where: str) -> None:
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    off_line = float(np.sqrt(np.sum(singular[1:] ** 2) / len(points)))
    if off_line < COLLINEAR_MM or singular[1] < COLLINEAR_RATIO * singular[0]:
        raise InputError(
            f"the {where} landmarks are collinear (all within {off_line:.1f} mm of one line): "
            "the rotation about that line is free; add a landmark off the line"
        )


def _check_pairing(patient: Array, ct: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Whether another order of the patient's landmarks fits far better than the one given."""
    from ModuleRegistrationLib.registration.landmarks import fit_rigid

    orders = np.array(_orders(len(ct)))
    candidates = patient[orders]  # (P, N, 3)
    fits = fit_rigid(candidates, ct)
    misses = candidates @ np.swapaxes(fits[:, :3, :3], -1, -2) + fits[:, None, :3, 3] - ct
    fres = np.sqrt(np.mean(np.sum(misses**2, axis=-1), axis=-1))
    best = int(np.argmin(fres))
    given = float(fres[0])
    if best == 0 or given < LEAST_FRE_MM or fres[best] * WARNED_FRE_RATIO > given:
        return ()
    changed = [i for i in range(len(ct)) if orders[best][i] != i]
    what = f"{' and '.join(names[i] for i in changed)} look swapped" if len(changed) == 2 else (
        f"{', '.join(names[i] for i in changed)} look paired in the wrong order"
    )  # fmt: skip
    text = f"landmarks {what}: the fit leaves {given:.1f} mm as given and {fres[best]:.1f} mm with them exchanged"
    if fres[best] * REFUSED_FRE_RATIO <= given:
        raise InputError(f"{text}; check left and right and measure again")
    return (f"{text}; check left and right",)


def _orders(count: int) -> list[tuple[int, ...]]:
    """Orders to try, the given one first: all of them for a few landmarks, exchanges of two for many."""
    if count <= MOST_PERMUTED:
        return list(permutations(range(count)))
    given = list(range(count))
    orders = [tuple(given)]
    for a, b in combinations(given, 2):
        order = given.copy()
        order[a], order[b] = b, a
        orders.append(tuple(order))
    return orders
