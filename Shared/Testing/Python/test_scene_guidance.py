"""What guidance rests on, as the scene has it."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.scene_guidance import forget_refinement, get_guidance, set_refinement, set_remark
from CranioNavLib.slicer_files import LabelledPoints, load_scene, save_scene

ROUGH, FINE = (rigid_from_vector([0.1, -0.2, angle], [1.0 / 3, 20.0, -40.0]) for angle in (0.30, 0.31))
ERROR = np.diag([1e-4, 2e-4, 3e-4, 0.5, 0.6, 0.7])


@pytest.fixture
def a_registered_scene():
    host.scene().Clear(False)
    scene_data.set_motion_error(10 * ERROR, [0, 1, 2], 9.0)
    scene_data.set_transform("ReferenceToRas", ROUGH).SetAttribute(scene.STATUS_ATTRIBUTE, "landmarks")
    yield
    host.scene().Clear(False)


def test_without_a_registration_there_is_nothing_to_rest_on(a_registered_scene):
    set_refinement(FINE, ERROR, [1, 2, 3], None, ("a", "b"))
    scene.find("ReferenceToRas").RemoveAttribute(scene.STATUS_ATTRIBUTE)
    assert get_guidance() is None


def test_guidance_rests_on_the_registration_until_it_is_refined(a_registered_scene):
    rough = get_guidance()
    np.testing.assert_array_equal(rough.reference_to_ras, ROUGH)
    np.testing.assert_array_equal(rough.error[0], 10 * ERROR)
    assert (rough.points, rough.refined, rough.remark) == ((), False, "")
    scene_data.set_points("RegisteredPoints", LabelledPoints(("p",), np.zeros((1, 3))))
    assert get_guidance().points == ("p",)
    set_remark("too few")
    assert (get_guidance().remark, get_guidance().refined) == ("too few", False)
    set_refinement(FINE, ERROR, [1, 2, 3], None, ("a", "b"))
    fine = get_guidance()
    np.testing.assert_array_equal(fine.reference_to_ras, FINE)
    np.testing.assert_array_equal(fine.error[0], ERROR)
    assert (fine.points, fine.refined, fine.remark) == (("a", "b"), True, ""), "what was said of the one before is gone"
    np.testing.assert_array_equal(scene_data.get_transform("ReferenceToRas"), ROUGH)
    set_remark("ambiguous")
    assert (get_guidance().remark, get_guidance().points) == ("ambiguous", ("a", "b"))
    forget_refinement()
    np.testing.assert_array_equal(get_guidance().reference_to_ras, ROUGH)
    assert get_guidance().remark == ""


def test_a_refinement_is_void_with_another_registration_in_force(a_registered_scene):
    set_refinement(FINE, ERROR, [1, 2, 3], None, ("a", "b"))
    other = rigid_from_vector([0, 0, 0], [1, 0, 0]) @ ROUGH
    scene_data.set_transform("ReferenceToRas", other)
    np.testing.assert_array_equal(get_guidance().reference_to_ras, other)
    set_remark("too few")
    assert not get_guidance().refined, "a remark does not bring it back"


def test_a_saved_scene_keeps_it(a_registered_scene, tmp_path):
    set_refinement(FINE, ERROR, [1, 2, 3], 12.5, ("a", "b"))
    save_scene(tmp_path / "s.mrb")
    load_scene(tmp_path / "s.mrb")
    assert get_guidance().points in (("a", "b"), ())  # a matrix that the file has rounded is another one
    assert get_guidance().refined == (scene_data.get_transform("ReferenceToRas").tolist() == ROUGH.tolist())
