"""How each list of points looks and in which steps it is seen: shapes differ as well as colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from CranioNavLib import scene

from Workstation.web.tool_models import registered

LATER = ("verification", "navigation", "report")


@dataclass(frozen=True)
class PointStyle:
    """Of one role."""

    size_mm: float
    glyph: str  # of vtkMRMLMarkupsDisplayNode
    steps: tuple[str, ...]  # of the procedure in which they are seen


STYLES = {
    "LandmarksCT": PointStyle(5.0, "Sphere3D", ("bone", "devices", "calibration", "landmarks")),
    "LandmarksPatient": PointStyle(6.0, "ThickCross2D", ("landmarks",)),
    "TargetsCT": PointStyle(4.0, "Diamond2D", ("bone", *LATER)),
    "TargetsPatient": PointStyle(4.0, "ThickCross2D", ("verification",)),
    "ProtocolPoints": PointStyle(5.0, "Sphere3D", ("ultrasound",)),
    "SurfacePoints": PointStyle(4.0, "ThickCross2D", ("ultrasound",)),
    "RegisteredPoints": PointStyle(3.5, "Sphere3D", ("ultrasound", "verification")),
    "PlausibilityPoints": PointStyle(4.0, "Square2D", ("verification",)),
    "ClampPins": PointStyle(6.0, "StarBurst2D", ("landmarks", "ultrasound")),
}
ASKED_FOR = (0.9, 0.25, 0.0)  # Okabe and Ito's vermilion, a little stronger: the point to place, touch or palpate now
MARKED = ("LandmarksCT", "ProtocolPoints")  # lists of which one point is asked for


class PointStyles:
    """Gives every list its looks once, and shows it where it belongs."""

    def __init__(self) -> None:
        self._styled: set[str] = set()

    def refresh(self, step: str, residuals_drawn: bool, asked_for: str) -> None:
        """For the open step; `asked_for` names the point to place, touch or palpate now, or is empty."""
        for role, style in STYLES.items():
            node = scene.find(role)
            if node is None or node.GetDisplayNode() is None:
                continue
            if node.GetID() not in self._styled:
                _style(node, style)
                self._styled.add(node.GetID())
            known = scene.role(role).parent == "" or registered()  # the patient's place is not known before
            _set(node.GetDisplayNode(), "Visibility", step in style.steps and known and not _replaced(role, residuals_drawn))
            _set(node, "Locked", not (role == "LandmarksCT" and step == "bone"))  # dragged only where they are planned
            if role in MARKED:
                _mark(node, asked_for)


def _replaced(role: str, residuals_drawn: bool) -> bool:
    """Planned and raw points give way to those that were registered, these to their residuals."""
    if role in ("ProtocolPoints", "SurfacePoints"):
        return scene.find("RegisteredPoints") is not None
    return role == "RegisteredPoints" and residuals_drawn


def _style(node: Any, style: PointStyle) -> None:
    display = node.GetDisplayNode()
    display.SetUseGlyphScale(False)
    display.SetGlyphSize(style.size_mm)
    display.SetGlyphType(getattr(display, style.glyph))
    display.SetPointLabelsVisibility(False)  # the one asked for is marked, and named beside the views
    display.SetPropertiesLabelVisibility(False)
    if node.GetAttribute(scene.ROLE_ATTRIBUTE) in MARKED:
        display.SetSelectedColor(*ASKED_FOR)  # selected is the one asked for


def _mark(node: Any, asked_for: str) -> None:
    for index in range(node.GetNumberOfControlPoints()):
        wanted = node.GetNthControlPointLabel(index) == asked_for
        if node.GetNthControlPointSelected(index) != wanted:
            node.SetNthControlPointSelected(index, wanted)


def _set(node: Any, name: str, value: bool) -> None:
    """Only when it differs: every write draws the views anew."""
    if getattr(node, f"Get{name}")() != int(value):
        getattr(node, f"Set{name}")(bool(value))
