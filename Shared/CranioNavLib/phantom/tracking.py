"""The error of an optical tracker: what it reports for tools whose true poses are known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from CranioNavLib.phantom import constants
from CranioNavLib.rigid import Array, check_points, rigid, rigid_from_vector

STANDING_SHARE = float(np.sqrt(1 - constants.TRACKER_JITTER_SHARE**2))
SOURCES = 2  # the tool, and the reference base against which it is expressed


@dataclass(frozen=True, eq=False)
class TrackerError:
    """Noise of poses expressed in the reference base's frame. Camera axes: x, y across, z is depth."""

    camera_to_reference: Array  # (3, 3) rotation

    def of_points(self, points_mm: npt.ArrayLike, rng: np.random.Generator) -> Array:
        """Points (N, 3) in Reference as a tracked tip measures them, one independent measurement each."""
        points = check_points(points_mm)
        poses = rigid(np.broadcast_to(np.eye(3), (len(points), 3, 3)), points)
        measured: Array = self.of_poses(poses, rng, np.arange(len(points)))[:, :3, 3]
        return measured

    def of_poses(self, tool_to_reference: npt.ArrayLike, rng: np.random.Generator, groups: npt.ArrayLike) -> Array:
        """Poses (F, 4, 4) in Reference as the tracker reports them.

        Most of the error stands still while a tool is held in one place (`groups` (F,) says which frames belong
        together); the rest changes from frame to frame.
        """
        poses = np.asarray(tool_to_reference, dtype=float)
        _, group = np.unique(np.asarray(groups), return_inverse=True)
        count = int(group.max()) + 1 if len(group) else 0
        for source in range(SOURCES):
            standing, moving = draw_error(rng, count), draw_error(rng, len(poses))
            drawn = STANDING_SHARE * standing[group] + constants.TRACKER_JITTER_SHARE * moving
            turn, shift = drawn[:, :3], drawn[:, 3:] @ self.camera_to_reference.T
            if source == 0:  # the tool turns about its own marker frame, a lever away from its tip
                pivots = poses[:, :3, 3] - poses[:, :3, 2] * constants.TOOL_ORIGIN_OFFSET_MM
                poses = _moved(poses, turn, shift, pivots)
            else:  # the reference base turns about itself: the origin of its frame
                poses = _moved(poses, turn, shift, np.zeros((len(poses), 3)))
        return poses


def draw_error(rng: np.random.Generator, count: int) -> Array:
    """(count, 6) errors of one source in the camera's axes: rotation vector (rad), then shift (mm)."""
    lateral, depth = constants.TRACKER_LATERAL_SD_MM, constants.TRACKER_DEPTH_SD_MM
    turn = constants.TRACKER_ROTATION_SD_RAD
    drawn: Array = rng.normal(size=(count, 6)) * (turn, turn, turn, lateral, lateral, depth)
    return drawn


def disturb(poses: Array, errors: Array, pivots: Array) -> Array:
    """Poses (F, 4, 4) as seen with errors (F, 6), whose rotation is about `pivots` (F, 3)."""
    return _moved(poses, errors[:, :3], errors[:, 3:], pivots)


def _moved(poses: Array, turns: Array, shifts: Array, pivots: Array) -> Array:
    moved = rigid_from_vector(turns, np.zeros(3))
    moved[:, :3, 3] = shifts + pivots - np.einsum("fij,fj->fi", moved[:, :3, :3], pivots)
    result: Array = moved @ poses
    return result
