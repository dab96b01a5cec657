"""The true head: closed surfaces, nothing but the head, and where the CT's shape says they are."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.phantom import make_patient
from CranioNavLib.phantom.anatomy import extract_head
from CranioNavLib.phantom.synthetic_head import SCALP_BUMPS, SCALP_MM, _bumps, _radius
from CranioNavLib.volume import Volume


@pytest.fixture(scope="module")
def a_patient():
    return make_patient(None, 0)


def open_edges(surface):
    edges = np.sort(surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return int((counts != 2).sum())


@pytest.mark.parametrize("part", ["bone", "skin"])
def test_the_surfaces_are_closed_with_outward_normals(a_patient, part):
    surface = getattr(a_patient, part)
    assert open_edges(surface) == 0
    assert surface.signed_distance([[0.0, 0.0, 300.0]])[0] > 0
    outermost = surface.vertices_mm[:, 2].argmax()
    assert surface.vertex_normals[outermost, 2] > 0.9


def test_bone_and_skin_lie_where_the_synthetic_head_was_drawn(a_patient):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = 250.0 * directions
    for surface, drawn in (
        (a_patient.bone, _radius(directions)),
        (a_patient.skin, _radius(directions) + SCALP_MM + _bumps(directions, SCALP_BUMPS)),
    ):
        found = 250.0 - surface.cast(origins, -directions).distances_mm
        # a threshold below half way lies outside the drawn edge, by a fraction of the blur
        assert abs(np.median(found - drawn)) < 0.6
        assert np.percentile(np.abs(found - drawn - np.median(found - drawn)), 95) < 0.5


def test_the_head_holder_is_left_out(a_patient):
    holder = a_patient.scanned.volume.hu > 100
    assert (holder & ~a_patient.scanned.head.head_mask).sum() > 1000  # there is one in the CT
    assert np.linalg.norm(a_patient.skin.vertices_mm[:, :2], axis=1).max() < 111.0


def test_all_bone_is_under_skin(a_patient):
    some = a_patient.bone.vertices_mm[::50]
    assert a_patient.skin.signed_distance(some).max() < 0


def test_a_ct_without_a_head_is_refused():
    with pytest.raises(InputError, match="holds no body"):
        extract_head(Volume(np.full((30, 30, 30), -1000, dtype=np.int16), np.eye(4)))
    small = np.full((40, 40, 40), -1000, dtype=np.int16)
    small[10:30, 10:30, 10:30] = 1000
    with pytest.raises(InputError, match="smaller than half a litre"):
        extract_head(Volume(small, np.eye(4)))
