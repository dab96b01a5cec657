"""Turning the head in 3-D, and making it larger, by keys: as dragging and the wheel do."""

from __future__ import annotations

from typing import Any

import numpy as np

STEEPEST = np.radians(85.0)  # of the eye over the head's middle; straight above it nothing is up on the screen


def turn(camera: Any, right_deg: float, up_deg: float) -> None:
    """Let a VTK camera go round what it looks at: to its right, and up; RAS's S stays upright on the screen."""
    middle = np.array(camera.GetFocalPoint())
    sight = np.array(camera.GetPosition()) - middle
    far = float(np.linalg.norm(sight))
    height = np.clip(np.arcsin(sight[2] / far) + np.radians(up_deg), -STEEPEST, STEEPEST)
    around = np.arctan2(sight[1], sight[0]) + np.radians(right_deg)
    level = np.cos(height)
    camera.SetPosition(*(middle + far * np.array([level * np.cos(around), level * np.sin(around), np.sin(height)])))
    camera.SetViewUp(0.0, 0.0, 1.0)


def come_nearer(camera: Any, factor: float) -> None:
    """What a VTK camera looks at becomes so many times as large."""
    if camera.GetParallelProjection():
        camera.SetParallelScale(camera.GetParallelScale() / factor)
    else:
        middle = np.array(camera.GetFocalPoint())
        camera.SetPosition(*(middle + (np.array(camera.GetPosition()) - middle) / factor))


def enlarge_slice(node: Any, factor: float) -> None:
    """What a slice node's view shows becomes so many times as large; its middle stays."""
    across, up, deep = node.GetFieldOfView()
    node.SetFieldOfView(across / factor, up / factor, deep)
