"""The CT step: an image or a whole case folder into the scene."""

from __future__ import annotations

from typing import Union

from CranioNavLib import scene, scene_data
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.case import Case, read_case
from CranioNavLib.module_logic import done_or
from CranioNavLib.panel import Level, Progress, Reading, StepStatus, Task
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.logic.given import RegistrationStep, filled
from ModuleRegistrationLib.logic.results import forget_registration

# A new CT of him leaves them.
OF_THE_PATIENT = ("LandmarksPatient", "SurfacePoints", "TargetsPatient", "PlausibilityPoints", "ClampPins")


class LoadingStep(RegistrationStep):
    """Load CT, or a case with its lists and bone points."""

    def loadCt(self) -> Task:
        """Read the CT of `ct_path` into the scene."""
        from ModuleRegistrationLib.anatomy.ct_reader import read_ct

        wanted = self.parameters().read()

        def read(progress: Progress) -> Volume:
            progress("reading the CT", 0.1)
            return read_ct(wanted.ct_path, wanted.ct_series or None)

        return Task("Load CT", read, self.takeCt)

    def loadCtBlocked(self) -> str:
        """Why no CT can be loaded now."""
        return "" if self.parameters().read().ct_path else "choose a DICOM folder or an image file first"

    def ct_pathChanged(self) -> None:
        """Another path was given: the series chosen of the one before is none of it."""
        self.parameters().change(ct_series="")

    def takeCt(self, volume: Volume) -> Union[str, Reading]:
        """Make a CT the scene's; what was found in another one, and its registration, go. Returns a message, a warning if what
        was touched on the patient stays."""
        kept = filled(*OF_THE_PATIENT) if scene.find("CT") is not None else []
        found = ("Bone", "OuterTable", "Skin", "LandmarksCT", "TargetsCT", "ProtocolPoints")
        for role in (*found, "RegisteredPoints", "Results", "Residuals", "TargetErrors"):
            scene.release(role)
        forget_registration()
        scene_data.set_volume("CT", volume)
        said = f"{volume.description}: {' × '.join(str(size) for size in volume.hu.shape[::-1])} voxels"
        if not kept:
            return said
        return Reading(f"{said}; kept from before: {', '.join(kept)}. For another patient begin a new session", Level.WARNING)

    def forgetPatient(self) -> None:
        """Another patient: what was touched on the one before goes."""
        for role in OF_THE_PATIENT:
            scene.release(role)

    def loadCase(self) -> Task:
        """Read a case folder: CT, landmarks, targets, plausibility points, and its bone points by mode."""
        from ModuleRegistrationLib.anatomy.ct_reader import read_ct
        from ModuleRegistrationLib.procedure import collect_points

        folder = self.parameters().read().case_folder

        def read(progress: Progress) -> tuple[Case, Volume, BonePoints]:
            case = read_case(folder)
            progress("reading the CT", 0.1)
            volume = read_ct(case.ct)
            progress("measuring bone points", 0.6)
            return case, volume, collect_points(case, case.mode())[0]

        return Task("Load case", read, lambda found: self._takeCase(*found))

    def loadCaseBlocked(self) -> str:
        """Why no case can be loaded now."""
        return "" if self.parameters().read().case_folder else "choose a case folder first"

    def _takeCase(self, case: Case, volume: Volume, points: BonePoints) -> str:
        self.takeCt(volume)
        lists = {
            "LandmarksCT": case.landmarks_ct,
            "LandmarksPatient": case.landmarks_patient,
            "TargetsCT": case.targets_ct,
            "TargetsPatient": case.targets_patient,
            "PlausibilityPoints": case.plausibility,
        }
        for role, found in lists.items():
            if found is None:
                scene.release(role)
            else:
                scene_data.set_points(role, found)
        if len(points):
            scene_data.set_bone_points(points)
        else:
            scene.release("SurfacePoints")
        return f"case {case.name}, mode {case.mode()}: {len(case.landmarks_ct)} landmarks, {len(points)} bone points"

    def ctStatus(self) -> StepStatus:
        """Whether a CT is there."""
        return done_or(scene.find("CT") is not None, "load the head CT")
