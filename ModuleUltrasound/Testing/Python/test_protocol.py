"""The 18 points: in their regions, on bone, where a probe can stand, and together holding all six degrees of freedom."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import invert_rigid, rigid_from_vector, transform_directions, transform_points
from CranioNavLib.surface import Surface
from ModuleUltrasoundLib.palpation.clamp import clear_of_clamp
from ModuleUltrasoundLib.palpation.footprint import probe_footprint
from ModuleUltrasoundLib.palpation.head_frame import LANDMARK_LABELS
from ModuleUltrasoundLib.palpation.protocol import REGIONS, plan_protocol

COUNTS = {"Left lateral": 3, "Right lateral": 3, "Frontal convexity": 4, "Forehead": 4, "Periorbital": 4}
# Nasion at the origin of the head built below
LANDMARKS = np.array([[0.0, 0.0, 0.0], [-48.0, -14.0, 2.0], [48.0, -14.0, 2.0], [0.0, 2.0, -48.0]])


def a_head(keep=None) -> Surface:
    """An egg 140 x 180 x 150 mm with its nasion at the origin; `keep` picks triangles by their middles."""
    theta, phi = np.meshgrid(np.linspace(0.02, np.pi - 0.02, 120), np.linspace(0, 2 * np.pi, 240, endpoint=False), indexing="ij")
    vertices = np.stack(
        [
            70 * np.sin(theta) * np.cos(phi) * (1 - 0.1 * np.sin(theta) * np.sin(phi)),
            90 * np.sin(theta) * np.sin(phi) - 88.0,
            75 * np.cos(theta) + 15.0,
        ],
        axis=-1,
    )
    rows, columns = theta.shape
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    flat = vertices.reshape(-1, 3)
    if keep is not None:
        triangles = triangles[keep(flat[triangles].mean(axis=1))]
    return Surface(flat, triangles)


@pytest.fixture(scope="module")
def a_skull() -> Surface:
    return a_head()


def test_there_are_18_points_with_the_counts_of_the_chapter(a_skull):
    plan = plan_protocol(a_skull, LANDMARKS, LANDMARK_LABELS)
    assert len(plan) == 18
    assert {region: plan.regions.count(region) for region in REGIONS} == COUNTS
    assert len(set(plan.labels)) == 18
    assert all(label.startswith(region) for label, region in zip(plan.labels, plan.regions))


def test_points_lie_on_the_surface_with_outward_unit_normals(a_skull):
    plan = plan_protocol(a_skull, LANDMARKS)
    found = a_skull.closest(plan.positions_ras_mm)
    assert found.distances_mm.max() < 0.01
    assert np.linalg.norm(plan.normals, axis=1) == pytest.approx(1.0)
    assert np.degrees(np.arccos(np.sum(plan.normals * found.normals, axis=1))).max() < 4.0


def test_regions_are_where_their_names_say(a_skull):
    plan = plan_protocol(a_skull, LANDMARKS)
    by_region = {region: plan.positions_ras_mm[[r == region for r in plan.regions]] for region in REGIONS}
    assert (by_region["Left lateral"][:, 0] < -40).all()
    assert (by_region["Right lateral"][:, 0] > 40).all()
    assert (by_region["Frontal convexity"][:, 2] > 50).all()
    assert by_region["Forehead"][:, 2].min() > by_region["Periorbital"][:, 2].min()
    assert (by_region["Forehead"][:, 1] > -60).all()
    assert (by_region["Periorbital"][:, 1] > -45).all()
    assert by_region["Periorbital"][:, 2].max() < by_region["Frontal convexity"][:, 2].min()


def test_both_sides_are_alike_on_a_symmetric_head(a_skull):
    plan = plan_protocol(a_skull, LANDMARKS)
    mirrored = plan.positions_ras_mm * (-1, 1, 1)
    gaps = np.linalg.norm(mirrored[:, None] - plan.positions_ras_mm[None], axis=2).min(axis=1)
    assert gaps.max() < 6.0


def test_points_keep_apart(a_skull):
    places = plan_protocol(a_skull, LANDMARKS).positions_ras_mm
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2) + 1e3 * np.eye(18)
    assert gaps.min() > 15.0


def test_landmarks_turn_the_plan_with_the_head(a_skull):
    pose = rigid_from_vector([0.3, -0.5, 1.2], [40.0, -300.0, 900.0])
    turned = Surface(transform_points(pose, a_skull.vertices_mm), a_skull.triangles)
    here = plan_protocol(a_skull, LANDMARKS, LANDMARK_LABELS)
    there = plan_protocol(turned, transform_points(pose, LANDMARKS)[::-1], LANDMARK_LABELS[::-1])
    assert there.head_to_ras == pytest.approx(pose @ here.head_to_ras, abs=1e-6)
    # between places that serve equally well the last digit of the ray casts decides
    back = transform_points(invert_rigid(pose), there.positions_ras_mm)
    assert np.linalg.norm(back - here.positions_ras_mm, axis=1).max() < 10.0
    assert np.sum(there.normals * transform_directions(pose, here.normals), axis=1).min() > np.cos(np.radians(10.0))


def test_without_landmarks_the_shape_gives_a_plan_near_the_same(a_skull):
    plan = plan_protocol(a_skull)
    assert len(plan) == 18
    assert np.linalg.norm(plan.head_to_ras[:3, 3]) < 25.0
    assert (plan.positions_ras_mm[[r == "Right lateral" for r in plan.regions], 0] > 40).all()


def test_unknown_landmark_names_fall_back_on_the_shape(a_skull):
    assert np.allclose(plan_protocol(a_skull, LANDMARKS, list("abcd")).head_to_ras, plan_protocol(a_skull).head_to_ras)


def test_a_hole_in_the_bone_is_kept_clear_of():
    hole = np.array([28.0, -12.0, 42.0])
    skull = a_head(lambda middles: np.linalg.norm(middles - hole, axis=1) > 22.0)
    plan = plan_protocol(skull, LANDMARKS)
    assert np.linalg.norm(plan.positions_ras_mm - hole, axis=1).min() > 22.0 + 5.0


@pytest.mark.parametrize("place", [[28.0, -12.0, 42.0], [62.0, -60.0, 30.0]])
def test_over_a_craniotomy_no_point_is_planned_and_the_missing_ones_are_named(a_skull, place):
    whole = plan_protocol(a_skull, LANDMARKS)
    hole = whole.positions_ras_mm[np.argmin(np.linalg.norm(whole.positions_ras_mm - place, axis=1))]
    plan = plan_protocol(a_head(lambda middles: np.linalg.norm(middles - hole, axis=1) > 40.0), LANDMARKS)
    assert np.linalg.norm(plan.positions_ras_mm - hole, axis=1).min() > 40.0 + 5.0
    assert 1 <= len(plan.left_out) <= 4
    assert set(plan.labels) | set(plan.left_out) == set(whole.labels)
    assert len(plan) == 18 - len(plan.left_out)
    assert not whole.left_out


def test_points_keep_clear_of_the_pins_of_the_head_clamp(a_skull):
    free = plan_protocol(a_skull, LANDMARKS)
    pins = free.positions_ras_mm[[free.labels.index(label) for label in ("Left lateral 1", "Right lateral 1", "Right lateral 2")]]
    plan = plan_protocol(a_skull, LANDMARKS, clamp_ras_mm=pins)
    assert clear_of_clamp(plan.positions_ras_mm, plan.normals, pins).all()
    assert plan.labels == free.labels
    assert plan.too_near == plan.left_out == ()


def test_points_keep_the_distance_that_is_asked_for(a_skull):
    free = plan_protocol(a_skull, LANDMARKS)
    base = free.positions_ras_mm[:1] + 50.0 * free.normals[:1]  # before the hand
    for clearance_mm in (10.0, 45.0):
        plan = plan_protocol(a_skull, LANDMARKS, clamp_ras_mm=base, clearance_mm=clearance_mm)
        assert clear_of_clamp(plan.positions_ras_mm, plan.normals, base, clearance_mm).all()


@pytest.mark.parametrize("clearance_mm", [30.0, 60.0, 100.0])
@pytest.mark.parametrize(
    ("direction", "distance_mm"),
    [
        ([0.0, 1.0, 0.3], 130.0),  # before the forehead
        ([0.0, 1.0, 0.3], 170.0),
        ([1.0, 0.1, 0.2], 130.0),  # at the side
        ([-1.0, -0.2, -0.1], 110.0),  # beside the ear
        ([0.6, 0.8, -0.25], 140.0),  # before the cheek
        ([0.3, 0.2, 1.0], 150.0),  # over the vertex
        ([1.0, 1.0, 1.0], 900.0),  # far away
    ],
)
def test_a_base_takes_no_point_away_and_points_are_clear_of_it_or_named(a_skull, direction, distance_mm, clearance_mm):
    free = plan_protocol(a_skull, LANDMARKS)
    base = np.array([0.0, -88.0, 15.0]) + distance_mm * np.array(direction) / np.linalg.norm(direction)
    plan = plan_protocol(a_skull, LANDMARKS, clamp_ras_mm=base[None], clearance_mm=clearance_mm)
    assert plan.labels == free.labels
    assert plan.regions == free.regions
    clear = clear_of_clamp(plan.positions_ras_mm, plan.normals, base[None], clearance_mm)
    assert plan.too_near == tuple(label for label, free_of_it in zip(plan.labels, clear) if not free_of_it)
    if clearance_mm == 30.0:
        assert plan.too_near == (), "an even skull has a free place beside each"
    apart = np.linalg.norm(plan.positions_ras_mm[:, None] - plan.positions_ras_mm[None], axis=2) + 1e3 * np.eye(18)
    assert apart.min() > 12.0
    found = a_skull.closest(plan.positions_ras_mm)
    assert np.degrees(np.arccos(np.sum(plan.normals * found.normals, axis=1))).max() < 4.0, "square to the bone"


def a_cheek_alone(a_skull, radius_mm=16.0):
    """The skull with nothing but an island of bone around its third periorbital point, and where that is."""
    free = plan_protocol(a_skull, LANDMARKS)
    cheek = free.positions_ras_mm[free.labels.index("Periorbital 3")]

    def keep(middles):
        far = np.linalg.norm(middles - cheek, axis=1)
        return (far < radius_mm) | (far > 60.0)

    alone = a_head(keep)
    return alone, plan_protocol(alone, LANDMARKS)


def test_a_point_without_a_free_place_in_reach_keeps_its_own_and_is_named(a_skull):
    skull, free = a_cheek_alone(a_skull)
    index = free.labels.index("Periorbital 3")
    base = free.positions_ras_mm[index] + 80.0 * free.normals[index]
    plan = plan_protocol(skull, LANDMARKS, clamp_ras_mm=base[None])
    assert plan.labels == free.labels
    assert plan.too_near == ("Periorbital 3",)
    assert plan.positions_ras_mm[index] == pytest.approx(free.positions_ras_mm[index])


def test_a_point_is_lost_only_where_a_pin_sits_in_its_place(a_skull):
    skull, free = a_cheek_alone(a_skull, 9.0)
    index = free.labels.index("Periorbital 3")
    over = free.positions_ras_mm[index] + 6.0 * free.normals[index]  # on the skin
    plan = plan_protocol(skull, LANDMARKS, clamp_ras_mm=over[None])
    assert plan.left_out == ("Periorbital 3",)
    assert set(free.labels) - set(plan.labels) == {"Periorbital 3"}


def test_an_open_face_without_the_back_of_the_head_is_enough():
    plan = plan_protocol(a_head(lambda middles: middles[:, 1] > -150.0), LANDMARKS)
    assert len(plan) == 18


def test_missing_bone_is_refused_by_the_name_of_its_region():
    with pytest.raises(InputError, match=r"no place for the probe at left lateral 3"):
        plan_protocol(a_head(lambda middles: middles[:, 2] < 30.0), LANDMARKS)


def test_landmarks_that_span_no_face_are_refused(a_skull):
    with pytest.raises(InputError, match="check their labels and their unit"):
        plan_protocol(a_skull, LANDMARKS / 1000.0, LANDMARK_LABELS)
    with pytest.raises(InputError, match="got 4 landmarks and 3 labels"):
        plan_protocol(a_skull, LANDMARKS, LANDMARK_LABELS[:3])


def test_all_six_degrees_of_freedom_are_held(a_skull):
    """No small motion of the head, turned about its middle or shifted, leaves all points where they are on the bone."""
    plan = plan_protocol(a_skull, LANDMARKS)
    center = np.array([0.0, -85.0, 10.0])
    rows = np.concatenate([np.cross(plan.positions_ras_mm - center, plan.normals) / 75.0, plan.normals], axis=1)
    assert np.linalg.svd(rows, compute_uv=False).min() > 0.2


def test_a_probe_cannot_stand_at_an_edge_or_on_a_step():
    grid = np.arange(-40.0, 40.5, 1.0)
    x, y = np.meshgrid(grid, grid, indexing="ij")
    z = np.where(x > 20.0, 3.0, 0.0)  # a step at x = 20
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    plate = Surface(np.column_stack([x.ravel(), y.ravel(), z.ravel()]), triangles)
    places = np.array([[0.2, 0.1, 0.0], [18.0, 0.0, 0.0], [-37.0, 0.0, 0.0], [0.0, 30.0, 0.0]])
    leaning = np.array([0.1, 0.1, 1.0]) / np.linalg.norm([0.1, 0.1, 1.0])
    _, normals, _, good = probe_footprint(plate, places, np.tile(leaning, (4, 1)))
    assert good.tolist() == [True, False, False, True]
    assert normals[0] == pytest.approx([0.0, 0.0, 1.0], abs=1e-4)


def test_the_nasion_is_the_uppermost_dip_that_neighbours_share_though_more_are_under_the_orbits(a_skull, monkeypatch):
    seen = [95, None, 90, 92, 53, 52, 48, 47, None, 87, 85, 93, None]  # as on a real skull: 4 mm steps from its right to its left
    dips = iter([20, None, None, *seen, None, None, None])  # and a lone one higher up, of a hole's rim
    monkeypatch.setattr("ModuleUltrasoundLib.palpation.head_frame._first_dip", lambda profile: next(dips))
    origin = plan_protocol(a_skull).head_to_ras[:3, 3]
    top = a_skull.vertices_mm[:, 2].max() - 45.0
    assert 46.0 < top - origin[2] < 54.0
    assert abs(origin[0]) < 10.0


def test_two_dips_that_disagree_still_give_a_nasion(a_skull, monkeypatch):
    dips = iter([30, None, 80] + [None] * 50)
    monkeypatch.setattr("ModuleUltrasoundLib.palpation.head_frame._first_dip", lambda profile: next(dips))
    assert np.isfinite(plan_protocol(a_skull).head_to_ras).all()
