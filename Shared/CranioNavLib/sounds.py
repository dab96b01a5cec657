"""When the user is to hear something: a point taken, a refusal, a tool lost, the probe coming upright. Others make the tones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any

from CranioNavLib import scene, scene_data
from CranioNavLib.panel import Level
from CranioNavLib.panel_model import PanelModel
from CranioNavLib.parameter_node import ParameterNode
from CranioNavLib.parameters import Parameters

TOUCHED = ("LandmarksPatient", "TargetsPatient", "PlausibilityPoints", "ClampPins")
TOOLS = ("Stylus", "Probe", "Sphere")
NEWS_S = 1.0  # a tilt that was not heard of for so long is not known any more


@dataclass(frozen=True)
class SoundParameters(Parameters):
    """What the scene keeps of sounds, for the panels of all modules in 3D Slicer; each window of the web page has its own."""

    sounds: Annotated[bool, "a point taken, a refusal and a lost tool are heard, and how far the probe is tilted"] = True


def sound_parameters() -> ParameterNode[SoundParameters]:
    """The door to them; makes their node."""
    return ParameterNode(scene.find_or_create("Sounds"), SoundParameters)


def sounds_are_on() -> bool:
    """Whether anything is to be heard; asked for many times a second, so no node is made."""
    node = scene.find("Sounds")
    return node is None or ParameterNode(node, SoundParameters).read().sounds


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
        self._before: Any = None

    def next(self, guide: Any) -> dict[str, Any]:
        """Beeps a second (0: a steady tone), pitch in Hz (0: silence), and a number that is another one with each new guide.

        Who plays falls silent when the number stays the same for `NEWS_S`: lines have stopped, and the tilt is not known.
        """
        if guide is not self._before:
            self._before, self._count = guide, self._count + 1
        if guide is None or not guide.on_target:
            return {"rate": 0.0, "pitch": 0.0, "count": 0}
        return {"rate": round(guide.cue.rate_hz, 2), "pitch": round(guide.cue.pitch_hz), "count": self._count}


def situation(models: Iterable[PanelModel], palpated: int) -> Situation:
    """The present moment: of the scene, of what the panels say, and of the points palpated in this recording."""
    counts = [node.GetNumberOfControlPoints() for node in map(scene.find, TOUCHED) if node is not None]
    refusals = tuple(model.message for model in models if model.message.level is Level.BAD)
    tools = frozenset(tool for tool in TOOLS if scene_data.get_pose(f"{tool}ToReference").matrix is not None)
    return Situation(sum(counts) + palpated, refusals, tools)
