"""One registration from its case folder to a verified result: the order of the steps, and nothing of their inside."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Optional

import numpy as np
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.case import Case
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording, read_recording
from CranioNavLib.slicer_files import LabelledPoints
from CranioNavLib.volume import Volume
from ModuleUltrasoundLib.measurement.measure import LineMeasurements, bone_points, measure_lines
from ModuleUltrasoundLib.measurement.speed_of_sound import SpeedEstimate, estimate_if_pressed

from ModuleRegistrationLib.anatomy.ct_reader import read_ct
from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces, segment_bone
from ModuleRegistrationLib.registration.error_theory import PredictedTre, predict_tre_of
from ModuleRegistrationLib.registration.landmarks import LandmarkRegistration, register_landmarks
from ModuleRegistrationLib.registration.pairing import pair_points
from ModuleRegistrationLib.registration.problem import METHODS, RegistrationProblem, RegistrationResult
from ModuleRegistrationLib.registration.verdict import Limits, Verdict, judge
from ModuleRegistrationLib.verification.confidence import LIMIT_MM, Confidence, assess, doubted, touched_points
from ModuleRegistrationLib.verification.held_out import DistanceCheck
from ModuleRegistrationLib.verification.plausibility import Plausibility, plausibility
from ModuleRegistrationLib.verification.tre import TargetErrors, target_errors

Progress = Callable[[str, float], None]  # what is being done, and how much of all is done (0..1)

LANDMARK_MODES = ("Ia", "Ib", "IIa")
DEFAULT_METHOD = "cranionav"
STYLUS_POINT_SD_MM = 0.5  # per axis: tracker 0.25 mm, tip calibration, and the tip's rest on rough bone
# Root mean square 3D localisation error usual for what a mode pairs: error theory starts from it.
# Bone screws and skin markers: Maurer et al., IEEE TMI 16(4), 1997; landmarks: the chapter's mode IIa, whose
# TRE of 2.78 mm with four landmarks needs about 3.5 mm.
USUAL_FLE_MM = {"Ia": 0.7, "Ib": 2.0, "IIa": 3.5, "IIb": 3.5, "III": 3.5}
# Landmarks alone are a start, not a result to navigate by: their error is told in a warning, and refused only beyond use
LANDMARKS_ALONE = Limits(refuse_p95_mm=20.0)
DEFAULT_TARGETS = 12  # spread over the outer table, where a case names no targets


@dataclass(frozen=True, eq=False)
class Ultrasound:
    """What mode III measured."""

    recording: Recording
    measurements: LineMeasurements
    pressed: Optional[SpeedEstimate] = None  # speed of sound from pressing on the same spot; None: nobody did


@dataclass(frozen=True, eq=False)
class CaseResult:
    """A registered case, everything kept that a report, a scene or a table may show."""

    case: Case
    mode: str
    volume: Volume
    bone: BoneSurfaces
    landmarks: LandmarkRegistration
    landmarks_ct_mm: Array  # (L, 3) RAS, in the CT list's order
    landmarks_patient_mm: Array  # (L, 3) Reference, paired with landmarks_ct_mm
    points: BonePoints  # Reference; empty in modes Ia, Ib, IIa
    registration: RegistrationResult
    verdict: Verdict
    targets_ras_mm: Array  # (T, 3) where the error is predicted: the case's targets, else DEFAULT_TARGETS on the bone
    predicted: Optional[PredictedTre]  # None: the method gives no uncertainty
    ultrasound: Optional[Ultrasound] = None
    tre: Optional[TargetErrors] = None
    plausibility: Optional[Plausibility] = None
    confidence: Confidence = field(default_factory=lambda: Confidence(LIMIT_MM))
    duration_s: float = 0.0
    target_labels: tuple[str, ...] = field(default_factory=tuple)


def register_case(
    case: Case,
    mode: Optional[str] = None,
    method: Optional[str] = None,
    segmentation: str = "threshold",
    progress: Optional[Progress] = None,
    limit_mm: float = LIMIT_MM,
    series: Optional[str] = None,
) -> CaseResult:
    """Read, segment, register, judge and verify one case.

    Parameters
    ----------
    case : Case
    mode, method, segmentation : str, optional
        By default the richest mode the case allows, `cranionav` (`procrustes` in landmark modes), and `threshold`.
    progress : callable, optional
    limit_mm : float
        The error at a target that the probability of staying below is told for.
    series : str, optional
        Which series of a DICOM folder: its number, description or UID.

    Raises
    ------
    InputError
        Anything in the case that cannot be registered honestly.
    """
    started = time.monotonic()
    say = progress or (lambda step, share: None)
    mode = case.mode(mode)
    method = _method_for(mode, method)
    say("reading the CT", 0.0)
    volume = read_ct(case.ct, series)
    say("segmenting bone", 0.15)
    bone = segment_bone(volume, method=segmentation)
    say("registering landmarks", 0.5)
    patient, planned, labels = _pair("landmarks", case.landmarks_patient, case.landmarks_ct)
    landmarks = register_landmarks(patient, planned, labels=labels, expected_fle_mm=USUAL_FLE_MM[mode])
    say("measuring bone points", 0.55)
    points, ultrasound = collect_points(case, mode)
    say(f"registering with {method}", 0.75)
    problem = _problem(mode, bone, points, landmarks, planned, patient)
    plugin = METHODS.create(method)
    registration = plugin.register(problem)
    say("verifying", 0.85)
    targets, target_labels = _targets(case, bone)
    predicted = predict_tre_of(registration, targets) if registration.covariance is not None else None
    checks, touched = _plausibility(case, problem, registration, bone)
    confidence = replace(assess(problem, registration, targets, plugin, limit_mm), touched=touched)
    verdict = judge(problem, registration, targets, LANDMARKS_ALONE if mode in LANDMARK_MODES else None)
    return CaseResult(
        case=case,
        mode=mode,
        volume=volume,
        bone=bone,
        landmarks=landmarks,
        landmarks_ct_mm=planned,
        landmarks_patient_mm=patient,
        points=points,
        registration=registration,
        verdict=_in_view_of(verdict, confidence, case),
        targets_ras_mm=targets,
        predicted=predicted,
        ultrasound=ultrasound,
        tre=_measured_tre(case, registration),
        plausibility=checks,
        confidence=confidence,
        duration_s=time.monotonic() - started,
        target_labels=target_labels,
    )


def _problem(
    mode: str, bone: BoneSurfaces, points: BonePoints, landmarks: LandmarkRegistration, planned: Array, patient: Array
) -> RegistrationProblem:
    return RegistrationProblem(
        surface=bone.outer_table,
        points=points,
        initial_reference_to_ras=landmarks.reference_to_ras,
        landmarks_ct_mm=planned,
        landmarks_patient_mm=patient,
        # with bone points the method estimates the landmarks' error itself
        landmark_sd_mm=USUAL_FLE_MM[mode] / math.sqrt(3) if mode in LANDMARK_MODES else None,
        surface_sd_mm=bone.position_sd_mm,
        surface_offset_sd_mm=bone.offset_sd_mm,
    )


def _in_view_of(verdict: Verdict, confidence: Confidence, case: Case) -> Verdict:
    """The verdict, doubted where plausibility points contradict it, and with what of the case could not be used."""
    if case.targets_patient is not None and case.targets_ct is None:
        unused = "targets-patient is not used: there is no targets-ct to compare it with, so no TRE is measured"
        verdict = replace(verdict, messages=(*verdict.messages, unused))
    return doubted(verdict, confidence)


def collect_points(case: Case, mode: str) -> tuple[BonePoints, Optional[Ultrasound]]:
    """The bone points of a case for a mode (Reference frame), and for mode III the lines they come from.

    Raises
    ------
    InputError
        The recording or list cannot be read, or no line of the recording shows bone.
    """
    if mode in LANDMARK_MODES:
        return BonePoints.palpated(np.empty((0, 3)), STYLUS_POINT_SD_MM), None
    if mode == "IIb":
        assert case.points is not None  # Case.mode has checked it
        return BonePoints.palpated(case.points.positions_mm, STYLUS_POINT_SD_MM, labels=case.points.labels), None
    assert case.palpation is not None
    recording = read_recording(case.palpation)
    measurements = measure_lines(recording)
    points = bone_points(recording, measurements)
    if not len(points):
        most = Counter(reason for reason in measurements.reasons if reason).most_common(3)
        statuses = Counter(status for status in recording.statuses if status != "OK").most_common(2)
        why = ", ".join(f"{count} times {reason}" for reason, count in most)
        lost = "".join(f", {count} frames {status}" for status, count in statuses)
        raise InputError(f"{case.palpation}: none of {len(recording)} lines shows bone ({why}{lost}); palpate again")
    return points, Ultrasound(recording, measurements, estimate_if_pressed(recording, measurements))


def _method_for(mode: str, wanted: Optional[str]) -> str:
    if mode not in LANDMARK_MODES:
        return METHODS.find(wanted).name if wanted else DEFAULT_METHOD
    if wanted not in (None, "procrustes"):
        METHODS.find(str(wanted))  # an unknown name is the first thing to say
        raise InputError(
            f"mode {mode} uses paired points only, and method {wanted} needs surface points; "
            "choose --mode IIb or III, or leave --method out"
        )
    return "procrustes"


def _pair(what: str, patient: LabelledPoints, ct: LabelledPoints) -> tuple[Array, Array, tuple[str, ...]]:
    try:
        return pair_points(patient.labels, patient.positions_mm, ct.labels, ct.positions_mm)
    except InputError as error:
        raise InputError(f"{what}: {error}") from None


def _targets(case: Case, bone: BoneSurfaces) -> tuple[Array, tuple[str, ...]]:
    if case.targets_ct is not None and len(case.targets_ct.labels):
        return case.targets_ct.positions_mm, tuple(case.targets_ct.labels)
    spread = spread_over(bone.outer_table.vertices_mm, DEFAULT_TARGETS)
    return spread, tuple(f"bone {number + 1}" for number in range(len(spread)))


def spread_over(points_mm: Array, count: int) -> Array:
    """`count` of the points, each the farthest from those before it; the first is the one farthest from the middle."""
    chosen = [int(np.argmax(np.linalg.norm(points_mm - points_mm.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points_mm - points_mm[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points_mm)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points_mm - points_mm[chosen[-1]], axis=1))
    return points_mm[chosen]


def _measured_tre(case: Case, registration: RegistrationResult) -> Optional[TargetErrors]:
    if case.targets_ct is None or case.targets_patient is None:
        return None
    touched, planned, _ = _pair("targets", case.targets_patient, case.targets_ct)
    return target_errors(registration.reference_to_ras, planned, touched)


def _plausibility(
    case: Case, problem: RegistrationProblem, registration: RegistrationResult, bone: BoneSurfaces
) -> tuple[Optional[Plausibility], Optional[DistanceCheck]]:
    """Distances of the plausibility points, and what was to be expected of them; None without such points."""
    if case.plausibility is None or not len(case.plausibility.labels):
        return None, None
    found = plausibility(registration.reference_to_ras, case.plausibility.positions_mm, bone.closed)
    return found, touched_points(problem, registration, found, case.plausibility.labels, STYLUS_POINT_SD_MM)
