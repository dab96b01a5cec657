"""Points placed, moved and taken out in the views, each step undone on request; 3D Slicer's place mode does the clicks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from CranioNavLib import host, scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.panel import Entry
from CranioNavLib.slicer_files import LabelledPoints

MOST_STEPS = 100  # that can be undone
PLACED_BY_CLICK = "Point to place"  # name of the node that Slicer's place mode fills; a clicked point is taken over from it


class PointEditor:
    """Edits the points of one role.

    Parameters
    ----------
    role : str
        A MarkupsFiducial role whose points have names.
    expected : sequence of str
        Names that are asked for although they have no place yet.
    refuse : callable, optional
        Why a place (3,) in RAS cannot be one of these points; "" if it can.
    """

    def __init__(self, role: str, expected: Sequence[str] = (), refuse: Callable[[Any], str] | None = None) -> None:
        self.role, self.expected, self._refuse = role, tuple(expected), refuse or (lambda _: "")
        self.placing = ""  # the point that the next click places
        self.said = ""  # why the last click was refused
        self._added: list[str] = []
        self._steps: list[LabelledPoints | None] = []
        self._clicks: tuple[Any, scene.Observation] | None = None
        self._dragged: scene.Observation | None = None
        self._dragged_node: Any = None

    def entries(self) -> tuple[Entry, ...]:
        """All points, placed or asked for."""
        placed = self._points()
        labels = placed.labels if placed is not None else ()
        names = [*self.expected, *(name for name in (*self._added, *labels) if name not in self.expected)]
        return tuple(
            Entry(name, name in labels, "click in a view" if name == self.active() else "") for name in dict.fromkeys(names)
        )

    def active(self) -> str:
        """The point that the next click in a view places; "" if none (Esc and the right button end it, too)."""
        if self.placing and _interaction().GetCurrentInteractionMode() != _interaction().Place:
            self.placing = ""
        return self.placing

    def add(self) -> str:
        """A further point; returns its name."""
        taken = {one.name for one in self.entries()}
        number = len(taken) + 1
        while f"Landmark {number}" in taken:
            number += 1
        self._added.append(f"Landmark {number}")
        return self._added[-1]

    def place(self, name: str) -> None:
        """Let the next click in any view place or move a point."""
        host.check_thread()
        self._watch_drags()
        self.said = ""
        package = host.slicer_package()
        if self._clicks is None or self._clicks[0].GetScene() is None:
            node = host.scene().AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", PLACED_BY_CLICK)
            node.SetSaveWithScene(False)
            node.SetHideFromEditors(True)
            node.CreateDefaultDisplayNodes()
            node.GetDisplayNode().SetPointLabelsVisibility(False)
            self._clicks = (node, scene.Observation(node, self._clicked, ("PointPositionDefinedEvent",)))
        node = self._clicks[0]
        node.GetDisplayNode().SetVisibility(True)
        selection = host.scene().GetNodeByID("vtkMRMLSelectionNodeSingleton")
        selection.SetReferenceActivePlaceNodeClassName("vtkMRMLMarkupsFiducialNode")
        selection.SetActivePlaceNodeID(node.GetID())
        self.placing = name
        _interaction().SetPlaceModePersistence(1)
        _interaction().SetCurrentInteractionMode(package.vtkMRMLInteractionNode.Place)

    def stop(self) -> None:
        """The mouse turns and moves the views again."""
        self.placing = ""
        if self._clicks is None:
            return
        self._clicks[0].GetDisplayNode().SetVisibility(False)
        if _interaction().GetCurrentInteractionMode() == _interaction().Place:
            _interaction().SetCurrentInteractionMode(_interaction().ViewTransform)

    def put(self, name: str, position_ras_mm: npt.ArrayLike) -> None:
        """Place or move a point.

        Raises
        ------
        InputError
            The point cannot lie there.
        """
        place = np.asarray(position_ras_mm, dtype=float)
        reason = self._refuse(place)
        if reason:
            raise InputError(f"{name} is not placed: {reason}")
        self.remember()
        points = self._points()
        known = dict(zip(points.labels, points.positions_mm)) if points is not None else {}
        known[name] = place
        scene_data.set_points(self.role, LabelledPoints(tuple(known), np.array(list(known.values()))))

    def remove(self, name: str) -> None:
        """Take a point out.

        Raises
        ------
        InputError
            It has no place.
        """
        points = self._points()
        if points is None or name not in points.labels:
            raise InputError(f"{name} has no place; choose a point that has one")
        self.remember()
        self._restore(_without(points, name))

    def remember(self) -> None:
        """Before a change: what `undo` brings back."""
        self._steps = [*self._steps, self._points()][-MOST_STEPS:]

    def undo(self) -> None:
        """Bring back what was before the last change; without one nothing happens."""
        if self._steps:
            self._restore(self._steps.pop())

    def can_undo(self) -> bool:
        """Whether there is a change to undo."""
        return bool(self._steps)

    def following(self, name: str) -> str:
        """The next point after this one that has no place yet; "" if all have."""
        entries = self.entries()
        at = next((k for k, one in enumerate(entries) if one.name == name), -1)
        return next((one.name for one in (*entries[at + 1 :], *entries[: at + 1]) if not one.done), "")

    def _clicked(self, node: Any) -> None:
        """Slicer has placed a point of the hidden list: take its place over."""
        name, last = self.placing, node.GetNumberOfControlPoints() - 1
        if not name or last < 0:
            return
        node.SetNthControlPointVisibility(last, False)
        try:
            self.put(name, node.GetNthControlPointPositionWorld(last))
        except InputError as error:
            self.said = str(error)
            return
        self.said = ""
        self.placing = self.following(name)
        if not self.placing:
            self.stop()

    def _watch_drags(self) -> None:
        node = scene.find(self.role)
        if node is None or node is self._dragged_node:
            return
        if self._dragged is not None:
            self._dragged.stop()
        self._dragged_node = node
        self._dragged = scene.Observation(node, lambda _: self.remember(), ("PointStartInteractionEvent",))

    def _points(self) -> LabelledPoints | None:
        node = scene.find(self.role)
        return scene_data.get_points(self.role) if node is not None and node.GetNumberOfControlPoints() else None

    def _restore(self, points: LabelledPoints | None) -> None:
        if points is not None and len(points):
            scene_data.set_points(self.role, points)
        elif scene.find(self.role) is not None:
            scene.find_or_create(self.role).RemoveAllControlPoints()


def _without(points: LabelledPoints, name: str) -> LabelledPoints | None:
    kept = [k for k, label in enumerate(points.labels) if label != name]
    return LabelledPoints(tuple(points.labels[k] for k in kept), points.positions_mm[kept]) if kept else None


def _interaction() -> Any:
    return host.scene().GetNodeByID("vtkMRMLInteractionNodeSingleton")
