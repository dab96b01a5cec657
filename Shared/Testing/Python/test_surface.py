"""Surface against closed forms and VTK."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.surface import Surface
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import reference
from vtkmodules.vtkCommonDataModel import vtkStaticCellLocator
from vtkmodules.vtkFiltersSources import vtkCubeSource, vtkSphereSource

TETRAHEDRON = Surface(
    np.array([[10.0, 20, 30], [50, 22, 31], [12, 70, 33], [14, 24, 90]]), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
)


@pytest.fixture(scope="module")
def a_sphere() -> Surface:
    source = vtkSphereSource()
    source.SetRadius(80)
    source.SetCenter(30, -200, 400)
    source.SetThetaResolution(120)
    source.SetPhiResolution(120)
    source.Update()
    return Surface.from_polydata(source.GetOutput())


def test_closest_points_agree_with_vtk_in_double_precision(a_sphere):
    rng = np.random.default_rng(1)
    queries = a_sphere.center_mm + rng.normal(size=(200, 3)) * 70
    locator = vtkStaticCellLocator()
    locator.SetDataSet(a_sphere.to_polydata())
    locator.BuildLocator()
    found = a_sphere.closest(queries)
    for query, distance in zip(queries, found.distances_mm):
        square = reference(0.0)
        locator.FindClosestPoint(query, [0.0] * 3, reference(0), reference(0), square)
        assert distance == pytest.approx(np.sqrt(square.get()), abs=1e-3)


def test_normals_point_outward(a_sphere):
    outward = (a_sphere.vertices_mm - a_sphere.center_mm) / 80
    assert (np.sum(outward * a_sphere.vertex_normals, axis=1) > 0.99).all()


def test_signed_distance_is_negative_inside(a_sphere):
    assert a_sphere.signed_distance([a_sphere.center_mm])[0] == pytest.approx(-80, abs=0.1)


def test_rays_hit_or_say_that_they_miss(a_sphere):
    origin = a_sphere.center_mm + [200, 0, 0]
    hits = a_sphere.cast([origin, origin], [[-1, 0, 0], [1, 0, 0]])
    assert hits.distances_mm[0] == pytest.approx(120, abs=0.1)
    assert np.isinf(hits.distances_mm[1])
    assert hits.triangles[1] == -1
    assert np.isnan(hits.normals[1]).all()


def test_polygons_are_split_into_triangles():
    cube = vtkCubeSource()
    cube.Update()
    assert Surface.from_polydata(cube.GetOutput()).triangles.shape == (12, 3)


def test_a_written_surface_reads_back_the_same(a_sphere, tmp_path):
    a_sphere.write(tmp_path / "bone.vtp")
    back = Surface.read(tmp_path / "bone.vtp")
    np.testing.assert_allclose(back.vertices_mm, a_sphere.vertices_mm)
    assert (back.triangles == a_sphere.triangles).all()
    assert vtk_to_numpy(back.to_polydata().GetPointData().GetNormals()).shape == (len(back.vertices_mm), 3)


def test_what_is_no_surface_is_refused(tmp_path):
    with pytest.raises(InputError, match="no surface file"):
        Surface.read(tmp_path / "absent.vtp")
    (tmp_path / "bone.obj").write_text("v 0 0 0")
    with pytest.raises(InputError, match="unknown surface format"):
        Surface.read(tmp_path / "bone.obj")
    with pytest.raises(InputError, match="triangles of shape"):
        Surface(np.zeros((3, 3)), np.empty((0, 3), dtype=np.int64))


def test_the_content_hash_tells_surfaces_apart(a_sphere):
    moved = Surface(a_sphere.vertices_mm + 1e-9, a_sphere.triangles)
    assert moved.content_hash != a_sphere.content_hash
    assert Surface(a_sphere.vertices_mm.copy(), a_sphere.triangles).content_hash == a_sphere.content_hash


@pytest.mark.parametrize("extension", [".vtp", ".stl", ".ply", ".vtk"])
@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_a_model_saved_by_slicer_lies_where_slicer_had_it(tmp_path, extension, space):
    from CranioNavLib import host

    host.scene().Clear(False)
    node = host.scene().AddNewNodeByClass("vtkMRMLModelNode")
    node.SetAndObservePolyData(TETRAHEDRON.to_polydata())
    storage = host.scene().AddNewNodeByClass("vtkMRMLModelStorageNode")
    storage.SetCoordinateSystem(storage.GetCoordinateSystemFromString(space))
    storage.SetFileName(str(tmp_path / f"m{extension}"))
    assert storage.WriteData(node)
    found = Surface.read(tmp_path / f"m{extension}")
    assert np.allclose(found.center_mm, TETRAHEDRON.center_mm, atol=1e-4)
    assert np.allclose(found.closest(TETRAHEDRON.vertices_mm).distances_mm, 0, atol=1e-4)
    assert np.sum(found.triangle_normals * (found.vertices_mm[found.triangles].mean(axis=1) - found.center_mm)) > 0


def test_slicer_loads_a_written_surface_where_it_lies(tmp_path):
    from CranioNavLib import host

    TETRAHEDRON.write(tmp_path / "m.vtp")
    node = host.scene().AddNewNodeByClass("vtkMRMLModelNode")
    storage = host.scene().AddNewNodeByClass("vtkMRMLModelStorageNode")
    storage.SetFileName(str(tmp_path / "m.vtp"))
    assert storage.ReadData(node)
    assert np.allclose(Surface.from_polydata(node.GetPolyData()).vertices_mm, TETRAHEDRON.vertices_mm, atol=1e-4)
