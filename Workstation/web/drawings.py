"""Live drawings as plain numbers for the page's SVG: the A-line with gates and echo, the bull's-eye, the points taken."""

from __future__ import annotations

from typing import Any

from CranioNavLib import scene
from ModuleUltrasoundLib.live_drawings import a_line, bulls_eye


def progress(logic: Any) -> list[dict[str, Any]]:
    """One entry a planned point: taken, asked for, or open; none while a sweep is recorded, which asks for no point."""
    node = scene.find("ProtocolPoints")
    if node is None or logic.sweep is not None:
        return []
    if logic.recorded() is None and scene.find("SurfacePoints") is not None:
        return []  # palpated and measured
    taken, current = set(logic.taken()), logic.currentIndex()
    labels = [node.GetNthControlPointLabel(index) for index in range(node.GetNumberOfControlPoints())]
    return [
        {"label": label, "state": "taken" if label in taken else "now" if index == current else "open"}
        for index, label in enumerate(labels)
    ]


def drawings(logic: Any) -> dict[str, Any]:
    """All of them; `measured`: whether there are bone points and nothing is being recorded."""
    measured = logic.recorded() is None and scene.find("SurfacePoints") is not None
    live = logic.live()
    return {
        "line": a_line(live, logic.parameters().read().echo_settings()),
        "eye": bulls_eye(logic.guide(), live),
        "points": progress(logic),
        "measured": measured,
    }
