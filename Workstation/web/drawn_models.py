"""Models as drawn: coarser copies of large surfaces, as without a graphics card every triangle counts."""

from __future__ import annotations

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


class CoarseCopy:
    """Stands in the views for the model of a role, which itself is hidden."""

    def __init__(self, role: str) -> None:
        self._role = role
        self._node: Any = None
        self._source: Any = None  # held, not only compared: VTK's wrappers of data that nobody holds are made anew

    @property
    def node(self) -> Any | None:
        """The copy; None without one."""
        return self._node if self._node is not None and self._node.GetScene() is not None else None

    def refresh(self) -> bool:
        """Follow the role's model; True if it is another one than before."""
        model = scene.find(self._role)
        source = model.GetPolyData() if model is not None else None
        if model is None or source is None or not source.GetNumberOfPoints():
            if self.node is not None:
                host.scene().RemoveNode(self.node)  # another CT: its surface is not found yet
            self._source = None
            return False
        if source is self._source and self.node is not None:
            return False
        self._source = source
        wanted = scene.role(self._role)
        copy = self.node
        if copy is None:
            copy = self._node = new_model(f"{self._role} as drawn", wanted.color or scene.BONE)
            self._node.GetDisplayNode().SetOpacity(wanted.opacity)
        copy.SetAndObservePolyData(_coarse(source))
        model.GetDisplayNode().SetVisibility(False)
        return True


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
