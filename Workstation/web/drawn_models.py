"""Models as drawn: coarser copies of large surfaces, as without a graphics card every triangle counts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from CranioNavLib import host, scene

DIVISIONS = (110, 110, 110)  # of a copy: cells of about 2 mm on a head


def new_model(name: str, color: tuple[float, float, float]) -> Any:
    """A model node for the views alone; it is not saved with the scene."""
    node = host.scene().AddNewNodeByClass("vtkMRMLModelNode", name)
    node.CreateDefaultDisplayNodes()
    node.GetDisplayNode().SetColor(*color)
    node.SetSelectable(False)
    node.SetSaveWithScene(False)
    return node


def hide(role: str) -> None:
    """Do not show the model of a role itself, if there is one."""
    model = scene.find(role)
    if model is not None and model.GetDisplayNode() is not None and model.GetDisplayNode().GetVisibility():
        model.GetDisplayNode().SetVisibility(False)


class CoarseCopy:
    """Stands in the views for the model of a role, which itself is hidden.

    Parameters
    ----------
    role : str
    start : callable
        Calls its first argument, off the main thread if it can, and then its second one with what came out (a result or an
        exception) in the main thread.
    """

    def __init__(self, role: str, start: Callable[[Callable[[], Any], Callable[[Any], None]], None] | None = None) -> None:
        self._role = role
        self._start = start or (lambda compute, finished: finished(compute()))
        self._node: Any = None
        self._source: Any = None  # held, not only compared: VTK's wrappers of data that nobody holds are made anew
        self._mesh: Any = None  # the coarser one, once it is made

    @property
    def node(self) -> Any | None:
        """The copy; None without one."""
        return self._node if self._node is not None and self._node.GetScene() is not None else None

    @property
    def waits(self) -> bool:
        """Whether it is being made."""
        return self._source is not None and self._mesh is None

    def refresh(self) -> bool:
        """Follow the role's model; True if another one is shown than before."""
        model = scene.find(self._role)
        source = model.GetPolyData() if model is not None else None
        if model is None or source is None or not source.GetNumberOfPoints():
            if self.node is not None:
                host.scene().RemoveNode(self.node)  # another CT: its surface is not found yet
            self._source = self._mesh = None
            return False
        if source is not self._source:
            self._source, self._mesh = source, None
            hide(self._role)
            self._make(source)
        if self._mesh is None or (self.node is not None and self.node.GetPolyData() is self._mesh):
            return False
        if self.node is None:
            wanted = scene.role(self._role)
            self._node = new_model(f"{self._role} as drawn", wanted.color or scene.BONE)
            self._node.GetDisplayNode().SetOpacity(wanted.opacity)
        self._node.SetAndObservePolyData(self._mesh)
        return True

    def _make(self, source: Any) -> None:
        from vtkmodules.vtkCommonDataModel import vtkPolyData

        mesh = vtkPolyData()
        mesh.ShallowCopy(source)  # the views may ask the scene's own for its bounds meanwhile
        self._start(lambda: _coarse(mesh), lambda made: self._take(source, made))

    def _take(self, source: Any, made: Any) -> None:
        if isinstance(made, Exception):
            raise made
        if source is self._source:  # or there is something newer by now
            self._mesh = made


def _coarse(surface: Any) -> Any:
    from vtkmodules.vtkFiltersCore import vtkBinnedDecimation, vtkPolyDataNormals

    coarse = vtkBinnedDecimation()
    coarse.SetInputData(surface)
    coarse.SetNumberOfDivisions(*DIVISIONS)
    coarse.SetPointGenerationModeToBinAverages()  # one of its input points would make the surface rough
    smooth = vtkPolyDataNormals()
    smooth.SetInputConnection(coarse.GetOutputPort())
    smooth.SplittingOff()
    smooth.ConsistencyOff()  # the triangles are turned alike already
    smooth.Update()
    return smooth.GetOutput()
