"""What the views show by themselves: a new CT in all slices, the skull in the middle, tools, points, the error in colours."""

from __future__ import annotations

from typing import Any

from CranioNavLib import scene, slice_views

from Workstation.web.drawn_models import CoarseCopy, hide
from Workstation.web.error_views import RESIDUALS, ErrorViews
from Workstation.web.framing import Framing
from Workstation.web.point_styles import PointStyles
from Workstation.web.tool_models import ErrorRing, ToolModels

WITH_CROSSING = ("bone", "navigation")  # steps in which the place where the slices cross matters
ZOOM_MM = 90.0  # shown about a tool's tip: a millimetre is then seen
WITH_ERROR = ("landmarks", "ultrasound", "verification", "navigation", "report")


class ViewFollower:
    """Looks at the scene now and then; when the CT or the bone is another one, the views turn to it."""

    def __init__(self, slicer_app: Any, start: Any) -> None:
        self._app = slicer_app
        self._framing = Framing(slicer_app.view_manager, self._bounds)
        self._bone, self._skin = CoarseCopy("Bone", start), CoarseCopy("Skin", start)
        self._tools, self._ring = ToolModels(), ErrorRing()
        self._points, self._errors = PointStyles(), ErrorViews(start)
        self._image: Any = None
        self._asked_for_in, self._zoomed = ("", ""), False
        for view in slicer_app.view_manager.get_threed_views():
            node = view.get_view_node()
            node.SetOrientationMarkerType(node.OrientationMarkerTypeAxes)
            node.SetOrientationMarkerSize(node.OrientationMarkerSizeSmall)

    def refresh(self, step: str, error_shown: str, forerun_mm: float = 0.0, asked_for: str = "") -> dict[str, Any] | None:
        """Show what is new, as the open step needs it; returns the legend of the colours. Main thread only."""
        self._show_ct()
        if self._bone.refresh():
            self._framing.fit()
        self._skin.refresh()
        legend = self._errors.refresh(self._bone.node, error_shown if step in WITH_ERROR else "")
        self._points.refresh(step, legend is not None and error_shown == RESIDUALS, asked_for)
        self.show_tools(forerun_mm)
        slice_views.show_crossing(step in WITH_CROSSING and scene.find("CT") is not None)
        if self._zoomed and step != "navigation":
            self._zoomed = False
            self._framing.fit_slices()
        if not self._zoomed:
            self._framing.keep()
        self._look_at(step, asked_for)
        return legend

    @property
    def waits(self) -> bool:
        """Whether a surface that is to be shown is still being made."""
        return self._bone.waits or self._skin.waits

    def hide_large(self) -> None:
        """Hide the surfaces that copies stand in for, before one of them is drawn even once."""
        for role in ("Bone", "Skin", "OuterTable"):  # the last one lies on Bone: drawing both shows nothing more
            hide(role)

    def fit(self) -> None:
        """Frame all views anew."""
        self._framing.fit()

    def show_tools(self, forerun_mm: float) -> None:
        """Show the tools in view and no others: a lost one is gone at once."""
        self._tools.refresh(forerun_mm)

    def follow(self, tip_ras_mm: Any, zoom: bool) -> None:
        """Let all slices pass through a point; or show its surroundings alone."""
        if zoom:
            slice_views.zoom_on(tip_ras_mm, ZOOM_MM)
        else:
            slice_views.go_to(tip_ras_mm)
        if self._zoomed and not zoom:
            self._framing.fit_slices()
        self._zoomed = zoom

    def moving_models(self) -> list[Any]:
        """Nodes of what moves with every pose."""
        return [*self._tools.nodes(), *self._ring.nodes()]

    def sphere(self) -> tuple[Any, float] | None:
        """Middle (3,) in RAS and radius in mm of what the ring is cut from; None without one."""
        return self._ring.sphere

    def ring(self, tip_ras_mm: Any, radius_mm: float | None) -> None:
        """The 95% error about a point; without a radius none."""
        self._ring.show(tip_ras_mm, radius_mm)

    def _look_at(self, step: str, asked_for: str) -> None:
        """Turn the head so that the point to palpate now is seen, when another one is asked for."""
        if (step, asked_for) == self._asked_for_in:
            return
        self._asked_for_in = (step, asked_for)
        node = scene.find("ProtocolPoints") if step == "ultrasound" else None
        index = node.GetControlPointIndexByLabel(asked_for) if node is not None and asked_for else -1
        if node is not None and index >= 0:
            self._framing.face(node.GetNthControlPointPositionWorld(index))

    def _show_ct(self) -> None:
        node = scene.find("CT")
        image = node.GetImageData() if node is not None else None
        before, self._image = self._image, image  # held: see CoarseCopy
        if image is not None and image is not before:
            self._app.display_manager.show_volume_in_slice_background(node)
            self._app.display_manager.reset_views()
            self._framing.fit()

    def _bounds(self) -> tuple[float, ...] | None:
        """What the 3-D view is to show: the skull. Points lie on it, and tools come and go."""
        node = self._bone.node
        return tuple(node.GetPolyData().GetBounds()) if node is not None else None
