"""Registration as 3D Slicer sees it. Wiring only: the panel, its steps and the self-test stand in ModuleRegistrationLib."""

from __future__ import annotations

import sys
from pathlib import Path

_HERE = Path(__file__).resolve().parent
for _folder in (_HERE, *(_HERE.parent / name for name in ("Shared", "ModuleTracking", "ModuleUltrasound"))):
    # In a source checkout the libraries stand in folders of their own; installed, they stand beside this file.
    if _folder.is_dir() and str(_folder) not in sys.path:
        sys.path.append(str(_folder))

from CranioNavLib.host import (  # noqa: E402
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleTest,
    ScriptedLoadableModuleWidget,
)
from CranioNavLib.module_logic import describeModule  # noqa: E402
from CranioNavLib.module_widget import PolledPanel  # noqa: E402
from ModuleRegistrationLib.logic.bone import BoneStep  # noqa: E402
from ModuleRegistrationLib.logic.loading import LoadingStep  # noqa: E402
from ModuleRegistrationLib.logic.planning import PlanningStep  # noqa: E402
from ModuleRegistrationLib.logic.refining import POLL_MS, RefiningStep  # noqa: E402
from ModuleRegistrationLib.logic.verifying import VerifyingSteps  # noqa: E402
from ModuleRegistrationLib.panel_description import PANEL  # noqa: E402
from ModuleRegistrationLib.selftest import RegistrationSelfTest  # noqa: E402


class ModuleRegistration(ScriptedLoadableModule):
    """What 3D Slicer's module list says."""

    def __init__(self, parent=None):
        super().__init__(parent)
        describeModule(self.parent, "CranioNav Registration", PANEL, ["ModuleTracking", "ModuleUltrasound"])


class ModuleRegistrationWidget(PolledPanel, ScriptedLoadableModuleWidget):
    """The panel inside 3D Slicer. Guidance is refined while another module is shown, too."""

    panelDescription = PANEL
    pollMs = POLL_MS

    def createLogic(self):
        """The module's logic."""
        return ModuleRegistrationLogic()


class ModuleRegistrationLogic(LoadingStep, BoneStep, PlanningStep, VerifyingSteps, RefiningStep, ScriptedLoadableModuleLogic):
    """Nodes in, arrays to the library, results to nodes: the steps of the panel together. Runs without a widget.

    While points are palpated, the owner of the event loop calls `poll`.
    """


class ModuleRegistrationTest(RegistrationSelfTest, ScriptedLoadableModuleTest):
    """What "Reload and Test" runs."""

    def createLogic(self):
        """The module's logic."""
        return ModuleRegistrationLogic()
