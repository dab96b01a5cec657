"""What "Reload and Test" runs: simulated probe and tracker on a virtual patient, up to bone points."""

from __future__ import annotations

import tempfile

from CranioNavLib import scene_data
from CranioNavLib.module_selftest import ScenarioWithPatient
from CranioNavLib.rigid import transform_points
from CranioNavLib.slicer_files import LabelledPoints
from ModuleTrackingLib.pose_stream import PoseStream
from ModuleTrackingLib.tracker import TRACKERS

POLL_MS = 30


class UltrasoundSelfTest(ScenarioWithPatient):
    """The recorded lines become bone points that lie on the bone."""

    patientSeed = 2
    pollMs = POLL_MS
    POINTS = 3
    LARGEST_DISTANCE_MM = 2.0  # simulated: depth error at an unknown speed of sound, and the tracker's own
    SECONDS_A_POINT = 2.5  # of which the hand takes one to get there

    def test_palpation_becomes_bone_points(self) -> None:
        """Plan, connect, palpate three points, stop: SurfacePoints lie on the patient's bone."""
        patient, logic = self.session.patient, self.logic
        scene_data.set_surface("OuterTable", patient.bone)
        scene_data.set_points("LandmarksCT", LabelledPoints(patient.landmark_labels, patient.landmarks_ras_mm))
        self.delayDisplay(logic.planProtocol())
        positions, normals, _ = logic.protocolPoints()
        self.session.set_plan(positions, normals)
        with tempfile.TemporaryDirectory() as folder, PoseStream(TRACKERS.create("simulated", rate_hz="60")) as poses:
            logic.parameters().change(device="simulated", recording_path=f"{folder}/palpation.igs.mha")
            logic.connect()
            self.session.hold_probe_at(0)
            self._run(poses, self.SECONDS_A_POINT)
            logic.startRecording()
            for _ in range(self.POINTS):
                self._palpate(poses)
            self.delayDisplay(logic.stopRecording().run())
        points = scene_data.get_bone_points("SurfacePoints")
        assert len(points) >= self.POINTS, f"{len(points)} points from {self.POINTS} places"
        in_ras = transform_points(patient.true_reference_to_ras, points.positions_mm)
        distances = patient.bone.closest(in_ras).distances_mm
        assert distances.max() < self.LARGEST_DISTANCE_MM, f"a bone point lies {distances.max():.2f} mm from the bone"

    def _palpate(self, poses: PoseStream) -> None:
        """The hand goes to the point that is asked for and rests there until it is taken, or is skipped."""
        asked = self.logic.currentIndex()
        self.session.hold_probe_at(asked)
        for _ in range(10):
            self._run(poses, self.SECONDS_A_POINT / 5)
            if self.logic.currentIndex() != asked:
                return
        self.logic.nextPoint()

    def _run(self, poses: PoseStream, seconds: float) -> None:
        """The event loop: the tracking module's part writes the probe's pose, the logic reads it."""

        def track() -> None:
            for frame in poses.poll():
                time_s = frame[0].host_time_s
                pose = poses.in_reference_at("Probe", time_s)
                scene_data.set_pose("ProbeToReference", pose.tool_to_reference, pose.status.value, time_s)

        self.runFor(seconds, track)
