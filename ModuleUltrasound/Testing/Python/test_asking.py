"""The points of the protocol while they are palpated: how far each is, for the drawings of both faces."""

from __future__ import annotations

import time

import numpy as np
import pytest
from CranioNavLib import scene_data
from CranioNavLib.slicer_files import LabelledPoints
from ModuleUltrasoundLib.live_drawings import PointState
from ModuleUltrasoundLib.palpation.palpation import Palpation, PalpationLine

TAKEN, NOW, OPEN = PointState.TAKEN, PointState.NOW, PointState.OPEN


@pytest.fixture
def a_palpating_logic(a_logic):
    """Without a device: five planned points, and the palpation of them has begun."""
    normals = np.tile([0.0, 0.0, 1.0], (5, 1))
    node = scene_data.set_points(
        "ProtocolPoints", LabelledPoints(tuple("abcde"), 30.0 * np.eye(5, 3) + [[0, 0, k] for k in range(5)])
    )
    for axis, name in enumerate(("Normal_R", "Normal_A", "Normal_S")):
        scene_data.add_measurement(node, name, normals[:, axis])
    a_logic.goTo(0)
    a_logic.palpation = Palpation(tuple("abcde"))
    yield a_logic
    a_logic.palpation = None


def take(logic):
    """A dwell on the point that is asked for."""
    position = 50.0 * np.array([logic.currentIndex(), 1.0, 2.0])
    for moment in time.monotonic() + np.arange(13) / 20:
        logic.palpation.add(PalpationLine(moment, True, 0.95, "", position, np.eye(3), np.array([0.0, 0.0, -1.0]), 5.0))
    logic.askNext()


def test_points_are_taken_asked_for_or_open(a_palpating_logic):
    logic = a_palpating_logic
    assert logic.pointStates() == [NOW, OPEN, OPEN, OPEN, OPEN]
    take(logic)
    logic.nextPoint()
    take(logic)
    assert logic.pointStates() == [TAKEN, OPEN, TAKEN, NOW, OPEN]
    assert logic.pointsDrawn().count("<circle") == 5


def test_the_last_point_taken_leaves_none_that_is_asked_for(a_palpating_logic):
    for _ in range(5):
        take(a_palpating_logic)
    assert a_palpating_logic.pointStates() == [TAKEN] * 5


def test_before_the_recording_all_are_open_and_after_it_none_is_drawn(a_palpating_logic):
    logic = a_palpating_logic
    logic.palpation = None
    assert logic.pointStates() == [NOW, OPEN, OPEN, OPEN, OPEN]
    scene_data.set_points("SurfacePoints", LabelledPoints(("S1",), np.ones((1, 3))))
    assert logic.pointStates() == []
    assert logic.pointsDrawn() is None


def test_while_the_probe_glides_no_point_is_asked_for(a_palpating_logic):
    a_palpating_logic.palpation, a_palpating_logic.sweep = None, object()
    assert a_palpating_logic.pointStates() == []
    a_palpating_logic.sweep = None
