"""Landmarks on the outside of the head and in it, on a shell of bone with scalp whose distances are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.anatomy.landmark_places import (
    counterpart,
    landmark_places,
    nearest_outside,
    on_wrong_side,
    side_of,
)

OUTER_MM, INNER_MM, SKIN_MM = 70.0, 63.0, 78.0
UP, OBLIQUE = np.array([0.0, 0, 1]), np.array([2.0, 3, 6]) / 7
HOLDER = np.array([0.0, 130, 0])


def sphere(radius: float, resolution: int = 120) -> Surface:
    from vtkmodules.vtkFiltersSources import vtkSphereSource

    source = vtkSphereSource()
    source.SetRadius(radius)
    source.SetThetaResolution(resolution)
    source.SetPhiResolution(resolution)
    source.Update()
    return Surface.from_polydata(source.GetOutput())


@pytest.fixture(scope="module")
def a_shell_of_bone() -> Surface:
    """Outer and inner table, with a hole of 15 mm radius at the bottom, as where the spinal cord leaves."""
    outer, inner = sphere(OUTER_MM), sphere(INNER_MM)
    vertices = np.concatenate([outer.vertices_mm, inner.vertices_mm])
    triangles = np.concatenate([outer.triangles, inner.triangles[:, ::-1] + len(outer.vertices_mm)])
    middles = vertices[triangles].mean(axis=1)
    return Surface(vertices, triangles[(np.hypot(*middles.T[:2]) > 15) | (middles[:, 2] > 0)])


@pytest.fixture(scope="module")
def a_ct() -> Volume:
    """The shell in its scalp, air around it, and a bar of a holder 50 mm in front of it; the neck is cut off below."""
    low, step = np.array([-100.0, -100, -46]), 2.0
    k, j, i = np.mgrid[:75, :130, :100]
    places = low + step * np.stack([i, j, k], axis=-1)
    hu = np.where(np.linalg.norm(places, axis=-1) < SKIN_MM, 40, -1000)
    hu[np.linalg.norm(places - HOLDER, axis=-1) < 8] = 300
    matrix = np.diag([step, step, step, 1.0])
    matrix[:3, 3] = low
    return Volume(hu.astype(np.int16), matrix)


@pytest.mark.parametrize("direction", [UP, OBLIQUE])
@pytest.mark.parametrize("depth", [0.0, 3.0])
def test_a_landmark_on_the_bone_or_on_the_skin_is_none_to_doubt(a_shell_of_bone, a_ct, direction, depth):
    points = np.stack([(OUTER_MM - depth) * direction, (OUTER_MM + depth) * direction, (SKIN_MM - depth) * direction])
    found = landmark_places(a_shell_of_bone, a_ct, points)
    assert not found.doubtful.any()
    np.testing.assert_allclose(found.bone_mm, [depth, depth, SKIN_MM - depth - OUTER_MM], atol=1.0)
    np.testing.assert_allclose(found.skin_mm[2], depth, atol=2.5)  # voxels of 2 mm


@pytest.mark.parametrize("radius", [INNER_MM, 50.0, 30.0])
def test_a_landmark_in_the_head_is_doubted_with_its_distance(a_shell_of_bone, a_ct, radius):
    """On the inner table, too, which is bone, but which the hole at the bottom alone shows to the outside."""
    found = landmark_places(a_shell_of_bone, a_ct, radius * UP)
    assert found.doubtful.all()
    assert found.bone_mm[0] == pytest.approx(OUTER_MM - radius, rel=0.08)  # it is told as under a flat surface
    assert found.off_mm[0] == found.bone_mm[0]
    assert nearest_outside(a_shell_of_bone, a_ct, radius * UP) == pytest.approx(OUTER_MM * UP, abs=0.12 * (OUTER_MM - radius))


def test_a_landmark_on_a_holder_or_where_the_ct_ends_is_doubted(a_shell_of_bone, a_ct):
    found = landmark_places(a_shell_of_bone, a_ct, [HOLDER, (20.0, 20, -44), (0.0, 300, 0)])
    assert found.doubtful.all()
    np.testing.assert_allclose(found.bone_mm, [HOLDER[1] - OUTER_MM, OUTER_MM - np.sqrt(2736), 300 - OUTER_MM], rtol=0.12)


def test_without_a_ct_the_bone_alone_tells(a_shell_of_bone):
    found = landmark_places(a_shell_of_bone, None, [OUTER_MM * UP, SKIN_MM * UP, 40 * UP])
    assert found.doubtful.tolist() == [False, True, True]
    assert not np.isfinite(found.skin_mm).any()


@pytest.mark.parametrize(
    ("label", "side"),
    [("Left frontozygomatic", "left"), ("tragus_R", "right"), ("Tragus (L)", "left"), ("Nasion", ""), ("Alright", "")],
)
def test_a_name_says_its_side_by_a_word_of_its_own(label, side):
    assert side_of(label) == side


def test_counterparts_differ_by_the_side_alone():
    labels = ("Left tragus", "right Tragus", "Right orbit", "Nasion")
    assert counterpart("Left tragus", labels) == "right Tragus"
    assert counterpart("Right orbit", labels) == counterpart("Nasion", labels) == ""


def test_left_and_right_exchanged_are_both_named_and_a_turned_head_is_not():
    labels = ("Nasion", "Left tragus", "Right tragus")
    right = [(0.0, 90, 0), (-70.0, 0, 0), (70.0, 0, 0)]
    assert on_wrong_side(labels, right, 0.0) == ()
    assert on_wrong_side(labels, np.add(right, (90.0, 0, 0)), 0.0) == (), "the head lies beside the scanner's middle"
    assert on_wrong_side(labels, [right[0], right[2], right[1]], 0.0) == labels[1:]


def test_a_landmark_without_counterpart_is_held_to_the_heads_middle():
    assert on_wrong_side(("Left tragus",), [(50.0, 0, 0)], 0.0) == ("Left tragus",)
    assert on_wrong_side(("Left tragus", "R orbit"), [(5.0, 0, 0), (-5.0, 0, 0)], 0.0) == (), "heads are not symmetric"
