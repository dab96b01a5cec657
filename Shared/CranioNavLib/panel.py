"""A module's panel described once, as data: steps with fields, actions and read-outs. Renderers draw it, and hold no behaviour.

A description names things by words alone, so that it can be drawn by Qt inside 3D Slicer (panel_qt.py) and in a browser:

    Panel("ModuleX", "X", XParameters, steps=(
        Step("load", "Load the CT", "Choose ...", (FileField("ct_path", "CT"), Action("loadCt", "Load")), status="ctStatus"),
    ))

What the words mean to the module's logic:

=============  ==================================================================================================
ParameterField  a field of the panel's `Parameters` dataclass: type, limits, unit and help come from there
FileField      the same, for a `str` parameter that holds a path
PluginField    the same, for a `str` parameter that holds a plugin's name; the plugin's own settings are shown below it
ListField      the same, for a `str` parameter that names one of the entries that a method of the logic lists
NodeField      a role of the scene; the user may let another node of the same class play it
Action         a method of the logic without arguments. It returns None, a message (str, or a `Reading` if it is no good
               news), or a `Task` for long work
ReadOut        a method of the logic that returns a `Reading`, or None while there is nothing to show
Picture        a method of the logic that returns a drawing as SVG text, or None while there is nothing to show
Step.status    a method of the logic that returns a `StepStatus`
=============  ==================================================================================================

An action `loadCt` may have a companion method `loadCtBlocked()` that returns why it cannot be used now ("" if it can), and a
list `landmark` a companion `landmarkChosen()` that is called when the user has chosen an entry. A logic
refuses with InputError or with what its attribute `refusals` names; the text is shown, and nothing is changed. A renderer
talks to a `PanelModel` (panel_model.py), which does all of this for it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any, Union

from CranioNavLib import scene
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import UNITS, ParameterInfo, Parameters
from CranioNavLib.plugins import KINDS


class Level(str, Enum):
    """How a text is to be taken. Renderers show a word or sign too, never the colour alone."""

    PLAIN = "plain"
    GOOD = "good"
    WARNING = "warning"
    BAD = "bad"


class StepState(str, Enum):
    """Where the user is with a step. No state locks a step."""

    TODO = "to do"
    DONE = "done"
    ATTENTION = "needs attention"


@dataclass(frozen=True)
class Reading:
    """What a read-out shows now; `unit` stands in its description."""

    text: str
    level: Level = Level.PLAIN

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class StepStatus:
    """State of a step with one line of why, and what to do next."""

    state: StepState
    text: str = ""
    action: str = ""  # what to press next; "": the step's first main action that can be used


@dataclass(frozen=True)
class Entry:
    """One line of a list to choose from."""

    name: str
    done: bool = False
    note: str = ""  # beside the name
    doubtful: bool = False  # there is something to look at


@dataclass(frozen=True)
class ParameterField:
    """One parameter. Label and help may be left to the parameter's own name and help."""

    name: str
    label: str = ""


@dataclass(frozen=True)
class FileField:
    """A path: a `str` parameter with a browse button."""

    name: str
    label: str
    filters: tuple[str, ...] = ()  # Qt's form: "Markups (*.mrk.json *.fcsv)"
    folder: bool = False  # a folder instead of a file
    save: bool = False  # a file that need not exist yet


@dataclass(frozen=True)
class PluginField:
    """The name of a plugin of a kind, with the settings of the one chosen."""

    name: str
    label: str
    kind: str  # "tracker", "amode", "registration", "segmentation"


@dataclass(frozen=True)
class ListField:
    """A list with one entry chosen: a `str` parameter that holds the entry's name."""

    name: str
    label: str
    entries: str  # method of the logic that returns a tuple of Entry
    help: str = ""


@dataclass(frozen=True)
class NodeField:
    """The node that plays a role of the scene."""

    role: str
    label: str
    help: str = ""


@dataclass(frozen=True)
class Action:
    """A button. `shortcut` in Qt's form ("Ctrl+Z"); `primary`: the step's main one; `rare`: shown only while it can be used."""

    name: str
    label: str
    help: str = ""
    shortcut: str = ""
    primary: bool = False
    rare: bool = False


@dataclass(frozen=True)
class ReadOut:
    """A value shown live; `large` ones are legible at two metres."""

    name: str
    label: str
    unit: str = ""
    large: bool = False

    @property
    def spaced_unit(self) -> str:
        """The unit as it follows a number: a degree sign stands close to it."""
        return self.unit if self.unit in ("", "°") else f" {self.unit}"


@dataclass(frozen=True)
class Picture:
    """A drawing shown live; `label` says what it shows, for those who do not see it."""

    name: str
    label: str
    on_page: bool = True  # False: the web page has a larger one of its own


Field = Union[ParameterField, FileField, PluginField, ListField]
Item = Union[ParameterField, FileField, PluginField, ListField, NodeField, Action, ReadOut, Picture]


@dataclass(frozen=True)
class Step:
    """One step of the procedure: a collapsible section, or a page of a stepper."""

    name: str
    title: str
    help: str
    items: tuple[Item, ...]
    status: str = ""  # method of the logic; "": the step has no state


@dataclass(frozen=True)
class Panel:
    """All of a module's panel."""

    module: str
    title: str
    parameters: type[Parameters]
    steps: tuple[Step, ...]

    def items(self) -> Iterator[Item]:
        """All items of all steps."""
        for step in self.steps:
            yield from step.items

    def actions(self) -> tuple[Action, ...]:
        """All actions, in order."""
        return tuple(item for item in self.items() if isinstance(item, Action))

    def parameter(self, name: str) -> ParameterInfo:
        """What is known of a parameter.

        Raises
        ------
        InputError
            The panel's parameters have no such field.
        """
        known = {info.name: info for info in self.parameters.describe()}
        if name not in known:
            raise InputError(f"panel {self.module}: no parameter {name!r}; known: {', '.join(known)}")
        return known[name]


class Cancelled(Exception):  # noqa: N818 - not an error: the user's wish
    """Long work ended because the user asked for it."""


class Progress:
    """How far long work has come; shared by the thread that works and the one that shows it."""

    def __init__(self, listener: Callable[[str, float], None] | None = None) -> None:
        self.text, self.share = "", 0.0
        self._cancelled = threading.Event()
        self._listener = listener

    def __call__(self, text: str, share: float) -> None:
        """Say what is being done and how much of all is done (0..1).

        Raises
        ------
        Cancelled
            The user asked to stop.
        """
        if self._cancelled.is_set():
            raise Cancelled(f"cancelled while {text}")
        self.text, self.share = text, min(max(share, 0.0), 1.0)
        if self._listener is not None:
            self._listener(text, self.share)

    @property
    def cancelled(self) -> bool:
        """Whether the user asked to stop."""
        return self._cancelled.is_set()

    def cancel(self) -> None:
        """Ask the work to stop at its next report."""
        self._cancelled.set()


@dataclass(frozen=True)
class Task:
    """Long work of an action in two parts: `compute` off the main thread, without the scene; `apply` on it."""

    title: str
    compute: Callable[[Progress], Any]
    apply: Callable[[Any], Union[str, Reading, None]]  # given what compute returned; returns a message or None

    def run(self, progress: Progress | None = None) -> str | Reading | None:
        """Both parts, here and now: for scripts and tests."""
        return self.apply(self.compute(progress or Progress()))


def label_of(panel: Panel, field: Field) -> str:
    """A field's label: its own, else made of the parameter's name (`landmark_sd_mm` -> "Landmark sd")."""
    if field.label:
        return field.label
    return words_of(panel.parameter(field.name).name)


def words_of(name: str) -> str:
    """A parameter's name as words, its unit left out (`landmark_sd_mm` -> "Landmark sd")."""
    ending = next((ending for ending in UNITS if name.endswith(ending)), "")
    return name[: len(name) - len(ending)].replace("_", " ").capitalize()


def check_panel(panel: Panel, logic_class: type) -> None:
    """Hold a description to what exists: parameters, roles, plugin kinds and the logic's methods.

    Raises
    ------
    InputError
        Something named is not there, or a name stands twice in a step.
    """
    missing: list[str] = []
    methods = [item.name for item in panel.items() if isinstance(item, (Action, ReadOut, Picture))]
    methods += [item.entries for item in panel.items() if isinstance(item, ListField)]
    methods += [step.status for step in panel.steps if step.status]
    missing += [f"method {name}" for name in methods if not callable(getattr(logic_class, name, None))]
    for item in panel.items():
        if isinstance(item, (ParameterField, FileField, PluginField, ListField)):
            panel.parameter(item.name)
        if isinstance(item, PluginField) and item.kind not in KINDS:
            missing.append(f"plugin kind {item.kind}")
        if isinstance(item, NodeField):
            scene.role(item.role)
    if missing:
        raise InputError(f"panel {panel.module}: {logic_class.__name__} has no {', '.join(missing)}")
    names = [step.name for step in panel.steps] + [item.name for item in panel.actions()]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"panel {panel.module}: {', '.join(twice)} stands twice")
