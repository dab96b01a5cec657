"""Keeps what matters in the frame: slices fitted, the skull in the middle, unless the user has zoomed, moved or turned a view."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

MARGIN = 0.92  # share of the 3-D view that the skull takes up


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
