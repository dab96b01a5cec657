"""The landmark and surface steps: ReferenceToRas, first from pairs, then from bone points laid on the outer table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Optional, Union

from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.module_logic import todo
from CranioNavLib.panel import Level, Progress, Reading, StepState, StepStatus, Task
from CranioNavLib.rigid import Array
from CranioNavLib.slicer_files import LabelledPoints

from ModuleRegistrationLib import quantities as names
from ModuleRegistrationLib.logic import results
from ModuleRegistrationLib.logic.given import RegistrationStep, lacking, of_this_ct, pairs, promised, targets_found_by

if TYPE_CHECKING:
    from ModuleRegistrationLib.registration.error_theory import PredictedTre
    from ModuleRegistrationLib.registration.landmarks import LandmarkRegistration
    from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration
    from ModuleRegistrationLib.registration.verdict import Verdict

    Judged = tuple[RegistrationResult, Verdict, Optional[PredictedTre]]


@dataclass(frozen=True, eq=False)
class SurfaceRegistered:
    """What a surface registration was made of and came to, kept for what asks about it later."""

    problem: RegistrationProblem
    method: SurfaceRegistration
    result: RegistrationResult
    verdict: Verdict


SAME_FRE_MM = 0.01  # of the same landmarks: the table's figures are rounded


class RegisteringSteps(RegistrationStep):
    """Landmarks, surface, and what the panel says of them."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.registered: Optional[SurfaceRegistered] = None  # last surface registration

    # Landmarks

    def registerLandmarks(self) -> Union[str, Reading]:
        """Register the landmark pairs; writes ReferenceToRas and Results. Returns a message, a warning if they do not fit."""
        from ModuleRegistrationLib.result_tables import landmark_rows

        found = self._landmarks()
        self.registered = None
        results.set_registration(found.reference_to_ras, "landmarks", landmark_rows(found), found)
        text, names = self._misfit()
        doubts = [text] if names else list(found.warnings) or list(filter(None, [text]))  # one wrong point explains more
        said = "; ".join([f"{len(found.labels)} landmark pairs, FRE {found.fre_mm:.2f} mm (RMS)", *doubts])
        return Reading(said, Level.BAD) if doubts else said

    def registerLandmarksBlocked(self) -> str:
        """Why landmarks cannot be registered now."""
        return lacking("LandmarksCT", "LandmarksPatient")

    def _landmarks(self) -> LandmarkRegistration:
        from ModuleRegistrationLib.registration.landmarks import register_landmarks

        patient, planned, labels = pairs("LandmarksPatient", "LandmarksCT")
        return register_landmarks(patient, planned, labels, expected_fle_mm=self.parameters().read().landmark_fle_mm)

    def _misfit(self) -> tuple[str, tuple[str, ...]]:
        """Why the pairs in the scene are no good, in words, and the one that it is; "" if they fit."""
        from ModuleRegistrationLib.registration.landmark_checks import misfit

        if self.registerLandmarksBlocked():
            return "", ()
        try:
            patient, planned, labels = pairs("LandmarksPatient", "LandmarksCT")
        except InputError:  # to register says why
            return "", ()
        return misfit(patient, planned, labels, self.parameters().read().landmark_fle_mm) if len(labels) > 2 else ("", ())

    def _isOfOthers(self) -> bool:
        """Whether the landmarks' registration in force is not of the landmarks in the scene."""
        from ModuleRegistrationLib.registration.landmark_checks import fit_rms_mm

        try:
            patient, planned, labels = pairs("LandmarksPatient", "LandmarksCT")
        except InputError:
            return True
        rows = results.rows()
        counted = names.FRE in rows and len(labels) > 2
        return not counted or abs(float(rows[names.FRE]) - fit_rms_mm(patient, planned)) > SAME_FRE_MM

    def dropMisfit(self) -> str:
        """Take the landmark that does not fit off the patient's list, so that it is asked for again. Returns a message."""
        name, node = self._misfit()[1][0], scene.find_or_create("LandmarksPatient")
        node.RemoveNthControlPoint(node.GetControlPointIndexByLabel(name))
        return f"{name} is taken out; touch it again"

    def dropMisfitBlocked(self) -> str:
        """Why there is no landmark to take out."""
        return "" if self._misfit()[1] else "no single landmark stands out"

    def fre(self) -> Optional[Reading]:
        """FRE of the landmarks."""
        bad = results.status() == "landmarks" and self._misfit()[0]
        return results.reading(names.FRE, level=Level.BAD if bad else Level.PLAIN)  # a low FRE is no sign of a low TRE

    def landmarkStatus(self) -> StepStatus:
        """Whether landmarks are registered, and fit."""
        if not results.status():
            return todo(self.registerLandmarksBlocked() or "register the landmarks")
        if results.status() == "landmarks" and self._isOfOthers():
            return todo("the landmarks have changed: register them again")
        text, found = self._misfit() if results.status() == "landmarks" else ("", ())
        return StepStatus(StepState.ATTENTION, text, "dropMisfit" if found else "") if text else StepStatus(StepState.DONE)

    # Surface

    def registerSurface(self) -> Task:
        """Lay the bone points on the outer table; writes ReferenceToRas unless refused, Results, Residuals, plot."""
        from ModuleRegistrationLib.registration.error_theory import predict_tre_of
        from ModuleRegistrationLib.registration.verdict import judge

        landmarks, problem, find_places = self._problem()
        method = self.createPlugin("registration", self.parameters().read().method)

        def register(progress: Progress) -> Judged:
            progress(f"registering with {method.name}", 0.1)
            result, places = method.register(problem), find_places()
            progress("judging the result", 0.8)
            predicted = predict_tre_of(result, places) if result.covariance is not None else None
            return result, judge(problem, result, places), predicted

        take = of_this_ct(lambda done: self._takeSurface(landmarks, problem, method, *done))
        return Task("Register surface", register, take)

    def registerSurfaceBlocked(self) -> str:
        """Why the surface cannot be registered now."""
        return lacking("OuterTable", "LandmarksCT", "LandmarksPatient", "SurfacePoints")

    def _problem(self) -> tuple[LandmarkRegistration, RegistrationProblem, Callable[[], Array]]:
        from ModuleRegistrationLib.registration.problem import RegistrationProblem

        wanted, landmarks = self.parameters().read(), self._landmarks()
        patient, planned, _ = pairs("LandmarksPatient", "LandmarksCT")
        problem = RegistrationProblem(
            surface=scene_data.get_surface("OuterTable"),
            points=scene_data.get_bone_points("SurfacePoints", wanted.palpated_sd_mm),
            initial_reference_to_ras=landmarks.reference_to_ras,
            landmarks_ct_mm=planned,
            landmarks_patient_mm=patient,
            **promised(),
        )
        return landmarks, problem, targets_found_by()

    def _takeSurface(
        self,
        landmarks: LandmarkRegistration,
        problem: RegistrationProblem,
        method: SurfaceRegistration,
        result: RegistrationResult,
        verdict: Verdict,
        predicted: Optional[PredictedTre],
    ) -> Reading:
        from ModuleRegistrationLib.result_tables import landmark_rows, residual_columns, surface_rows

        points, rows = problem.points, {**landmark_rows(landmarks), **surface_rows(result, verdict, predicted)}
        refused = verdict.status == "refused"  # then the landmarks' registration stays, and is shown as no more than that
        matrix, status = (landmarks.reference_to_ras, "landmarks") if refused else (result.reference_to_ras, verdict.status)
        results.set_registration(matrix, status, rows, landmarks if refused else result)
        self.registered = SurfaceRegistered(problem, method, result, verdict)
        scene_data.set_table("Residuals", residual_columns(points, result))
        _plot_residuals()
        if refused:
            raise InputError("; ".join(verdict.messages) or "the registration is refused")
        scene_data.set_points("RegisteredPoints", LabelledPoints(points.labels, result.points_ras_mm))
        laid = f"{verdict.status}: {len(points)} bone points laid on the skull"
        error = "the error to expect at the targets is not known"
        if predicted is not None:
            mean, worst = predicted.mean_mm.mean(), predicted.p95_mm.max()
            error = f"error to expect at the targets {mean:.1f} mm (mean), {worst:.1f} mm at the worst (95%)"
        return Reading("; ".join([laid, error, *verdict.messages]), results.LEVELS[verdict.status])

    def surfaceResidual(self) -> Optional[Reading]:
        """RMS distance of the bone points to the surface."""
        return results.reading(names.SURFACE_RMS, level=Level.PLAIN)  # a low residual is no sign of a low TRE

    def speedOfSound(self) -> Optional[Reading]:
        """Estimated speed of sound in the scalp."""
        return results.reading(names.SPEED)

    def predictedTre(self) -> Optional[Reading]:
        """Predicted TRE, mean over the targets, and the 95% bound at the worst one."""
        return results.reading(names.PREDICTED_MEAN, "; ", names.PREDICTED_P95)

    def verdict(self) -> Optional[Reading]:
        """Accepted, warning or refused; None before there is a surface registration."""
        status = results.rows().get(names.STATUS, "")
        return Reading(status, results.LEVELS[status]) if status else None

    def surfaceStatus(self) -> StepStatus:
        """Whether the surface registration holds, or what its verdict asks for."""
        rows = results.rows()
        status = rows.get(names.STATUS, "")
        if not status:
            return todo(self.registerSurfaceBlocked() or "register the surface")
        return StepStatus(StepState.DONE if status == "accepted" else StepState.ATTENTION, rows.get(names.MESSAGE, ""))


def _plot_residuals() -> None:
    series, chart = scene.find_or_create("ResidualsSeries"), scene.find_or_create("ResidualsChart")
    series.SetAndObserveTableNodeID(scene.find_or_create("Residuals").GetID())
    series.SetPlotType(series.PlotTypeBar)
    series.SetLabelColumnName("point")
    series.SetYColumnName("residual (mm)")
    chart.SetTitle("Distance of each bone point to the surface")
    chart.SetYAxisTitle("residual (mm)")
    chart.SetXAxisTitle("bone point")
    if not chart.HasPlotSeriesNodeID(series.GetID()):
        chart.AddAndObservePlotSeriesNodeID(series.GetID())
