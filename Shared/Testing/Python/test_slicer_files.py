"""Markups, transforms and scenes on disk: LPS there, RAS here, and nothing unclear accepted."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
import SimpleITK as sitk
from CranioNavLib import host, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid, rigid_from_vector, transform_points
from CranioNavLib.slicer_files import (
    LabelledPoints,
    load_scene,
    read_points,
    read_transform,
    save_scene,
    write_points,
    write_transform,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

FCSV = """# Markups fiducial file version = 4.11
# CoordinateSystem = {system}
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
1,10,20,30,0,0,0,1,1,1,0,Nasion,,
2,-1.5,2,3,0,0,0,1,1,1,0,Left,,
"""


@pytest.fixture
def two_points():
    return LabelledPoints(("Nasion", "Left frontozygomatic"), np.array([[10.0, -20.0, 30.0], [1 / 3, 2.0, -3.0]]))


def markup(**changes):
    point = {"id": "1", "label": "A", "position": [1.0, 2.0, 3.0], "positionStatus": "defined"}
    content = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": [point]}
    content.update(changes)
    return {
        "@schema": "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
        "markups-schema-v1.0.3.json#",
        "markups": [{key: value for key, value in content.items() if value is not None}],
    }


def write_json(path, content):
    path.write_text(json.dumps(content))
    return path


# Points


def test_points_come_back_as_they_were_and_lie_in_lps_on_disk(tmp_path, two_points):
    path = tmp_path / "points.mrk.json"
    write_points(path, two_points, name="Landmarks")
    back = read_points(path)
    assert back.labels == two_points.labels
    np.testing.assert_allclose(back.positions_mm, two_points.positions_mm, rtol=1e-15)
    stored = json.loads(path.read_text())["markups"][0]
    assert stored["coordinateSystem"] == "LPS"
    np.testing.assert_allclose(stored["controlPoints"][0]["position"], [-10.0, 20.0, 30.0])


coordinates = st.floats(-500, 500, allow_subnormal=False)
labels = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=12)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(labels, coordinates, coordinates, coordinates), min_size=1, max_size=6))
def test_any_labels_and_coordinates_come_back(tmp_path, rows):
    points = LabelledPoints(tuple(row[0] for row in rows), np.array([row[1:] for row in rows]))
    write_points(tmp_path / "p.mrk.json", points)
    back = read_points(tmp_path / "p.mrk.json")
    assert back.labels == points.labels
    np.testing.assert_allclose(back.positions_mm, points.positions_mm, rtol=1e-14, atol=1e-12)


@pytest.mark.parametrize(("system", "sign"), [("LPS", -1), ("RAS", 1)])
def test_a_markup_file_is_read_in_the_system_that_it_says(tmp_path, system, sign):
    path = write_json(tmp_path / "a.mrk.json", markup(coordinateSystem=system))
    np.testing.assert_allclose(read_points(path).positions_mm, [[sign * 1, sign * 2, 3]])


@pytest.mark.parametrize(("system", "sign"), [("LPS", -1), ("RAS", 1), ("0", 1), ("1", -1)])
def test_a_legacy_fcsv_is_read_in_the_system_that_it_says(tmp_path, system, sign):
    path = tmp_path / "a.fcsv"
    path.write_text(FCSV.format(system=system))
    points = read_points(path)
    assert points.labels == ("Nasion", "Left")
    np.testing.assert_allclose(points.positions_mm[0], [sign * 10, sign * 20, 30])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (markup(coordinateSystem=None), "does not say its coordinate system"),
        (markup(coordinateSystem="IJK"), "says 'IJK' for its coordinate system"),
        (markup(coordinateUnits="m"), "is in 'm'; save it in mm"),
        (markup(type="Line"), "type 'Line'"),
        (markup(controlPoints=[]), "holds no points"),
        (
            markup(controlPoints=[{"id": "1", "label": "A", "position": [0, 0, 0], "positionStatus": "undefined"}]),
            r"point 1 \('A'\) has no position",
        ),
        (
            markup(controlPoints=[{"id": "1", "label": "A", "position": [1e9, 0, 0], "positionStatus": "defined"}]),
            "coordinates are expected in mm",
        ),
        ({"markups": [markup()["markups"][0]] * 2}, "holds 2 point lists"),
        ({"markups": []}, "holds no Slicer markups"),
        ({"points": [[1, 2, 3]]}, "holds no Slicer markups"),
        ([1, 2, 3], "holds no Slicer markups"),
    ],
)
def test_an_unclear_markup_file_is_refused(tmp_path, content, says):
    path = write_json(tmp_path / "bad.mrk.json", content)
    with pytest.raises(InputError, match=says) as refused:
        read_points(path)
    assert "bad.mrk.json" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_fcsv_without_coordinate_system_is_refused(tmp_path):
    path = tmp_path / "old.fcsv"
    path.write_text("# Markups fiducial file version = 4.3\n1,10,20,30,0,0,0,1,1,1,0,Nasion,,\n")
    with pytest.raises(InputError, match="does not say its coordinate system"):
        read_points(path)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"[" * 100000])
def test_a_damaged_markup_file_is_refused(tmp_path, content):
    path = tmp_path / "cut.mrk.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"cut\.mrk\.json"):
        read_points(path)


@pytest.mark.parametrize(("read", "name"), [(read_points, "p.mrk.json"), (read_transform, "t.tfm"), (load_scene, "s.mrb")])
def test_a_missing_file_is_refused_by_its_name(tmp_path, read, name):
    with pytest.raises(InputError, match=f"no file .*{name}"):
        read(tmp_path / name)


@pytest.mark.parametrize(("read", "name"), [(read_points, "p.csv"), (read_transform, "t.npy"), (load_scene, "s.zip")])
def test_another_kind_of_file_is_refused(tmp_path, read, name):
    (tmp_path / name).write_text("x")
    with pytest.raises(InputError, match="expected"):
        read(tmp_path / name)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_a_file_that_may_not_be_read_is_refused(tmp_path, two_points):
    path = tmp_path / "p.mrk.json"
    write_points(path, two_points)
    path.chmod(0)
    with pytest.raises(InputError, match="Permission denied"):
        read_points(path)


def test_writing_into_a_missing_folder_is_refused_and_leaves_nothing(tmp_path, two_points):
    with pytest.raises(InputError, match="cannot write"):
        write_points(tmp_path / "none" / "p.mrk.json", two_points)
    with pytest.raises(InputError, match=r"ends with \.mrk\.json"):
        write_points(tmp_path / "p.json", two_points)
    assert list(tmp_path.iterdir()) == []


def test_labels_and_positions_must_be_of_equal_number():
    with pytest.raises(InputError, match="one label per point, got 1 for 2"):
        LabelledPoints(("a",), np.zeros((2, 3)))


# Transforms

angles, shifts = st.floats(-3, 3), st.floats(-1000, 1000)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.tuples(angles, angles, angles), st.tuples(shifts, shifts, shifts), st.sampled_from([".tfm", ".h5"]))
def test_any_rigid_transform_comes_back(tmp_path, turn, shift, suffix):
    matrix = rigid_from_vector(turn, shift)
    write_transform(tmp_path / f"t{suffix}", matrix)
    np.testing.assert_allclose(read_transform(tmp_path / f"t{suffix}"), matrix, atol=1e-9)


def test_simpleitk_reads_the_inverse_in_lps(tmp_path):
    """ITK files hold the transform from the parent, in LPS: the convention that 3D Slicer documents."""
    matrix = rigid_from_vector([0.3, -0.2, 0.5], [10, -20, 30])
    write_transform(tmp_path / "t.tfm", matrix)
    read = sitk.ReadTransform(str(tmp_path / "t.tfm"))
    point_ras = np.array([1.0, 2.0, 3.0])
    moved_lps = np.array(read.TransformPoint((transform_points(matrix, point_ras[None])[0] * [-1, -1, 1]).tolist()))
    np.testing.assert_allclose(moved_lps * [-1, -1, 1], point_ras, atol=1e-9)


def test_a_transform_written_by_simpleitk_is_read(tmp_path):
    other = sitk.Euler3DTransform()
    other.SetRotation(0.1, 0.2, 0.3)
    other.SetTranslation((4, 5, 6))
    sitk.WriteTransform(other, str(tmp_path / "t.tfm"))
    to_parent = read_transform(tmp_path / "t.tfm")
    point_lps = np.array([7.0, 8.0, 9.0])
    from_parent = np.array(other.TransformPoint(point_lps.tolist()))
    np.testing.assert_allclose(
        transform_points(to_parent, (from_parent * [-1, -1, 1])[None])[0], point_lps * [-1, -1, 1], atol=1e-9
    )


def test_a_transform_that_scales_is_refused(tmp_path):
    affine = sitk.AffineTransform(3)
    affine.Scale(1.1)
    sitk.WriteTransform(affine, str(tmp_path / "scaled.tfm"))
    with pytest.raises(InputError, match=r"scaled\.tfm.* not rigid"):
        read_transform(tmp_path / "scaled.tfm")


def test_a_transform_that_bends_is_refused(tmp_path):
    bspline = sitk.BSplineTransformInitializer(sitk.Image(8, 8, 8, sitk.sitkInt16), [2, 2, 2])
    bspline.SetParameters(np.random.default_rng(0).normal(size=len(bspline.GetParameters())).tolist())
    sitk.WriteTransform(bspline, str(tmp_path / "bent.tfm"))
    with pytest.raises(InputError, match=r"bent\.tfm.*not linear"):
        read_transform(tmp_path / "bent.tfm")


def test_a_transform_that_is_not_rigid_is_not_written(tmp_path):
    with pytest.raises(InputError, match="mirrors"):
        write_transform(tmp_path / "t.tfm", rigid(np.diag([1, 1, -1]), [0, 0, 0]))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".tfm", ".h5"])
def test_a_damaged_transform_is_refused_without_a_word_on_the_console(tmp_path, suffix, capfd):
    path = tmp_path / f"cut{suffix}"
    write_transform(path, np.eye(4))
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match="cut"):
        read_transform(path)
    said = capfd.readouterr()
    assert (said.out, said.err) == ("", "")


# Scenes


def test_a_scene_is_replaced_by_the_one_loaded_or_joined_by_it(tmp_path, two_points):
    host.scene().Clear(False)
    scene_data.set_points("LandmarksCT", two_points)
    save_scene(tmp_path / "s.mrb")
    host.scene().AddNewNodeByClass("vtkMRMLModelNode", "stranger")
    load_scene(tmp_path / "s.mrb", clear=False)
    assert host.scene().GetFirstNodeByName("stranger") is not None
    load_scene(tmp_path / "s.mrb")
    assert host.scene().GetFirstNodeByName("stranger") is None
    assert scene_data.get_points("LandmarksCT").labels == two_points.labels
    host.scene().Clear(False)


@pytest.mark.parametrize("damage", ["cut", "no zip", "no scene"])
def test_a_damaged_scene_is_refused(tmp_path, damage):
    import zipfile

    path = tmp_path / "s.mrb"
    save_scene(path)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-200])
    elif damage == "no zip":
        path.write_text("nothing")
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("readme.txt", "x")
    with pytest.raises(InputError, match=r"s\.mrb"):
        load_scene(path)


def test_a_scene_is_saved_as_mrb_only(tmp_path):
    with pytest.raises(InputError, match=r"\.mrb"):
        save_scene(tmp_path / "scene.mrml")
