"""The registration panel and its parameters, as data: drawn by Qt inside 3D Slicer and in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from CranioNavLib.panel import Action, FileField, ListField, NodeField, Panel, ParameterField, PluginField, ReadOut, Step
from CranioNavLib.parameters import Limits, Parameters

from ModuleRegistrationLib.anatomy.segmentation import SEGMENTATIONS
from ModuleRegistrationLib.registration.problem import METHODS

CT_FILES = ("CT (*.nrrd *.nii *.nii.gz *.mha *.mhd *.dcm)", "All files (*)")


@dataclass(frozen=True)
class RegistrationParameters(Parameters):
    """What the registration module keeps in the scene."""

    case_folder: Annotated[str, "folder with CT, landmark lists and recording of one registration"] = ""
    ct_path: Annotated[str, "DICOM folder or image file of the head"] = ""
    ct_series: Annotated[str, "number, description or UID of the series, where a folder holds several"] = ""
    segmentation: Annotated[str, "how bone is found in the CT"] = "threshold"
    marker_diameter_mm: Annotated[float, Limits(1, 20), "diameter of the titanium spheres"] = 4.0
    landmark: Annotated[str, "planned landmark that is placed or moved next"] = ""
    # The chapter's mode IIa: a TRE of 2.78 mm with four anatomical landmarks needs about this much per landmark.
    landmark_fle_mm: Annotated[float, Limits(0.05, 20), "usual error of one landmark pair (RMS, 3-D)"] = 3.5
    palpated_sd_mm: Annotated[float, Limits(0.05, 5), "error of a point touched with the stylus, per axis"] = 0.5
    method: Annotated[str, "how bone points are laid on the surface"] = "cranionav"
    tre_limit_mm: Annotated[float, Limits(0.1, 20), "the probability that the TRE stays below this is told"] = 2.0
    output_folder: Annotated[str, "where results are written"] = ""


PANEL = Panel(
    module="ModuleRegistration",
    title="Registration",
    parameters=RegistrationParameters,
    steps=(
        Step(
            name="ct",
            title="CT",
            help="Load the head CT, or a whole case folder with its landmarks and recording.",
            items=(
                FileField("ct_path", "CT", CT_FILES),
                ParameterField("ct_series", "Series"),
                Action("loadCt", "Load CT", "Read the CT into the scene", primary=True),
                FileField("case_folder", "Case folder", folder=True),
                Action("loadCase", "Load case", "Read CT, landmarks, recording and targets of a case folder"),
                NodeField("CT", "CT in use", "Another volume of the scene may be chosen"),
            ),
            status="ctStatus",
        ),
        Step(
            name="bone",
            title="Bone and markers",
            help="Find the skull in the CT. Skin and titanium spheres (markers) only where they are wanted.",
            items=(
                PluginField("segmentation", "Method", SEGMENTATIONS.kind),
                Action("segmentBone", "Find bone", "Segment the skull; takes some seconds", primary=True),
                NodeField("OuterTable", "Outer table"),
                Action("findSkin", "Find skin", "The scalp's surface, for the views"),
                ParameterField("marker_diameter_mm"),
                Action("findMarkers", "Find spheres", "Centres of titanium spheres become the target points of the CT"),
            ),
            status="boneStatus",
        ),
        Step(
            name="plan",
            title="Planned landmarks",
            help="Choose a landmark and click on the head or a slice: there it is. Choose it again to move it.",
            items=(
                Action("suggestLandmarks", "Suggest landmarks", "Propose landmarks on the skull; check and move each"),
                ListField("landmark", "Landmarks", "landmarks", "A click places the landmark that is chosen"),
                Action("moveToSurface", "Move to the bone", "Move the landmark that lies on no surface to the bone", rare=True),
                Action("exchangeSides", "Exchange left and right", "Give both landmarks each other's place", rare=True),
                ReadOut("placing", "The next click places"),
                Action("placeHere", "Place at the cross", "Place the chosen landmark where the slices cross", "P"),
                Action("undoLandmark", "Undo", "Take back the last change of a landmark", "Ctrl+Z"),
                Action("removeLandmark", "Remove", "Take the chosen landmark out", "Del"),
                Action("addLandmark", "Add a landmark", "A further point to be placed and touched"),
                Action("stopPlacing", "Stop placing", "Let the mouse turn the views again", "Escape"),
            ),
            status="planStatus",
        ),
        Step(
            name="landmarks",
            title="Landmarks",
            help="The landmarks touched on the patient are laid on the same landmarks of the CT: a first, rough registration.",
            items=(
                NodeField("LandmarksCT", "In the CT"),
                NodeField("LandmarksPatient", "On the patient"),
                ParameterField("landmark_fle_mm", "Usual error of a pair"),
                Action("registerLandmarks", "Register landmarks", "First, rough registration", primary=True),
                Action("dropMisfit", "Touch the misfit again", "Take out the landmark that does not fit", rare=True),
                ReadOut("fre", "Misfit of the landmarks (FRE, RMS; no accuracy)", "mm"),
            ),
            status="landmarkStatus",
        ),
        Step(
            name="surface",
            title="Surface",
            help="Lay the bone points measured by ultrasound or stylus on the skull.",
            items=(
                NodeField("SurfacePoints", "Bone points"),
                ParameterField("palpated_sd_mm", "Error of palpation"),
                PluginField("method", "Method", METHODS.kind),
                Action("registerSurface", "Register surface", "The registration by bone points, and its verdict", primary=True),
                ReadOut("verdict", "Verdict", large=True),
                ReadOut("predictedTre", "Expected error at the targets (TRE: mean; 95% at the worst)", "mm", large=True),
                ReadOut("surfaceResidual", "Distance of the bone points (RMS; no accuracy)", "mm"),
                ReadOut("speedOfSound", "Speed of sound in the scalp", "m/s"),
            ),
            status="surfaceStatus",
        ),
        Step(
            name="verification",
            title="Verification",
            help="Compare the registration with what it has not used: markers, further bone points, its own points in turn.",
            items=(
                NodeField("TargetsCT", "Targets in the CT"),
                NodeField("TargetsPatient", "Targets on the patient"),
                NodeField("PlausibilityPoints", "Plausibility points"),
                ParameterField("tre_limit_mm", "Limit of the TRE"),
                Action("verify", "Verify", "Measured TRE, plausibility, held-out points; takes some seconds", primary=True),
                ReadOut("measuredTre", "Measured error at the targets (TRE: mean ± SD; largest)", "mm", large=True),
                ReadOut("belowLimit", "Probability that the error is below the limit"),
                ReadOut("plausibility", "Plausibility (largest surface distance)", "mm"),
                ReadOut("touchedPoints", "Plausibility points"),
                ReadOut("heldOutPoints", "Held-out points"),
                ReadOut("influentialPoint", "Most influential point"),
            ),
            status="verificationStatus",
        ),
        Step(
            name="results",
            title="Results",
            help="ReferenceToRas.tfm and scene.mrb, for 3D Slicer and other programs.",
            items=(
                FileField("output_folder", "Folder", folder=True),
                Action("saveResults", "Save", "Write the transform and the scene", primary=True),
            ),
        ),
    ),
)
