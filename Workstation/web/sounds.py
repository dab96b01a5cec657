"""When the page is to be heard: a point taken, a refusal, a tool lost, the probe coming upright. The browser makes the tones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from CranioNavLib import scene, scene_data
from CranioNavLib.panel import Level

TOUCHED = ("LandmarksPatient", "TargetsPatient", "PlausibilityPoints", "ClampPins")
TOOLS = ("Stylus", "Probe", "Sphere")


@dataclass(frozen=True)
class Situation:
    """What can be heard of at one moment."""

    taken: int = 0  # points
    refusals: tuple[object, ...] = ()  # the panels' messages that say no, each an object of its own
    tools: frozenset[str] = frozenset()  # in view


class Cues:
    """Compares one moment with the one before."""

    def __init__(self) -> None:
        self._before: Situation | None = None
        self._count = 0

    def next(self, now: Situation) -> dict[str, Any] | None:
        """The cue to play: its name and a running number; None: silence. The gravest goes first."""
        before, self._before = self._before, now
        if before is None:
            return None
        if before.tools - now.tools:
            return self._cue("lost")
        if any(all(one is not other for other in before.refusals) for one in now.refusals):
            return self._cue("refused")
        if now.taken == before.taken + 1:  # more at once are loaded, not touched
            return self._cue("taken")
        return None

    def _cue(self, name: str) -> dict[str, Any]:
        self._count += 1
        return {"name": name, "count": self._count}


class TiltTone:
    """What is heard of the probe's tilt while it stands on its point: beeps that quicken, a steady tone when it is square."""

    def __init__(self) -> None:
        self._count = 0

    def next(self, guide: Any) -> dict[str, Any]:
        """Beeps a second (0: a steady tone), pitch in Hz (0: silence), and a running number, without which the page is silent."""
        self._count += 1
        if guide is None or not guide.on_target:
            return {"rate": 0.0, "pitch": 0.0, "count": 0}
        return {"rate": round(guide.cue.rate_hz, 2), "pitch": round(guide.cue.pitch_hz), "count": self._count}


def situation(panels: dict[str, Any], ultrasound: Any) -> Situation:
    """The present moment."""
    counts = [node.GetNumberOfControlPoints() for node in map(scene.find, TOUCHED) if node is not None]
    refusals = tuple(panel.model.message for panel in panels.values() if panel.model.message.level is Level.BAD)
    tools = frozenset(tool for tool in TOOLS if scene_data.get_pose(f"{tool}ToReference").matrix is not None)
    return Situation(sum(counts) + len(ultrasound.taken()), refusals, tools)
