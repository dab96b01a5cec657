"""What the views show by themselves: a new CT in all slices, the skull in the middle, tools, points without clutter."""

from __future__ import annotations

from typing import Any

import numpy as np
from CranioNavLib import host, scene, scene_data

from Workstation.web.framing import Framing

POINTS = {  # role: (size of the glyphs in mm, whether labels are drawn)
    "LandmarksCT": (6.0, False),
    "LandmarksPatient": (5.0, False),
    "TargetsCT": (4.0, False),
    "TargetsPatient": (3.0, False),
    "ProtocolPoints": (4.0, False),
    "SurfacePoints": (3.0, False),
    "RegisteredPoints": (3.5, False),
    "PlausibilityPoints": (3.0, False),
}
TOOLS = {"Stylus": (0.902, 0.624, 0.0), "Probe": (0.337, 0.706, 0.914), "Sphere": (0.8, 0.475, 0.655)}
DIVISIONS = (110, 110, 110)  # of the bone as drawn: cells of about 2 mm
TOOL_ATTRIBUTE = "CranioNav.ToolModel"
# half the width of the tip, of the shaft, and the length, mm
SHAPES = {"Stylus": (0.4, 4.0, 120.0), "Probe": (3.0, 9.0, 110.0), "Sphere": (2.0, 4.0, 100.0)}


class ViewFollower:
    """Looks at the scene now and then; when the CT or the bone is another one, the views turn to it."""

    def __init__(self, slicer_app: Any) -> None:
        self._app = slicer_app
        self._framing = Framing(slicer_app.view_manager, self._bounds)
        self._shown: dict[str, tuple[str, Any]] = {}
        self._styled: set[str] = set()
        self._tools: dict[str, Any] = {}
        self._foreruns: dict[str, float] = {}
        self._bone: Any = None
        self._ring: tuple[Any, float] = (None, 0.0)

    def refresh(self, forerun_mm: float = 0.0) -> None:
        """Show what is new; `forerun_mm` is the length of the probe's delay line. Main thread only."""
        if self._is_new("CT", lambda node: node.GetImageData()):
            self._app.display_manager.show_volume_in_slice_background(scene.find("CT"))
            self._app.display_manager.reset_views()
            self._framing.fit()
        if self._is_new("Bone", lambda node: node.GetPolyData()):
            self._show_bone(scene.find("Bone"))
            self._framing.fit()
        if self._is_new("OuterTable", lambda node: node.GetPolyData()):
            scene.find("OuterTable").GetDisplayNode().SetVisibility(False)  # it lies on Bone: drawing both shows nothing more
        if scene.find("Bone") is None and self._bone is not None and self._bone.GetScene() is not None:
            host.scene().RemoveNode(self._bone)  # another CT: its bone is not found yet
        for role in POINTS:
            self._style(role)
        for tool in TOOLS:
            self._show_tool(tool, forerun_mm if tool == "Probe" else 0.0)
        self._framing.keep()

    def follow(self, tip_ras_mm: Any) -> None:
        """Let all slices pass through a point."""
        for index in range(host.scene().GetNumberOfNodesByClass("vtkMRMLSliceNode")):
            node = host.scene().GetNthNodeByClass(index, "vtkMRMLSliceNode")
            node.JumpSliceByOffsetting(*(float(value) for value in tip_ras_mm))

    def ring(self, tip_ras_mm: Any, radius_mm: float | None) -> None:
        """A sphere of the 95% error about the tip; the slices cut it in a ring. Without a radius it is hidden."""
        node, drawn = self._ring
        if radius_mm is None:
            if node is not None:
                node.GetDisplayNode().SetVisibility(False)
            return
        if node is None:
            node = _model("Error ring", (0.94, 0.71, 0.16))
            node.GetDisplayNode().SetOpacity(0.35)
            node.GetDisplayNode().SetVisibility2D(True)
            node.GetDisplayNode().SetSliceIntersectionThickness(3)
        from vtkmodules.vtkFiltersSources import vtkSphereSource

        source = vtkSphereSource()
        source.SetCenter(*(float(value) for value in tip_ras_mm))
        source.SetRadius(float(radius_mm))
        source.SetThetaResolution(24)
        source.SetPhiResolution(16)
        source.Update()
        node.SetAndObservePolyData(source.GetOutput())
        node.GetDisplayNode().SetVisibility(True)
        self._ring = (node, float(radius_mm) or drawn)

    def _style(self, role: str) -> None:
        node = scene.find(role)
        if node is None or node.GetDisplayNode() is None:
            return
        visible = int(scene.role(role).parent == "" or registered())  # the patient's place is not known before
        if node.GetDisplayNode().GetVisibility() != visible:
            node.GetDisplayNode().SetVisibility(visible)
        if node.GetID() in self._styled:
            return
        display, (size, labels) = node.GetDisplayNode(), POINTS[role]
        display.SetUseGlyphScale(False)
        display.SetGlyphSize(size)
        display.SetTextScale(3.2)
        display.SetPointLabelsVisibility(labels)
        display.SetPropertiesLabelVisibility(False)
        node.SetLocked(role != "LandmarksCT")
        self._styled.add(node.GetID())

    def _show_tool(self, tool: str, forerun_mm: float) -> None:
        pose = scene_data.get_pose(f"{tool}ToReference")
        node = self._tools.get(tool)
        if node is None or node.GetScene() is None:
            if pose.matrix is None or not registered():
                return
            node = self._tools[tool] = _model(f"{tool} model", TOOLS[tool])
            node.SetAttribute(TOOL_ATTRIBUTE, tool)
            node.SetAndObserveTransformNodeID(scene.find(f"{tool}ToReference").GetID())
        if node.GetPolyData() is None or self._foreruns.get(tool) != forerun_mm:
            node.SetAndObservePolyData(_tool_shape(*SHAPES[tool], forerun_mm))
            self._foreruns[tool] = forerun_mm
        display, visible = node.GetDisplayNode(), int(pose.matrix is not None and registered())
        if display.GetVisibility() != visible:
            display.SetVisibility(visible)

    def _show_bone(self, bone: Any) -> None:
        """A coarser copy is drawn in place of the bone: without a graphics card every triangle counts."""
        from vtkmodules.vtkFiltersCore import vtkBinnedDecimation, vtkPolyDataNormals

        coarse = vtkBinnedDecimation()
        coarse.SetInputData(bone.GetPolyData())
        coarse.SetNumberOfDivisions(*DIVISIONS)
        smooth = vtkPolyDataNormals()
        smooth.SetInputConnection(coarse.GetOutputPort())
        smooth.SplittingOff()
        smooth.ConsistencyOff()  # the triangles are turned alike already
        smooth.Update()
        if self._bone is None or self._bone.GetScene() is None:
            self._bone = _model("Bone as drawn", scene.BONE)
        self._bone.SetAndObservePolyData(smooth.GetOutput())
        bone.GetDisplayNode().SetVisibility(False)

    def _is_new(self, role: str, content: Any) -> bool:
        node = scene.find(role)
        data = content(node) if node is not None else None
        node_id, before = self._shown.get(role, ("", None))
        # held, not only named: VTK's wrappers of data that nobody holds are made anew, with another id
        self._shown[role] = (node.GetID() if data is not None else "", data)
        return data is not None and (data is not before or node.GetID() != node_id)

    def _bounds(self) -> tuple[float, ...] | None:
        """What the 3-D view is to show: the skull. Points lie on it, and tools come and go."""
        if self._bone is None or self._bone.GetScene() is None or not self._bone.GetPolyData().GetNumberOfPoints():
            return None
        return tuple(self._bone.GetPolyData().GetBounds())


def registered() -> bool:
    """Whether ReferenceToRas means anything yet."""
    node = scene.find("ReferenceToRas")
    return node is not None and bool(node.GetAttribute(scene.STATUS_ATTRIBUTE))


def _model(name: str, color: tuple[float, float, float]) -> Any:
    node = host.scene().AddNewNodeByClass("vtkMRMLModelNode", name)
    node.CreateDefaultDisplayNodes()
    node.GetDisplayNode().SetColor(*color)
    node.SetSelectable(False)
    node.SetSaveWithScene(False)
    return node


def _tool_shape(tip_mm: float, shaft_mm: float, length_mm: float, forerun_mm: float) -> Any:
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
