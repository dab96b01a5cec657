"""A panel at work: its description bound to a module's logic. Renderers draw it and pass on what the user does.

A renderer builds its widgets from `model.panel`, asks `value`, `reading`, `status`, `blocked` and `node` for what to show,
passes edits to `change`, `choose` and `run`, and redraws when a listener is called. It needs no other rule.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from CranioNavLib import scene
from CranioNavLib.errors import InputError
from CranioNavLib.panel import (
    Action,
    Cancelled,
    Entry,
    Field,
    Level,
    ListField,
    NodeField,
    Panel,
    Picture,
    PluginField,
    Progress,
    Reading,
    ReadOut,
    Step,
    StepState,
    StepStatus,
    Task,
    check_panel,
)
from CranioNavLib.parameter_node import ParameterNode
from CranioNavLib.parameters import ParameterInfo, Parameters
from CranioNavLib.plugins import KINDS

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Message:
    """The last thing that an action or an edit had to say."""

    text: str
    level: Level


class Runner(Protocol):
    """Runs `compute` in another thread and calls `finished(result or exception)` in the thread that owns the scene."""

    def start(self, compute: Callable[[], Any], finished: Callable[[Any], None]) -> None:
        """Return at once."""


class PanelModel:
    """One panel and one logic.

    Parameters
    ----------
    panel : Panel
    logic : object
        Has the methods that the panel names, and `parameters()`, which returns a ParameterNode.
    runner : Runner, optional
        For long work. Without one, an action returns when all is done.

    Raises
    ------
    InputError
        The panel names what the logic, the scene or the plugins do not have.
    """

    def __init__(self, panel: Panel, logic: Any, runner: Runner | None = None) -> None:
        check_panel(panel, type(logic))
        self.panel, self.logic, self.runner = panel, logic, runner
        self.message = Message("", Level.PLAIN)
        self.errors: dict[str, str] = {}  # field name -> why the last edit was refused
        self.busy: Action | None = None
        self.progress = Progress()
        self._listeners: list[Callable[[], None]] = []
        self._stamp: tuple[tuple[str, int], ...] = ()
        self._refusals: tuple[type[Exception], ...] = (InputError, *getattr(logic, "refusals", ()))

    # Fields

    def describe(self, field: Field) -> ParameterInfo:
        """Type, limits, unit and help of a field."""
        return self.panel.parameter(field.name)

    def value(self, field: Field) -> Any:
        """The field's value in the scene."""
        return getattr(self._parameters().read(), field.name)

    def change(self, field: Field, value: Any) -> bool:
        """Store an edit; False, with `errors[field.name]` set, if it is refused. The logic may hear of it: `<name>Changed`."""
        before = self.value(field)
        if not self._store(field.name, self._parameters(), field.name, value):
            return False
        companion = getattr(self.logic, f"{field.name}Changed", None)
        if companion is not None and self.value(field) != before:
            companion()
            self.notify()
        return True

    def choices(self, field: PluginField) -> list[str]:
        """Names of the plugins that can be chosen."""
        return list(KINDS[field.kind].names())

    def settings(self, field: PluginField) -> ParameterNode[Parameters] | None:
        """Where the chosen plugin's own settings are kept; None if the plugin cannot be loaded."""
        name = self.value(field)
        try:
            kind = KINDS[field.kind].find(name).Settings
        except (InputError, ImportError) as error:
            self.errors[field.name] = str(error)
            return None
        return ParameterNode(self._parameters().node, kind, settings_prefix(field.kind, name))

    def change_setting(self, field: PluginField, name: str, value: Any) -> bool:
        """Store an edit of the chosen plugin's settings; False, with `errors["<plugin field>.<name>"]` set, if refused."""
        door = self.settings(field)
        return door is not None and self._store(f"{field.name}.{name}", door, name, value)

    # Lists

    def entries(self, field: ListField) -> tuple[Entry, ...]:
        """What can be chosen now."""
        try:
            return tuple(getattr(self.logic, field.entries)())
        except self._refusals as error:
            self.errors[field.name] = str(error)
            return ()

    def pick(self, field: ListField, name: str) -> bool:
        """Choose an entry, and let the logic hear of it; False, with a message, if it is refused."""
        if not self.change(field, name):
            return False
        companion = getattr(self.logic, f"{field.name}Chosen", None)
        return companion is None or self._guarded(lambda: self._say(companion() or "", Level.GOOD))

    # Nodes

    def node(self, field: NodeField) -> Any | None:
        """The node that plays the role now."""
        return scene.find(field.role)

    def choose(self, field: NodeField, node: Any | None) -> bool:
        """Let another node play the role; False, with a message, if it is of another class."""
        if node is None or node is self.node(field):
            return True
        return self._guarded(lambda: scene.assign(field.role, node))

    # Actions

    def blocked(self, action: Action) -> str:
        """Why the action cannot be used now; "" if it can."""
        if self.busy is not None:
            return f"{self.busy.label} is still running"
        companion = getattr(self.logic, f"{action.name}Blocked", None)
        return str(companion()) if companion is not None else ""

    def run(self, action: Action) -> bool:
        """Do what the button says; False, with a message, if it is refused. Long work goes to the runner."""
        reason = self.blocked(action)
        if reason:
            self._say(reason, Level.WARNING)
            return False
        return self._guarded(lambda: self._perform(action))

    def cancel(self) -> None:
        """Stop the long work under way; the user goes on at once, and what the work may still bring is dropped."""
        self.progress.cancel()
        if self.busy is not None:
            label, self.busy = self.busy.label, None
            self._say(f"{label}: cancelled", Level.WARNING)

    # Read-outs and steps

    def reading(self, read_out: ReadOut) -> Reading | None:
        """What a read-out shows now; None: nothing yet."""
        try:
            return getattr(self.logic, read_out.name)()  # type: ignore[no-any-return]
        except self._refusals as error:
            return Reading(str(error), Level.BAD)

    def drawing(self, picture: Picture) -> str | None:
        """A picture as SVG text; None: nothing to show."""
        try:
            return getattr(self.logic, picture.name)()  # type: ignore[no-any-return]
        except self._refusals:  # a read-out beside it says why
            return None

    def status(self, step: Step) -> StepStatus:
        """The state of a step."""
        if not step.status:
            return StepStatus(StepState.TODO)
        try:
            return getattr(self.logic, step.status)()  # type: ignore[no-any-return]
        except self._refusals as error:
            return StepStatus(StepState.ATTENTION, str(error))

    def offered(self, step: Step) -> Action | None:
        """What to press next in a step; None if it is done, or nothing can be pressed now."""
        status = self.status(step)
        if status.state is StepState.DONE:
            return None
        actions = [item for item in step.items if isinstance(item, Action)]
        wanted = [one for one in actions if (one.name == status.action if status.action else one.primary)]
        return next((one for one in wanted if not self.blocked(one)), None)

    # Listeners

    def listen(self, callback: Callable[[], None]) -> None:
        """Call `callback()` when something may have to be drawn anew."""
        self._listeners.append(callback)

    def forget(self, callback: Callable[[], None]) -> None:
        """No more calls."""
        self._listeners = [listener for listener in self._listeners if listener != callback]

    def notify(self) -> None:
        """Let all listeners draw anew."""
        for listener in list(self._listeners):
            listener()

    def scene_changed(self) -> bool:
        """Whether parameters or shown nodes have changed since the last call, by whomever: then draw anew."""
        nodes = [self._parameters().node]
        nodes += [scene.find(item.role) for item in self.panel.items() if isinstance(item, NodeField)]
        stamp = tuple((node.GetID(), node.GetMTime()) for node in nodes if node is not None)
        changed, self._stamp = stamp != self._stamp, stamp
        return changed

    def _parameters(self) -> ParameterNode[Parameters]:
        door: ParameterNode[Parameters] = self.logic.parameters()
        return door

    def _store(self, key: str, door: ParameterNode[Parameters], name: str, value: Any) -> bool:
        try:
            door.change(**{name: value})
        except InputError as error:
            kept = getattr(door.read(), name)
            stays = "" if kept in ("", None) else f"; {getattr(kept, 'value', kept)} is kept"
            self.errors[key] = _at_its_field(str(error), name) + stays
            self.notify()
            return False
        self.errors.pop(key, None)
        self.notify()
        return True

    def _guarded(self, work: Callable[[], object]) -> bool:
        try:
            work()
        except Cancelled as cancelled:
            self._say(str(cancelled), Level.WARNING)
            return False
        except self._refusals as error:
            self._say(str(error), Level.BAD)
            return False
        return True

    def _perform(self, action: Action) -> None:
        self.message = Message("", Level.PLAIN)
        result = getattr(self.logic, action.name)()
        if not isinstance(result, Task):
            self._report(result)
            return
        self.progress = progress = Progress()
        if self.runner is None:
            self._report(result.run(progress))
            return
        self.busy = action
        self.runner.start(lambda: result.compute(progress), lambda outcome: self._finish(result, outcome, progress))
        self.notify()

    def _finish(self, task: Task, outcome: Any, progress: Progress) -> None:
        """In the scene's thread: what a runner brought back becomes nodes, or a message."""
        if progress.cancelled:
            return
        self.busy = None

        def bring_in() -> None:
            if isinstance(outcome, BaseException):
                raise outcome
            self._report(task.apply(outcome))

        try:
            self._guarded(bring_in)
        except Exception as error:
            LOG.exception("%s failed", task.title)
            self._say(f"{task.title} failed: {type(error).__name__}: {error}; this is a defect, please report it", Level.BAD)

    def _report(self, said: str | Reading | None) -> None:
        """What an action returned: good news, unless it says otherwise."""
        reading = said if isinstance(said, Reading) else Reading(said or "", Level.GOOD)
        self._say(reading.text, reading.level)

    def _say(self, text: str, level: Level) -> None:
        self.message = Message(text, level if text else Level.PLAIN)
        self.notify()


def settings_prefix(kind: str, plugin: str) -> str:
    """Under which a plugin's settings are kept in its module's parameter node."""
    return f"{kind}.{plugin}."


def _at_its_field(refusal: str, name: str) -> str:
    """A refusal as it is said beside the field that it is of, whose label names it."""
    return refusal.removeprefix(f"parameter {name}").removeprefix(":").strip().removeprefix("is ")
