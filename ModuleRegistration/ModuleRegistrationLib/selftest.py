"""What "Reload and Test" runs: one registration of a virtual patient, through the logic and the scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

from CranioNavLib import scene_data
from CranioNavLib.module_selftest import ScenarioOnScene

from ModuleRegistrationLib.logic.results import status

if TYPE_CHECKING:
    from CranioNavLib.phantom import VirtualPatient


class RegistrationSelfTest(ScenarioOnScene):
    """A virtual patient with palpated bone points is registered and verified."""

    LARGEST_MEAN_TRE_MM = 2.5  # simulated; the chapter's worst mode (four landmarks alone) has 2.78 mm

    def test_registration_of_a_virtual_patient(self) -> None:
        """CT, bone, landmarks, palpated points and markers end in a registration whose measured TRE is small."""
        from CranioNavLib.phantom import make_patient

        patient, logic = make_patient(None, seed=1), self.logic
        logic.takeCt(patient.planning_ct)
        logic.segmentBone().run()
        self._touchPatient(patient)
        logic.registerLandmarks()
        assert status() == "landmarks"
        self.delayDisplay(str(logic.registerSurface().run()))
        assert status() in ("accepted", "warning")
        self.delayDisplay(str(logic.verify().run()))
        errors = scene_data.get_table("TargetErrors")["TRE (mm)"]
        assert len(errors) == len(patient.markers_ras_mm)
        assert sum(errors) / len(errors) < self.LARGEST_MEAN_TRE_MM

    def _touchPatient(self, patient: VirtualPatient) -> None:
        """What planning and a stylus would write: landmarks and markers in both frames, palpated bone points."""
        import numpy as np
        from CranioNavLib.slicer_files import LabelledPoints
        from ModuleUltrasoundLib.palpation.protocol import plan_protocol

        rng = np.random.default_rng(1)
        planned = patient.landmarks_ras_mm + rng.normal(0, 0.5, patient.landmarks_ras_mm.shape)
        scene_data.set_points("LandmarksCT", LabelledPoints(patient.landmark_labels, planned))
        touched = patient.digitise(patient.landmarks_ras_mm, rng, 1.5)
        scene_data.set_points("LandmarksPatient", LabelledPoints(patient.landmark_labels, touched))
        protocol = plan_protocol(scene_data.get_surface("OuterTable"), planned, patient.landmark_labels)
        bone = patient.bone.closest(protocol.positions_ras_mm).points_mm
        scene_data.set_points("SurfacePoints", LabelledPoints(protocol.labels, patient.digitise(bone, rng, 0.3)))
        names = tuple(f"Marker {number + 1}" for number in range(len(patient.markers_ras_mm)))
        scene_data.set_points("TargetsCT", LabelledPoints(names, patient.markers_ras_mm))
        scene_data.set_points("TargetsPatient", LabelledPoints(names, patient.digitise(patient.markers_ras_mm, rng, 0.2)))
