"""Tracking as 3D Slicer sees it. Wiring only: the panel, its steps and the self-test stand in ModuleTrackingLib."""

from __future__ import annotations

import sys
from pathlib import Path

_HERE = Path(__file__).resolve().parent
for _folder in (_HERE, _HERE.parent / "Shared"):
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
from ModuleTrackingLib.logic.base import BaseStep  # noqa: E402
from ModuleTrackingLib.logic.outlets import OutletSteps  # noqa: E402
from ModuleTrackingLib.logic.points import PointsStep  # noqa: E402
from ModuleTrackingLib.panel_description import PANEL  # noqa: E402
from ModuleTrackingLib.selftest import POLL_MS, TrackingSelfTest  # noqa: E402


class ModuleTracking(ScriptedLoadableModule):
    """What 3D Slicer's module list says."""

    def __init__(self, parent=None):
        super().__init__(parent)
        describeModule(self.parent, "CranioNav Tracking", PANEL, [])


class ModuleTrackingWidget(PanelOfDevice, ScriptedLoadableModuleWidget):
    """The panel inside 3D Slicer. Tracking goes on while another module is shown."""

    panelDescription = PANEL
    pollMs = POLL_MS

    def createLogic(self):
        """The module's logic."""
        return ModuleTrackingLogic()


class ModuleTrackingLogic(BaseStep, PointsStep, OutletSteps, ScriptedLoadableModuleLogic):
    """Frames of the tracker in, nodes out: the steps of the panel together; the owner of the event loop calls `poll`."""

    def __init__(self, parent=None):
        super().__init__(parent)
        self._identified = False  # since the tracker connected: do calibrations and check point belong to its tools?

    def connect(self):
        """Open the tracker that the parameters name; poses arrive through `poll`. Returns a message."""
        from ModuleTrackingLib.pose_stream import PoseStream

        tracker = self.createPlugin("tracker", self.parameters().read().tracker)
        self.failure, self._identified = "", False
        self.stream = PoseStream(tracker, {tool: found.tool_to_marker for tool, found in self.calibrator.found.items()})
        self.stream.start()
        return str(tracker.title)

    def disconnect(self):
        """Stop tracking; every tool is missing from now on."""
        self.stopRecording()
        self.stopSharing()
        self.cancelPivot()
        self.loseTools()

    def poll(self):
        """Take over the frames that came since the last call and write the tools' nodes. Main thread only."""
        if self.stream is None:
            return
        frames = self.takeFrames()
        self.collectPoses(self.writeFrames(frames))
        self.handOn(frames)
        if not self._identified and self.stream.state.connected and self.stream.tools:
            self._identified = True
            self.loadCalibrations()
            self.loadCheckPoint()
        self.finishCalibration()
        self.watchBase()


class ModuleTrackingTest(TrackingSelfTest, ScriptedLoadableModuleTest):
    """What "Reload and Test" runs."""

    def createLogic(self):
        """The module's logic."""
        return ModuleTrackingLogic()
