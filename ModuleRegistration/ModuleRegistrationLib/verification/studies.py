"""The chapter's studies on the virtual patient: phantom, cadaver and patient, in its five modes of registration.

Every number that comes out of here is simulated. A trial draws a patient, a session and its noise from one seed; the
registration sees the planning CT, the digitised points and the A-mode recording, and nothing else. The truth is used
only to score it: by the ten titanium spheres, touched with the sphere tool (so that the TRE holds their localisation
error, as the chapter's does).
"""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Optional

import numpy as np
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.errors import InputError
from CranioNavLib.files import written_whole
from CranioNavLib.phantom import MODES, VirtualPatient
from CranioNavLib.phantom.session_data import SessionData, draw_session
from CranioNavLib.rigid import Array
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces, segment_bone
from ModuleRegistrationLib.procedure import LANDMARK_MODES, LANDMARKS_ALONE, STYLUS_POINT_SD_MM, USUAL_FLE_MM
from ModuleRegistrationLib.registration.error_theory import predict_tre_of
from ModuleRegistrationLib.registration.landmarks import LandmarkRegistration, register_landmarks
from ModuleRegistrationLib.registration.problem import METHODS, RegistrationProblem, RegistrationResult
from ModuleRegistrationLib.registration.verdict import judge
from ModuleRegistrationLib.verification.plausibility import plausibility
from ModuleRegistrationLib.verification.simulated_patient import simulated_patient
from ModuleRegistrationLib.verification.tre import target_errors

STUDIES = ("phantom", "cadaver", "patient")
LARGE_TRE_MM = 3.0  # a registration this far off would be noticed or do harm; the share above it is always told
Progress = Callable[[int, int], None]  # trials done, trials in all


@dataclass(frozen=True)
class TrialRow:
    """One registration of one simulated session. NaN where there is no such number."""

    study: str
    mode: str
    method: str
    seed: int
    status: str  # accepted, warning, refused; "failed" when no registration came out at all
    tre_mean_mm: float  # over the ten targets
    tre_max_mm: float
    landmark_tre_mean_mm: float  # of the landmark registration that it started from
    predicted_tre_mm: float  # mean over the targets, from the registration's own uncertainty
    plausibility_mean_mm: float  # distance of five touched points to the bone: not an accuracy
    points_used: int
    speed_of_sound_m_s: float
    duration_s: float  # of the computation
    message: str = ""


@dataclass(frozen=True)
class ModeSummary:
    """A mode over its trials. TRE of a trial is the mean over its targets; the trials that failed are counted, not used."""

    study: str
    mode: str
    method: str
    trials: int
    failed: int
    refused: int  # by the verdict; they are in the figures all the same
    tre_mean_mm: float
    tre_sd_mm: float
    tre_min_mm: float
    tre_max_mm: float
    share_above_3_mm: float
    predicted_tre_mm: float
    plausibility_mean_mm: float


@dataclass(frozen=True, eq=False)
class _Plan:
    """What is prepared once for all trials: the segmented CT and the palpation plan."""

    bone: BoneSurfaces
    positions_ras_mm: Array
    normals: Array
    labels: tuple[str, ...]


def run_study(
    study: str,
    trials: int = 30,
    jobs: int = 1,
    seed0: int = 0,
    volume: Optional[Volume] = None,
    modes: Sequence[str] = MODES,
    method: str = "cranionav",
    progress: Optional[Progress] = None,
) -> list[TrialRow]:
    """All trials of a study, by seed and mode.

    Parameters
    ----------
    study : "phantom", "cadaver" or "patient"
        The condition of the simulated sessions.
    trials : int
        Seeds seed0 ... seed0 + trials - 1; each in every mode.
    jobs : int
        Processes. The rows do not depend on it.
    volume : Volume, optional
        The head CT; None: the synthetic head.
    modes : sequence of str
    method : str
        Registration plugin for modes IIb and III.
    progress : callable, optional

    Raises
    ------
    InputError
        Unknown study, mode or method, no trials, or a CT that cannot be segmented.
    """
    if study not in STUDIES:
        raise InputError(f"unknown study {study!r}; studies are {', '.join(STUDIES)}")
    unknown = [mode for mode in modes if mode not in MODES]
    if unknown or not modes:
        raise InputError(f"unknown mode {', '.join(unknown) or '(none given)'}; modes are {', '.join(MODES)}")
    if trials < 1 or jobs < 1:
        raise InputError(f"a study needs at least one trial and one job, got {trials} trials and {jobs} jobs")
    METHODS.find(method)
    _plan_for(volume)  # segmented once here: the workers find it in the cache
    rows: list[TrialRow] = []
    for number, batch in enumerate(_batches(study, volume, range(seed0, seed0 + trials), tuple(modes), method, jobs), start=1):
        rows += batch
        if progress is not None:
            progress(number, trials)
    return sorted(rows, key=lambda row: (MODES.index(row.mode), row.seed))


def _batches(study: str, volume: Optional[Volume], seeds: Sequence[int], modes: tuple[str, ...], method: str, jobs: int) -> Any:
    if jobs == 1:
        return (run_seed(study, volume, seed, modes, method) for seed in seeds)
    from joblib import Parallel, delayed

    return Parallel(n_jobs=jobs, return_as="generator_unordered")(
        delayed(run_seed)(study, volume, seed, modes, method) for seed in seeds
    )


def run_seed(study: str, volume: Optional[Volume], seed: int, modes: Sequence[str], method: str) -> list[TrialRow]:
    """One simulated patient, registered in each mode."""
    patient = simulated_patient(volume, seed, study)
    plan = _plan_for(volume)
    rows = []
    for mode in modes:
        rng = np.random.default_rng([seed, MODES.index(mode)])
        data = draw_session(patient, mode, plan.positions_ras_mm, plan.normals, rng, plan.labels)
        used = method if mode in ("IIb", "III") else "procrustes"
        try:
            rows.append(_trial(study, mode, used, seed, patient, plan, data))
        except InputError as error:
            nan = math.nan
            rows.append(TrialRow(study, mode, used, seed, "failed", nan, nan, nan, nan, nan, 0, nan, nan, str(error)))
    return rows


def _trial(study: str, mode: str, method: str, seed: int, patient: VirtualPatient, plan: _Plan, data: SessionData) -> TrialRow:
    started = time.monotonic()
    targets = patient.markers_ras_mm
    alone = mode in LANDMARK_MODES
    fle_mm = USUAL_FLE_MM[mode]
    landmarks = register_landmarks(
        data.fiducials_patient_mm, data.fiducials_ct_mm, labels=data.fiducial_labels, expected_fle_mm=fle_mm
    )
    problem = _problem(plan.bone, landmarks, data, landmark_sd_mm=fle_mm / math.sqrt(3) if alone else None)
    result = METHODS.create(method).register(problem)
    verdict = judge(problem, result, targets, LANDMARKS_ALONE if alone else None)
    matrix = result.reference_to_ras
    taken_s = time.monotonic() - started
    tre = target_errors(matrix, targets, data.targets_patient_mm)
    before = target_errors(landmarks.reference_to_ras, targets, data.targets_patient_mm)
    near = plausibility(matrix, data.checks_patient_mm, plan.bone.closed)
    return TrialRow(
        study=study,
        mode=mode,
        method=method,
        seed=seed,
        status=verdict.status,
        tre_mean_mm=tre.mean_mm,
        tre_max_mm=tre.max_mm,
        landmark_tre_mean_mm=before.mean_mm,
        predicted_tre_mm=_predicted(result, targets),
        plausibility_mean_mm=near.mean_mm,
        points_used=len(data.fiducials_ct_mm) if alone else int(result.used.sum()),
        speed_of_sound_m_s=result.speed_of_sound_m_s,
        duration_s=taken_s,
        message="; ".join(verdict.messages),
    )


def _problem(
    bone: BoneSurfaces, landmarks: LandmarkRegistration, data: SessionData, landmark_sd_mm: Optional[float]
) -> RegistrationProblem:
    if data.recording is not None:
        from ModuleUltrasoundLib.measurement.measure import bone_points, measure_lines

        points = bone_points(data.recording, measure_lines(data.recording))
    else:
        points = BonePoints.palpated(data.points_patient_mm, STYLUS_POINT_SD_MM, data.point_labels)
    return RegistrationProblem(
        surface=bone.outer_table,
        points=points,
        initial_reference_to_ras=landmarks.reference_to_ras,
        landmarks_ct_mm=data.fiducials_ct_mm,
        landmarks_patient_mm=data.fiducials_patient_mm,
        landmark_sd_mm=landmark_sd_mm,
        surface_sd_mm=bone.position_sd_mm,
        surface_offset_sd_mm=bone.offset_sd_mm,
    )


def _predicted(result: RegistrationResult, targets: Array) -> float:
    return math.nan if result.covariance is None else float(predict_tre_of(result, targets).mean_mm.mean())


_PLANS: dict[str, _Plan] = {}


def _plan_for(volume: Optional[Volume]) -> _Plan:
    """Segmentation and palpation plan of the planning CT: the same for all patients of one head."""
    from ModuleUltrasoundLib.palpation.protocol import plan_protocol

    patient = simulated_patient(volume, 0)
    key = patient.bone.content_hash
    if key not in _PLANS:
        bone = segment_bone(patient.planning_ct)
        plan = plan_protocol(bone.outer_table, patient.landmarks_ras_mm, patient.landmark_labels)
        _PLANS[key] = _Plan(bone, plan.positions_ras_mm, plan.normals, plan.labels)
    return _PLANS[key]


def summarise(rows: Sequence[TrialRow]) -> list[ModeSummary]:
    """One line a mode (and study and method), in the order of first appearance."""
    groups: dict[tuple[str, str, str], list[TrialRow]] = {}
    for row in rows:
        groups.setdefault((row.study, row.mode, row.method), []).append(row)
    return [_summary(*key, group) for key, group in groups.items()]


def _summary(study: str, mode: str, method: str, rows: list[TrialRow]) -> ModeSummary:
    done = [row for row in rows if row.status != "failed"]
    tre = np.array([row.tre_mean_mm for row in done])

    def mean(name: str) -> float:
        values = np.array([getattr(row, name) for row in done], dtype=float)
        values = values[np.isfinite(values)]
        return float(values.mean()) if len(values) else math.nan

    return ModeSummary(
        study=study,
        mode=mode,
        method=method,
        trials=len(rows),
        failed=len(rows) - len(done),
        refused=sum(row.status == "refused" for row in rows),
        tre_mean_mm=float(tre.mean()) if len(tre) else math.nan,
        tre_sd_mm=float(tre.std(ddof=1)) if len(tre) > 1 else math.nan,
        tre_min_mm=float(tre.min()) if len(tre) else math.nan,
        tre_max_mm=float(tre.max()) if len(tre) else math.nan,
        share_above_3_mm=float((tre > LARGE_TRE_MM).mean()) if len(tre) else math.nan,
        predicted_tre_mm=mean("predicted_tre_mm"),
        plausibility_mean_mm=mean("plausibility_mean_mm"),
    )


def write_table(path: str | Path, rows: Sequence[TrialRow] | Sequence[ModeSummary]) -> None:
    """Rows as CSV, one column a field; NaN is left empty.

    Raises
    ------
    InputError
        No rows, or the folder cannot be written to.
    """
    if not rows:
        raise InputError("there are no rows to write; run at least one trial")
    names = [field.name for field in fields(rows[0])]
    with written_whole(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        for row in rows:
            writer.writerow({name: _cell(value) for name, value in asdict(row).items()})


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.4g}" if abs(value) < 1000 else f"{value:.1f}"
    return value
