"""From measured lines to bone points: a dwell becomes one point, a sweep an even carpet of points."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

SWEEP_EXTENT_MM = 8.0  # a hand that holds a probe on one spot wanders by 1 to 3 mm; a sweep covers centimetres
SPACING_MM = 2.0  # of a sweep's points: about two beam widths, so that neighbours see different bone
PATCH_MM = 1.0  # frames within this of a sweep's point are averaged: on a rim of 10 mm radius bone bends 0.05 mm over it
OUTLIER_SDS = 3.0
LEAST_SPREAD_MM = 0.15  # frames of a dwell nearer than this to their median along the beam are never outliers
HAND_SD_MM = 0.05  # what does not average out of a dwell or a patch along the beam: probe shape, tool calibration, pulse
MEDIAN_TO_SD = 1.4826


class Lines(Protocol):
    """What bone points are made from (see LineMeasurements)."""

    @property
    def depths_mm(self) -> Array: ...

    @property
    def positions_mm(self) -> Array: ...

    @property
    def covariances_mm2(self) -> Array: ...

    @property
    def beam_directions(self) -> Array: ...

    @property
    def qualities(self) -> Array: ...

    @property
    def accepted(self) -> npt.NDArray[np.bool_]: ...

    @property
    def alternative_depths_mm(self) -> Array: ...

    @property
    def alternative_probabilities(self) -> Array: ...

    @property
    def speed_of_sound_m_s(self) -> float: ...

    @property
    def speed_of_sound_sd_m_s(self) -> float: ...


def bone_points(recording: Recording, measurements: Lines) -> BonePoints:
    """Bone points of a recording, in the Reference frame.

    Frames that share a palpation point while the probe dwells give one point each (the robust mean of the accepted
    frames, its covariance from their scatter and the model). Where no palpation point is given, or the probe moves over
    more than `SWEEP_EXTENT_MM` under one number, the frames are a sweep: one point every `SPACING_MM`, the mean of the most
    certain frame and of those around it. `groups` is the palpation point, or -1 for a sweep without one.
    """
    chosen: list[npt.NDArray[np.int64]] = []  # the frames behind each point
    labels: list[str] = []
    groups: list[int] = []
    good = np.flatnonzero(measurements.accepted)
    for group in sorted(set(recording.palpation_points[good].tolist())):
        frames = good[recording.palpation_points[good] == group]
        if group >= 0 and extent_mm(measurements.positions_mm[frames]) <= SWEEP_EXTENT_MM:
            chosen.append(keep_agreeing(measurements, frames))
            labels.append(f"P{group}")
            groups.append(group)
            continue
        # where the beam entered the tissue: unlike the bone points, these places do not scatter with the depths they choose
        entries = measurements.positions_mm[frames] - measurements.depths_mm[frames, None] * measurements.beam_directions[frames]
        thinned = thin(entries, measurements.qualities[frames])
        patches = patches_of(entries, thinned)
        chosen += [keep_agreeing(measurements, frames[patch]) for patch in patches]
        labels += [f"S{frames[index]}" for index in thinned]
        groups += [group] * len(thinned)
    return combine(measurements, chosen, tuple(labels), np.array(groups, dtype=np.int64))


def extent_mm(positions: Array) -> float:
    """How far positions (n, 3) spread: twice the 90th percentile of their distance from the median."""
    return float(2 * np.percentile(np.linalg.norm(positions - np.median(positions, axis=0), axis=1), 90))


def keep_agreeing(measurements: Lines, frames: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """The frames of a dwell whose bone lies where the others' does, along their common beam."""
    beam = measurements.beam_directions[frames].mean(axis=0)
    along = measurements.positions_mm[frames] @ (beam / np.linalg.norm(beam))
    off = np.abs(along - np.median(along))
    spread = MEDIAN_TO_SD * float(np.median(off))
    agreeing: npt.NDArray[np.int64] = frames[off <= max(OUTLIER_SDS * spread, LEAST_SPREAD_MM)]
    return agreeing


def thin(positions: Array, qualities: Array) -> npt.NDArray[np.int64]:
    """Indices of a subset no two of which are nearer than `SPACING_MM`, best quality first, in order of frames."""
    cells = np.floor(positions / SPACING_MM).astype(np.int64)
    taken: dict[tuple[int, int, int], list[int]] = {}
    kept = []
    for index in np.argsort(-qualities, kind="stable").tolist():
        cell = cells[index]
        near = [
            other
            for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)
            for other in taken.get((int(cell[0]) + x, int(cell[1]) + y, int(cell[2]) + z), ())
        ]  # fmt: skip
        if near and (np.linalg.norm(positions[near] - positions[index], axis=1) < SPACING_MM).any():
            continue
        taken.setdefault((int(cell[0]), int(cell[1]), int(cell[2])), []).append(index)
        kept.append(index)
    return np.array(sorted(kept), dtype=np.int64)


def patches_of(positions: Array, centres: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """Indices of the frames around each centre that see the same bone: each frame counts once, for the nearest centre."""
    from scipy.spatial import KDTree

    if not len(centres):
        return []
    distance, nearest = KDTree(positions[centres]).query(positions)
    near = np.flatnonzero(distance <= PATCH_MM)
    order = near[np.argsort(nearest[near], kind="stable")]
    return np.split(order, np.searchsorted(nearest[order], np.arange(1, len(centres))))


def combine(
    measurements: Lines, chosen: list[npt.NDArray[np.int64]], labels: tuple[str, ...], groups: npt.NDArray[np.int64]
) -> BonePoints:
    """One point from each set of frames."""
    positions, covariances, beams, depths, qualities = [], [], [], [], []
    best = []
    for frames in chosen:
        cov = measurements.covariances_mm2[frames]
        beam = measurements.beam_directions[frames].mean(axis=0)
        beam = beam / np.linalg.norm(beam)
        along = np.einsum("i,nij,j->n", beam, cov, beam)
        weight = 1 / along
        weight = weight / weight.sum()
        position = weight @ measurements.positions_mm[frames]
        variance = along_variance(measurements.positions_mm[frames] @ beam, weight, along)
        outer = np.outer(beam, beam)
        rest = np.eye(3) - outer
        across = rest @ cov.mean(axis=0) @ rest
        positions.append(position)
        covariances.append(across + variance * outer)
        beams.append(beam)
        depths.append(weight @ measurements.depths_mm[frames])
        qualities.append(float(measurements.qualities[frames].max()))
        best.append(frames[np.argmax(measurements.qualities[frames])])
    count = len(chosen)
    index = np.array(best, dtype=np.int64)
    return BonePoints(
        positions_mm=np.array(positions).reshape(count, 3),
        covariances_mm2=np.array(covariances).reshape(count, 3, 3),
        beam_directions=np.array(beams).reshape(count, 3),
        depths_mm=np.array(depths, dtype=float).reshape(count),
        qualities=np.array(qualities, dtype=float).reshape(count),
        labels=labels,
        speed_of_sound_m_s=measurements.speed_of_sound_m_s,
        speed_of_sound_sd_m_s=measurements.speed_of_sound_sd_m_s,
        alternative_depths_mm=measurements.alternative_depths_mm[index],
        alternative_probabilities=measurements.alternative_probabilities[index],
        groups=groups,
    )


def along_variance(along: Array, weight: Array, model: Array) -> float:
    """Variance along the beam of the mean of a dwell or a patch: the larger of model and scatter, and a floor."""
    predicted = float((weight**2 * model).sum())
    if len(along) < 3:
        return predicted + HAND_SD_MM**2
    scatter = float((weight * (along - weight @ along) ** 2).sum()) * float((weight**2).sum()) / (1 - float((weight**2).sum()))
    return max(predicted, scatter) + HAND_SD_MM**2
