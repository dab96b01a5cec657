"""Titanium spheres in a CT: found by an automatic threshold, told from other metal by their shape, centred below a voxel.

The centre is the one that makes a sphere of the known diameter, averaged over each voxel and clipped where the
scanner clips, agree best with the CT. The tissue behind it (skin on one side, air or bone on the other) is
taken from the sphere's surroundings, because a mere centre of intensity is pulled towards the denser side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.grid import Grid

LOWEST_METAL_HU, HIGHEST_METAL_HU = 1600.0, 2400.0  # dense bone ends below, clipped metal (3071) lies above
METAL_MARGIN_HU = 300.0  # above the densest hundredth of bone
SMALLEST_SHARE, LARGEST_SHARE = 0.08, 4.0  # of a sphere's volume that a cluster may have: partial volume, blooming
LARGEST_EXTENT = 2.5  # of the diameter
WORST_MISFIT = 0.17  # RMS of model minus CT, in units of the metal's contrast, near the sphere
SURROUND_MM = 2.5  # how far beyond the sphere the CT is looked at
BLUR_MM = 0.5  # the scanner's own blur, beyond the voxel's edge
MOST_CLUSTERS = 4000  # more clusters than this are noise or a wrong unit, not markers
DEPTH_SAMPLES = 6  # sub-samples along a voxel's longest side


@dataclass(frozen=True, eq=False)
class SphereMarkers:
    """Spheres found, from the highest to the lowest."""

    centers_ras_mm: Array  # (N, 3)
    misfits: Array  # (N,) RMS of the fitted sphere minus the CT, relative to the metal's contrast
    threshold_hu: float  # what counted as metal
    diameter_mm: float

    def __len__(self) -> int:
        return len(self.centers_ras_mm)


def find_spheres(volume: Volume, diameter_mm: float = 4.0) -> SphereMarkers:
    """The metal spheres of a given diameter in a CT; none is a valid answer.

    Other metal and teeth are left out because they do not look like the sphere.

    Raises
    ------
    InputError
        The diameter is not 1 to 20 mm.
    """
    if not 1.0 <= diameter_mm <= 20.0:
        raise InputError(f"sphere diameter is {diameter_mm} mm; expected 1 to 20 mm")
    grid = Grid.of(volume)
    threshold = metal_threshold(volume.hu)
    found = []
    for cluster in _clusters(volume.hu, threshold, grid, diameter_mm):
        fitted = _fit(volume.hu, grid, cluster, diameter_mm)
        if fitted is not None and fitted[1] <= WORST_MISFIT:
            found.append(fitted)
    centers: Array = np.array([center for center, _ in found]).reshape(-1, 3)
    misfits = np.array([misfit for _, misfit in found])
    keep = _best(centers, misfits, diameter_mm)
    centers, misfits = centers[keep], misfits[keep]
    order = np.lexsort((centers[:, 0], centers[:, 1], -np.round(centers[:, 2], 1)))
    return SphereMarkers(centers[order], misfits[order], threshold, diameter_mm)


def metal_threshold(hu: npt.NDArray[np.int16]) -> float:
    """HU above which a voxel is metal or enamel rather than bone: above the densest hundredth of this head's bone."""
    some = hu[::2, ::4, ::4]
    bone = some[(some > 300) & (some < 2000)]
    if len(bone) == 0:
        return LOWEST_METAL_HU
    return float(np.clip(np.percentile(bone, 99) + METAL_MARGIN_HU, LOWEST_METAL_HU, HIGHEST_METAL_HU))


def dense_voxels(hu: npt.NDArray[np.int16], threshold: float) -> npt.NDArray[np.int64]:
    """(N, 3) subscripts of the voxels above a threshold that few exceed."""
    flat = np.flatnonzero(hu.ravel() > threshold)
    index: npt.NDArray[np.int64] = np.stack(np.unravel_index(flat, hu.shape), axis=1)
    return index


def _clusters(hu: npt.NDArray[np.int16], threshold: float, grid: Grid, diameter_mm: float) -> list[npt.NDArray[np.int64]]:
    """Index lists (n, 3) of connected voxels above the threshold whose size could be a sphere's."""
    from scipy import ndimage

    index = dense_voxels(hu, threshold)
    if len(index) == 0:
        return []
    low = index.min(axis=0)
    mask = np.zeros(tuple(index.max(axis=0) - low + 1), dtype=bool)
    mask[tuple((index - low).T)] = True
    labels, count = ndimage.label(mask, structure=np.ones((3, 3, 3)))
    if count > MOST_CLUSTERS:
        return []
    groups = labels[tuple((index - low).T)]
    order = np.argsort(groups, kind="stable")
    parts = np.split(index[order], np.flatnonzero(np.diff(groups[order])) + 1)
    sphere_mm3 = np.pi / 6 * diameter_mm**3
    kept = []
    for part in parts:
        extent = (part.max(axis=0) - part.min(axis=0)) * grid.spacing_mm
        share = len(part) * grid.voxel_mm3 / sphere_mm3
        if SMALLEST_SHARE <= share <= LARGEST_SHARE and extent.max() <= LARGEST_EXTENT * diameter_mm:
            kept.append(part)
    return kept


def _fit(
    hu: npt.NDArray[np.int16], grid: Grid, cluster: npt.NDArray[np.int64], diameter_mm: float
) -> Optional[tuple[Array, float]]:
    """Centre in RAS and misfit of the sphere that explains the CT around a cluster; None where there is no room for one."""
    from scipy.optimize import least_squares

    spacing, radius = grid.spacing_mm, diameter_mm / 2
    values = hu[tuple(cluster.T)].astype(float)
    start = (cluster * values[:, None]).sum(axis=0) / values.sum()
    reach = np.ceil((radius + SURROUND_MM) / spacing + 0.5).astype(int)
    low = np.maximum(np.rint(start).astype(int) - reach, 0)
    high = np.minimum(np.rint(start).astype(int) + reach + 1, hu.shape)
    patch = hu[tuple(slice(a, b) for a, b in zip(low, high))].astype(float)
    places = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high)), indexing="ij"), axis=-1).reshape(-1, 3)
    places_mm, measured = places * spacing, patch.ravel()
    peak = float(measured.max())
    limit = peak if np.count_nonzero(measured == peak) >= 3 else np.inf  # several equal peaks: the scanner clipped

    center, level = start * spacing, peak
    residual = np.zeros(0)
    for _ in range(2):  # the second time with the surroundings of the fitted place
        touched = np.linalg.norm(np.maximum(np.abs(places_mm - center) - spacing / 2, 0), axis=1) < radius + BLUR_MM
        if touched.all() or not touched.any():
            return None
        behind = _surroundings(places_mm, measured, touched)

        def misfit(guess: Array, touched: npt.NDArray[np.bool_] = touched, behind: Array = behind) -> Array:
            share = sphere_share(places_mm[touched], guess[:3], radius, spacing)
            model = behind + share * (guess[3] * 1000 - behind)
            difference: Array = np.minimum(model, limit) - measured[touched]
            return difference

        bounds = (np.append(center - radius, 0.8 * peak / 1000), np.append(center + radius, 25.0))
        solved = least_squares(
            misfit,
            np.append(center, np.clip(level / 1000, 0.81 * peak / 1000, 24)),
            bounds=bounds,
            xtol=1e-4,
            ftol=1e-6,
            x_scale=(1, 1, 1, 2),
        )
        center, level, residual = solved.x[:3], solved.x[3] * 1000, solved.fun
    contrast = peak - float(np.median(behind))
    return grid.to_ras((center / spacing)[None])[0], float(np.sqrt(np.mean(residual**2)) / contrast)


def _surroundings(places_mm: Array, measured: Array, touched: npt.NDArray[np.bool_]) -> Array:
    """What the CT would show without the sphere: the values around it, weighted by their nearness (Gaussian, 1 mm)."""
    outside = places_mm[~touched]
    squared = ((places_mm[touched][:, None] - outside[None]) ** 2).sum(axis=2)
    weights = np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True)))
    filled: Array = weights @ measured[~touched] / weights.sum(axis=1)
    return filled


def sphere_share(places_mm: Array, center_mm: Array, radius_mm: float, spacing_mm: Array) -> Array:
    """(N,) share of each voxel (box of sides `spacing_mm` around a place) that lies in a sphere, to about 1%.

    Along the longest side the voxel is sub-sampled; across it the sphere's edge is a ramp of a voxel's width.
    """
    longest = int(np.argmax(spacing_mm))
    ramp = float(np.mean(np.delete(spacing_mm, longest)))
    steps = ((np.arange(DEPTH_SAMPLES) + 0.5) / DEPTH_SAMPLES - 0.5) * spacing_mm[longest]
    total = np.zeros(len(places_mm))
    away = places_mm - center_mm
    across = (np.delete(away, longest, axis=1) ** 2).sum(axis=1)
    for step in steps:
        distance = np.sqrt(across + (away[:, longest] + step) ** 2)
        total += np.clip(0.5 - (distance - radius_mm) / ramp, 0, 1)
    share: Array = total / DEPTH_SAMPLES
    return share


def _best(centers: Array, misfits: Array, diameter_mm: float) -> list[int]:
    """Which fits to keep: of several within a radius of each other, the best."""
    keep: list[int] = []
    for index in np.argsort(misfits, kind="stable"):
        if all(np.linalg.norm(centers[index] - centers[other]) > diameter_mm / 2 for other in keep):
            keep.append(int(index))
    return sorted(keep)
