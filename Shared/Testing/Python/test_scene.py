"""Roles: found by attribute, whatever a node is called, also after a way through .mrb."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.slicer_files import LabelledPoints, load_scene, save_scene


@pytest.fixture(autouse=True)
def an_empty_scene():
    host.scene().Clear(False)
    yield host.scene()
    host.scene().Clear(False)


@pytest.mark.parametrize("name", scene.ROLES)
def test_each_role_makes_a_node_of_its_class_under_its_parent(name):
    node = scene.find_or_create(name)
    wanted = scene.role(name)
    assert node.GetClassName() == wanted.mrml_class
    assert node is scene.find(name) is scene.find_or_create(name)
    if wanted.parent:
        assert node.GetParentTransformNode() is scene.find(wanted.parent)


def test_parents_are_roles_of_transforms():
    for role in scene.ROLES.values():
        assert role.parent == "" or scene.role(role.parent).node_class == "LinearTransform"


def test_a_transform_that_left_the_scene_is_not_found_again(an_empty_scene):
    for leave in (an_empty_scene.RemoveNode, lambda node: an_empty_scene.Clear(False)):
        node = scene.find_or_create("ProbeToReference")
        assert scene.find("ProbeToReference") is node
        leave(node)
        assert scene.find("ProbeToReference") is None
    node = scene.find_or_create("ProbeToReference")
    node.RemoveAttribute(scene.ROLE_ATTRIBUTE)
    assert scene.find("ProbeToReference") is None
    assert scene.find_or_create("ProbeToReference") is not node


def test_a_role_survives_renaming():
    node = scene.find_or_create("SurfacePoints")
    node.SetName("Punkte vom Dienstag")
    assert scene.find("SurfacePoints") is node


def test_a_node_of_the_right_name_without_the_role_is_left_alone(an_empty_scene):
    stranger = an_empty_scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "ReferenceToRas")
    assert scene.find("ReferenceToRas") is None
    assert scene.find_or_create("ReferenceToRas") is not stranger


def test_an_unknown_role_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match=r"no role 'Skull'.*Bone"):
        scene.find("Skull")


def test_a_chosen_node_takes_the_role_over_and_its_parent(an_empty_scene):
    before = scene.find_or_create("TargetsPatient")
    chosen = an_empty_scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "mine")
    scene.assign("TargetsPatient", chosen)
    assert scene.find("TargetsPatient") is chosen
    assert before.GetAttribute(scene.ROLE_ATTRIBUTE) is None
    assert chosen.GetParentTransformNode() is scene.find("ReferenceToRas")


def test_a_node_of_another_class_cannot_take_the_role(an_empty_scene):
    model = an_empty_scene.AddNewNodeByClass("vtkMRMLModelNode", "m")
    with pytest.raises(InputError, match=r"TargetsCT needs a vtkMRMLMarkupsFiducialNode, got vtkMRMLModelNode 'm'"):
        scene.assign("TargetsCT", model)


def test_two_observers_of_a_node_both_hear_of_a_write_until_they_stop():
    heard = {"guidance": [], "registration": []}
    matrix = rigid_from_vector([0.1, 0.2, 0.3], [1, 2, 3])

    def listener(name):
        return lambda node: heard[name].append(scene_data.get_transform("ProbeToReference"))

    first = scene.observe("ProbeToReference", listener("guidance"))
    second = scene.observe("ProbeToReference", listener("registration"))
    scene_data.set_transform("ProbeToReference", matrix)
    for name in heard:
        np.testing.assert_allclose(heard[name][-1], matrix, atol=1e-12)
    first.stop()
    first.stop()
    counts = {name: len(calls) for name, calls in heard.items()}
    scene_data.set_transform("ProbeToReference", np.eye(4))
    assert len(heard["guidance"]) == counts["guidance"]
    assert len(heard["registration"]) > counts["registration"]
    second.stop()


def test_a_point_placed_by_hand_is_heard_of():
    heard = []
    observation = scene.observe("LandmarksPatient", heard.append)
    scene.find("LandmarksPatient").AddControlPoint([1.0, 2.0, 3.0], "Nasion")
    assert heard
    observation.stop()


def test_moving_the_registration_moves_the_patients_points_in_the_world():
    node = scene_data.set_points("SurfacePoints", LabelledPoints(("a",), np.array([[1.0, 2.0, 3.0]])))
    scene_data.set_transform("ReferenceToRas", rigid_from_vector([0, 0, np.pi / 2], [10, 0, 0]))
    np.testing.assert_allclose(node.GetNthControlPointPositionWorld(0), [8, 1, 3], atol=1e-12)
    np.testing.assert_allclose(scene_data.get_points("SurfacePoints").positions_mm, [[1, 2, 3]])


def test_all_roles_survive_a_way_through_mrb(tmp_path):
    names = {role: f"renamed {role}" for role in scene.ROLES}
    for role, name in names.items():
        scene.find_or_create(role).SetName(name)
    save_scene(tmp_path / "scene.mrb")
    host.scene().Clear(False)
    assert scene.find("Bone") is None
    load_scene(tmp_path / "scene.mrb")
    for role, name in names.items():
        node = scene.find(role)
        assert node is not None, role
        assert node.GetName() == name
        if scene.role(role).parent:
            assert node.GetParentTransformNode() is scene.find(scene.role(role).parent)


def test_a_saved_scene_is_a_bundle_as_slicer_expects_it(tmp_path):
    points = LabelledPoints(("Nasion",), np.array([[1.0, 2.0, 3.0]]))
    scene_data.set_points("LandmarksCT", points)
    scene_data.set_transform("ReferenceToRas", np.eye(4))
    scene_data.set_text("Report", "<html>ä</html>")
    scene_data.set_table("Results", {"quantity": ["x"], "value": ["1"]})
    save_scene(tmp_path / "case one.mrb")
    with zipfile.ZipFile(tmp_path / "case one.mrb") as archive:
        names = archive.namelist()
        tops = {name.split("/")[0] for name in names}
        assert len(tops) == 1, "one folder on top"
        top = tops.pop()
        assert [name for name in names if name.endswith(".mrml")] == [f"{top}/{top}.mrml"]
        mrml = archive.read(f"{top}/{top}.mrml").decode()
    assert str(tmp_path) not in mrml, "no path of this computer"
    for ending in ("LandmarksCT.mrk.json", "ReferenceToRas.h5", "Report.txt", "Results.tsv"):
        assert any(name.endswith(f"Data/{ending}") for name in names), ending
    assert mrml.count('name=""') == 0


def test_shared_nodes_stand_in_one_folder_of_the_subject_hierarchy(an_empty_scene):
    node = scene.find_or_create("Bone")
    hierarchy = host.slicer_package().vtkMRMLSubjectHierarchyNode.GetSubjectHierarchyNode(an_empty_scene)
    item = hierarchy.GetItemByDataNode(node)
    assert hierarchy.GetItemName(hierarchy.GetItemParent(item)) == scene.FOLDER
