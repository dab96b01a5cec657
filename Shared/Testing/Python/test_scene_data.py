"""What is written into the shared nodes comes back as it was, in the scene and through .mrb."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.errors import InputError
from CranioNavLib.slicer_files import LabelledPoints, load_scene, save_scene
from CranioNavLib.surface import Surface
from CranioNavLib.volume import Volume


@pytest.fixture(autouse=True)
def an_empty_scene():
    host.scene().Clear(False)
    yield
    host.scene().Clear(False)


@pytest.fixture
def measured_points():
    """Five points of ultrasound and stylus, with everything that a point can carry."""
    rng = np.random.default_rng(4)
    roots = rng.normal(size=(5, 3, 3))
    beams = rng.normal(size=(5, 3))
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    beams[2] = np.nan  # touched with the stylus
    depths = rng.uniform(2, 15, (5, 2))
    depths[1, 1] = np.nan
    return BonePoints(
        positions_mm=rng.normal(0, 80, (5, 3)),
        covariances_mm2=roots @ roots.transpose(0, 2, 1),
        beam_directions=beams,
        depths_mm=rng.uniform(2, 10, 5),
        qualities=rng.uniform(0, 1, 5),
        labels=("a", "b", "c", "d", "e"),
        speed_of_sound_m_s=1540.0,
        speed_of_sound_sd_m_s=52.0,
        alternative_depths_mm=depths,
        alternative_probabilities=np.where(np.isfinite(depths), 0.1, np.nan),
        groups=np.array([0, 0, 3, 4, 4]),
    )


def assert_same(a: BonePoints, b: BonePoints) -> None:
    for field in fields(BonePoints):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, np.ndarray):
            np.testing.assert_allclose(one, other, rtol=1e-13, err_msg=field.name)
        else:
            np.testing.assert_equal(one, other, err_msg=field.name)


def through_mrb(tmp_path):
    save_scene(tmp_path / "s.mrb")
    load_scene(tmp_path / "s.mrb")


@pytest.mark.parametrize("saved", [False, True])
def test_bone_points_keep_all_that_is_known_of_their_error(tmp_path, measured_points, saved):
    scene_data.set_bone_points(measured_points)
    if saved:
        through_mrb(tmp_path)
    assert_same(measured_points, scene_data.get_bone_points())


@pytest.mark.parametrize("saved", [False, True])
def test_a_point_deleted_by_the_user_takes_its_values_along(tmp_path, measured_points, saved):
    scene_data.set_bone_points(measured_points).RemoveNthControlPoint(1)
    if saved:
        through_mrb(tmp_path)
    assert_same(measured_points.subset([0, 2, 3, 4]), scene_data.get_bone_points())


def test_a_point_added_by_hand_among_measured_ones_is_refused(tmp_path, measured_points):
    scene_data.set_bone_points(measured_points).RemoveNthControlPoint(1)
    through_mrb(tmp_path)
    scene.find("SurfacePoints").AddControlPoint([1.0, 2.0, 3.0], "by hand")
    with pytest.raises(InputError, match="'by hand' was not measured"):
        scene_data.get_bone_points()


def test_a_measured_point_moved_by_hand_is_refused(measured_points):
    node = scene_data.set_bone_points(measured_points)
    node.SetNthControlPointPosition(3, *(measured_points.positions_mm[3] + [0, 0, 1.0]))
    with pytest.raises(InputError, match=r"'d' was moved by 1\.00 mm"):
        scene_data.get_bone_points()


def test_new_points_do_not_inherit_old_measurements(measured_points):
    scene_data.set_bone_points(measured_points)
    scene_data.set_points("SurfacePoints", LabelledPoints(("x",), np.zeros((1, 3))))
    with pytest.raises(InputError, match="says nothing of its points' error"):
        scene_data.get_bone_points()
    points = scene_data.get_bone_points(palpated_sd_mm=0.4)
    np.testing.assert_allclose(points.covariances_mm2, [np.eye(3) * 0.16])
    assert not points.has_beam.any()


def test_points_without_sound_stay_without(tmp_path, measured_points):
    silent = replace(measured_points, speed_of_sound_m_s=float("nan"), speed_of_sound_sd_m_s=0.0)
    scene_data.set_bone_points(silent)
    through_mrb(tmp_path)
    assert np.isnan(scene_data.get_bone_points().speed_of_sound_m_s)


def test_an_oblique_volume_keeps_its_voxels_and_its_place(tmp_path):
    rng = np.random.default_rng(1)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = turn * [0.4, 0.5, 2.0] * np.sign(np.linalg.det(turn))
    matrix[:3, 3] = [10, -20, 30]
    volume = Volume(rng.integers(-1024, 3000, (4, 5, 6)).astype(np.int16), matrix, "a CT")
    scene_data.set_volume("CT", volume)
    through_mrb(tmp_path)
    back = scene_data.get_volume("CT")
    np.testing.assert_array_equal(back.hu, volume.hu)
    np.testing.assert_allclose(back.ijk_to_ras, volume.ijk_to_ras, atol=1e-6)
    assert back.description == "a CT"


def test_a_volume_under_a_transform_is_refused():
    node = scene_data.set_volume("CT", Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)))
    node.SetAndObserveTransformNodeID(scene.find_or_create("ReferenceToRas").GetID())
    with pytest.raises(InputError, match="hangs under a transform"):
        scene_data.get_volume("CT")


def test_a_surface_stays_a_closed_mesh(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    tetrahedron = Surface(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    scene_data.set_surface("Bone", tetrahedron)
    through_mrb(tmp_path)
    back = scene_data.get_surface("Bone")
    np.testing.assert_allclose(back.vertices_mm[back.triangles], tetrahedron.vertices_mm[tetrahedron.triangles], atol=1e-6)


def test_tables_keep_numbers_as_numbers_and_text_as_text(tmp_path):
    columns = {"point": ["a", "b"], "residual (mm)": [0.25, -1.5], "used": ["yes", "no"]}
    scene_data.set_table("Residuals", columns)
    assert scene_data.get_table("Residuals") == columns
    through_mrb(tmp_path)
    assert scene_data.get_table("Residuals") == columns


def test_a_matrix_that_is_not_rigid_is_not_written():
    with pytest.raises(InputError, match="ReferenceToRas is not rigid"):
        scene_data.set_transform("ReferenceToRas", np.diag([2.0, 2.0, 2.0, 1.0]))


@pytest.mark.parametrize(
    "read", [scene_data.get_points, scene_data.get_transform, scene_data.get_surface, scene_data.get_volume, scene_data.get_table]
)
def test_what_is_not_there_yet_is_refused_with_who_makes_it(read):
    role = {"get_points": "LandmarksCT", "get_transform": "ReferenceToRas", "get_surface": "Bone", "get_volume": "CT"}
    with pytest.raises(InputError, match="in the scene yet; it is made by ModuleRegistration"):
        read(role.get(read.__name__, "Results"))


def test_an_empty_list_or_mesh_is_refused():
    scene.find_or_create("LandmarksCT")
    scene.find_or_create("Bone")
    with pytest.raises(InputError, match="holds no points"):
        scene_data.get_points("LandmarksCT")
    with pytest.raises(InputError, match="holds no surface"):
        scene_data.get_surface("Bone")
