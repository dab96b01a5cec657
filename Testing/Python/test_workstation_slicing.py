"""While a tool moves the slices are cut here; they must look as Slicer draws them, and Slicer draws what is not a plain CT."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from vtkmodules.util.numpy_support import numpy_to_vtk
from vtkmodules.vtkCommonCore import vtkCommand
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkCommonMath import vtkMatrix4x4

from Workstation.web.slicing import SlicePicture, draw_ring, is_plain
from Workstation.web.tool_models import RING

SIZE = (150, 110)


def new_volume(scene: Any, rng: Any) -> Any:
    """A CT whose voxels are noise, turned and not cubes, so that every mistake shows."""
    values = rng.integers(-1000, 2500, (20, 30, 40)).astype(np.int16)
    image = vtkImageData()
    image.SetDimensions(40, 30, 20)
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(), deep=True))
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "CT")
    node.SetAndObserveImageData(image)
    node.SetSpacing(2.0, 2.5, 4.0)
    turned, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    node.SetIJKToRASDirections(*turned.ravel())
    node.CreateDefaultDisplayNodes()
    node.GetDisplayNode().SetAndObserveColorNodeID("vtkMRMLColorTableNodeGrey")
    node.GetDisplayNode().SetAutoWindowLevel(False)
    node.GetDisplayNode().SetWindowLevel(1500.0, 300.0)
    return node


@pytest.fixture(scope="module")
def a_slice_view():
    from trame_slicer.core import SlicerApp
    from trame_slicer.views import ScheduledRenderStrategy, SliceView

    app = SlicerApp()
    view = SliceView(app.scene, app.app_logic, "Red", scheduled_render_strategy=ScheduledRenderStrategy())
    view.render_window().SetMultiSamples(0)
    view.interactor().UpdateSize(*SIZE)
    view.interactor().InvokeEvent(vtkCommand.WindowResizeEvent)
    view.volume = new_volume(app.scene, np.random.default_rng(4))
    view.set_background_volume_id(view.volume.GetID())
    view.fit_view_to_content()
    points = app.scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "Points")
    points.CreateDefaultDisplayNodes()
    centre = np.zeros(6)
    view.volume.GetRASBounds(centre)
    view.centre = centre.reshape(3, 2).mean(axis=1)
    points.AddControlPoint(*view.centre, "drawn over it")
    view.app = app
    return view


def drawn(view: Any, by_slicer: bool, sphere: Any = None) -> Any:
    picture = SlicePicture(view, lambda: sphere)
    picture._exact = by_slicer
    return picture.draw().astype(int)


@pytest.mark.parametrize("interpolate", [True, False])
@pytest.mark.parametrize("turn", [0.0, 25.0])
def test_a_cut_made_here_looks_as_slicer_draws_it(a_slice_view, interpolate, turn):
    view, node = a_slice_view, a_slice_view.get_view_node()
    view.volume.GetDisplayNode().SetInterpolate(interpolate)
    node.SetOrientation("Axial")
    turned, to_ras = vtkMatrix4x4(), node.GetSliceToRAS()
    angle = np.radians(turn)
    turned.SetElement(1, 1, np.cos(angle)), turned.SetElement(2, 2, np.cos(angle))
    turned.SetElement(1, 2, -np.sin(angle)), turned.SetElement(2, 1, np.sin(angle))
    vtkMatrix4x4.Multiply4x4(turned, to_ras, to_ras)
    node.UpdateMatrices()
    for shift in ((0.0, 0.0, 0.0), (3.3, -2.1, 0.4)):
        node.JumpSliceByCentering(*(view.centre + shift))
        assert is_plain(view)
        slicers, own = drawn(view, True), drawn(view, False)
        assert slicers.std() > 20
        assert shift[0] or np.ptp(slicers, axis=2).max() > 100  # the point, in colour
        assert np.abs(own - slicers).max() <= 2
        assert (own != slicers).mean() < 0.02  # rounding, where letters are laid over


def test_a_new_window_or_ct_is_seen_at_once(a_slice_view):
    view, display = a_slice_view, a_slice_view.volume.GetDisplayNode()
    view.get_view_node().SetOrientation("Axial")
    view.get_view_node().JumpSliceByCentering(*(view.centre + (0.0, 0.0, 15.0)))  # the point's letters are not laid over
    picture = SlicePicture(view, lambda: None)
    picture.draw()
    for change in (lambda: display.SetWindowLevel(80.0, 40.0), lambda: display.SetWindowLevel(1500.0, 300.0)):
        change()
        assert np.abs(picture.draw().astype(int) - drawn(view, True)).max() <= 1
    values = view.volume.GetImageData().GetPointData().GetScalars()
    values.Fill(700)
    values.Modified()
    view.volume.GetImageData().Modified()
    assert np.abs(picture.draw().astype(int) - drawn(view, True)).max() <= 1


@pytest.mark.parametrize(
    ("change", "back"),
    [
        (lambda one: one.GetDisplayNode().SetApplyThreshold(True), lambda one: one.GetDisplayNode().SetApplyThreshold(False)),
        (
            lambda one: one.GetDisplayNode().SetAndObserveColorNodeID("vtkMRMLColorTableNodeRainbow"),
            lambda one: one.GetDisplayNode().SetAndObserveColorNodeID("vtkMRMLColorTableNodeGrey"),
        ),
    ],
)
def test_what_is_not_a_plain_ct_is_drawn_by_slicer(a_slice_view, change, back):
    view = a_slice_view
    change(view.volume)
    assert not is_plain(view)
    assert (drawn(view, False) == drawn(view, True)).all()
    back(view.volume)
    view._logic.GetSliceCompositeNode().SetForegroundVolumeID(view.volume.GetID())
    assert not is_plain(view)
    view._logic.GetSliceCompositeNode().SetForegroundVolumeID(None)
    assert is_plain(view)


def test_only_what_tools_do_is_drawn_here(a_slice_view, monkeypatch):
    picture = SlicePicture(a_slice_view, lambda: None)
    by_slicer = []
    monkeypatch.setattr(picture, "_drawn_by_slicer", lambda: by_slicer.append(1) or np.zeros((*SIZE[::-1], 3), np.uint8))
    picture.draw()
    picture.draw()
    assert by_slicer == [1]  # the first picture; then only tools have moved
    picture.forget()
    picture.draw()
    picture.draw()
    assert by_slicer == [1, 1]


@pytest.mark.parametrize(("off_mm", "radius"), [(0.0, 10.0), (3.0, 8.0), (6.0, None)])
def test_the_ring_is_where_the_slice_cuts_the_sphere(off_mm, radius):
    to_slice = np.diag([2.0, 2.0, 1.0, 1.0])  # two pixels a millimetre
    to_slice[:3, 3] = 30.0, 40.0, -off_mm
    picture = np.zeros((80, 60, 3), np.uint8)
    draw_ring(picture, to_slice, np.zeros(3), 5.0)
    rows, columns = np.nonzero(picture[..., 0] > 127)
    if radius is None:
        assert not len(rows)
        return
    distances = np.hypot(rows - 40.0, columns - 30.0)
    assert distances.mean() == pytest.approx(radius, abs=0.2)
    assert np.abs(distances - radius).max() <= 1.6
    assert len(rows) == pytest.approx(2 * np.pi * radius * 3, rel=0.1)  # a closed line, three pixels wide
    np.testing.assert_allclose(picture.max(axis=(0, 1)), 255 * np.array(RING), atol=1)
