"""While a tool is being pivoted: to which sides it has been tilted, as numbers, in words and as a drawing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array

FEWEST_POSES = 20
SECTORS = 8
NEAR_DEG = (
    15.0  # a tilt counts for a side that it is so near to: less than half a sector, as the mean shifts from a side left out
)
ENOUGH_DEG = 20.0  # of tilt to each side; the calibration itself refuses below about 10
RIM_DEG = 40.0  # of the drawing
MOST_DOTS = 120
LEAST_LEVER_MM = 10.0  # below, the tracker gives the tip itself; a tool's +z points out of its tip
LONGEST_MM = 1000.0  # from the marker to the tip: a longer one comes of poses that hardly differ
SIDES = (
    "away from the camera",
    "away from the camera and to the right",
    "to the right",
    "towards the camera and to the right",
    "towards the camera",
    "towards the camera and to the left",
    "to the left",
    "away from the camera and to the left",
)  # right and left as the camera sees them


@dataclass(frozen=True, eq=False)
class TiltCoverage:
    """To which sides the tool was tilted, off the mean of its directions."""

    tilts_deg: Array  # (N, 2) right (as the camera sees it) and away from the camera, pose by pose
    reached_deg: Array  # (SECTORS,) farthest tilt to each of `SIDES`

    @property
    def covered(self) -> npt.NDArray[np.bool_]:
        """(SECTORS,) Whether the tool was tilted far enough to each side."""
        result: npt.NDArray[np.bool_] = self.reached_deg >= ENOUGH_DEG
        return result

    @property
    def advice(self) -> str:
        """What to do next, in words; "" when every side is covered."""
        return "" if self.covered.all() else f"tilt further {SIDES[int(np.argmin(self.reached_deg))]}"


def tilt_coverage(marker_to_reference: npt.ArrayLike, camera_mm: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Optional[TiltCoverage]:
    """Where a pivoting tool was tilted to; None while the poses are too few or too alike to tell its tip.

    Parameters
    ----------
    marker_to_reference : array-like, shape (N, 4, 4)
        Poses of the tool's marker, in a frame that does not move with it.
    camera_mm : array-like, shape (3,)
        Where the camera stands in that frame.
    """
    poses = np.asarray(marker_to_reference, dtype=float).reshape(-1, 4, 4)
    if len(poses) < FEWEST_POSES:
        return None
    found = _tip_and_pivot(poses)
    if found is None:
        return None
    tip, pivot = found
    length = float(np.linalg.norm(tip))
    out = tip / length if length > LEAST_LEVER_MM else np.array([0.0, 0.0, 1.0])
    upright = -(poses[:, :3, :3] @ out)  # from the tip to the marker
    mean = upright.mean(axis=0)
    mean /= np.linalg.norm(mean)
    away = pivot - np.asarray(camera_mm, dtype=float)
    away = away - mean * (mean @ away)
    if np.linalg.norm(away) < 1e-6:  # the tool points at the camera: any direction serves
        away = np.cross(mean, np.eye(3)[int(np.argmin(np.abs(mean)))])
    away /= np.linalg.norm(away)
    right = np.cross(away, mean)
    angle = np.degrees(np.arccos(np.clip(upright @ mean, -1, 1)))
    across = np.stack([upright @ right, upright @ away], axis=1)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    tilts = across * angle[:, None]
    bearings = 2 * np.pi / SECTORS * np.arange(SECTORS)
    along = across @ np.stack([np.sin(bearings), np.cos(bearings)])  # (N, SECTORS)
    reached = np.where(along > np.cos(np.radians(NEAR_DEG)), angle[:, None], 0.0).max(axis=0)
    return TiltCoverage(tilts, reached)


def draw_coverage(coverage: TiltCoverage) -> str:
    """The sides covered (filled), the tool's way so far and its present tilt, as an SVG of 220 by 220."""
    middle, scale = 110.0, 88.0 / RIM_DEG
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" width="220" height="220" viewBox="0 0 220 220">',
        f'<circle cx="110" cy="110" r="{RIM_DEG * scale:.1f}" fill="#10151b" stroke="#78909c"/>',
    ]
    parts += [_wedge(index, ENOUGH_DEG * scale) for index in np.flatnonzero(coverage.covered)]
    parts.append(f'<circle cx="110" cy="110" r="{ENOUGH_DEG * scale:.1f}" fill="none" stroke="#cfd8dc" stroke-dasharray="4 4"/>')
    shown = coverage.tilts_deg[:: max(1, len(coverage.tilts_deg) // MOST_DOTS)]
    places = np.clip(shown, -RIM_DEG, RIM_DEG) * (scale, -scale) + middle
    parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2" fill="#6cb8f0"/>' for x, y in places]
    x, y = np.clip(coverage.tilts_deg[-1], -RIM_DEG, RIM_DEG) * (scale, -scale) + middle
    parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="#f0b429" stroke="#10151b" stroke-width="2"/>')
    text = 'text-anchor="middle" fill="#cfd8dc" font-size="14" font-family="sans-serif"'
    parts.append(f'<text x="110" y="14" {text}>away from the camera</text><text x="110" y="216" {text}>camera</text></svg>')
    return "".join(parts)


def _tip_and_pivot(poses: Array) -> Optional[tuple[Array, Array]]:
    """Tip in the marker's frame and pivot, (3,) each: the algebraic step alone, good enough to show a direction."""
    design = np.concatenate([poses[:, :3, :3], np.broadcast_to(-np.eye(3), (len(poses), 3, 3))], axis=2).reshape(-1, 6)
    solution, _, rank, _ = np.linalg.lstsq(design, -poses[:, :3, 3].reshape(-1), rcond=1e-4)
    length = float(np.linalg.norm(solution[:3]))
    if rank < 6 or length > LONGEST_MM:
        return None
    return solution[:3], solution[3:]


def _wedge(index: int, radius: float) -> str:
    """One side as a piece of the disc; the first is at the top, the others follow clockwise."""
    edges = (np.array([index - 0.5, index + 0.5])) * 2 * np.pi / SECTORS
    (x0, y0), (x1, y1) = np.stack([110 + radius * np.sin(edges), 110 - radius * np.cos(edges)], axis=1)
    return (
        f'<path d="M110 110L{x0:.1f} {y0:.1f}A{radius:.1f} {radius:.1f} 0 0 1 {x1:.1f} {y1:.1f}Z" fill="#2fbf8f" opacity="0.55"/>'
    )
