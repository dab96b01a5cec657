"""What "Reload and Test" runs: a stylus of the simulated tracker is calibrated, touches the landmarks, and is recorded."""

from __future__ import annotations

import tempfile

import numpy as np
from CranioNavLib import scene_data
from CranioNavLib.module_selftest import ScenarioWithPatient
from CranioNavLib.rigid import transform_points
from CranioNavLib.sequence_metafile import Recording, read_recording
from CranioNavLib.slicer_files import LabelledPoints

from ModuleTrackingLib.panel_description import Tool

POLL_MS = 5


class TrackingSelfTest(ScenarioWithPatient):
    """Pivot calibration, landmarks and a recording of a simulated patient."""

    patientSeed = 3
    pollMs = POLL_MS
    TIP_TOLERANCE_MM = 0.5  # simulated: tracker 0.25 mm, some hundred poses
    LANDMARK_TOLERANCE_MM = 12.0  # simulated: four times the SD of finding a landmark; the test is of the wiring

    def setUp(self) -> None:
        """A tracker whose tools are not calibrated."""
        super().setUp()
        self.logic.parameters().change(tracker="simulated")
        self.logic.pluginSettings("tracker", "simulated").change(rate_hz=60.0, calibrated=False)

    def test_pivot_landmarks_and_recording(self) -> None:
        """Pivot calibration finds the tip; digitised landmarks lie where the patient has them; the file holds them all."""
        patient, logic = self.session.patient, self.logic
        scene_data.set_points("LandmarksCT", LabelledPoints(patient.landmark_labels, patient.landmarks_ras_mm))
        logic.connect()
        self._findTip()
        recording = self._touchLandmarks()
        touched = scene_data.get_points("LandmarksPatient")
        assert touched.labels == tuple(patient.landmark_labels)
        truth = transform_points(patient.ras_to_reference, patient.landmarks_ras_mm)
        assert np.linalg.norm(touched.positions_mm - truth, axis=1).max() < self.LANDMARK_TOLERANCE_MM
        assert "StylusToReference" in recording.other_transforms
        self.session.put_away("Stylus")
        self.runFor(0.5)
        assert scene_data.get_pose("StylusToReference").matrix is None

    def _findTip(self) -> None:
        """The stylus is pivoted, and its tip found."""
        from CranioNavLib.phantom.session import TIPS_MM

        self.session.pivot("Stylus")
        self.runFor(1.5)
        self.logic.parameters().change(tool=Tool.STYLUS, pivot_s=5.0)
        self.logic.startPivot()
        self.runFor(5.3)
        assert "Stylus" in self.logic.calibrator.found, self.logic.pivotProgress()
        tip = self.logic.calibrator.found["Stylus"].tool_to_marker[:3, 3]
        error = np.linalg.norm(tip - TIPS_MM["Stylus"])
        assert error < self.TIP_TOLERANCE_MM, f"tip is wrong by {error:.2f} mm"
        self.delayDisplay(f"tip found to {error:.2f} mm")

    def _touchLandmarks(self) -> Recording:
        """Every landmark is touched and read while all is recorded; returns the recording."""
        with tempfile.TemporaryDirectory() as folder:
            self.logic.parameters().change(recording_path=f"{folder}/session.igs.mha")
            self.session.pivot("Probe")  # in view: a recording without the probe is refused
            self.logic.startRecording()
            for index in range(len(self.session.patient.landmarks_ras_mm)):
                self.session.touch_landmark(index)
                self.runFor(2.2)
                self.logic.digitise()
            self.logic.stopRecording()
            return read_recording(f"{folder}/session.igs.mha")
