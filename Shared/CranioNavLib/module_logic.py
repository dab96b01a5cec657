"""What the logics of the three modules have in common: parameters by type, plugins by the scene's settings, a device."""

from __future__ import annotations

from typing import Any, Generic, Optional, Protocol, TypeVar

from CranioNavLib import scene
from CranioNavLib.errors import InputError
from CranioNavLib.panel import Level, Panel, Reading, StepState, StepStatus
from CranioNavLib.panel_model import settings_prefix
from CranioNavLib.parameter_node import ParameterNode
from CranioNavLib.parameters import Parameters
from CranioNavLib.plugins import KINDS

P = TypeVar("P", bound=Parameters)


class StreamState(Protocol):
    """What every stream can say of itself."""

    @property
    def connected(self) -> bool:
        """Whether its device is there."""

    @property
    def problem(self) -> str:
        """In words, why it is not."""


class Stream(Protocol):
    """What comes from a device, as far as the logics have it in common."""

    @property
    def state(self) -> StreamState:
        """How the device is doing."""


S = TypeVar("S", bound=Stream)


class ParametersInScene(Generic[P]):
    """To be mixed into a ScriptedLoadableModuleLogic; `parameterClass` says what its parameters are."""

    parameterClass: type[P]
    sessionRole: str = ""  # the role of the module's parameter node in the scene
    refusals: tuple[type[Exception], ...] = ()  # beside InputError: what the module's devices raise

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)  # type: ignore[call-arg]  # of the ScriptedLoadableModuleLogic

    def parameters(self) -> ParameterNode[P]:
        """The door to the module's parameters in the scene."""
        node: Any = self.getParameterNode()  # type: ignore[attr-defined]
        if node.GetAttribute(scene.ROLE_ATTRIBUTE) != self.sessionRole:
            node.SetAttribute(scene.ROLE_ATTRIBUTE, self.sessionRole)
        return ParameterNode(node, self.parameterClass)

    def pluginSettings(self, kind: str, name: str) -> ParameterNode[Parameters]:
        """The door to the settings that the scene keeps for a plugin."""
        return ParameterNode(self.parameters().node, KINDS[kind].find(name).Settings, settings_prefix(kind, name))

    def createPlugin(self, kind: str, name: str) -> Any:
        """A plugin of a kind with the settings that the scene keeps for it."""
        return KINDS[kind].find(name)(self.pluginSettings(kind, name).read())


class DeviceInScene(ParametersInScene[P], Generic[P, S]):
    """The same for a logic with a device: its stream while it is connected, and why there is none."""

    deviceWord: str  # what the user knows it by

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.stream: Optional[S] = None
        self.failure = ""  # why there is no connection

    @property
    def running(self) -> S:
        """The stream, where there has to be one.

        Raises
        ------
        InputError
            Nothing is connected.
        """
        if self.stream is None:
            raise InputError(self.notConnected())
        return self.stream

    def connectBlocked(self) -> str:
        """Why no device can be connected now."""
        return "disconnect first" if self.stream is not None else ""

    def disconnectBlocked(self) -> str:
        """Why there is nothing to disconnect."""
        return self.notConnected()

    def notConnected(self) -> str:
        """What to do first; "" if the device is connected, or being connected."""
        return "" if self.stream is not None else f"connect the {self.deviceWord} first"

    def whyNoConnection(self) -> Reading:
        """Read-out of a device that is not connected."""
        return Reading(self.failure or "not connected", Level.BAD if self.failure else Level.PLAIN)

    def statusOfDevice(self) -> StepStatus:
        """Status of the step that connects the device."""
        if self.stream is None:
            return StepStatus(StepState.ATTENTION, self.failure) if self.failure else todo(f"connect the {self.deviceWord}")
        state = self.stream.state
        return StepStatus(StepState.DONE if state.connected else StepState.ATTENTION, state.problem)


def todo(what: str) -> StepStatus:
    """Status of a step that waits for something to be done."""
    return StepStatus(StepState.TODO, what)


def done_or(done: bool, what: str) -> StepStatus:
    """Status of a step that is done, or waits for `what`."""
    return StepStatus(StepState.DONE) if done else todo(what)


def describeModule(parent: Any, title: str, panel: Panel, dependencies: list[str]) -> None:
    """Fill in what 3D Slicer's module list says of a module; the help text comes from its panel."""
    parent.title = title
    parent.categories = ["IGT.CranioNav"]
    parent.dependencies = dependencies
    parent.contributors = ["The CranioNav developers"]
    steps = "".join(f"<li><b>{step.title}</b>: {step.help}</li>" for step in panel.steps)
    parent.helpText = f"<p>{panel.title}, step by step:</p><ol>{steps}</ol><p>Not a medical device.</p>"
    parent.acknowledgementText = (
        "After Popovic, Heger et al., Efficient Non-Invasive Registration with A-mode Ultrasound in Skull Surgery."
    )
