"""What the user does with the views as a whole: layout, grey window, what dragging does, reset, moving and turning by keys."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from CranioNavLib import host, scene, slice_views

from Workstation.web.error_views import MAP
from Workstation.web.turning import come_nearer, enlarge_slice, turn


@dataclass(frozen=True)
class LayoutChoice:
    """One arrangement of the views."""

    icon: str
    key: str


@dataclass(frozen=True)
class GreyWindow:
    """Which part of the CT's scale becomes grey, HU."""

    width_hu: float
    level_hu: float


# Names as in Slicer's own layouts; trame-slicer knows the views by these tags.
LAYOUTS = {
    "four": LayoutChoice("mdi-view-grid-outline", "1"),
    "wide": LayoutChoice("mdi-view-split-vertical", "2"),
    "3d": LayoutChoice("mdi-cube-outline", "3"),
    "axial": LayoutChoice("mdi-alpha-a-box-outline", "4"),
    "sagittal": LayoutChoice("mdi-alpha-s-box-outline", "5"),
    "coronal": LayoutChoice("mdi-alpha-c-box-outline", "6"),
}
# The usual windows of radiology for a head CT; "skin" shows where the air ends.
WINDOWS = {
    "bone": GreyWindow(2000, 400),
    "brain": GreyWindow(80, 40),
    "skin": GreyWindow(900, -150),
}
STEPS_MM = {
    "ArrowLeft": (1, 0, 0),
    "ArrowRight": (-1, 0, 0),
    "ArrowUp": (0, 1, 0),
    "ArrowDown": (0, -1, 0),
    "PageUp": (0, 0, 1),
    "PageDown": (0, 0, -1),
}  # in RAS, as radiology looks at an axial slice: the patient's right is at the left of the screen
FAR_MM = 10.0  # with Shift
TURNS_DEG = {"J": (-15, 0), "L": (15, 0), "I": (0, 15), "K": (0, -15)}  # of the eye about the head: to its right, and up
SIZES = {"+": 1.2, "-": 1 / 1.2}


class ViewControls:
    """Serves the toolbar and the keys; `view_manager` knows the views, `fit` frames all of them anew."""

    def __init__(self, server: Any, layouts: Any, view_manager: Any, fit: Callable[[], None]) -> None:
        self._state, self._layouts, self._manager, self._fit = server.state, layouts, view_manager, fit
        self._state.layout, self._state.window, self._state.drag_window, self._state.error_shown = "four", "bone", False, MAP
        for name, function in {
            "layout": self.show_layout,
            "window": self.show_window,
            "drag": self.drag_sets_window,
            "reset": self.reset,
            "move": self.move,
            "turn": self.turn,
            "size": self.size,
        }.items():
            server.controller.trigger(f"view_{name}")(function)

    def show_layout(self, name: str) -> None:
        """Arrange the views otherwise."""
        if name in LAYOUTS:
            self._layouts.set_layout(name)
            self._state.layout = name

    def show_window(self, name: str = "") -> None:
        """Choose what is grey; without a name the next of the list."""
        names = list(WINDOWS)
        if name not in WINDOWS:
            at = names.index(self._state.window) if self._state.window in WINDOWS else -1
            name = names[(at + 1) % len(names)]
        node = scene.find("CT")
        if node is not None and node.GetDisplayNode() is not None:
            node.GetDisplayNode().SetAutoWindowLevel(False)
            node.GetDisplayNode().SetWindowLevel(WINDOWS[name].width_hu, WINDOWS[name].level_hu)
        self._state.window = name

    def look(self) -> None:
        """Show which window the slices have; none once it has been set by dragging."""
        node = scene.find("CT")
        display = node.GetDisplayNode() if node is not None else None
        if display is not None:
            now = GreyWindow(round(display.GetWindow()), round(display.GetLevel()))
            self._state.window = next((name for name, window in WINDOWS.items() if window == now), "")

    def drag_sets_window(self, wanted: bool) -> None:
        """Let dragging in a slice set the grey window, or give the mouse back."""
        node = host.scene().GetNodeByID("vtkMRMLInteractionNodeSingleton")
        node.SetCurrentInteractionMode(node.AdjustWindowLevel if wanted else node.ViewTransform)
        self._state.drag_window = bool(wanted)

    def reset(self) -> None:
        """Fit all views, 3-D from the front, slices through the middle."""
        node = scene.find("CT")
        if node is not None:
            bounds = [0.0] * 6
            node.GetRASBounds(bounds)
            slice_views.go_to(np.add(bounds[::2], bounds[1::2]) / 2)
        self._fit()

    def move(self, key: str, far: bool = False) -> None:
        """Move the place where the slices cross by 1 mm, or by 10."""
        place = slice_views.crossing()
        if place is not None and key in STEPS_MM:
            slice_views.go_to(place + np.array(STEPS_MM[key]) * (FAR_MM if far else 1.0))

    def turn(self, key: str) -> None:
        """Look at the head in 3-D from further left (J), right (L), above (I) or below (K)."""
        if key in TURNS_DEG:
            self._change_3d(lambda camera: turn(camera, *TURNS_DEG[key]))

    def size(self, key: str) -> None:
        """All views larger or smaller."""
        if key in SIZES:
            self._change_3d(lambda camera: come_nearer(camera, SIZES[key]))
            for node in slice_views.slice_nodes():
                enlarge_slice(node, SIZES[key])

    def _change_3d(self, change: Callable[[Any], None]) -> None:
        for view in self._manager.get_threed_views():
            change(view.renderer().GetActiveCamera())
            view.renderer().ResetCameraClippingRange()
            view.schedule_render()


def layout_grid() -> dict[str, Any]:
    """The layouts by name, for trame-slicer's LayoutManager."""
    from trame_slicer.views import Layout, LayoutDirection, ViewLayoutDefinition

    across, down = LayoutDirection.Horizontal, LayoutDirection.Vertical
    axial, coronal = ViewLayoutDefinition.axial_view(), ViewLayoutDefinition.coronal_view()
    sagittal, solid = ViewLayoutDefinition.sagittal_view(), ViewLayoutDefinition.threed_view()

    def large(first: Any, *others: Any) -> Any:
        return Layout(across, [first, Layout(down, list(others))], ["2", "1"])

    return {
        "four": Layout(across, [Layout(down, [coronal, sagittal]), Layout(down, [solid, axial])]),
        "wide": large(solid, axial, coronal, sagittal),
        "3d": Layout(down, [solid]),
        "axial": large(axial, solid, coronal, sagittal),
        "sagittal": large(sagittal, solid, axial, coronal),
        "coronal": large(coronal, solid, axial, sagittal),
    }
