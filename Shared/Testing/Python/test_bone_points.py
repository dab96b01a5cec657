"""Bone points carry their uncertainty through frames and speeds of sound."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid_from_vector


@pytest.fixture
def ultrasound_points() -> BonePoints:
    return BonePoints(
        positions_mm=np.array([[0.0, 0, 6], [10, 0, 8]]),
        covariances_mm2=np.tile(np.diag([0.5, 0.5, 0.1]), (2, 1, 1)),
        beam_directions=np.array([[0.0, 0, 1], [0, 0, 1]]),
        depths_mm=np.array([6.0, 8.0]),
        qualities=np.array([0.9, 0.8]),
        labels=("1", "2"),
        speed_of_sound_m_s=1540.0,
        alternative_depths_mm=np.array([[3.0], [np.nan]]),
        alternative_probabilities=np.array([[0.1], [np.nan]]),
    )


def test_a_faster_medium_puts_the_bone_deeper_along_the_beam(ultrasound_points):
    faster = ultrasound_points.at_speed(1617.0)  # 5 % more
    np.testing.assert_allclose(faster.positions_mm, [[0, 0, 6.3], [10, 0, 8.4]])
    np.testing.assert_allclose(faster.depths_mm, [6.3, 8.4])
    assert faster.alternative_depths_mm[0, 0] == pytest.approx(3.15)
    np.testing.assert_allclose(faster.at_speed(1540.0).positions_mm, ultrasound_points.positions_mm)


def test_a_change_of_frame_turns_beams_and_covariances(ultrasound_points):
    moved = ultrasound_points.transformed(rigid_from_vector([0, np.pi / 2, 0], [1, 0, 0]))
    np.testing.assert_allclose(moved.beam_directions, [[1, 0, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(moved.covariances_mm2[0], np.diag([0.1, 0.5, 0.5]), atol=1e-12)
    np.testing.assert_allclose(moved.positions_mm[0], [7, 0, 0], atol=1e-12)


def test_a_subset_keeps_everything_aligned(ultrasound_points):
    second = ultrasound_points.subset([False, True])
    assert second.labels == ("2",)
    assert second.depths_mm.tolist() == [8.0]
    assert second.groups.tolist() == [1]


def test_stylus_points_have_no_beam_and_no_speed():
    points = BonePoints.palpated([[1, 2, 3]], sd_mm=0.3)
    assert not points.has_beam.any()
    with pytest.raises(InputError, match="not measured by ultrasound"):
        points.at_speed(1500)


def test_lists_of_unequal_length_are_refused(ultrasound_points):
    with pytest.raises(InputError, match=r"expected 1 labels"):
        BonePoints(**{**BonePoints.palpated([[1, 2, 3]], 0.3).__dict__, "labels": ("a", "b")})
    with pytest.raises(InputError, match=r"covariances_mm2 of shape \(1, 3, 3\)"):
        BonePoints(**{**BonePoints.palpated([[1, 2, 3]], 0.3).__dict__, "covariances_mm2": np.zeros((2, 3, 3))})
