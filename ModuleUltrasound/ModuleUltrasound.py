"""Ultrasound as 3D Slicer sees it. Wiring only: the panel, its steps and the self-test stand in ModuleUltrasoundLib."""

from __future__ import annotations

import sys
from pathlib import Path

_HERE = Path(__file__).resolve().parent
for _folder in (_HERE, *(_HERE.parent / name for name in ("Shared", "ModuleTracking"))):
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
from CranioNavLib.module_widget import PanelOfDevice  # noqa: E402
from ModuleUltrasoundLib.logic.palpating import PalpationStep  # noqa: E402
from ModuleUltrasoundLib.panel_description import PANEL  # noqa: E402
from ModuleUltrasoundLib.selftest import POLL_MS, UltrasoundSelfTest  # noqa: E402


class ModuleUltrasound(ScriptedLoadableModule):
    """What 3D Slicer's module list says."""

    def __init__(self, parent=None):
        super().__init__(parent)
        describeModule(self.parent, "CranioNav Ultrasound", PANEL, ["ModuleTracking"])


class ModuleUltrasoundWidget(PanelOfDevice, ScriptedLoadableModuleWidget):
    """The panel inside 3D Slicer. Lines are taken while another module is shown, too."""

    panelDescription = PANEL
    pollMs = POLL_MS

    def createLogic(self):
        """The module's logic."""
        return ModuleUltrasoundLogic()

    def palpated(self):
        """Points taken in the recording under way."""
        return len(self.logic.taken())

    def probeGuide(self):
        """Where the probe stands to its point, while this module is shown."""
        return self.logic.guide() if self.isOpen else None


class ModuleUltrasoundLogic(PalpationStep, ScriptedLoadableModuleLogic):
    """Lines of the device and the probe's pose in, bone points out; the owner of the event loop calls `poll`."""

    def poll(self):
        """Take over the lines that came since the last call, and what has come into the probe's way. Main thread only."""
        self.keepClear()
        if self.stream is None:
            return
        self.record(self.takeLines())
        measured = self.measureLive()
        if measured:
            self.takePoints(measured)
            self.steer()


class ModuleUltrasoundTest(UltrasoundSelfTest, ScriptedLoadableModuleTest):
    """What "Reload and Test" runs."""

    def createLogic(self):
        """The module's logic."""
        return ModuleUltrasoundLogic()
