"""The scene contract: every node that the modules share, found by its role.

A role is an attribute of the node, so that names may be changed by the user and a scene loaded from .mrb works
at once. Modules never call each other: one writes a node (scene_data.py), another observes it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from CranioNavLib import host
from CranioNavLib.errors import InputError

ROLE_ATTRIBUTE = "CranioNav.Role"
STATUS_ATTRIBUTE = "CranioNav.Status"  # on ReferenceToRas: "landmarks", "accepted", "warning"; none: not registered
FOLDER = "CranioNav"  # the folder of the subject hierarchy that holds the shared nodes

TRACKING, ULTRASOUND, REGISTRATION = "ModuleTracking", "ModuleUltrasound", "ModuleRegistration"

Color = tuple[float, float, float]
# The colours of Okabe and Ito ("Color universal design", 2008), which the colour-blind tell apart.
BONE, SKIN, BLUE, ORANGE = (0.93, 0.89, 0.80), (0.87, 0.70, 0.60), (0.0, 0.447, 0.698), (0.902, 0.624, 0.0)
GREEN, VERMILION, PURPLE, SKY = (0.0, 0.62, 0.451), (0.835, 0.369, 0.0), (0.8, 0.475, 0.655), (0.337, 0.706, 0.914)


@dataclass(frozen=True)
class Role:
    """One line of the table of shared nodes."""

    name: str  # also the node's first name
    node_class: str  # without "vtkMRML" and "Node"
    writers: tuple[str, ...]  # modules that may write it
    parent: str = ""  # role of the transform that it hangs under; "": the world (RAS)
    color: Color | None = None
    opacity: float = 1.0

    @property
    def mrml_class(self) -> str:
        """The full name of the node's class."""
        return f"vtkMRML{self.node_class}Node"


_POINTS, _MOVE, _SCRIPT = "MarkupsFiducial", "LinearTransform", "ScriptedModule"

ROLES: dict[str, Role] = {
    role.name: role
    for role in (
        Role("CT", "ScalarVolume", (REGISTRATION,)),
        Role("Bone", "Model", (REGISTRATION,), color=BONE),
        Role("OuterTable", "Model", (REGISTRATION,), color=SKY, opacity=0.5),
        Role("Skin", "Model", (REGISTRATION,), color=SKIN, opacity=0.3),
        Role("LandmarksCT", _POINTS, (REGISTRATION,), color=BLUE),
        Role("TargetsCT", _POINTS, (REGISTRATION,), color=GREEN),
        Role("LandmarksPatient", _POINTS, (TRACKING, ULTRASOUND), "ReferenceToRas", ORANGE),
        Role("SurfacePoints", _POINTS, (TRACKING, ULTRASOUND), "ReferenceToRas", VERMILION),
        Role("TargetsPatient", _POINTS, (TRACKING, ULTRASOUND), "ReferenceToRas", PURPLE),
        Role("PlausibilityPoints", _POINTS, (TRACKING, ULTRASOUND), "ReferenceToRas", SKY),
        Role("ClampPins", _POINTS, (TRACKING,), "ReferenceToRas", ORANGE),
        Role("ReferenceToTracker", _MOVE, (TRACKING,)),
        Role("StylusToReference", _MOVE, (TRACKING,), "ReferenceToRas"),
        Role("ProbeToReference", _MOVE, (TRACKING,), "ReferenceToRas"),
        Role("SphereToReference", _MOVE, (TRACKING,), "ReferenceToRas"),
        Role("ReferenceToRas", _MOVE, (REGISTRATION,)),
        Role("ALine", "Table", (ULTRASOUND,)),
        Role("ALineSequence", "Sequence", (ULTRASOUND,)),
        Role("Protocol", _SCRIPT, (ULTRASOUND,)),
        Role("ProtocolPoints", _POINTS, (ULTRASOUND,), color=BLUE),
        Role("Guidance", _SCRIPT, (REGISTRATION,)),
        Role("TrackingSession", _SCRIPT, (TRACKING,)),
        Role("UltrasoundSession", _SCRIPT, (ULTRASOUND,)),
        Role("RegistrationSession", _SCRIPT, (REGISTRATION,)),
        Role("RegisteredPoints", _POINTS, (REGISTRATION,), color=GREEN),
        Role("Results", "Table", (REGISTRATION,)),
        Role("Sounds", _SCRIPT, (TRACKING, ULTRASOUND, REGISTRATION)),
        Role("TargetErrors", "Table", (REGISTRATION,)),
        Role("Residuals", "Table", (REGISTRATION,)),
        Role("ResidualsSeries", "PlotSeries", (REGISTRATION,)),
        Role("ResidualsChart", "PlotChart", (REGISTRATION,)),
        Role("Report", "Text", (REGISTRATION,)),
    )
}


_transforms: dict[str, Any] = {}  # found before: they are asked for at every pose


def role(name: str) -> Role:
    """The role of that name.

    Raises
    ------
    InputError
        There is no such role.
    """
    if name not in ROLES:
        raise InputError(f"no role {name!r} in the scene; known: {', '.join(ROLES)}")
    return ROLES[name]


def find(name: str) -> Any | None:
    """The node that plays a role, or None. Of several (a cloned node keeps its role) the first in the scene."""
    scene = host.scene()
    known = _transforms.get(name)
    if known is not None and known.GetScene() is scene and known.GetAttribute(ROLE_ATTRIBUTE) == name:
        return known
    mrml_class = role(name).mrml_class
    for index in range(scene.GetNumberOfNodesByClass(mrml_class)):
        node = scene.GetNthNodeByClass(index, mrml_class)
        if node.GetAttribute(ROLE_ATTRIBUTE) == name:
            if ROLES[name].node_class == _MOVE:
                _transforms[name] = node
            return node
    return None


def find_or_create(name: str) -> Any:
    """The node that plays a role; made, named, coloured and put under its parent transform if there is none."""
    found = find(name)
    if found is not None:
        return found
    host.check_thread()
    wanted, scene = role(name), host.scene()
    node = scene.AddNewNodeByClass(wanted.mrml_class, name)
    node.SetAttribute(ROLE_ATTRIBUTE, name)
    if wanted.parent:
        node.SetAndObserveTransformNodeID(find_or_create(wanted.parent).GetID())
    if wanted.color is not None:
        _color(node, wanted)
    if wanted.node_class == "Text":
        node.SetForceCreateStorageNode(type(node).CreateStorageNodeAlways)
    _file_in_folder(node)
    return node


def assign(name: str, node: Any) -> None:
    """Let a node that the user chose play a role; the one that played it before loses it.

    Raises
    ------
    InputError
        The node is of another class than the role asks for.
    """
    host.check_thread()
    wanted = role(name)
    if not node.IsA(wanted.mrml_class):
        raise InputError(f"role {name} needs a {wanted.mrml_class}, got {node.GetClassName()} {node.GetName()!r}")
    before = find(name)
    if before is not None and before is not node:
        before.RemoveAttribute(ROLE_ATTRIBUTE)
    node.SetAttribute(ROLE_ATTRIBUTE, name)
    if wanted.parent and node.GetTransformNodeID() is None:
        node.SetAndObserveTransformNodeID(find_or_create(wanted.parent).GetID())


def release(name: str) -> None:
    """Remove the node of a role from the scene, if there is one."""
    host.check_thread()
    node = find(name)
    if node is not None:
        host.scene().RemoveNode(node)


class Observation:
    """A standing wish to hear of a node's changes, or of the events of its class that are named; `stop` ends it."""

    def __init__(self, node: Any, callback: Callable[[Any], None], events: tuple[str, ...] = ()) -> None:
        from vtkmodules.vtkCommonCore import vtkCommand

        self._node = node
        wanted = [int(getattr(type(node), event)) for event in events] or _events(node, vtkCommand)
        self._tags = [node.AddObserver(event, lambda caller, _: callback(caller)) for event in wanted]

    def stop(self) -> None:
        """No more calls; may be called twice."""
        for tag in self._tags:
            self._node.RemoveObserver(tag)
        self._tags = []


def observe(name: str, callback: Callable[[Any], None]) -> Observation:
    """Call `callback(node)` when the role's node changes (made first if there is none)."""
    return Observation(find_or_create(name), callback)


def _events(node: Any, command: Any) -> list[int]:
    """What tells a change of this class of node; Modified alone does not for points and transforms."""
    events = [int(command.ModifiedEvent)]
    for class_name, names in {
        "vtkMRMLMarkupsNode": ("PointModifiedEvent", "PointAddedEvent", "PointRemovedEvent"),
        "vtkMRMLTransformNode": ("TransformModifiedEvent",),
        "vtkMRMLModelNode": ("PolyDataModifiedEvent",),
        "vtkMRMLVolumeNode": ("ImageDataModifiedEvent",),
    }.items():
        if node.IsA(class_name):
            events += [int(getattr(type(node), event)) for event in names]
    return events


def _color(node: Any, wanted: Role) -> None:
    node.CreateDefaultDisplayNodes()
    display = node.GetDisplayNode()
    if display is None or wanted.color is None:
        return
    display.SetColor(*wanted.color)
    if wanted.node_class == "MarkupsFiducial":
        display.SetSelectedColor(*wanted.color)  # points are "selected" unless unticked
    display.SetOpacity(wanted.opacity)


def _file_in_folder(node: Any) -> None:
    """Under the folder of the subject hierarchy, which 3D Slicer shows as the tree of its Data module."""
    hierarchy = host.slicer_package().vtkMRMLSubjectHierarchyNode.GetSubjectHierarchyNode(host.scene())
    if hierarchy is None or node.GetHideFromEditors():
        return
    top = hierarchy.GetSceneItemID()
    folder = hierarchy.GetItemChildWithName(top, FOLDER) or hierarchy.CreateFolderItem(top, FOLDER)
    item = hierarchy.GetItemByDataNode(node)
    if item:
        hierarchy.SetItemParent(item, folder)
    else:
        hierarchy.CreateItem(folder, node)
