"""Draws what moves over a kept picture of what stands still: without a graphics card a skull takes too long for each pose.

The kept picture has the depth of each pixel, so that a tool behind bone stays hidden as it would be if all were drawn anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

CROSSHAIR = "vtkHandleRepresentation"
EDGE = 4  # pixels about what moves, for the width of lines
NEAR_SHARE = 0.002  # of the farthest distance: how near to the eye a tool is still drawn


@dataclass(frozen=True, eq=False)
class Still:
    """What stands still."""

    stamp: tuple[Any, ...]  # of the view when it was drawn
    colors: npt.NDArray[np.uint8]  # (height, width, 3), from the bottom up
    depths: npt.NDArray[np.float32]  # (height, width), mm before the eye


class MovingPicture:
    """The picture of a 3-D view.

    Parameters
    ----------
    view : trame_slicer.views.ThreeDView
    models : callable
        Gives the model nodes that move; they are left out of the view itself, and drawn here.
    """

    def __init__(self, view: Any, models: Callable[[], Iterable[Any]]) -> None:
        from vtkmodules.vtkCommonCore import vtkFloatArray, vtkUnsignedCharArray
        from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow

        self._view, self._models = view, models
        self._depths, self._pixels = vtkFloatArray(), vtkUnsignedCharArray()
        self._window, self._renderer = vtkRenderWindow(), vtkRenderer()
        self._window.SetOffScreenRendering(1)
        self._window.SetMultiSamples(0)
        self._window.SetAlphaBitPlanes(1)
        self._window.SwapBuffersOff()  # there is no screen, and what was drawn is read from where it was drawn
        self._renderer.SetBackgroundAlpha(0.0)
        self._window.AddRenderer(self._renderer)
        self._actors: dict[str, Any] = {}
        self._still: Still | None = None

    def forget(self) -> None:
        """Something that stands still has changed."""
        self._still = None

    def draw(self) -> npt.NDArray[np.uint8]:
        """The picture (height, width, 3) from the bottom up; it is not written into later."""
        moving = self._place_actors()
        if self._still is None or self._still.stamp != self._stamp(moving):
            self._still = self._draw_still(moving)
        if not moving:
            return self._still.colors
        picture = self._still.colors.copy()
        self._lay_over(picture, self._still)
        return picture

    def _stamp(self, moving: bool) -> tuple[Any, ...]:
        """Of the window's size, the camera, and everything that is drawn."""
        size, camera = tuple(self._view.render_window().GetSize()), self._view.renderer().GetActiveCamera()
        times = [prop.GetRedrawMTime() for prop in self._props() if prop.GetVisibility() and not prop.IsA(CROSSHAIR)]
        return moving, size, camera.GetMTime(), len(times), max(times, default=0)

    def _props(self) -> list[Any]:
        return [prop for renderer in self._view.render_window().GetRenderers() for prop in renderer.GetViewProps()]

    def _draw_still(self, moving: bool) -> Still:
        from vtkmodules.util.numpy_support import vtk_to_numpy

        from Workstation.web.pacing import pixels_of

        window = self._view.render_window()
        for prop in self._props():
            if prop.IsA(CROSSHAIR):  # it follows the tip: where a tool is to be seen, that is the place
                prop.SetVisibility(not moving)
        window.Render()
        colors = pixels_of(window)
        height, width, _ = colors.shape
        window.GetZbufferData(0, 0, width - 1, height - 1, self._depths)
        depths = _before_the_eye(vtk_to_numpy(self._depths).reshape(height, width), self._view.renderer().GetActiveCamera())
        return Still(self._stamp(moving), colors, depths)

    def _place_actors(self) -> bool:
        """Put the moving models where they are; whether any is to be seen."""
        from vtkmodules.vtkCommonMath import vtkMatrix4x4

        seen, present = False, set()
        for node in self._models():
            display, mesh = node.GetDisplayNode(), node.GetPolyData()
            present.add(node.GetID())
            actor = self._actors.get(node.GetID()) or self._new_actor(node.GetID())
            visible = bool(mesh is not None and display.GetVisibility())
            actor.SetVisibility(visible)
            if not visible:
                continue
            seen = True
            to_world = vtkMatrix4x4()
            if node.GetParentTransformNode() is not None:
                node.GetParentTransformNode().GetMatrixTransformToWorld(to_world)
            actor.SetUserMatrix(to_world)
            actor.GetMapper().SetInputData(mesh)
            actor.GetProperty().SetColor(*display.GetColor())
            actor.GetProperty().SetOpacity(display.GetOpacity())
            actor.GetProperty().SetRepresentation(display.GetRepresentation())
        for node_id in set(self._actors) - present:
            self._renderer.RemoveActor(self._actors.pop(node_id))
        return seen

    def _new_actor(self, node_id: str) -> Any:
        from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper

        mapper, actor = vtkPolyDataMapper(), vtkActor()
        mapper.ScalarVisibilityOff()
        actor.SetMapper(mapper)
        self._renderer.AddActor(actor)
        self._actors[node_id] = actor
        return actor

    def _lay_over(self, picture: npt.NDArray[np.uint8], still: Still) -> None:
        """Draw the moving models into the picture where nothing is before them."""
        from vtkmodules.util.numpy_support import vtk_to_numpy

        height, width, _ = picture.shape
        camera = self._renderer.GetActiveCamera()
        camera.DeepCopy(self._view.renderer().GetActiveCamera())
        self._renderer.ResetCameraClippingRange()
        near, far = camera.GetClippingRange()
        camera.SetClippingRange(max(near, NEAR_SHARE * far), far)
        left, bottom, right, top = self._frame(width, height)
        if left >= right or bottom >= top:
            return
        self._window.SetSize(width, height)
        self._window.Render()
        self._window.GetRGBACharPixelData(left, bottom, right - 1, top - 1, 0, self._pixels)
        self._window.GetZbufferData(left, bottom, right - 1, top - 1, self._depths)
        pixels = vtk_to_numpy(self._pixels).reshape(top - bottom, right - left, 4)
        depths = vtk_to_numpy(self._depths).reshape(top - bottom, right - left)
        behind, below = still.depths[bottom:top, left:right], picture[bottom:top, left:right]
        seen = (pixels[..., 3] > 0) & (_before_the_eye(depths, camera) < behind)  # the background's alpha is 0
        rows, columns = np.nonzero(seen & (pixels[..., 3] < 255))
        share = pixels[rows, columns, 3:].astype(np.float32) / 255.0
        mixed = share * pixels[rows, columns, :3] + (1.0 - share) * below[rows, columns]
        np.copyto(below, pixels[..., :3], where=seen[..., None])
        below[rows, columns] = mixed.astype(np.uint8)

    def _frame(self, width: int, height: int) -> tuple[int, int, int, int]:
        """Left, bottom, right, top (without) of the part of the picture in which the moving models lie, pixels."""
        to_picture = self._renderer.GetActiveCamera().GetCompositeProjectionTransformMatrix(width / height, -1, 1)
        matrix = np.array([[to_picture.GetElement(row, column) for column in range(4)] for row in (0, 1, 3)])
        corners = [
            [*actor.GetUserMatrix().MultiplyPoint((x, y, z, 1.0))]
            for actor in self._actors.values()
            if actor.GetVisibility()
            for x, y, z in product(*np.reshape(actor.GetMapper().GetInput().GetBounds(), (3, 2)))
        ]
        across, up, depth = matrix @ np.transpose(corners)
        if depth.min() <= 0:  # partly behind the eye
            return 0, 0, width, height
        places = (np.stack([across, up], axis=1) / depth[:, None] + 1) / 2 * (width, height)
        low = np.clip(np.floor(places.min(axis=0)) - EDGE, 0, (width, height)).astype(int)
        high = np.clip(np.ceil(places.max(axis=0)) + EDGE, 0, (width, height)).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _before_the_eye(depths: npt.NDArray[Any], camera: Any) -> npt.NDArray[np.float32]:
    """Depths of the buffer (0 at the near, 1 at the far plane) as distances along the view, mm; inf where nothing is drawn."""
    near, far = camera.GetClippingRange()
    parallel = camera.GetParallelProjection()
    distances = near + depths * (far - near) if parallel else near * far / (far - depths * (far - near))
    return np.where(depths < 1.0, distances, np.inf).astype(np.float32)
