"""Live drawings as plain numbers for the page's SVG: the A-line with gates and echo, the bull's-eye, the points taken."""

from __future__ import annotations

from typing import Any

from CranioNavLib import scene
from ModuleUltrasoundLib.live_drawings import a_line, bulls_eye


def progress(logic: Any) -> list[dict[str, Any]]:
    """One entry a planned point: its name, and whether it is taken, asked for, or open."""
    node = scene.find("ProtocolPoints")
    return [
        {"label": node.GetNthControlPointLabel(index), "state": state.value} for index, state in enumerate(logic.pointStates())
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
