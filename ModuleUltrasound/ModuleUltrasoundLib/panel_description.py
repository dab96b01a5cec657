"""The ultrasound panel and its parameters, as data: drawn by Qt inside 3D Slicer and in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Optional

from CranioNavLib.panel import Action, FileField, NodeField, Panel, ParameterField, Picture, PluginField, ReadOut, Step
from CranioNavLib.parameters import Limits, Parameters

from ModuleUltrasoundLib.devices.device import AMODE_DEVICES
from ModuleUltrasoundLib.measurement.measure import EchoSettings
from ModuleUltrasoundLib.palpation.clamp import CLEARANCE_LIMITS, CLEARANCE_MM

RECORDINGS = ("Recording (*.igs.mha *.igs.mhd *.mha)",)


class PatientLies(str, Enum):
    """What of the head the table hides from the probe."""

    FREE = "head is free all round"
    BACK = "on the back"
    LEFT = "on the left side"
    RIGHT = "on the right side"
    FACE = "face down"


TOWARDS_TABLE: dict[PatientLies, Optional[tuple[float, float, float]]] = {  # RAS
    PatientLies.FREE: None,
    PatientLies.BACK: (0.0, -1.0, 0.0),
    PatientLies.LEFT: (-1.0, 0.0, 0.0),
    PatientLies.RIGHT: (1.0, 0.0, 0.0),
    PatientLies.FACE: (0.0, 1.0, 0.0),
}


class PalpateBy(str, Enum):
    """How the probe finds the bone."""

    POINTS = "points: rest on each"
    SWEEP = "sweep: glide over the skull"


@dataclass(frozen=True)
class UltrasoundParameters(Parameters):
    """What the ultrasound module keeps in the scene."""

    device: Annotated[str, "where RF lines come from"] = "simulated"
    patient_lies: Annotated[PatientLies, "points that the table hides are asked for last"] = PatientLies.FREE
    clamp_clearance_mm: Annotated[
        float, CLEARANCE_LIMITS, "between the probe's axis and each pin of the clamp, and the middle of the reference base"
    ] = CLEARANCE_MM
    palpate_by: Annotated[PalpateBy, "one point where the probe rests, or one every 2 mm of its way"] = PalpateBy.POINTS
    recording_path: Annotated[str, "recording to be measured, or to be written (.igs.mha)"] = ""
    speed_of_sound_m_s: Annotated[float, Limits(1300, 1800), "speed of sound in the scalp: mean of the prior"] = (
        EchoSettings.speed_of_sound_m_s
    )
    speed_of_sound_sd_m_s: Annotated[float, Limits(0, 200), "speed of sound in the scalp: SD of the prior"] = (
        EchoSettings.speed_of_sound_sd_m_s
    )
    most_depth_mm: Annotated[float, Limits(2, 60), "no bone is looked for below this depth"] = EchoSettings.most_depth_mm
    quality_gate: Annotated[float, Limits(0, 1), "lines below this quality are not points"] = EchoSettings.quality_gate

    def echo_settings(self) -> EchoSettings:
        """The settings of the signal chain."""
        return EchoSettings(
            speed_of_sound_m_s=self.speed_of_sound_m_s,
            speed_of_sound_sd_m_s=self.speed_of_sound_sd_m_s,
            most_depth_mm=self.most_depth_mm,
            quality_gate=self.quality_gate,
        )


PANEL = Panel(
    module="ModuleUltrasound",
    title="A-mode ultrasound",
    parameters=UltrasoundParameters,
    steps=(
        Step(
            name="protocol",
            title="Protocol",
            help="Place the 18 palpation points on this skull, from its outer table and the planned landmarks.",
            items=(
                NodeField("OuterTable", "Outer table"),
                NodeField("LandmarksCT", "Landmarks in the CT"),
                NodeField("ClampPins", "Pins of the head clamp"),
                ParameterField("patient_lies", "The patient lies"),
                ParameterField("clamp_clearance_mm", "Distance from clamp and base"),
                ReadOut("clampPins", "Head clamp"),
                Action("planProtocol", "Plan points", "Place the palpation points", primary=True),
                ReadOut("currentPoint", "Palpate now", large=True),
                Action("nextPoint", "Next point", "Go on to the next point", shortcut="Right"),
                Action("previousPoint", "Point before", "Go back to the point before", shortcut="Left"),
            ),
            status="protocolStatus",
        ),
        Step(
            name="device",
            title="Probe",
            help="Choose the device that drives the ultrasound probe and connect. The tracker tells where the probe is.",
            items=(
                PluginField("device", "Device", AMODE_DEVICES.kind),
                Action("connect", "Connect the probe", "Begin to take lines", primary=True),
                Action("disconnect", "Disconnect the probe", "Let go of the device"),
                ReadOut("connection", "Connection"),
                ReadOut("probePose", "Probe's pose"),
                ReadOut("depth", "Bone depth", "mm", large=True),
                ReadOut("quality", "Echo quality (0..1)"),
                Picture("aLine", "The last line, with skin and bone; the light band is the gate", on_page=False),
            ),
            status="deviceStatus",
        ),
        Step(
            name="palpation",
            title="Palpation",
            help="Hold the probe still on each point, or sweep it slowly; every line is recorded.",
            items=(
                ParameterField("palpate_by", "Palpate by"),
                FileField("recording_path", "Recording", RECORDINGS, save=True),
                Action("startRecording", "Record", "Begin to record lines and poses", primary=True),
                Action("stopRecording", "Stop the recording", "Finish the file and measure it"),
                ReadOut("guidance", "Do now", large=True),
                Picture("bullsEye", "Where the probe's back end stands off the upright, seen from outside", on_page=False),
                Picture(
                    "pointsDrawn", "The points of the protocol: full ones are taken, the thick ring is asked for", on_page=False
                ),
                ReadOut("restsOn", "Guidance rests on"),
                ReadOut("brings", "Predicted error with this point", "mm"),
                ReadOut("tilt", "Tilt off the upright", "°", large=True),
                ReadOut("dwell", "Taken"),
                Action("undoPoint", "Undo the last point", "Take back the last point", shortcut="Ctrl+Z"),
                ReadOut("recorded", "Recorded"),
            ),
            status="palpationStatus",
        ),
        Step(
            name="measure",
            title="Bone points",
            help="Find the bone echo in every recorded line; good ones become bone points with their error.",
            items=(
                ParameterField("speed_of_sound_m_s"),
                ParameterField("speed_of_sound_sd_m_s", "Its SD"),
                ParameterField("most_depth_mm", "Deepest bone"),
                ParameterField("quality_gate"),
                Action("measureRecording", "Measure recording", "Read the recording and write SurfacePoints", primary=True),
                NodeField("SurfacePoints", "Bone points"),
                ReadOut("pointCount", "Points"),
                ReadOut("pressedSpeed", "Speed of sound by pressing"),
                Action("useSpeed", "Use this speed of sound", "As the prior of the next measurement"),
            ),
            status="measureStatus",
        ),
    ),
)
