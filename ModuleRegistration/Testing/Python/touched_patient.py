"""A patient as touched by a stylus, in the scene: what the tests of the module's logic stand on."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib import host, scene_data
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.rigid import invert_rigid, rigid_from_vector, transform_points
from CranioNavLib.slicer_files import LabelledPoints
from CranioNavLib.surface import Surface

import ModuleRegistration as module

TRUTH = rigid_from_vector([0.3, -0.2, 0.4], [20, -30, 40])  # ReferenceToRas
LABELS = ("Nasion", "Left", "Right", "Spine")
LANDMARKS = np.array([[0.0, 92, 0], [-60, 45, 10], [60, 47, 12], [3, 78, -45]])


@pytest.fixture(scope="module")
def a_skull():
    """A closed surface without symmetry, so that it has one best pose."""
    import vtk

    source = vtk.vtkSphereSource()
    source.SetThetaResolution(120)
    source.SetPhiResolution(90)
    source.SetRadius(1.0)
    source.Update()
    egg = Surface.from_polydata(source.GetOutput())
    x, y, z = egg.vertices_mm.T
    bumps = 1 + 0.08 * np.sin(3 * x + y) + 0.06 * np.cos(4 * y - 2 * z) + 0.05 * np.sin(5 * z + x)
    return Surface(egg.vertices_mm * bumps[:, None] * [72.0, 92.0, 85.0], egg.triangles)


@pytest.fixture
def a_logic():
    host.scene().Clear(False)
    logic = module.ModuleRegistrationLogic()
    logic.parameters().change(method="icp")
    yield logic
    host.scene().Clear(False)


@pytest.fixture
def a_patient(a_logic, a_skull):
    """Landmarks and bone points as touched on a patient whose true registration is TRUTH."""
    rng = np.random.default_rng(0)
    to_reference = invert_rigid(TRUTH)
    scene_data.set_surface("Bone", a_skull)
    scene_data.set_surface("OuterTable", a_skull)
    scene_data.set_points("LandmarksCT", LabelledPoints(LABELS, LANDMARKS))
    touched = transform_points(to_reference, LANDMARKS + rng.normal(0, 0.7, LANDMARKS.shape))
    scene_data.set_points("LandmarksPatient", LabelledPoints(LABELS, touched))
    bone = a_skull.vertices_mm[rng.choice(len(a_skull.vertices_mm), 40, replace=False)]
    scene_data.set_bone_points(BonePoints.palpated(transform_points(to_reference, bone + rng.normal(0, 0.1, bone.shape)), 0.2))
    targets = np.array([[0.0, 0, 60], [40, 20, 30], [-40, -20, 10]])
    scene_data.set_points("TargetsCT", LabelledPoints(("t1", "t2", "t3"), targets))
    scene_data.set_points(
        "TargetsPatient", LabelledPoints(("t3", "t1", "t2"), transform_points(to_reference, targets)[[2, 0, 1]])
    )
    scene_data.set_points("PlausibilityPoints", LabelledPoints(("p",), transform_points(to_reference, bone[:1])))
    return a_logic
