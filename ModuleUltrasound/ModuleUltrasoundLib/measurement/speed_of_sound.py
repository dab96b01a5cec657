"""Speed of sound in the tissue from pressing harder and softer on the same spot: the tissue's thickness changes, the bone stays.

While the probe presses, its face moves along the beam by as much as the tissue gives way. The tracker measures that way in
millimetres, the echo in microseconds; the slope of one over the other is the speed of sound. Both carry noise, and noise of the
echo would flatten a slope fitted to the way alone and pass for slow tissue: the line is fitted to both (Deming, 1943). Sliding
over sloped bone while pressing would pass for a change of thickness, so each spot's bone is a plane of unknown, small slope.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

from ModuleUltrasoundLib.measurement.measure import LineMeasurements, stays

LEAST_FRAMES = 8  # accepted frames of a spot
LEAST_RANGE_MM = 0.4  # of depth and of the probe's way at a spot, 10th to 90th percentile; less pressing tells nothing
SLOPE_SD = 0.05  # of the bone under a spot across the beam: an echo is seen only within some 3 degrees
LEAST_NOISE_MM = 0.03  # of a tracked position and of a depth; never believe a better fit
OUTLIER_SDS = 3.5
MEDIAN_TO_SD = 1.4826
ROUNDS = 3
LEAST_SPOTS_FOR_SCATTER = 4


@dataclass(frozen=True, eq=False)
class SpeedEstimate:
    """Speed of sound from pressing, and what it becomes together with the prior."""

    pressed_m_s: float  # from the pressing alone
    pressed_sd_m_s: float
    speed_m_s: float  # with the prior
    speed_sd_m_s: float
    spots: int
    frames: int

    def __str__(self) -> str:
        return f"{self.pressed_m_s:.0f} ± {self.pressed_sd_m_s:.0f} m/s ({self.spots} spot{'s' if self.spots > 1 else ''})"


@dataclass(frozen=True, eq=False)
class _Spot:
    depth_mm: Array  # (n,) tissue along the mean beam, at the speed that the lines were measured with
    way_mm: Array  # (n,) how far the skin lies from a fixed plane, against the beam
    side_mm: Array  # (n, 2) where the beam stands across its mean direction


def estimate_speed(recording: Recording, lines: LineMeasurements) -> SpeedEstimate:
    """Speed of sound from every spot of a recording at which the pressure was varied.

    Parameters
    ----------
    recording, lines
        A recording and what `measure_lines` gave for it; the speed assumed there is the prior here.

    Raises
    ------
    InputError
        No spot has enough accepted frames over a sufficient range of thickness.

    Notes
    -----
    The probe's way over the echo's depth, with an intercept and a slope of the bone a spot and one factor for all. The noise
    of both is what changes from frame to frame and is no pressing: second differences. The deviation is the larger of what
    the residuals say and of the spread of the spots' own estimates.
    """
    spots = _spots(recording, lines)
    if not spots:
        raise InputError(
            f"no spot was pressed hard and softly enough to tell the speed of sound: a spot needs {LEAST_FRAMES} good frames "
            f"over {LEAST_RANGE_MM} mm of thickness; hold the probe on one place and vary the pressure slowly"
        )
    factor, sd, frames = _factor(spots)
    speed, sd = factor * lines.speed_of_sound_m_s, sd * lines.speed_of_sound_m_s
    prior_sd = lines.speed_of_sound_sd_m_s
    share = prior_sd**2 / (prior_sd**2 + sd**2)
    return SpeedEstimate(
        pressed_m_s=speed,
        pressed_sd_m_s=sd,
        speed_m_s=lines.speed_of_sound_m_s + share * (speed - lines.speed_of_sound_m_s),
        speed_sd_m_s=float(np.sqrt(share) * sd),
        spots=len(spots),
        frames=frames,
    )


def estimate_if_pressed(recording: Recording, lines: LineMeasurements) -> Optional[SpeedEstimate]:
    """The estimate, or None where no spot was pressed hard and softly enough to tell."""
    try:
        return estimate_speed(recording, lines)
    except InputError:
        return None


def _spots(recording: Recording, lines: LineMeasurements) -> list[_Spot]:
    """The spots that can tell: enough accepted frames over enough thickness."""
    runs = stays(recording)
    found = []
    for run in np.unique(runs):
        spot = _spot(recording, lines, np.flatnonzero((runs == run) & lines.accepted))
        if spot is not None:
            found.append(spot)
    return found


def _spot(recording: Recording, lines: LineMeasurements, frames: npt.NDArray[np.int64]) -> Optional[_Spot]:
    if len(frames) < LEAST_FRAMES:
        return None
    depth = lines.depths_mm[frames]
    if np.percentile(depth, 90) - np.percentile(depth, 10) < LEAST_RANGE_MM:
        return None
    poses = recording.probe_to_reference[frames]
    beam = poses[:, :3, 2].mean(axis=0)
    beam = beam / np.linalg.norm(beam)
    tilt = poses[:, :3, 2] @ beam
    skin = poses[:, :3, 3] + recording.acquisition.forerun_length_mm * poses[:, :3, 2]
    bone = skin + depth[:, None] * poses[:, :3, 2]
    axes = np.linalg.svd(beam[None])[2][1:]
    side = (bone - bone.mean(axis=0)) @ axes.T
    way = -(skin - skin.mean(axis=0)) @ beam
    if np.percentile(way, 90) - np.percentile(way, 10) < LEAST_RANGE_MM:
        return None
    return _Spot(depth * tilt, way, side)


def _factor(spots: list[_Spot]) -> tuple[float, float, int]:
    """True over assumed speed of sound, its deviation, and how many frames told it."""
    noise, factor = LEAST_NOISE_MM, 1.0
    keep: list[npt.NDArray[np.bool_]] = [np.ones(len(spot.way_mm), dtype=bool) for spot in spots]
    ratio = _noise([spot.way_mm for spot in spots]) / _noise([spot.depth_mm for spot in spots])  # of variances
    sums: Array = np.zeros((0, 3))
    for _ in range(ROUNDS):
        sums = np.array([_sums(spot, mask, noise) for spot, mask in zip(spots, keep)])
        depths, both, ways = sums.sum(axis=0)
        more = ways - ratio * depths
        factor = float((more + np.hypot(more, 2 * np.sqrt(ratio) * both)) / (2 * both))
        rest = [_plane(spot, mask, noise, spot.way_mm - factor * spot.depth_mm) for spot, mask in zip(spots, keep)]
        together = np.concatenate([r[mask] for r, mask in zip(rest, keep)])
        noise = max(MEDIAN_TO_SD * float(np.median(np.abs(together))), LEAST_NOISE_MM)
        keep = [np.abs(r) < OUTLIER_SDS * noise for r in rest]
    depths, both, ways = sums.sum(axis=0)
    sd = noise * float(np.sqrt(factor / both))
    if len(spots) >= LEAST_SPOTS_FOR_SCATTER:  # sandwich: what is common to a spot's frames does not average out
        off = sums[:, 1] * (ratio - factor**2) + factor * (sums[:, 2] - ratio * sums[:, 0])
        slope = 2 * factor * both - (ways - ratio * depths)
        sd = max(sd, float(np.sqrt((off**2).sum() * len(spots) / (len(spots) - 1)) / slope))
    return factor, sd, int(sum(mask.sum() for mask in keep))


def _noise(series: list[Array]) -> float:
    """Variance of what changes from frame to frame, mm^2: a second difference has six times that of each value."""
    second = np.concatenate([np.diff(values, 2) for values in series])
    return max(float(np.median(np.abs(second)) * MEDIAN_TO_SD) ** 2 / 6, LEAST_NOISE_MM**2)


def _plane(spot: _Spot, mask: npt.NDArray[np.bool_], noise: float, values: Array) -> Array:
    """What remains of `values` when the spot's plane is fitted to those under `mask`, slopes held small by their prior."""
    design = np.column_stack([np.ones(len(values)), spot.side_mm])
    use = design[mask]
    ridge = np.diag([0.0, (noise / SLOPE_SD) ** 2, (noise / SLOPE_SD) ** 2])
    return np.asarray(values - design @ np.linalg.solve(use.T @ use + ridge, use.T @ values[mask]))


def _sums(spot: _Spot, mask: npt.NDArray[np.bool_], noise: float) -> tuple[float, float, float]:
    """Sums of squares of one spot's depth, of its products with the way, and of the way, all off the spot's plane."""
    depth, way = _plane(spot, mask, noise, spot.depth_mm)[mask], _plane(spot, mask, noise, spot.way_mm)[mask]
    return float(spot.depth_mm[mask] @ depth), float(spot.depth_mm[mask] @ way), float(spot.way_mm[mask] @ way)
