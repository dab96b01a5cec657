"""The threshold method: where its surface lies, on shells of known radius and on a real head."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume
from ModuleRegistrationLib.anatomy.head import find_head
from ModuleRegistrationLib.plugins.threshold import ThresholdSegmentation, ThresholdSettings
from scipy.spatial.transform import Rotation

RADIUS_MM = 40.0
CENTER_MM = (12.0, -30.0, 55.0)


def radial_error(surface: Surface) -> np.ndarray:
    return np.linalg.norm(surface.vertices_mm - CENTER_MM, axis=1) - RADIUS_MM


def open_edges(surface: Surface) -> int:
    edges = np.sort(surface.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return int((counts % 2).sum())


@pytest.fixture(scope="module")
def a_tilted_shell(a_shell) -> Volume:
    turn = Rotation.from_euler("xyz", (25, -15, 40), degrees=True).as_matrix()
    return a_shell(RADIUS_MM, rotation=turn, center_mm=CENTER_MM)


@pytest.fixture(scope="module")
def shell_bone(a_tilted_shell):
    return ThresholdSegmentation().segment(a_tilted_shell)


@pytest.fixture(scope="module")
def head_bone(a_sample_head):
    return ThresholdSegmentation().segment(a_sample_head)


def test_the_outer_table_is_the_outer_sphere_alone(shell_bone):
    error = radial_error(shell_bone.outer_table)
    assert np.abs(error).max() < 1.6  # the diploe begins 1.5 mm, the inner table 4.5 mm further in
    covered = shell_bone.outer_table.triangle_areas_mm2.sum() / (4 * np.pi * RADIUS_MM**2)
    assert covered == pytest.approx(1, abs=0.1)


def test_the_stated_uncertainty_is_that_on_a_shell(shell_bone):
    error = radial_error(shell_bone.outer_table)
    assert 0.5 * shell_bone.position_sd_mm < error.std() < 1.2 * shell_bone.position_sd_mm
    assert 0.5 * shell_bone.offset_sd_mm < abs(error.mean()) < 1.2 * shell_bone.offset_sd_mm


def test_the_closed_surface_is_closed_and_looks_outwards(shell_bone):
    closed = shell_bone.closed
    assert open_edges(closed) == 0
    a, b, c = (closed.vertices_mm[closed.triangles[:, k]] - CENTER_MM for k in range(3))
    solid = np.einsum("ij,ij->", a, np.cross(b, c)) / 6
    shell = 4 / 3 * np.pi * (RADIUS_MM**3 - (RADIUS_MM - 6) ** 3)
    assert solid == pytest.approx(shell, rel=0.2)
    outwards = np.einsum("ij,ij->i", shell_bone.outer_table.vertex_normals, shell_bone.outer_table.vertices_mm - CENTER_MM)
    assert (outwards > 0).all()


def test_a_mirrored_grid_gives_the_same_surface(a_tilted_shell, shell_bone):
    matrix = a_tilted_shell.ijk_to_ras.copy()
    matrix[:3, 3] += matrix[:3, 0] * (a_tilted_shell.hu.shape[2] - 1)
    matrix[:3, 0] *= -1
    mirrored = ThresholdSegmentation().segment(Volume(np.ascontiguousarray(a_tilted_shell.hu[:, :, ::-1]), matrix))
    assert len(mirrored.outer_table.triangles) == pytest.approx(len(shell_bone.outer_table.triangles), rel=0.05)
    outwards = np.einsum(
        "ij,ij->i",
        mirrored.outer_table.triangle_normals,
        mirrored.outer_table.vertices_mm[mirrored.outer_table.triangles[:, 0]] - CENTER_MM,
    )
    assert (outwards > 0).mean() > 0.999


def test_a_given_threshold_is_used(a_tilted_shell, shell_bone):
    lower = ThresholdSegmentation(ThresholdSettings(threshold_hu=200.0)).segment(a_tilted_shell)
    assert lower.threshold_hu == 200
    assert radial_error(lower.outer_table).mean() > radial_error(shell_bone.outer_table).mean() + 0.05


def test_no_bone_of_the_sample_head_lies_outside_its_head(a_sample_head, head_bone):
    # the holder around it is as dense as bone (550 HU) and 10 to 40 mm away
    depth = find_head(a_sample_head).depth_at(head_bone.closed.vertices_mm)
    assert depth.min() > -1.0  # of a mask whose cells are 2.5 mm


def test_the_sample_heads_surface_is_closed(head_bone):
    assert open_edges(head_bone.closed) == 0


def test_no_bone_stands_between_the_outer_table_and_the_skin(a_sample_head, head_bone):
    outer = head_bone.outer_table
    which = np.random.default_rng(1).choice(len(outer.vertices_mm), 3000, replace=False)
    head = find_head(a_sample_head)
    away = outer.vertices_mm[which] - outer.center_mm
    start = outer.vertices_mm[which] + 3 * outer.vertex_normals[which]
    hits = head_bone.closed.cast(start, outer.vertex_normals[which]).distances_mm
    assert (hits < 25).mean() < 0.03  # exact rays against the whole bone; the way to the skin is not quite the normal
    assert (np.einsum("ij,ij->i", away, outer.vertex_normals[which]) > 0).mean() > 0.95
    assert (head.depth_at(outer.vertices_mm) < 25).all()


def test_the_jaw_is_not_part_of_the_outer_table(head_bone):
    # the sample's jaw is cut off at its rami: in front of the ears, lower than the cheek bones
    closed, outer = head_bone.closed.vertices_mm, head_bone.outer_table.vertices_mm
    low = closed[:, 2].min()
    middle = closed[:, 0].mean()

    def in_rami(points: np.ndarray) -> np.ndarray:
        forward = points[:, 1] - closed[:, 1].min()
        return (np.abs(points[:, 0] - middle) > 35) & (points[:, 2] < low + 30) & (forward > 112) & (forward < 150)

    assert in_rami(closed).sum() > 2000
    assert in_rami(outer).sum() == 0


def test_a_burr_hole_is_left_open(a_shell):
    shell = a_shell(RADIUS_MM)
    hu = shell.hu.copy()
    k, j, i = np.indices(hu.shape)
    middle = (np.array(hu.shape) - 1) / 2
    hole = ((j - middle[1]) ** 2 + (k - middle[0]) ** 2 * (2 / 0.42) ** 2 < (7 / 0.42) ** 2) & (i > middle[2])
    hu[hole & (hu > 100)] = 40
    outer = ThresholdSegmentation().segment(Volume(hu, shell.ijk_to_ras)).outer_table
    beside = np.hypot(outer.vertices_mm[:, 1], outer.vertices_mm[:, 2])[outer.vertices_mm[:, 0] > 0]
    assert beside.min() > 6.5
    assert np.linalg.norm(outer.vertices_mm, axis=1).min() > RADIUS_MM - 1.6  # no way to the inner table through it


def test_metal_on_the_bone_is_no_bone_point(a_shell):
    shell = a_shell(RADIUS_MM)
    hu = shell.hu.copy()
    k, j, i = np.indices(hu.shape)
    middle = (np.array(hu.shape) - 1) / 2
    place = middle + (0, 0, (RADIUS_MM + 1) / 0.42)
    ball = ((k - place[0]) * 2) ** 2 + ((j - place[1]) * 0.42) ** 2 + ((i - place[2]) * 0.42) ** 2 < 2**2
    hu[ball] = 3071
    outer = ThresholdSegmentation().segment(Volume(hu, shell.ijk_to_ras)).outer_table
    center = np.array([RADIUS_MM + 1, 0, 0])
    assert np.linalg.norm(outer.vertices_mm - center, axis=1).min() > 2.4
    assert radial_error_at_origin(outer).max() < 1.5


def radial_error_at_origin(surface: Surface) -> np.ndarray:
    return np.linalg.norm(surface.vertices_mm, axis=1) - RADIUS_MM


@pytest.mark.parametrize("padding", [-2048, -3024])
def test_padding_around_the_scanners_circle_changes_nothing(a_tilted_shell, shell_bone, padding):
    hu = a_tilted_shell.hu.copy()
    hu[:, :8] = padding
    found = ThresholdSegmentation().segment(Volume(hu, a_tilted_shell.ijk_to_ras))
    assert found.outer_table.triangle_areas_mm2.sum() == pytest.approx(shell_bone.outer_table.triangle_areas_mm2.sum(), rel=0.02)


def test_a_clipped_head_has_no_outer_table_at_the_cut(a_shell):
    shell = a_shell(RADIUS_MM)
    part = Volume(
        shell.hu[16:36], np.block([[shell.ijk_to_ras[:3, :3], (shell.ijk_to_ras @ (0, 0, 16, 1))[:3, None]], [0, 0, 0, 1]])
    )
    found = ThresholdSegmentation().segment(part)
    assert open_edges(found.closed) == 0
    assert np.abs(radial_error_at_origin(found.outer_table)).max() < 1.6


def test_a_volume_of_air_is_refused():
    with pytest.raises(InputError, match="no head"):
        ThresholdSegmentation().segment(Volume(np.full((50, 60, 60), -1000, dtype=np.int16), np.diag([2.0, 2.0, 2.0, 1.0])))


def test_a_block_of_water_is_refused():
    hu = np.full((50, 60, 60), -1000, dtype=np.int16)
    hu[10:40, 10:50, 10:50] = 0
    with pytest.raises(InputError, match="no bone"):
        ThresholdSegmentation().segment(Volume(hu, np.diag([2.0, 2.0, 2.0, 1.0])))


def test_values_off_by_a_thousand_are_refused(a_tilted_shell):
    with pytest.raises(InputError, match="no air"):
        ThresholdSegmentation().segment(Volume(a_tilted_shell.hu + np.int16(1024), a_tilted_shell.ijk_to_ras))
