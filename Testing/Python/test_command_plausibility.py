"""`cranionav plausibility`: what is expected of touched points, and bone surfaces that come from elsewhere."""

from __future__ import annotations

import json

import numpy as np
import pytest
from CranioNavLib.rigid import invert_rigid, rigid_from_vector, transform_points
from CranioNavLib.slicer_files import LabelledPoints, write_points, write_transform
from CranioNavLib.surface import Surface
from vtkmodules.vtkFiltersSources import vtkSphereSource
from vtkmodules.vtkIOGeometry import vtkSTLWriter

from Workstation.__main__ import run

REFERENCE_TO_RAS = rigid_from_vector([0.2, -0.1, 0.3], [5, -30, 20])
CENTER = np.array([10.0, 120, 40])  # a head that does not lie in the middle of its CT


@pytest.fixture
def a_call(tmp_path):
    """Files of one call: points touched 0.4 mm outside a sphere, the transform, and the sphere's mesh."""
    source = vtkSphereSource()
    source.SetRadius(80)
    source.SetCenter(*CENTER)
    source.SetThetaResolution(200)
    source.SetPhiResolution(200)
    source.Update()
    directions = np.array([[1.0, 0, 0], [-1, 0.3, 0], [0, 1, 0.2], [0, 0, 1], [0.5, 0.5, 0.5]])
    touched = CENTER + 80.4 * directions / np.linalg.norm(directions, axis=1)[:, None]
    labels = tuple(f"P{k}" for k in range(5))
    write_points(tmp_path / "p.mrk.json", LabelledPoints(labels, transform_points(invert_rigid(REFERENCE_TO_RAS), touched)))
    write_transform(tmp_path / "ReferenceToRas.tfm", REFERENCE_TO_RAS)
    return tmp_path, Surface.from_polydata(source.GetOutput())


def plausibility(folder, name: str, *options: str) -> int:
    files = {"--transform": "ReferenceToRas.tfm", "--points": "p.mrk.json", "--surface": name}
    return run(["plausibility", *(part for key, file in files.items() for part in (key, str(folder / file))), *options])


def write_stl(surface: Surface, path) -> None:
    """An STL that says nothing of its axes."""
    writer = vtkSTLWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(surface.to_polydata())
    assert writer.Write()


def write_record(folder, matrix, sd_mm: float) -> None:
    variances = np.array([1e-8] * 3 + [sd_mm**2] * 3)
    bone = {"position_sd_mm": 0.0, "offset_sd_mm": 0.0}
    stated = {"covariance": np.diag(variances).tolist(), "pivot_ras_mm": CENTER.tolist(), "degrees_of_freedom": None}
    record = {"reference_to_ras": matrix.tolist(), "verification": {**stated, "bone_surface": bone}}
    (folder / "registration.json").write_text(json.dumps(record))


def test_the_stated_error_beside_the_transform_says_what_to_expect(a_call, capsys):
    folder, sphere = a_call
    sphere.write(folder / "bone.vtp")
    write_record(folder, REFERENCE_TO_RAS, sd_mm=1.2)
    assert plausibility(folder, "bone.vtp", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["distances_mm"] == pytest.approx([0.4] * 5, abs=0.05)
    assert found["expected"]["expected_sd_mm"] == pytest.approx([np.hypot(1.2, 0.5)] * 5, rel=0.01)  # 0.5 mm: the stylus
    assert found["expected"]["as_expected"]
    assert plausibility(folder, "bone.vtp") == 0
    assert "as far off as expected" in capsys.readouterr().out


@pytest.mark.parametrize("beside", ["nothing", "another registration", "no error", "no JSON"])
def test_without_a_stated_error_nothing_is_expected_and_that_is_said(a_call, capsys, beside):
    folder, sphere = a_call
    sphere.write(folder / "bone.vtp")
    if beside == "another registration":
        write_record(folder, np.eye(4), 1.0)
    elif beside == "no error":
        (folder / "registration.json").write_text(json.dumps({"reference_to_ras": REFERENCE_TO_RAS.tolist()}))
    elif beside == "no JSON":
        (folder / "registration.json").write_text("{")
    assert plausibility(folder, "bone.vtp") == 0
    assert "no stated error is known" in capsys.readouterr().out


@pytest.mark.parametrize(("scale", "unit"), [(0.001, "metres"), (0.1, "centimetres")])
def test_a_surface_of_another_unit_is_refused_by_it(a_call, capsys, scale, unit):
    folder, sphere = a_call
    write_stl(Surface(sphere.vertices_mm * scale, sphere.triangles), folder / "bone.stl")
    assert plausibility(folder, "bone.stl") == 2
    assert f"is it in {unit}?" in capsys.readouterr().err


def test_a_surface_in_lps_that_does_not_say_so_is_refused(a_call, capsys):
    folder, sphere = a_call
    write_stl(Surface(sphere.vertices_mm * [-1, -1, 1], sphere.triangles), folder / "bone.stl")
    assert plausibility(folder, "bone.stl") == 2
    assert "seems to be in LPS" in capsys.readouterr().err


def test_inward_normals_do_not_turn_outside_into_inside(a_call, capsys):
    folder, sphere = a_call
    write_stl(Surface(sphere.vertices_mm, sphere.triangles[:, ::-1]), folder / "bone.stl")
    assert plausibility(folder, "bone.stl", "--json") == 0
    assert json.loads(capsys.readouterr().out)["distances_mm"] == pytest.approx([0.4] * 5, abs=0.05)
