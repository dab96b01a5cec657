"""What the logics of the three modules have in common: parameters by type, plugins made from the scene's settings."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

from CranioNavLib import scene
from CranioNavLib.panel import Panel
from CranioNavLib.panel_model import settings_prefix
from CranioNavLib.parameter_node import ParameterNode
from CranioNavLib.parameters import Parameters
from CranioNavLib.plugins import KINDS

P = TypeVar("P", bound=Parameters)


class ParametersInScene(Generic[P]):
    """To be mixed into a ScriptedLoadableModuleLogic; `parameterClass` says what its parameters are."""

    parameterClass: type[P]
    sessionRole: str = ""  # the role of the module's parameter node in the scene
    refusals: tuple[type[Exception], ...] = ()  # beside InputError: what the module's devices raise

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
