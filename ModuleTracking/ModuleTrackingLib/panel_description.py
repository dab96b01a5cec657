"""The tracking panel and its parameters, as data: drawn by Qt inside 3D Slicer and in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from CranioNavLib.panel import Action, FileField, NodeField, Panel, ParameterField, Picture, PluginField, ReadOut, Step
from CranioNavLib.parameters import Limits, Parameters

from ModuleTrackingLib.tracker import TRACKERS


class Tool(str, Enum):
    """The tools that have a tip."""

    STYLUS = "Stylus"
    SPHERE = "Sphere"
    PROBE = "Probe"


class PointList(str, Enum):
    """Where a digitised point goes: a role of the scene."""

    LANDMARKS = "LandmarksPatient"
    BONE = "SurfacePoints"
    TARGETS = "TargetsPatient"
    PLAUSIBILITY = "PlausibilityPoints"
    CLAMP = "ClampPins"


@dataclass(frozen=True)
class TrackingParameters(Parameters):
    """What the tracking module keeps in the scene."""

    tracker: Annotated[str, "where poses come from"] = "simulated"
    tool: Annotated[Tool, "tool that is calibrated, or whose tip is read"] = Tool.STYLUS
    points: Annotated[PointList, "list that the next point goes to"] = PointList.LANDMARKS
    rest_s: Annotated[float, Limits(0.1, 10), "how long the tip must rest on a point"] = 0.7
    pivot_s: Annotated[float, Limits(1, 120), "how long the tool is pivoted for its calibration"] = 10.0
    calibration_folder: Annotated[str, "folder that keeps calibrations and the check point"] = ""
    share_port: Annotated[int, Limits(0, 65535), "TCP port of the OpenIGTLink server; 0: a free one"] = 18944
    recording_path: Annotated[str, "recording of all tools (.igs.mha)"] = ""


PANEL = Panel(
    module="ModuleTracking",
    title="Tracking",
    parameters=TrackingParameters,
    steps=(
        Step(
            name="tracker",
            title="Tracker",
            help="Choose the tracker and connect. A tool that the camera does not see is not shown.",
            items=(
                PluginField("tracker", "Tracker", TRACKERS.kind),
                Action("connect", "Connect the tracker", "Open the tracker and begin tracking", primary=True),
                Action("disconnect", "Disconnect the tracker", "Stop tracking and let go of the tracker"),
                ReadOut("connection", "Connection"),
                ReadOut("referenceTool", "Reference base"),
                ReadOut("probeTool", "Probe"),
                ReadOut("stylusTool", "Stylus"),
                ReadOut("sphereTool", "Sphere tool"),
            ),
            status="trackerStatus",
        ),
        Step(
            name="calibration",
            title="Calibration",
            help="Set the tip into a divot (a small hollow) that does not move, and tilt the tool by 30° to all sides. "
            "To know its axis too, roll it about itself afterwards.",
            items=(
                ReadOut("pivotAdvice", "Do now", large=True),
                Picture("pivotCone", "Sides to which the tool was tilted, seen from above it"),
                ParameterField("tool"),
                ParameterField("pivot_s", "Pivot for"),
                FileField("calibration_folder", "Kept in", folder=True),
                Action("startPivot", "Pivot", "Begin to collect poses; the calibration follows by itself", primary=True),
                Action("startSpin", "Roll", "Begin to collect poses of the tool rolled about itself, by 90° or more"),
                Action("cancelPivot", "Cancel", "Forget the poses collected"),
                ReadOut("pivotProgress", "Poses"),
                ReadOut("calibration", "Tip"),
            ),
            status="calibrationStatus",
        ),
        Step(
            name="base",
            title="Reference base",
            help="If wanted: rest the calibrated stylus in the divot on the head clamp and store the place. "
            "Touch it again at any time: a base that has moved on its clamp is noticed.",
            items=(
                Action("storeCheckPoint", "Store the check point", "Keep where the divot is now", primary=True),
                Action("checkBase", "Check the base", "Compare the divot with the place that is stored"),
                ReadOut("baseCheck", "Base"),
            ),
            status="baseStatus",
        ),
        Step(
            name="points",
            title="Points",
            help="Rest the tip on the point that is asked for, and read it.",
            items=(
                ParameterField("points", "List"),
                ParameterField("rest_s", "Rest for"),
                ReadOut("nextPoint", "Next point", large=True),
                Action("digitise", "Read point", "Add the resting tip to the list", shortcut="Space", primary=True),
                Action("undoPoint", "Undo", "Remove the last point of the list", shortcut="Ctrl+Z"),
                NodeField("LandmarksPatient", "Landmarks"),
                NodeField("SurfacePoints", "Bone points"),
                NodeField("TargetsPatient", "Targets"),
                NodeField("PlausibilityPoints", "Plausibility"),
                NodeField("ClampPins", "Clamp pins", "Where the pins of the head clamp enter the skin: the probe is kept away"),
            ),
            status="pointsStatus",
        ),
        Step(
            name="checks",
            title="Markers and check points",
            help="To verify: read the markers (targets) one after another, with the sphere tool or the stylus, and some places "
            "anywhere on the bone with the stylus.",
            items=(
                ReadOut("nextMarker", "Next marker", large=True),
                Action("readMarker", "Read marker", "Add the resting tip to the measured targets"),
                Action("readPlausibility", "Read bone", "Add the resting tip to the plausibility points"),
                Action("undoCheck", "Undo the last one", "Remove what was read last of these"),
                ReadOut("checksRead", "Read"),
                ParameterField("tool", "Read with"),
            ),
        ),
        Step(
            name="sharing",
            title="Sharing",
            help="Poses and registration for 3D Slicer or any other OpenIGTLink client on this computer.",
            items=(
                ParameterField("share_port", "Port"),
                Action("startSharing", "Share", "Serve OpenIGTLink", primary=True),
                Action("stopSharing", "Stop sharing", "Close the server"),
                ReadOut("sharing", "Shared with"),
            ),
        ),
        Step(
            name="recording",
            title="Recording",
            help="Every pose of every tool, into a file that any PLUS or IGSIO tool reads.",
            items=(
                FileField("recording_path", "File", ("Recording (*.igs.mha)",), save=True),
                Action("startRecording", "Record", "Begin to record", primary=True),
                Action("stopRecording", "Stop", "Finish the file"),
                ReadOut("recording", "Recorded"),
            ),
        ),
    ),
)
