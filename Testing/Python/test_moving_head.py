"""Head and reference base move while the surgeon palpates; the registration must not."""

from __future__ import annotations

import queue
import time

import numpy as np
import pytest
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.rigid import Array, invert_rigid, rigid, transform_points
from CranioNavLib.sequence_metafile import Acquisition, read_recording
from CranioNavLib.surface import Surface
from ModuleRegistrationLib.registration.problem import METHODS, RegistrationProblem
from ModuleTrackingLib.pose_stream import PoseStream
from ModuleTrackingLib.recorder import SessionRecorder
from ModuleTrackingLib.tracker import PoseStatus, ToolInfo, ToolPose, Tracker
from scipy.spatial.transform import Rotation

TRUE_REFERENCE_TO_RAS = rigid(Rotation.from_rotvec([0.2, -0.4, 0.3]).as_matrix(), [12.0, -30, 25])
POINTS, DWELL = 18, 12  # points of the protocol, tracker frames at each
START = 1000.0


def a_skull() -> Surface:
    """An ellipsoid with bumps, so that no turn of it fits as well as the right one."""
    polar, azimuth = np.meshgrid(
        np.linspace(0.02, np.pi - 0.02, 60), np.linspace(0, 2 * np.pi, 120, endpoint=False), indexing="ij"
    )
    radius = 1 + 0.05 * np.sin(3 * azimuth) * np.sin(polar) ** 2 + 0.04 * np.cos(2 * polar + azimuth)
    directions = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    vertices = (directions * radius[..., None] * [75, 95, 85]).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(59), np.arange(120), indexing="ij")
    a, b = row * 120 + column, row * 120 + (column + 1) % 120
    triangles = np.concatenate([np.stack([a, a + 120, b], axis=-1), np.stack([b, a + 120, b + 120], axis=-1)]).reshape(-1, 3)
    return Surface(vertices, triangles)


def moving_base(time_s: float) -> Array:
    """20 mm and 8 degrees of drift, with a breathing motion on top."""
    seconds = time_s - START
    shift = np.array([20 * seconds / 4, 3 * np.sin(2 * np.pi * seconds / 3), -1500 + 5 * seconds])
    return rigid(Rotation.from_rotvec([0.14 * seconds / 4, 0.02 * np.sin(2 * seconds), 0.3]).as_matrix(), shift)


def still_base(time_s: float) -> Array:
    return moving_base(START)


class QueueTracker(Tracker):
    """Gives the frames that were put."""

    name = "queue"

    def __init__(self, frames: list[list[ToolPose]]) -> None:
        super().__init__()
        self.frames: queue.Queue[list[ToolPose]] = queue.Queue()
        for frame in frames:
            self.frames.put(frame)

    def open(self) -> None:
        pass

    def start(self) -> None:
        pass

    def read(self, timeout_s: float = 1.0) -> list[ToolPose]:
        try:
            return self.frames.get(timeout=0.01)
        except queue.Empty:
            return []

    def stop(self) -> None:
        pass

    def close(self) -> None:
        pass

    @property
    def tools(self) -> list[ToolInfo]:
        return []


def palpated(base_to_tracker, targets_mm: Array, tmp_path) -> Array:
    """Points (18, 3) in Reference, by way of tracker, stream, recorder and file; lines come between the tracker's frames."""
    frames = []
    for k in range(POINTS * DWELL):
        time_s = START + k / 60
        base = base_to_tracker(time_s)
        probe = rigid(Rotation.from_rotvec([0.1 * (k // DWELL), 0.3, 0]).as_matrix(), targets_mm[k // DWELL])
        frames.append(
            [
                ToolPose("Probe", base @ probe, PoseStatus.OK, time_s, error_mm=0.1),
                ToolPose("Reference", base, PoseStatus.OK, time_s, error_mm=0.1),
            ]
        )
    with PoseStream(QueueTracker(frames), queue_frames=10_000, clock=lambda: START + 60) as stream:
        count, deadline = 0, time.monotonic() + 20
        while count < len(frames):
            count += len(stream.poll())
            assert time.monotonic() < deadline
        recorder = SessionRecorder(tmp_path / "p.igs.mha", stream, Acquisition(50e6, 5e6), 4, clock=lambda: START)
        with recorder:
            for point in range(POINTS):
                for step in range(DWELL - 2):
                    at_s = START + (point * DWELL + step + 0.37) / 60
                    recorder.add_line(np.zeros(4, dtype=np.int16), at_s, palpation_point=point)
    recording = read_recording(tmp_path / "p.igs.mha")
    assert set(recording.statuses) == {"OK"}
    tips = recording.probe_to_reference[:, :3, 3]
    return np.stack([tips[recording.palpation_points == point].mean(axis=0) for point in range(POINTS)])


@pytest.mark.parametrize("method", ["icp", "cranionav"])
def test_head_and_base_move_during_palpation_and_the_registration_does_not(method, tmp_path):
    skull = a_skull()
    rng = np.random.default_rng(3)
    on_bone = skull.vertices_mm[rng.choice(len(skull.vertices_mm), POINTS, replace=False)]
    targets_mm = transform_points(invert_rigid(TRUE_REFERENCE_TO_RAS), on_bone)
    still, moving = (palpated(base, targets_mm, tmp_path) for base in (still_base, moving_base))
    np.testing.assert_allclose(still, targets_mm, atol=1e-6)
    np.testing.assert_allclose(moving, targets_mm, atol=0.02)  # between frames the base's path is taken for straight

    first = rigid(Rotation.from_rotvec([0.01, 0.015, -0.01]).as_matrix(), [1.0, -1, 0.5]) @ TRUE_REFERENCE_TO_RAS
    found = []
    for points_mm in (still, moving):
        problem = RegistrationProblem(skull, BonePoints.palpated(points_mm, 0.3), first)
        found.append(METHODS.create(method).register(problem).reference_to_ras)
    moved = transform_points(found[0], targets_mm) - transform_points(found[1], targets_mm)
    assert np.linalg.norm(moved, axis=1).max() < 0.05
