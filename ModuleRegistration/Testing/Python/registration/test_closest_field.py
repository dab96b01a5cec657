import numpy as np
import pytest
from CranioNavLib.surface import Surface
from ModuleRegistrationLib.registration.closest_field import find_feet, find_feet_on_planes

PLATE = Surface(np.array([[0.0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))


def test_distance_is_positive_outside_and_negative_inside(a_skull: Surface) -> None:
    middle = a_skull.vertices_mm[a_skull.triangles[:50]].mean(axis=1)
    normals = a_skull.triangle_normals[:50]
    for height in (0.4, -0.4):
        assert find_feet(a_skull, middle + height * normals).distances_mm == pytest.approx(height, abs=0.05)


def test_a_point_beyond_the_rim_is_as_far_as_the_rim() -> None:
    feet = find_feet(PLATE, np.array([[23.0, 10, 0.5], [10, 10, 0.5]]))
    assert np.abs(feet.distances_mm) == pytest.approx([np.hypot(3, 0.5), 0.5], rel=1e-5)
    assert feet.at_edge.tolist() == [True, False]


def test_the_direction_is_the_gradient_of_the_distance(a_skull: Surface) -> None:
    points = a_skull.vertices_mm[a_skull.triangles[2000:2060]].mean(axis=1) * 1.02
    feet = find_feet(a_skull, points)
    slopes = [
        (find_feet(a_skull, points + step).distances_mm - find_feet(a_skull, points - step).distances_mm) / 0.02
        for step in np.eye(3) * 0.01
    ]
    assert np.einsum("ij,ij->i", np.array(slopes).T, feet.directions) == pytest.approx(1, abs=0.03)


def test_planes_find_nearly_the_exact_distance(a_skull: Surface) -> None:
    rng = np.random.default_rng(4)
    chosen = a_skull.triangles[rng.choice(len(a_skull.triangles), 200, replace=False)]
    points = a_skull.vertices_mm[chosen].mean(axis=1) + rng.normal(0, 2, (200, 3))
    exact, quick = find_feet(a_skull, points), find_feet_on_planes(a_skull, points)
    over_bone = ~exact.at_edge & ~quick.at_edge
    assert over_bone.mean() > 0.9
    assert np.mean(np.abs(exact.distances_mm - quick.distances_mm)[over_bone]) < 0.15
