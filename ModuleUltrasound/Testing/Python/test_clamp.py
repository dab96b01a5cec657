"""Keeping clear of the head clamp, against the probe's axis cut into many points."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleUltrasoundLib.palpation.clamp import PROBE_LENGTH_MM, clear_of_clamp

FOOT, UP = np.array([[10.0, -20.0, 30.0]]), np.array([[0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("pin", "clear"),
    [
        ((29.9, 0, 0), False),
        ((30.1, 0, 0), True),
        ((29.9, 0, 100), False),  # beside the hand
        ((0, 0, 179.9), False),  # over its end
        ((0, 0, 180.1), True),
        ((0, 18, -23.9), False),  # the head bends away from the foot
        ((0, 18, -24.1), True),
    ],
)
def test_the_probe_is_a_rod_that_stands_on_the_bone(pin, clear):
    assert clear_of_clamp(FOOT, UP, FOOT + np.array([pin], dtype=float)).tolist() == [clear]


def test_without_known_points_of_the_clamp_nothing_is_in_the_way():
    assert clear_of_clamp(FOOT, UP, None).all()
    assert clear_of_clamp(FOOT, UP, np.empty((0, 3))).all()
    with pytest.raises(InputError, match="points on the clamp: number 1"):
        clear_of_clamp(FOOT, UP, [[0.0, np.nan, 0.0]])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(5.0, 80.0))
def test_every_pin_counts_for_every_place(seed, clearance_mm):
    rng = np.random.default_rng(seed)
    feet, pins, normals = rng.normal(0, 60, (6, 3)), rng.normal(0, 60, (3, 3)), rng.normal(size=(6, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    axis = feet[:, None] + np.linspace(0, PROBE_LENGTH_MM, 1501)[:, None] * normals[:, None]  # (6, 1501, 3)
    nearest = np.linalg.norm(axis[:, :, None] - pins, axis=3).min(axis=(1, 2))
    sure = np.abs(nearest - clearance_mm) > 0.01
    assert (clear_of_clamp(feet, normals, pins, clearance_mm) == (nearest >= clearance_mm))[sure].all()
