"""The tools as models, seen only while their pose is known; and the 95% error about a tip."""

from __future__ import annotations

from typing import Any

import numpy as np
from CranioNavLib import host, scene, scene_data

from Workstation.web.drawn_models import new_model

TOOLS = {"Stylus": scene.ORANGE, "Probe": scene.SKY, "Sphere": scene.PURPLE}
# half the width of the tip, of the shaft, and the length, mm
SHAPES = {"Stylus": (0.4, 4.0, 120.0), "Probe": (3.0, 9.0, 110.0), "Sphere": (2.0, 4.0, 100.0)}
RING = (0.94, 0.71, 0.16)


class ToolModels:
    """One model a tool, under the tool's transform: a new pose moves it without a further word."""

    def __init__(self) -> None:
        self._models: dict[str, Any] = {}
        self._foreruns: dict[str, float] = {}

    def refresh(self, forerun_mm: float) -> None:
        """Show the tools in view; `forerun_mm` is the length of the probe's delay line."""
        for tool in TOOLS:
            self._show(tool, forerun_mm if tool == "Probe" else 0.0)

    def nodes(self) -> list[Any]:
        """The models' nodes."""
        return [node for node in self._models.values() if node.GetScene() is not None]

    def _show(self, tool: str, forerun_mm: float) -> None:
        visible = scene_data.get_pose(f"{tool}ToReference").matrix is not None and registered()
        node = self._models.get(tool)
        if node is None or node.GetScene() is None:
            if not visible:
                return
            node = self._models[tool] = moving_model(f"{tool} model", TOOLS[tool])
            node.SetAndObserveTransformNodeID(scene.find_or_create(f"{tool}ToReference").GetID())
        if node.GetPolyData() is None or self._foreruns.get(tool) != forerun_mm:
            node.SetAndObservePolyData(tool_shape(*SHAPES[tool], forerun_mm))
            self._foreruns[tool] = forerun_mm
        if node.GetDisplayNode().GetVisibility() != int(visible):
            node.GetDisplayNode().SetVisibility(visible)


class ErrorRing:
    """A sphere of the 95% error about the tip, moved and sized by a transform; slicing.py draws where a slice cuts it."""

    def __init__(self) -> None:
        self._node: Any = None
        self._place: Any = None
        self.sphere: tuple[Any, float] | None = None  # its middle (3,) in RAS and its radius, mm

    def nodes(self) -> list[Any]:
        """The ring's node, if there is one."""
        return [self._node] if self._node is not None and self._node.GetScene() is not None else []

    def _make(self) -> None:
        from vtkmodules.vtkFiltersSources import vtkSphereSource

        source = vtkSphereSource()
        source.SetRadius(1.0)
        source.SetThetaResolution(24)
        source.SetPhiResolution(16)
        source.Update()
        self._place = host.scene().AddNewNodeByClass("vtkMRMLLinearTransformNode", "Place of the error ring")
        self._place.SetSelectable(False)
        self._place.SetSaveWithScene(False)
        self._node = moving_model("Error ring", RING)
        self._node.GetDisplayNode().SetRepresentation(self._node.GetDisplayNode().WireframeRepresentation)
        self._node.SetAndObservePolyData(source.GetOutput())
        self._node.SetAndObserveTransformNodeID(self._place.GetID())

    def show(self, tip_ras_mm: Any, radius_mm: float | None) -> None:
        """Move and size it; without a radius it is hidden."""
        self.sphere = (np.asarray(tip_ras_mm, dtype=float), radius_mm) if radius_mm is not None else None
        if self._node is not None and self._node.GetScene() is None:
            self._node = None
        if radius_mm is None:
            if self._node is not None:
                self._node.GetDisplayNode().SetVisibility(False)
            return
        if self._node is None:
            self._make()
        place = np.diag([radius_mm, radius_mm, radius_mm, 1.0])
        place[:3, 3] = tip_ras_mm
        util = host.slicer_package().util
        self._place.SetMatrixTransformToParent(util.vtkMatrixFromArray(place))
        if not self._node.GetDisplayNode().GetVisibility():
            self._node.GetDisplayNode().SetVisibility(True)


def moving_model(name: str, color: tuple[float, float, float]) -> Any:
    """A model that moves with every pose: the slices draw it themselves, the 3-D view gets it from moving.MovingPicture."""
    node = new_model(name, color)
    for index in range(host.scene().GetNumberOfNodesByClass("vtkMRMLSliceNode")):
        node.GetDisplayNode().AddViewNodeID(host.scene().GetNthNodeByClass(index, "vtkMRMLSliceNode").GetID())
    return node


def registered() -> bool:
    """Whether ReferenceToRas means anything yet."""
    node = scene.find("ReferenceToRas")
    return node is not None and bool(node.GetAttribute(scene.STATUS_ATTRIBUTE))


def tool_shape(tip_mm: float, shaft_mm: float, length_mm: float, forerun_mm: float) -> Any:
    """A shaft that narrows to its tip at the origin, and a forerun in front of it; the tool's +z points out of the tip."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    sides = 16
    angles = np.arange(sides) * 2 * np.pi / sides
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(sides)])
    rings = [(tip_mm, forerun_mm)] * (forerun_mm > 0) + [(tip_mm, 0.0), (shaft_mm, -25.0), (shaft_mm, -length_mm)]
    rows = np.concatenate([circle * radius + (0.0, 0.0, height) for radius, height in rings])
    points, cells, mesh = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(rows), deep=True))
    for ring in range(len(rings) - 1):
        for side in range(sides):
            after = (side + 1) % sides
            corners = (ring * sides + side, ring * sides + after, (ring + 1) * sides + after, (ring + 1) * sides + side)
            cells.InsertNextCell(4, corners)
    for ring in (0, len(rings) - 1):
        cells.InsertNextCell(sides, tuple(ring * sides + side for side in range(sides)))
    mesh.SetPoints(points)
    mesh.SetPolys(cells)
    return mesh
