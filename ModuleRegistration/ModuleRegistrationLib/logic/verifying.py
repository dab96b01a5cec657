"""The last two steps: the registration compared with what it has not used, and the results as files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Optional, Union

import numpy as np
from CranioNavLib import scene, scene_data
from CranioNavLib.files import output_folder
from CranioNavLib.module_logic import done_or, todo
from CranioNavLib.panel import Level, Progress, Reading, StepState, StepStatus, Task
from CranioNavLib.slicer_files import save_scene, write_transform

from ModuleRegistrationLib import quantities as names
from ModuleRegistrationLib.logic import results
from ModuleRegistrationLib.logic.given import lacking, of_this_ct, pairs, promised, targets
from ModuleRegistrationLib.logic.registering import RegisteringSteps

if TYPE_CHECKING:
    from ModuleRegistrationLib.registration.problem import RegistrationProblem, RegistrationResult, SurfaceRegistration
    from ModuleRegistrationLib.verification.checks import Checks, ToVerify

    OnSurface = tuple[RegistrationProblem, RegistrationResult, SurfaceRegistration]

MARKERS, TOUCHED = ("TargetsCT", "TargetsPatient"), ("PlausibilityPoints", "Bone")  # what there may be to verify with
OWN_ERROR = 1.5  # times the limit may be measured at one target: the error of measuring it is in that
SAME_ENTRY = 1e-4  # of two transforms that are one registration, rounded by files: 0.01 mm on a head


class VerifyingSteps(RegisteringSteps):
    """Verification of the registration in the scene, and saving it."""

    def verify(self) -> Task:
        """Measured TRE, distance of the plausibility points, and whether the stated error is right; into Results."""
        from ModuleRegistrationLib.result_tables import verification_rows
        from ModuleRegistrationLib.verification.checks import verify

        given, labels = self._toVerify()

        again = self._again()

        def check(progress: Progress) -> Checks:
            progress("comparing with what the registration has not used", 0.1)
            return verify(given if again is None else replace(given, surface=again()))

        def take(checks: Checks) -> Union[str, Reading]:
            errors, distances = checks.errors, checks.distances
            if errors:
                scene_data.set_table("TargetErrors", {"target": list(labels), "TRE (mm)": errors.errors_mm.tolist()})
            results.write_rows({**results.rows(), **verification_rows(checks), **self._judgedAgain(checks)})
            said = [f"TRE {errors.mean_mm:.2f} mm (mean), {errors.max_mm:.2f} mm (largest)"] if errors else []
            said += [f"plausibility {distances.max_mm:.2f} mm (largest)"] if distances else []
            doubts = [sentence for sentence in checks.confidence.sentences() if results.contradicts(sentence)]
            doubts += [self._tooFarOff()] if errors and self._tooFarOff() else []
            text = "; ".join([*said, *doubts]) or "verified; see below"  # what agrees stands in the read-outs
            return Reading(text, Level.WARNING) if doubts else text

        return Task("Verify", check, of_this_ct(take))

    def _judgedAgain(self, checks: Checks) -> dict[str, str]:
        """Rows of the verdict in view of the checks, which the registration in force takes on; none for landmarks alone."""
        from ModuleRegistrationLib.registration.verdict import Verdict
        from ModuleRegistrationLib.result_tables import verdict_rows
        from ModuleRegistrationLib.verification.confidence import doubted

        rows = results.rows()
        if names.STATUS not in rows or results.status() != rows[names.STATUS]:
            return {}
        given = Verdict(rows[names.STATUS], (rows[names.MESSAGE],) if rows[names.MESSAGE] else ())  # of a scene read again
        verdict = doubted(self.registered.verdict if self.registered else given, checks.confidence)
        results.set_verdict(verdict.status)
        return verdict_rows(verdict)

    def _toVerify(self) -> tuple[ToVerify, tuple[str, ...]]:
        """What there is to verify with, and the labels of the markers among it."""
        from ModuleRegistrationLib.verification.checks import StatedError, ToVerify

        error, wanted = scene_data.get_motion_error(), self.parameters().read()
        labels: tuple[str, ...] = ()
        given: dict[str, Any] = {
            "reference_to_ras": scene_data.get_transform("ReferenceToRas"),
            "targets_ras_mm": targets(),
            "limit_mm": wanted.tre_limit_mm,
            "touched_sd_mm": wanted.palpated_sd_mm,
            "stated": StatedError(*error, **promised()) if error else None,
            "surface": self._verifiable(),
        }
        if not lacking(*MARKERS):
            *given["markers"], labels = pairs("TargetsPatient", "TargetsCT")
        if not lacking(*TOUCHED):
            given["touched"], given["bone"] = scene_data.get_points("PlausibilityPoints"), scene_data.get_surface("Bone")
        return ToVerify(**given), labels

    def _verifiable(self) -> Optional[OnSurface]:
        """Problem, result and method of a surface registration that stands; None after landmarks alone or a refusal."""
        if self.registered is None or self.registered.verdict.status == "refused":
            return None
        return self.registered.problem, self.registered.result, self.registered.method

    def _isReadBack(self) -> bool:
        """Whether a surface registration stands that was not made here, but read with all that it was made of."""
        return self.registered is None and results.status() in ("accepted", "warning") and not self.registerSurfaceBlocked()

    def _again(self) -> Optional[Callable[[], Optional[OnSurface]]]:
        """What repeats a registration that was read back, off the main thread; its outcome is None if it is another one."""
        if not self._isReadBack():
            return None
        _, problem, _ = self._problem()
        method = self.createPlugin("registration", self.parameters().read().method)
        in_force = scene_data.get_transform("ReferenceToRas")

        def register() -> Optional[OnSurface]:
            result = method.register(problem)
            same = np.allclose(result.reference_to_ras, in_force, rtol=0, atol=SAME_ENTRY)
            return (problem, result, method) if same else None

        return register

    def verifyBlocked(self) -> str:
        """Why nothing can be verified now."""
        if not results.status():
            return "register first"
        missing = lacking(*MARKERS), lacking(*TOUCHED)
        return "" if "" in missing or self._verifiable() or self._isReadBack() else missing[0]

    def measuredTre(self) -> Optional[Reading]:
        """Measured TRE; bad where it is above the limit."""
        found = results.reading(names.TRE_MEAN, " ± ", names.TRE_SD, "; ", names.TRE_MAX)
        if found is None:
            return None
        if len(_measured()) == 1:  # one has no SD
            found = replace(found, text=f"one marker: {found.text.split(' ')[0]} mm")
        return replace(found, level=Level.BAD) if self._tooFarOff() else found

    def _tooFarOff(self) -> str:
        """In words, which target was measured to lie clearly further off than the limit, and what to do; "" if none, and if their
        mean lies below it."""
        limit_mm = self.parameters().read().tre_limit_mm
        name, off_mm = max(_measured().items(), key=lambda item: item[1], default=("", 0.0))
        mean_mm = sum(_measured().values()) / max(len(_measured()), 1)
        if off_mm <= OWN_ERROR * limit_mm and mean_mm <= limit_mm:
            return ""
        return (
            f"{name} was measured {off_mm:.1f} mm off, above the limit of {limit_mm:g} mm: measure it again; if that does not "
            "help, palpate more points and register again"
        )

    def plausibility(self) -> Optional[Reading]:
        """Largest distance of a plausibility point."""
        return results.reading(names.PLAUSIBILITY_MAX)

    def belowLimit(self) -> Optional[Reading]:
        """Probability that the TRE is below the limit, at the worst target."""
        return results.said(names.BELOW_LIMIT)

    def touchedPoints(self) -> Optional[Reading]:
        """Plausibility points beside what was to be expected of them."""
        return results.said(names.TOUCHED)

    def heldOutPoints(self) -> Optional[Reading]:
        """Points left out of the registration beside what was to be expected of them."""
        return results.said(names.HELD_OUT)

    def influentialPoint(self) -> Optional[Reading]:
        """The point without which the targets would move most."""
        return results.said(names.INFLUENTIAL)

    def verificationStatus(self) -> StepStatus:
        """Whether the registration is verified, or what speaks against its stated error."""
        rows = results.rows()
        doubts = [f"{name}: {rows[name]}" for name in (names.TOUCHED, names.HELD_OUT) if results.contradicts(rows.get(name, ""))]
        if doubts:
            return StepStatus(StepState.ATTENTION, "; ".join(doubts))
        if names.TRE_MEAN in rows and self._tooFarOff():
            return StepStatus(StepState.ATTENTION, self._tooFarOff(), "verify")
        if (
            not lacking(*MARKERS)
            and names.BELOW_LIMIT in rows
            and set(_measured()) != set(pairs("TargetsPatient", "TargetsCT")[2])
        ):
            return todo("other markers have been read since: verify again")
        verified = any(name in rows for name in (names.TRE_MEAN, names.PLAUSIBILITY_MAX, names.HELD_OUT, names.BELOW_LIMIT))
        return done_or(verified, self.verifyBlocked() or "verify the registration")

    def saveResults(self) -> str:
        """Write ReferenceToRas.tfm and scene.mrb into `output_folder`. Returns a message."""
        folder = output_folder(self.parameters().read().output_folder)
        write_transform(folder / "ReferenceToRas.tfm", scene_data.get_transform("ReferenceToRas"))
        save_scene(folder / "scene.mrb")
        return f"ReferenceToRas.tfm and scene.mrb are in {folder}"

    def saveResultsBlocked(self) -> str:
        """Why nothing can be saved now."""
        if not results.status():
            return "register first"
        return "" if self.parameters().read().output_folder else "choose a folder first"


def _measured() -> dict[str, float]:
    """TRE of each target that was measured on the patient, mm."""
    if scene.find("TargetErrors") is None:
        return {}
    columns = scene_data.get_table("TargetErrors")
    return dict(zip(map(str, columns["target"]), map(float, columns["TRE (mm)"])))
