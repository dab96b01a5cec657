"""Spin calibration: the axis of a tool that is turned about itself, e.g. a stylus rolled in its divot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
import scipy
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, rigid

from ModuleTrackingLib.calibration.pivot import FEWEST_POSES, _checked

LEAST_TURN_DEG = 90.0  # below, the axis is drawn towards the mean rotation's own error
MOST_WOBBLE_DEG = 5.0  # RMS; more means that the tool was tilted, not rolled
OUTLIER_SDS = 4.0


@dataclass(frozen=True, eq=False)
class SpinCalibration:
    """The tool's axis, with what is known of its error."""

    axis_in_marker: Array  # (3,) unit; towards the tip where the tip is known
    sd_deg: float  # SD of the axis' direction, per axis across it
    wobble_deg: float  # RMS angle of the axis about its mean while it was turned
    turned_deg: float  # how far the tool was turned
    used: npt.NDArray[np.bool_]  # (N,)


def calibrate_spin(marker_to_frame: npt.ArrayLike, tip_in_marker_mm: Optional[npt.ArrayLike] = None) -> SpinCalibration:
    """The direction that stays fixed while a tool is turned about its own axis.

    Parameters
    ----------
    marker_to_frame : array-like, shape (N, 4, 4), N >= 20
        Poses of the marker, in a frame in which the axis rests.
    tip_in_marker_mm : array-like, shape (3,), optional
        Settles the axis' sense: it points from the marker's origin to the tip.

    Raises
    ------
    InputError
        Too few poses, turned by less than 90 deg, or tilted meanwhile.

    Notes
    -----
    The axis maximises |mean(R) a|: it is the right singular vector of the mean rotation's largest singular value.
    """
    poses = _checked(marker_to_frame)
    used: npt.NDArray[np.bool_] = np.ones(len(poses), dtype=bool)
    for _ in range(20):
        axis, still = _axis(poses[used])
        wobble = np.arccos(np.clip(poses[:, :3, :3] @ axis @ still, -1, 1))
        again = wobble <= OUTLIER_SDS * max(float(np.median(wobble[used])) / 1.1774, 1e-6)  # median of a Rayleigh number
        if np.array_equal(again, used) or again.sum() < FEWEST_POSES:
            break
        used = again
    turned = _turned_deg(poses[used], axis)
    rms = float(np.degrees(np.sqrt(np.mean(wobble[used] ** 2))))
    if turned < LEAST_TURN_DEG:
        raise InputError(f"the tool was turned by {turned:.0f} deg about its axis; turn it by more than {LEAST_TURN_DEG:.0f} deg")
    if rms > MOST_WOBBLE_DEG:
        raise InputError(f"the axis wobbled by {rms:.1f} deg; keep the tool upright and only turn it")
    if tip_in_marker_mm is not None and axis @ np.asarray(tip_in_marker_mm, dtype=float) < 0:
        axis = -axis
    return SpinCalibration(axis, rms / np.sqrt(2) / _effective(poses[used]), rms, turned, used)


def tool_to_marker(tip_in_marker_mm: npt.ArrayLike, axis_in_marker: npt.ArrayLike) -> Array:
    """Frame with its origin at the tip and +z along the axis; x as near to the marker's x as can be. (4, 4) mm."""
    z = np.asarray(axis_in_marker, dtype=float)
    z = z / np.linalg.norm(z)
    guide = np.eye(3)[0] if abs(z[0]) < 0.9 else np.eye(3)[1]
    x = guide - z * (guide @ z)
    x /= np.linalg.norm(x)
    return rigid(np.column_stack([x, np.cross(z, x), z]), tip_in_marker_mm)


def _axis(poses: Array) -> tuple[Array, Array]:
    """Axis in the marker and in the frame of the poses."""
    left, _, right = np.linalg.svd(poses[:, :3, :3].mean(axis=0))
    return right[0], left[:, 0]


def _turned_deg(poses: Array, axis: Array) -> float:
    """Angle between the two farthest neighbours' complement: how much of the circle was covered."""
    relative = scipy.spatial.transform.Rotation.from_matrix(poses[0, :3, :3].T @ poses[:, :3, :3]).as_quat()
    angles = np.sort(np.degrees(2 * np.arctan2(relative[:, :3] @ axis, relative[:, 3])) % 360)
    gaps = np.diff(np.append(angles, angles[0] + 360))
    return float(360 - gaps.max())


def _effective(poses: Array) -> float:
    """Root of the number of independent poses, weighed by how far the rotations differ: the axis' gain."""
    singular = np.linalg.svd(poses[:, :3, :3].mean(axis=0), compute_uv=False)
    return float(np.sqrt(len(poses)) * max(1 - singular[1], 1e-6))
