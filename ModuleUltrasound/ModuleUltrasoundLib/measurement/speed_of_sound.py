"""Speed of sound in the tissue from pressing harder and softer on the same spot: the tissue's thickness changes, the bone stays.

While the probe presses, its face moves along the beam by as much as the tissue gives way. The tracker measures that way in
millimetres, the echo in microseconds; the slope of one over the other is the speed of sound. Sliding over sloped bone while
pressing would pass for a change of thickness, so each spot's bone is a plane of unknown, small slope.
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
LEAST_RANGE_MM = 0.4  # of tissue depth at a spot, 10th to 90th percentile; less pressing tells nothing
SLOPE_SD = 0.05  # of the bone under a spot across the beam: an echo is seen only within some 3 degrees
LEAST_NOISE_MM = 0.03  # of a tracked position; never believe a better fit
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
    time_s: Array  # (n,) one-way time in the tissue along the mean beam
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
    Least squares of the probe's way on the echo's time, with an intercept and a slope of the bone a spot and one speed for
    all. The deviation is the larger of what the residuals say and of the spread of the spots' own estimates.
    """
    spots = _spots(recording, lines)
    if not spots:
        raise InputError(
            f"no spot was pressed hard and softly enough to tell the speed of sound: a spot needs {LEAST_FRAMES} good frames "
            f"over {LEAST_RANGE_MM} mm of thickness; hold the probe on one place and vary the pressure slowly"
        )
    noise = LEAST_NOISE_MM
    keep: list[npt.NDArray[np.bool_]] = [np.ones(len(spot.time_s), dtype=bool) for spot in spots]
    speed = lines.speed_of_sound_m_s
    sums: Array = np.zeros((0, 2))
    for _ in range(ROUNDS):
        sums = np.array([_sums(spot, mask, noise) for spot, mask in zip(spots, keep)])
        speed = float(sums[:, 0].sum() / sums[:, 1].sum()) * 1e-3
        rest = [_residual(spot, mask, noise, 1e3 * speed) for spot, mask in zip(spots, keep)]
        together = np.concatenate([r[mask] for r, mask in zip(rest, keep)])
        noise = max(MEDIAN_TO_SD * float(np.median(np.abs(together))), LEAST_NOISE_MM)
        keep = [np.abs(r) < OUTLIER_SDS * noise for r in rest]
    sd = noise / np.sqrt(float(sums[:, 1].sum())) * 1e-3
    if len(spots) >= LEAST_SPOTS_FOR_SCATTER:  # sandwich: what is common to a spot's frames does not average out
        off = sums[:, 0] - 1e3 * speed * sums[:, 1]
        sd = max(sd, float(np.sqrt((off**2).sum() * len(spots) / (len(spots) - 1)) / sums[:, 1].sum()) * 1e-3)
    prior_sd = lines.speed_of_sound_sd_m_s
    share = prior_sd**2 / (prior_sd**2 + sd**2)
    return SpeedEstimate(
        pressed_m_s=speed,
        pressed_sd_m_s=sd,
        speed_m_s=lines.speed_of_sound_m_s + share * (speed - lines.speed_of_sound_m_s),
        speed_sd_m_s=float(np.sqrt(share) * sd),
        spots=len(spots),
        frames=int(sum(mask.sum() for mask in keep)),
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
    time_s = depth * tilt / (1e3 * lines.speed_of_sound_m_s)
    return _Spot(time_s, -(skin - skin.mean(axis=0)) @ beam, side)


def _plane(spot: _Spot, mask: npt.NDArray[np.bool_], noise: float, values: Array) -> Array:
    """What remains of `values` when the spot's plane is fitted to those under `mask`, slopes held small by their prior."""
    design = np.column_stack([np.ones(len(values)), spot.side_mm])
    use = design[mask]
    ridge = np.diag([0.0, (noise / SLOPE_SD) ** 2, (noise / SLOPE_SD) ** 2])
    return np.asarray(values - design @ np.linalg.solve(use.T @ use + ridge, use.T @ values[mask]))


def _sums(spot: _Spot, mask: npt.NDArray[np.bool_], noise: float) -> tuple[float, float]:
    """Sums of the regression of one spot: time times way, and time squared, both off the spot's plane."""
    time_s = spot.time_s[mask]
    return float(time_s @ _plane(spot, mask, noise, spot.way_mm)[mask]), float(
        time_s @ _plane(spot, mask, noise, spot.time_s)[mask]
    )


def _residual(spot: _Spot, mask: npt.NDArray[np.bool_], noise: float, speed_mm_s: float) -> Array:
    return _plane(spot, mask, noise, spot.way_mm - speed_mm_s * spot.time_s)
