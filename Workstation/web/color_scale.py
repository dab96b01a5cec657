"""Colours from blue over grey to yellow, which the colour-blind read by lightness; for views and page."""

from __future__ import annotations

from typing import Any

import numpy as np
from CranioNavLib import host
from CranioNavLib.rigid import Array

from Workstation.web import words

# Lightness rises evenly, blue turns to yellow: what both common kinds of red-green blindness keep.
STOPS = np.array([[52, 92, 190], [98, 122, 176], [146, 150, 150], [200, 188, 108], [254, 232, 56]]) / 255
NAME = "CranioNav error scale"
ENTRIES = 128


def colors(count: int) -> Array:
    """(count, 3) colours of the scale from its low to its high end, 0..1."""
    place, stops = np.linspace(0, 1, count), np.linspace(0, 1, len(STOPS))
    return np.stack([np.interp(place, stops, STOPS[:, channel]) for channel in range(3)], axis=1)


def gradient() -> str:
    """The scale as the page's CSS draws it."""
    parts = ", ".join(f"rgb({', '.join(str(round(255 * value)) for value in color)})" for color in colors(len(STOPS)))
    return f"linear-gradient(to right, {parts})"


def ticks(most_mm: float) -> list[str]:
    """Numbers below the scale; what lies above its end looks like its end."""
    return ["0", f"{most_mm / 2:g}", words.SCALE_END.format(most=most_mm)]


def color_node() -> Any:
    """The scale as a colour table of the scene, made once."""
    found = host.scene().GetFirstNodeByName(NAME)
    if found is not None:
        return found
    node = host.scene().AddNewNodeByClass("vtkMRMLColorTableNode", NAME)
    node.SetTypeToUser()
    node.SetNumberOfColors(ENTRIES)
    for index, color in enumerate(colors(ENTRIES)):
        node.SetColor(index, f"{index}", *color, 1.0)
    node.NamesInitialisedOn()
    node.SetHideFromEditors(True)
    node.SetSaveWithScene(False)
    return node


def color_by(model: Any, scalars: str, most_mm: float) -> None:
    """Colour a model's points by one of its arrays."""
    from vtkmodules.vtkFiltersCore import vtkAssignAttribute

    display = model.GetDisplayNode()
    display.SetActiveScalar(scalars, vtkAssignAttribute.POINT_DATA)
    display.SetAndObserveColorNodeID(color_node().GetID())
    display.SetScalarRangeFlag(display.UseManualScalarRange)
    display.SetScalarRange(0.0, most_mm)
    display.SetScalarVisibility(True)
