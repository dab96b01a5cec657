"""The four base classes of a scripted module for a plain Python; inside 3D Slicer its own are used (see host.py).

They have the attributes and methods that CranioNav's modules and a console script use, under Slicer's names.
"""

from __future__ import annotations

import importlib
import sys
import unittest
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from CranioNavLib import host


def _module_folder(of: object) -> Path:
    return Path(str(sys.modules[type(of).__module__].__file__)).parent


class ScriptedLoadableModule:
    """What a module says of itself: `parent` holds title, categories, help text."""

    def __init__(self, parent: Any = None) -> None:
        self.moduleName = type(self).__name__
        self.parent = parent if parent is not None else SimpleNamespace(path=str(_module_folder(self) / f"{self.moduleName}.py"))
        self.parent.title = self.moduleName
        self.parent.categories = []
        self.parent.dependencies = []
        self.parent.contributors = []
        self.parent.helpText = ""
        self.parent.acknowledgementText = ""

    def resourcePath(self, filename: str) -> str:
        """Absolute path of a file in the module's Resources folder."""
        return str(_module_folder(self) / "Resources" / filename)

    def getDefaultModuleDocumentationLink(self, docPage: str | None = None) -> str:
        """Inside the application a link to its documentation; here there is none."""
        return ""

    def runTest(self, msec: int = 100, **kwargs: Any) -> None:
        """Run the module's self-test, the class `<ModuleName>Test`; it raises when the test fails."""
        test: Any = getattr(importlib.import_module(type(self).__module__), f"{self.moduleName}Test")()
        test.messageDelay = msec
        test.runTest(**kwargs)


class ScriptedLoadableModuleWidget:
    """A module's panel, put into `parent`, a Qt widget with a layout."""

    def __init__(self, parent: Any = None) -> None:
        self.moduleName = type(self).__name__.removesuffix("Widget")
        self.developerMode = False
        if parent is None:
            toolkit: Any = importlib.import_module("CranioNavLib.panel_qt_widgets").toolkit()
            parent = toolkit.QWidget()
            toolkit.QVBoxLayout(parent)
        self.parent = parent
        self.layout = parent.layout()

    def resourcePath(self, filename: str) -> str:
        """Absolute path of a file in the module's Resources folder."""
        return str(_module_folder(self) / "Resources" / filename)

    def setup(self) -> None:
        """Build the panel; derived classes add theirs."""

    def enter(self) -> None:
        """The user opened the module."""

    def exit(self) -> None:
        """The user left the module."""

    def cleanup(self) -> None:
        """The module is about to be unloaded."""


class ScriptedLoadableModuleLogic:
    """What a module does, without its panel. Its parameters live in a scripted module node of the scene."""

    def __init__(self, parent: Any = None) -> None:
        self.moduleName = type(self).__name__.removesuffix("Logic")
        self.isSingletonParameterNode = True
        host.scene()

    def getParameterNode(self) -> Any:
        """The module's first parameter node; a new one if there is none."""
        if self.isSingletonParameterNode:
            node = host.scene().GetSingletonNode(self.moduleName, "vtkMRMLScriptedModuleNode")
            if node is not None:
                node.SetAttribute("ModuleName", self.moduleName)
                return node
        nodes = self.getAllParameterNodes()
        return nodes[0] if nodes else host.scene().AddNode(self.createParameterNode())

    def getAllParameterNodes(self) -> list[Any]:
        """All parameter nodes of this module."""
        nodes = host.slicer_package().util.getNodesByClass("vtkMRMLScriptedModuleNode")
        return [node for node in nodes if node.GetAttribute("ModuleName") == self.moduleName]

    def createParameterNode(self) -> Any:
        """A new parameter node, not yet in the scene."""
        node = host.slicer_package().vtkMRMLScriptedModuleNode()
        if self.isSingletonParameterNode:
            node.SetSingletonTag(self.moduleName)
        node.SetModuleName(self.moduleName)
        node.SetAttribute("ModuleName", self.moduleName)
        node.SetName(host.scene().GenerateUniqueName(self.moduleName))
        return node


class ScriptedLoadableModuleTest(unittest.TestCase):
    """A module's self-test; `runTest` runs the scenario and raises when it fails."""

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.messageDelay = 0

    def delayDisplay(self, message: str, requestedDelay: int | None = None, msec: int | None = None) -> None:
        """Inside the application the message is shown for a moment; here it is not."""

    def runTest(self) -> None:
        """The scenario; derived classes say which."""
        raise NotImplementedError(f"{type(self).__name__} has no runTest")
