"""A module's typed parameters, kept in a scripted module node of the scene so that a saved scene restores them.

One mechanism inside 3D Slicer and outside: a frozen `Parameters` dataclass, stored field by field as text.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Generic, TypeVar

from CranioNavLib import host
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Parameters
from CranioNavLib.scene import Observation

P = TypeVar("P", bound=Parameters)

ABSENT = "(none)"  # the text of an optional parameter that is None


class ParameterNode(Generic[P]):
    """The door between a `Parameters` dataclass and the node that holds it.

    Parameters
    ----------
    node : vtkMRMLScriptedModuleNode
        A logic's `getParameterNode()`, or a node of the scene contract.
    kind : type
        The dataclass. Every field needs a default.
    prefix : str
        Keeps several sets apart in one node (a plugin's settings: `"simulated."`).
    """

    def __init__(self, node: Any, kind: type[P], prefix: str = "") -> None:
        self.node, self.kind, self.prefix = node, kind, prefix

    def read(self) -> P:
        """The parameters as the node has them; defaults where it says nothing.

        Raises
        ------
        InputError
            The node holds a value outside its limits or of another type (a scene from elsewhere).
        """
        texts: dict[str, str] = {}
        nothing: dict[str, Any] = {}
        stored = set(self.node.GetParameterNames())
        for info in self.kind.describe():
            if self.prefix + info.name not in stored:
                continue
            text = self.node.GetParameter(self.prefix + info.name)
            if text == ABSENT and info.optional:
                nothing[info.name] = None
            else:
                texts[info.name] = text
        try:
            return replace(self.kind.from_strings(texts), **nothing)
        except InputError as error:
            raise InputError(f"parameters of {self.node.GetName()} in the scene: {error}; reset it") from None

    def write(self, parameters: P) -> None:
        """Store all fields; observers of the node hear of it once."""
        host.check_thread()
        texts = parameters.to_strings()
        with host.slicer_package().util.NodeModify(self.node):
            for info in self.kind.describe():
                self.node.SetParameter(self.prefix + info.name, texts.get(info.name, ABSENT))

    def change(self, **values: Any) -> P:
        """Store some fields, keep the others; returns all. The values are checked before anything is stored."""
        changed = replace(self.read(), **values)
        self.write(changed)
        return changed

    def reset(self) -> P:
        """Back to the defaults."""
        defaults = self.kind()
        self.write(defaults)
        return defaults

    def observe(self, callback: Callable[[P], None]) -> Observation:
        """Call `callback(parameters)` after each change of the node; keep what is returned, `stop()` ends it."""
        return Observation(self.node, lambda _: callback(self.read()))
