"""The pictures of the slice views: Slicer's own; while a tool moves the CT's cut is made here, and looks the same.

Slicer's pipeline of a slice (layers, thresholds, stencils, blending, each an image of its own) takes several times as long as
the cut itself. Here the CT is cut, its grey values are looked up, and what the view draws over it is laid over it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

RING_HALF = 1.5  # pixels, half the width of the line
GREY = "vtkMRMLColorTableNodeGrey"
OUTSIDE = -32768  # no grey value of a CT; it is black in any window


class SlicePicture:
    """The picture of a slice view.

    Parameters
    ----------
    view : trame_slicer.views.SliceView
    sphere : callable
        Gives the sphere of the error, whose cut is drawn: its middle (3,) in RAS and its radius, mm; or None.
    """

    def __init__(self, view: Any, sphere: Callable[[], tuple[Any, float] | None]) -> None:
        from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

        self._view, self._sphere, self._cut, self._pixels = view, sphere, Cut(), vtkUnsignedCharArray()
        self._exact = True

    def forget(self) -> None:
        """Something other than a tool has changed: Slicer draws the next picture."""
        self._exact = True

    def draw(self) -> npt.NDArray[np.uint8]:
        """The picture (height, width, 3) from the bottom up; it is not written into later."""
        exact, self._exact = self._exact, False
        picture = self._drawn_by_slicer() if exact or not is_plain(self._view) else self._drawn_here()
        sphere = self._sphere()
        if sphere is not None:
            to_slice = np.linalg.inv(np.reshape(self._view.get_view_node().GetXYToRAS().GetData(), (4, 4)))
            draw_ring(picture, to_slice, *sphere)
        return picture

    def _drawn_by_slicer(self) -> npt.NDArray[np.uint8]:
        from Workstation.web.pacing import pixels_of

        self._view.render_window().Render()
        return np.asarray(pixels_of(self._view.render_window()))

    def _drawn_here(self) -> npt.NDArray[np.uint8]:
        window = self._view.render_window()
        below = self._cut.draw(self._view)
        image = self._view._render_manager.image_actor
        image.SetVisibility(False)
        window.SwapBuffersOff()  # there is no screen, and what was drawn is read from where it was drawn
        try:
            window.Render()
        finally:
            window.SwapBuffersOn()
            image.SetVisibility(True)
        height, width = below.shape
        window.GetRGBACharPixelData(0, 0, width - 1, height - 1, 0, self._pixels)
        return laid_over(below, self._pixels)


class Cut:
    """The grey picture of a plain CT's slice; kept until the slice, the CT or its window is another one."""

    def __init__(self) -> None:
        from vtkmodules.vtkImagingCore import vtkImageReslice

        self._reslice, self._image = vtkImageReslice(), None
        self._reslice.SetOutputDimensionality(2)
        self._reslice.SetOutputOrigin(0.0, 0.0, 0.0)
        self._reslice.SetOutputSpacing(1.0, 1.0, 1.0)
        self._reslice.SetBackgroundLevel(OUTSIDE)
        self._reslice.SetNumberOfThreads(1)  # a picture is too small to be shared out
        self._kept: tuple[tuple[Any, ...], npt.NDArray[np.uint8]] | None = None

    def draw(self, view: Any) -> npt.NDArray[np.uint8]:
        """Grey values (height, width) from the bottom up; not to be written into."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkCommonDataModel import vtkImageData
        from vtkmodules.vtkCommonMath import vtkMatrix4x4

        layer, node = view._logic.GetBackgroundLayer(), view.get_view_node()
        volume, display, to_voxels = layer.GetVolumeNode(), layer.GetVolumeDisplayNode(), vtkMatrix4x4()
        volume.GetRASToIJKMatrix(to_voxels)
        vtkMatrix4x4.Multiply4x4(to_voxels, node.GetXYToRAS(), to_voxels)
        (width, height, _), image = node.GetDimensions(), volume.GetImageData()
        stamp = (image.GetMTime(), width, height, display.GetWindow(), display.GetLevel(), display.GetInterpolate())
        stamp += tuple(to_voxels.GetData())
        if self._kept is not None and self._kept[0] == stamp:
            return self._kept[1]
        if self._image is not image:
            voxels = vtkImageData()
            voxels.ShallowCopy(image)
            voxels.SetOrigin(0.0, 0.0, 0.0)
            voxels.SetSpacing(1.0, 1.0, 1.0)
            self._reslice.SetInputData(voxels)
            self._image = image
        self._reslice.SetInterpolationMode(1 if display.GetInterpolate() else 0)
        self._reslice.SetResliceAxes(to_voxels)
        self._reslice.SetOutputExtent(0, width - 1, 0, height - 1, 0, 0)
        self._reslice.Update()
        values = vtk_to_numpy(self._reslice.GetOutput().GetPointData().GetScalars()).reshape(height, width)
        grey = greys(display.GetWindow(), display.GetLevel()).take(values.view(np.uint16))
        self._kept = (stamp, grey)
        return grey


def is_plain(view: Any) -> bool:
    """Whether a slice view shows a CT in grey and nothing with it that would have to be blended."""
    layer, node, shown = view._logic.GetBackgroundLayer(), view.get_view_node(), view._logic.GetSliceCompositeNode()
    volume, display = layer.GetVolumeNode(), layer.GetVolumeDisplayNode()
    image = volume.GetImageData() if volume is not None else None
    if image is None or display is None or shown.GetForegroundVolumeID() or shown.GetLabelVolumeID():
        return False
    return bool(
        volume.GetClassName() == "vtkMRMLScalarVolumeNode"
        and volume.GetParentTransformNode() is None
        and image.GetScalarTypeAsString() == "short"
        and image.GetNumberOfScalarComponents() == 1
        and display.GetColorNodeID() == GREY
        and display.GetWindow() > 0
        and not (display.GetApplyThreshold() or display.GetInvertDisplayScalarRange())
        and not node.GetSlabReconstructionEnabled()
        and tuple(node.GetDimensions()[:2]) == tuple(view.render_window().GetSize())
        and view._render_manager.image_actor.GetVisibility()
    )


@lru_cache(maxsize=4)
def greys(width_hu: float, level_hu: float) -> npt.NDArray[np.uint8]:
    """The grey (65536,) of each value, by its 16 bits, as VTK's window and level make it."""
    values = np.arange(65536).astype(np.uint16).view(np.int16)
    return np.clip((values - level_hu + width_hu / 2) * (255.0 / width_hu), 0.0, 255.0).astype(np.uint8)


def laid_over(below: npt.NDArray[np.uint8], over: Any) -> npt.NDArray[np.uint8]:
    """Grey values (height, width) under what was drawn on nothing: RGBA, each color times its share already."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    picture = np.empty((below.size, 3), np.uint8)
    for channel in range(3):  # several times as fast as all at once
        picture[:, channel] = below.ravel()
    drawn = vtk_to_numpy(over).reshape(-1, 4)
    places = np.flatnonzero(drawn.view(np.uint32).ravel() != 0)
    colors = drawn[places].astype(np.uint16)
    mixed = colors[:, :3] + picture[places] * (255 - colors[:, 3:]) // 255
    picture[places] = np.minimum(mixed, 255)
    return picture.reshape(*below.shape, 3)


def draw_ring(picture: npt.NDArray[np.uint8], to_slice: npt.NDArray[np.float64], middle_ras_mm: Any, radius_mm: float) -> None:
    """Draw where a slice cuts a sphere; `to_slice` (4, 4) leads from RAS to the picture's columns and rows."""
    from Workstation.web.tool_models import RING

    across, up, beside = to_slice[:3, :3] @ middle_ras_mm + to_slice[:3, 3]
    pixels_per_mm = np.linalg.norm(to_slice[:2, :3], axis=1).mean()
    off_mm = beside / np.linalg.norm(to_slice[2, :3])
    if abs(off_mm) >= radius_mm:
        return
    radius = np.sqrt(radius_mm**2 - off_mm**2) * pixels_per_mm
    reach, (height, width, _) = radius + RING_HALF + 1.0, picture.shape
    low = np.clip(np.floor([up - reach, across - reach]), 0, (height, width)).astype(int)
    high = np.clip(np.ceil([up + reach, across + reach]) + 1, 0, (height, width)).astype(int)
    rows, columns = np.arange(low[0], high[0])[:, None], np.arange(low[1], high[1])
    distance = np.abs(np.hypot(rows - up, columns - across) - radius)
    share = np.clip(RING_HALF + 0.5 - distance, 0.0, 1.0)[..., None]
    part = picture[low[0] : high[0], low[1] : high[1]]
    part[...] = share * (255.0 * np.array(RING)) + (1.0 - share) * part
