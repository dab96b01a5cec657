"""Keeps what matters in the frame: slices fitted, the skull in the middle, unless the user has zoomed, moved or turned a view."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

MARGIN = 0.92  # share of the 3-D view that the skull takes up
SEEN_COSINE = 0.35  # of the angle between a place's direction and the eye's
STEEPEST = 0.7  # height of the eye, sine


class Framing:
    """One for all views; looks at them now and then, and when one is resized. `bounds` gives what 3-D shows, or None."""

    def __init__(self, view_manager: Any, bounds: Callable[[], tuple[float, ...] | None]) -> None:
        self._manager, self._bounds = view_manager, bounds
        self._sizes: dict[str, tuple[int, int]] = {}
        self._fitted: dict[str, tuple[float, ...]] = {}  # how each view stood when it was last fitted
        self._touched: dict[str, bool] = {}
        for view in view_manager.get_views():  # of the interactor: the window's own event comes before it has its new size
            view.interactor().AddObserver("WindowResizeEvent", lambda *_: self.keep())

    def fit(self) -> None:
        """Fit every view, whatever the user did before."""
        for view in self._manager.get_slice_views():
            self._fit(view, _fit_slice, _slice_stand)
        for view in self._manager.get_threed_views():
            view.reset_view()
            self._fit(view, self._fit_3d, _camera_stand)

    def fit_slices(self) -> None:
        """Fit every slice view."""
        for view in self._manager.get_slice_views():
            self._fit(view, _fit_slice, _slice_stand)

    def face(self, point_ras_mm: Any) -> None:
        """Turn 3-D until a point on the skull is seen, unless it is seen already or the user has turned the view."""
        bounds = self._bounds()
        if bounds is None:
            return
        middle = np.add(bounds[::2], bounds[1::2]) / 2
        outward = np.asarray(point_ras_mm, dtype=float) - middle
        for view in self._manager.get_threed_views():
            camera = view.renderer().GetActiveCamera()
            sight = np.asarray(camera.GetPosition()) - middle
            if self._touched.get(view.get_view_node_id()) or seen(outward, sight):
                continue
            camera.SetPosition(*(middle + facing(outward) * np.linalg.norm(sight)))
            camera.SetFocalPoint(*middle)
            camera.SetViewUp(0.0, 0.0, 1.0)
            self._fit(view, self._fit_3d, _camera_stand)

    def keep(self) -> None:
        """Fit again each view whose size has changed, unless the user has taken it in hand."""
        for view in self._manager.get_slice_views():
            self._keep(view, _fit_slice, _slice_stand)
        for view in self._manager.get_threed_views():
            self._keep(view, self._fit_3d, _camera_stand)

    def _keep(self, view: Any, fit: Callable[[Any], None], stand: Callable[[Any], tuple[float, ...]]) -> None:
        name, size = view.get_view_node_id(), tuple(view.render_window().GetSize())
        if self._sizes.get(name) == size:
            before = self._fitted.get(name)
            self._touched[name] = before is not None and not np.allclose(stand(view), before, rtol=1e-3, atol=0.5)
            return
        self._sizes[name] = size
        if not self._touched.get(name):
            self._fit(view, fit, stand)
        view.schedule_render()

    def _fit(self, view: Any, fit: Callable[[Any], None], stand: Callable[[Any], tuple[float, ...]]) -> None:
        fit(view)
        self._fitted[view.get_view_node_id()], self._touched[view.get_view_node_id()] = stand(view), False

    def _fit_3d(self, view: Any) -> None:
        bounds = self._bounds()
        if bounds is not None:
            view.set_focal_point(*(np.add(bounds[::2], bounds[1::2]) / 2))
            view.renderer().ResetCameraScreenSpace(bounds, MARGIN)
            view.schedule_render()


def seen(outward: Any, sight: Any) -> bool:
    """Whether a place of the skull in this direction from its middle is well seen by an eye in that direction."""
    cosine = np.dot(outward, sight) / max(float(np.linalg.norm(outward) * np.linalg.norm(sight)), 1e-9)
    return bool(cosine > SEEN_COSINE)


def facing(outward: Any) -> Any:
    """The direction (3,) from which to look at a place of the skull: in front of it, never from straight above or below."""
    direction = np.asarray(outward, dtype=float) / max(float(np.linalg.norm(outward)), 1e-9)
    level = direction[:2] if np.linalg.norm(direction[:2]) > 0.1 else np.array([0.0, 1.0])  # the top is looked at from the front
    level = level / np.linalg.norm(level)
    height = np.clip(direction[2], -0.2, STEEPEST)
    return np.array([*(level * np.sqrt(1 - height**2)), height])


def _fit_slice(view: Any) -> None:
    """As large as the view allows; the slice stays the same."""
    if view.get_background_volume_id():
        offset = view.get_slice_value()
        view.fit_view_to_content()
        view.set_slice_value(offset)


def _slice_stand(view: Any) -> tuple[float, ...]:
    """Field of view and shift in the plane."""
    node = view.get_view_node()
    return (*node.GetFieldOfView()[:2], *node.GetXYZOrigin()[:2])


def _camera_stand(view: Any) -> tuple[float, ...]:
    camera = view.renderer().GetActiveCamera()
    return (*camera.GetPosition(), *camera.GetFocalPoint(), *(100 * value for value in camera.GetViewUp()))
