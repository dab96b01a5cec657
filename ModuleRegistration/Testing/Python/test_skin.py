"""The skin surface: closed, outward, at the true edge."""

from __future__ import annotations

import numpy as np
import pytest
from ModuleRegistrationLib.anatomy.skin import skin_surface


def open_edges(triangles: np.ndarray) -> int:
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] % 2).sum())


def test_the_skin_of_a_shell_is_its_sphere(a_shell):
    skin = skin_surface(a_shell())
    radii = np.linalg.norm(skin.vertices_mm, axis=1)
    assert radii.mean() == pytest.approx(46, abs=0.15)
    assert radii.std() < 0.25
    assert open_edges(skin.triangles) == 0
    assert (np.einsum("ij,ij->i", skin.vertex_normals, skin.vertices_mm) > 0).all()


def test_the_sample_heads_skin_is_one_closed_surface(a_sample_head):
    skin = skin_surface(a_sample_head)
    assert open_edges(skin.triangles) == 0
    a, b, c = (skin.vertices_mm[skin.triangles[:, k]] for k in range(3))
    assert 2.9e6 < np.einsum("ij,ij->", a, np.cross(b, c)) / 6 < 3.5e6
