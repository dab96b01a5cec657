"""Proposed landmarks: where a reader of the CT would put them, whichever way the head is turned."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.surface import Surface
from ModuleRegistrationLib.anatomy.landmark_suggestions import LABELS, suggest_landmarks
from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces
from ModuleRegistrationLib.plugins.threshold import ThresholdSegmentation
from scipy.spatial.transform import Rotation

# Read off the sample head's slices and its surface by eye, RAS, to about 3 mm (the sutures' height to about 6 mm)
READ_OFF_MM = np.array([[-2.6, 78.9, -12.4], [-49.3, 57.4, -19.6], [46.7, 57.8, -20.3], [-3.0, 84.1, -57.9]])


@pytest.fixture(scope="module")
def head_bone(a_sample_head) -> BoneSurfaces:
    return ThresholdSegmentation().segment(a_sample_head)


def moved(bone: BoneSurfaces, turn: np.ndarray, shift: np.ndarray) -> BoneSurfaces:
    surfaces = {
        name: Surface(getattr(bone, name).vertices_mm @ turn.T + shift, getattr(bone, name).triangles)
        for name in ("closed", "outer_table")
    }
    return dataclasses.replace(bone, **surfaces)


def test_the_sample_heads_landmarks_are_proposed_where_they_are(head_bone):
    found = suggest_landmarks(head_bone)
    assert found.labels == LABELS
    errors = np.linalg.norm(found.positions_ras_mm - READ_OFF_MM, axis=1)
    print("from the places read off by eye:", errors.round(1), "mm")
    assert (errors < 2 * found.sd_mm).all()


@pytest.mark.parametrize(
    "angles_deg",
    [(-12, 0, 0), (8, 6, -10), *(pytest.param(a, marks=pytest.mark.slow) for a in ((12, 0, 0), (0, 10, 0), (0, 0, -12)))],
)
def test_a_turned_head_gets_the_same_landmarks(head_bone, angles_deg):
    turn = Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix()
    shift = np.array([40.0, -25.0, 900.0])
    straight = suggest_landmarks(head_bone)
    turned = suggest_landmarks(moved(head_bone, turn, shift))
    errors = np.linalg.norm(turned.positions_ras_mm - (straight.positions_ras_mm @ turn.T + shift), axis=1)
    assert (errors < straight.sd_mm).all()


def test_a_vault_without_a_face_is_refused(head_bone):
    vertices = head_bone.closed.vertices_mm
    parts = {}
    for name in ("closed", "outer_table"):
        surface = getattr(head_bone, name)
        high = (surface.vertices_mm[surface.triangles, 2] > vertices[:, 2].max() - 70).all(axis=1)
        parts[name] = Surface(surface.vertices_mm, surface.triangles[high])
    with pytest.raises(InputError, match="place the landmarks by hand"):
        suggest_landmarks(dataclasses.replace(head_bone, **parts))
