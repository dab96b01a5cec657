"""What the views show: framing, colours of the error, shapes and visibility of points, the ring's size."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data, slice_views
from CranioNavLib.slicer_files import LabelledPoints
from CranioNavLib.surface import Surface
from hypothesis import given
from hypothesis import strategies as st
from vtkmodules.util.numpy_support import vtk_to_numpy

from Workstation.web import color_scale, error_views, framing
from Workstation.web.drawn_models import CoarseCopy, hide
from Workstation.web.point_styles import STYLES, PointStyles
from Workstation.web.tool_models import ErrorRing, ToolModels


@pytest.fixture
def an_empty_scene():
    host.scene().Clear(False)
    yield host.scene()
    host.scene().Clear(False)


class Camera:
    """A camera as far as framing knows one."""

    def __init__(self) -> None:
        self.position, self.focus, self.up = np.array([0.0, 500, 0]), np.zeros(3), np.array([0.0, 0, 1])

    def __getattr__(self, name):
        what = {"Position": "position", "FocalPoint": "focus", "ViewUp": "up"}[name[3:]]
        if name.startswith("Get"):
            return lambda: tuple(getattr(self, what))
        return lambda *place: setattr(self, what, np.array(place, dtype=float))


class View:
    """A 3-D view as far as framing knows one."""

    def __init__(self) -> None:
        self.camera, self.size, self.fits = Camera(), (400, 300), 0
        self.told = None

    def get_view_node_id(self):
        return "view"

    def interactor(self):
        return SimpleNamespace(AddObserver=lambda event, callback: setattr(self, "told", callback))

    def render_window(self):
        return SimpleNamespace(GetSize=lambda: self.size)

    def renderer(self):
        return SimpleNamespace(GetActiveCamera=lambda: self.camera, ResetCameraScreenSpace=self._fitted)

    def _fitted(self, bounds, margin):
        self.fits += 1

    def set_focal_point(self, *place):
        self.camera.focus = np.array(place)

    def schedule_render(self):
        pass

    def reset_view(self):
        self.camera = Camera()


@pytest.fixture
def a_view():
    view = View()
    manager = SimpleNamespace(get_views=lambda: [view], get_slice_views=list, get_threed_views=lambda: [view])
    view.framing = framing.Framing(manager, lambda: (-70.0, 70, -90, 90, -80, 80))
    view.framing.fit()
    view.framing.keep()
    return view


def test_a_resized_view_is_fitted_again_in_the_moment_of_its_resize(a_view):
    before = a_view.fits
    a_view.framing.keep()
    assert a_view.fits == before
    a_view.size = (800, 600)
    a_view.told()
    assert a_view.fits == before + 1


def test_a_view_that_the_user_has_turned_stays_as_it_is(a_view):
    a_view.camera.position = np.array([300.0, 300, 100])
    a_view.framing.keep()  # this is how the turning is noticed
    before = a_view.fits
    a_view.size = (800, 600)
    a_view.framing.keep()
    a_view.framing.face((0.0, -90, 0))
    assert a_view.fits == before
    np.testing.assert_array_equal(a_view.camera.position, [300, 300, 100])


def test_a_point_at_the_back_turns_the_head_and_one_in_front_does_not(a_view):
    a_view.framing.face((20.0, 80, 10))
    np.testing.assert_array_equal(a_view.camera.position, [0, 500, 0])
    a_view.framing.face((0.0, -90, 20))
    assert a_view.camera.position[1] < -400
    assert np.linalg.norm(a_view.camera.position) == pytest.approx(500)


@pytest.mark.parametrize("outward", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, -1, 0.3), (0.02, 0, 0.9)])
def test_the_eye_sees_the_point_and_never_stands_straight_above(outward):
    eye = framing.facing(np.array(outward, dtype=float))
    assert np.linalg.norm(eye) == pytest.approx(1)
    assert abs(eye[2]) <= framing.STEEPEST
    assert eye[2] > -0.5
    if outward[2] >= 0:
        assert framing.seen(outward, eye)


def test_the_scale_grows_lighter_all_along():
    lightness = color_scale.colors(64) @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(lightness) > 0).all()


def test_the_scale_has_no_red_against_green():
    """What the red-green blind see: red and green as their mean. Steps of the scale stay apart."""
    seen = color_scale.colors(8).copy()
    seen[:, :2] = seen[:, :2].mean(axis=1, keepdims=True)
    assert (np.linalg.norm(np.diff(seen, axis=0), axis=1) > 0.05).all()


def test_points_left_out_have_another_shape():
    positions, used = np.array([[0.0, 0, 0], [50, 0, 0]]), np.array([True, False])
    mesh = error_views.residual_glyphs(positions, np.array([0.4, 3.0]), used)
    vertices, values = vtk_to_numpy(mesh.GetPoints().GetData()), vtk_to_numpy(mesh.GetPointData().GetArray(error_views.RESIDUAL))
    ball, cross = vertices[values < 1], vertices[values > 1] - positions[1]
    np.testing.assert_allclose(np.linalg.norm(ball, axis=1), error_views.USED_MM, rtol=1e-3)
    assert len(cross) == 3 * 24
    assert np.abs(cross).max() == pytest.approx(error_views.REJECTED_MM)


def a_bone(an_empty_scene):
    from CranioNavLib.phantom import make_patient

    scene_data.set_surface("Bone", make_patient(None, seed=1).bone)
    copy = CoarseCopy("Bone")
    assert copy.refresh()
    return copy


def a_ball(radius_mm):
    from vtkmodules.vtkFiltersSources import vtkSphereSource

    source = vtkSphereSource()
    source.SetRadius(radius_mm)
    source.SetThetaResolution(40)
    source.SetPhiResolution(40)
    source.Update()
    return Surface.from_polydata(source.GetOutput())


def test_a_copy_is_made_elsewhere_and_shown_when_it_is_ready_unless_there_is_a_newer_bone(an_empty_scene):
    bones, waiting = [a_ball(radius) for radius in (60.0, 80.0)], []
    copy = CoarseCopy("Bone", lambda compute, finished: waiting.append((compute, finished)))
    model = scene_data.set_surface("Bone", bones[0])
    assert not copy.refresh()  # it is being made
    assert not copy.refresh()
    scene_data.set_surface("Bone", bones[1])
    assert not copy.refresh()
    (old, take_old), (new, take_new) = waiting
    take_old(old())
    assert not copy.refresh()
    assert copy.node is None
    take_new(new())
    assert copy.refresh()
    assert not copy.refresh()
    assert not model.GetDisplayNode().GetVisibility()
    np.testing.assert_allclose(copy.node.GetPolyData().GetBounds(), model.GetPolyData().GetBounds(), atol=3.0)


def test_a_large_surface_is_hidden_before_the_first_picture_of_it(an_empty_scene):
    model = scene_data.set_surface("Bone", a_ball(60.0))
    assert model.GetDisplayNode().GetVisibility()
    hide("Bone")
    hide("Skin")  # there is none
    assert not model.GetDisplayNode().GetVisibility()


def test_the_expected_error_is_drawn_where_it_is_and_shrinks_with_points(an_empty_scene):
    """Translation alone: the same error everywhere; a rotation about the pivot: growing with the distance from it."""
    from ModuleRegistrationLib.registration.error_theory import predict_tre

    copy, views = a_bone(an_empty_scene), error_views.ErrorViews()
    assert views.refresh(copy.node, error_views.MAP) is None
    pivot, turning = np.array([0.0, 80, 0]), np.diag([1e-4, 1e-4, 1e-4, 0.25, 0.25, 0.25])
    scene_data.set_motion_error(turning, pivot, None)
    scene.find("ReferenceToRas").SetAttribute(scene.STATUS_ATTRIBUTE, "landmarks")
    legend = views.refresh(copy.node, error_views.MAP)
    assert "Expected error" in legend["title"]
    mesh = copy.node.GetPolyData()
    vertices = vtk_to_numpy(mesh.GetPoints().GetData()).astype(float)
    drawn = vtk_to_numpy(mesh.GetPointData().GetArray(error_views.ERROR))
    np.testing.assert_allclose(drawn, predict_tre(turning, pivot, vertices).p95_mm, rtol=1e-5)
    far = np.linalg.norm(vertices - pivot, axis=1)
    assert drawn[far > 150].min() > drawn[far < 20].max()
    before = drawn.copy()
    scene_data.set_points("SurfacePoints", LabelledPoints(("a", "b", "c"), vertices[:: len(vertices) // 3][:3]))
    assert "taken: 3" in views.refresh(copy.node, error_views.MAP)["note"]
    after = vtk_to_numpy(mesh.GetPointData().GetArray(error_views.ERROR))
    assert (after <= before + 1e-6).all()
    assert after.mean() < 0.95 * before.mean()
    assert views.refresh(copy.node, error_views.NONE) is None
    assert not copy.node.GetDisplayNode().GetScalarVisibility()


def test_a_copy_is_drawn_in_place_of_a_large_surface_and_goes_with_it(an_empty_scene):
    copy = a_bone(an_empty_scene)
    bone = scene.find("Bone")
    assert copy.node.GetPolyData().GetNumberOfCells() <= bone.GetPolyData().GetNumberOfCells()
    assert not bone.GetDisplayNode().GetVisibility()
    assert not copy.node.GetSaveWithScene()
    assert not copy.refresh()
    scene.release("Bone")
    copy.refresh()
    assert copy.node is None


def test_lists_of_the_patient_are_seen_in_their_steps_once_their_place_is_known(an_empty_scene):
    scene_data.set_points("LandmarksCT", LabelledPoints(("a", "b"), np.eye(3)[:2]))
    scene_data.set_points("LandmarksPatient", LabelledPoints(("a",), np.eye(3)[:1]))
    styles = PointStyles()

    def visible(role):
        return bool(scene.find(role).GetDisplayNode().GetVisibility())

    styles.refresh("landmarks", False, "b")
    assert visible("LandmarksCT")
    assert not visible("LandmarksPatient")
    assert [scene.find("LandmarksCT").GetNthControlPointSelected(k) for k in range(2)] == [0, 1]
    scene.find("ReferenceToRas").SetAttribute(scene.STATUS_ATTRIBUTE, "landmarks")
    styles.refresh("landmarks", False, "b")
    assert visible("LandmarksPatient")
    styles.refresh("navigation", False, "")
    assert not visible("LandmarksPatient")


def test_landmarks_can_be_dragged_only_where_they_are_planned(an_empty_scene):
    node = scene_data.set_points("LandmarksCT", LabelledPoints(("a",), np.zeros((1, 3))))
    styles = PointStyles()
    for step, locked in (("bone", 0), ("landmarks", 1), ("ultrasound", 1)):
        styles.refresh(step, False, "")
        assert node.GetLocked() == locked


def test_planned_and_touched_points_differ_in_shape_not_only_in_colour():
    assert STYLES["LandmarksCT"].glyph != STYLES["LandmarksPatient"].glyph
    assert STYLES["TargetsCT"].glyph != STYLES["TargetsPatient"].glyph
    assert STYLES["ProtocolPoints"].glyph != STYLES["SurfacePoints"].glyph


def test_the_skull_is_not_coloured_by_another_registrations_error_while_its_own_is_computed(an_empty_scene):
    waiting = []
    copy, views = a_bone(an_empty_scene), error_views.ErrorViews(lambda compute, finished: waiting.append((compute, finished)))
    scene.find_or_create("ReferenceToRas").SetAttribute(scene.STATUS_ATTRIBUTE, "landmarks")
    turning = np.diag([1e-4, 1e-4, 1e-4, 0.25, 0.25, 0.25])
    scene_data.set_motion_error(turning, np.zeros(3), None)
    for _ in range(2):
        assert views.refresh(copy.node, error_views.MAP) is None  # computing
    ((compute, finished),) = waiting
    finished(compute())
    assert views.refresh(copy.node, error_views.MAP) is not None
    scene_data.set_motion_error(4 * turning, np.zeros(3), None)
    assert views.refresh(copy.node, error_views.MAP) is None
    assert not copy.node.GetDisplayNode().GetScalarVisibility()
    assert len(waiting) == 2


def test_the_dots_of_the_points_carry_their_names(an_empty_scene):
    from types import SimpleNamespace

    from ModuleUltrasoundLib.live_drawings import PointState

    from Workstation.web.drawings import progress

    scene_data.set_points("ProtocolPoints", LabelledPoints(("a", "b", "c"), np.eye(3)))
    logic = SimpleNamespace(pointStates=lambda: [PointState.TAKEN, PointState.OPEN, PointState.NOW])
    assert progress(logic) == [{"label": "a", "state": "taken"}, {"label": "b", "state": "open"}, {"label": "c", "state": "now"}]


def test_the_ring_has_the_size_of_the_error_and_goes_without_one(an_empty_scene):
    ring = ErrorRing()
    ring.show(np.array([10.0, -20, 30]), 2.5)
    node = an_empty_scene.GetFirstNodeByName("Error ring")
    for place, radius in (((10.0, -20, 30), 2.5), ((-3.0, 5, 1), 0.7)):
        ring.show(np.array(place), radius)
        bounds = np.zeros(6)
        node.GetRASBounds(bounds)
        bounds = bounds.reshape(3, 2)
        np.testing.assert_allclose(bounds.mean(axis=1), place, atol=0.05)
        np.testing.assert_allclose(np.diff(bounds, axis=1)[:, 0] / 2, radius, rtol=0.02)
    ring.show(np.array([10.0, -20, 30]), None)
    assert not node.GetDisplayNode().GetVisibility()


def test_a_lost_tool_is_not_drawn_where_it_was(an_empty_scene):
    scene.find_or_create("ReferenceToRas").SetAttribute(scene.STATUS_ATTRIBUTE, "accepted")
    tools = ToolModels()
    scene_data.set_pose("StylusToReference", np.eye(4), "OK", 1.0)
    tools.refresh(0.0)
    (drawn,) = tools.nodes()
    assert drawn.GetDisplayNode().GetVisibility()
    scene_data.set_pose("StylusToReference", None, "MISSING", 1.3)
    tools.refresh(0.0)
    assert not drawn.GetDisplayNode().GetVisibility()


def test_the_slices_cross_where_they_were_sent(an_empty_scene):
    for name, orientation in (("Red", "Axial"), ("Green", "Coronal"), ("Yellow", "Sagittal")):
        node = an_empty_scene.AddNewNodeByClass("vtkMRMLSliceNode", name)
        node.SetSingletonTag(name)
        {"Axial": node.SetOrientationToAxial, "Coronal": node.SetOrientationToCoronal}.get(
            orientation, node.SetOrientationToSagittal
        )()
    slice_views.go_to((12.0, -34, 56))
    np.testing.assert_allclose(slice_views.crossing(), [12, -34, 56], atol=1e-6)
    slice_views.zoom_on((1.0, 2, 3), 90.0)
    np.testing.assert_allclose(slice_views.crossing(), [1, 2, 3], atol=1e-6)
    assert min(slice_views.slice_nodes()[0].GetFieldOfView()[:2]) == pytest.approx(90.0)


def test_without_three_slices_there_is_no_crossing(an_empty_scene, monkeypatch):
    node = an_empty_scene.AddNewNodeByClass("vtkMRMLSliceNode", "Red")
    for nodes in ([], [node], [node] * 3):
        monkeypatch.setattr(slice_views, "slice_nodes", lambda nodes=nodes: nodes)
        assert slice_views.crossing() is None


def test_the_lit_grey_window_is_the_one_that_the_slices_have(an_empty_scene):
    from CranioNavLib.volume import Volume

    from Workstation.web.view_controls import ViewControls

    server = SimpleNamespace(state=SimpleNamespace(), controller=SimpleNamespace(trigger=lambda name: lambda function: None))
    controls = ViewControls(server, None, None, lambda: None)
    display = scene_data.set_volume("CT", Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), "nothing")).GetDisplayNode()
    display.SetWindowLevel(1500.0, 300.0)  # as dragging does
    controls.look()
    assert server.state.window == ""
    controls.show_window("bone")
    assert (display.GetWindow(), display.GetLevel()) == (2000.0, 400.0)
    controls.look()
    assert server.state.window == "bone"


@given(st.floats(0.2, 3.0), st.floats(-3.1, 3.1), st.lists(st.sampled_from("JLIK"), min_size=1, max_size=30))
def test_turning_by_keys_keeps_the_distance_and_the_head_upright_and_back_undoes_it(far, round_rad, keys):
    from vtkmodules.vtkRenderingCore import vtkCamera

    from Workstation.web.turning import turn
    from Workstation.web.view_controls import TURNS_DEG

    camera, middle = vtkCamera(), np.array([3.0, -20.0, 40.0])
    camera.SetFocalPoint(*middle)
    camera.SetPosition(*(middle + 100 * far * np.array([np.cos(round_rad), np.sin(round_rad), 0.3])))
    for key in keys:
        turn(camera, *TURNS_DEG[key])
        assert camera.GetDistance() == pytest.approx(100 * far * np.hypot(1, 0.3), rel=1e-9)
        assert camera.GetViewUp() == (0, 0, 1)
        assert abs(camera.GetDirectionOfProjection()[2]) < 0.997  # never along it: the picture would turn over
    before = np.array(camera.GetPosition())
    for key in "JL":
        turn(camera, *TURNS_DEG[key])
    np.testing.assert_allclose(camera.GetPosition(), before, atol=1e-6)


def test_turning_to_the_right_is_as_vtk_turns_a_camera():
    from vtkmodules.vtkRenderingCore import vtkCamera

    from Workstation.web.turning import come_nearer, turn

    ours, theirs = vtkCamera(), vtkCamera()
    for camera in (ours, theirs):
        camera.SetPosition(0.0, 300.0, 0.0)  # the patient's face
        camera.SetViewUp(0.0, 0.0, 1.0)
    turn(ours, 15, 0)
    theirs.Azimuth(15)
    np.testing.assert_allclose(ours.GetPosition(), theirs.GetPosition(), atol=1e-9)
    turn(ours, 0, 15)
    theirs.Elevation(15)
    np.testing.assert_allclose(ours.GetPosition(), theirs.GetPosition(), atol=1e-9)
    come_nearer(ours, 1.2)
    theirs.Dolly(1.2)
    np.testing.assert_allclose(ours.GetPosition(), theirs.GetPosition(), atol=1e-9)
