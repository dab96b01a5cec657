"""When the page is to be heard: a point taken, a refusal, a tool lost, the probe coming upright. The browser makes the tones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from CranioNavLib import scene, scene_data
from CranioNavLib.panel import Level

TOUCHED = ("LandmarksPatient", "TargetsPatient", "PlausibilityPoints")
TOOLS = ("Stylus", "Probe", "Sphere")
UPRIGHT_HZ, OCTAVE_DEG, LOWEST_HZ = 880.0, 10.0, 110.0  # of the tilt's tone: an octave lower for each so many degrees


@dataclass(frozen=True)
class Situation:
    """What can be heard of at one moment."""

    taken: int = 0  # points
    refusals: tuple[object, ...] = ()  # the panels' messages that say no, each an object of its own
    tools: frozenset[str] = frozenset()  # in view
    tilt_deg: float | None = None  # of the probe on its point


class Cues:
    """Compares one moment with the one before."""

    def __init__(self) -> None:
        self._before: Situation | None = None
        self._count = 0

    def next(self, now: Situation) -> dict[str, Any] | None:
        """The cue to play: its name, a running number and (tilt) a pitch in Hz; None: silence. The gravest goes first."""
        before, self._before = self._before, now
        if before is None:
            return None
        if before.tools - now.tools:
            return self._cue("lost")
        if any(all(one is not other for other in before.refusals) for one in now.refusals):
            return self._cue("refused")
        if now.taken == before.taken + 1:  # more at once are loaded, not touched
            return self._cue("taken")
        if now.tilt_deg is not None:
            return self._cue("tilt", pitch_of(now.tilt_deg))
        return None

    def _cue(self, name: str, pitch_hz: float = 0.0) -> dict[str, Any]:
        self._count += 1
        return {"name": name, "count": self._count, "pitch": round(pitch_hz)}


def pitch_of(tilt_deg: float) -> float:
    """The tone of a tilt: the higher the nearer to upright."""
    return max(LOWEST_HZ, UPRIGHT_HZ * float(2.0 ** (-abs(tilt_deg) / OCTAVE_DEG)))


def situation(panels: dict[str, Any], ultrasound: Any, palpating: bool) -> Situation:
    """The present moment; `palpating`: whether the probe's tilt is to be heard."""
    counts = [node.GetNumberOfControlPoints() for node in map(scene.find, TOUCHED) if node is not None]
    refusals = tuple(panel.model.message for panel in panels.values() if panel.model.message.level is Level.BAD)
    tools = frozenset(tool for tool in TOOLS if scene_data.get_pose(f"{tool}ToReference").matrix is not None)
    guide = ultrasound.guide() if palpating else None
    tilt = float(guide.angle_deg) if guide is not None and guide.on_target else None
    return Situation(sum(counts) + len(ultrasound.taken()), refusals, tools, tilt)
