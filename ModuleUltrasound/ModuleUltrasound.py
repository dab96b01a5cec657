"""Ultrasound as 3D Slicer sees it: module, widget, logic, self-test. Wiring only; the work stands in ModuleUltrasoundLib."""

from __future__ import annotations

import sys
from pathlib import Path

_HERE = Path(__file__).resolve().parent
for _folder in (_HERE, *(_HERE.parent / name for name in ("Shared", "ModuleTracking"))):
    # In a source checkout the libraries stand in folders of their own; installed, they stand beside this file.
    if _folder.is_dir() and str(_folder) not in sys.path:
        sys.path.append(str(_folder))

from CranioNavLib import scene, scene_data  # noqa: E402
from CranioNavLib.errors import InputError  # noqa: E402
from CranioNavLib.host import (  # noqa: E402
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleTest,
    ScriptedLoadableModuleWidget,
    slicer,
)
from CranioNavLib.module_logic import ParametersInScene, describeModule  # noqa: E402
from CranioNavLib.module_widget import PanelOfDevice  # noqa: E402
from CranioNavLib.panel import Level, Progress, Reading, StepState, StepStatus, Task  # noqa: E402
from ModuleUltrasoundLib.device import DeviceError  # noqa: E402
from ModuleUltrasoundLib.panel_description import PANEL, UltrasoundParameters  # noqa: E402

POLL_MS = 30
LIVE_LINES = 12  # that the live depth is read from: a third of a second at 40 lines a second
LIVE_EVERY_S = 0.2
CURRENT_POINT = "current"  # parameter of the Protocol node: index of the point to palpate now
NORMALS = ("Normal_R", "Normal_A", "Normal_S")  # measurements of ProtocolPoints: outward normals of the bone


class ModuleUltrasound(ScriptedLoadableModule):
    """What 3D Slicer's module list says."""

    def __init__(self, parent=None):
        super().__init__(parent)
        describeModule(self.parent, "CranioNav Ultrasound", PANEL, ["ModuleTracking"])


class ModuleUltrasoundWidget(PanelOfDevice, ScriptedLoadableModuleWidget):
    """The panel inside 3D Slicer. Lines are taken while another module is shown, too."""

    panelDescription = PANEL
    pollMs = POLL_MS

    def createLogic(self):
        """The module's logic."""
        return ModuleUltrasoundLogic()


class ModuleUltrasoundLogic(ParametersInScene, ScriptedLoadableModuleLogic):
    """Lines of the device and ProbeToReference of the scene in, bone points out; `poll` is called by the event loop's owner."""

    parameterClass = UltrasoundParameters
    sessionRole = "UltrasoundSession"
    refusals = (DeviceError,)

    def __init__(self, parent=None):
        super().__init__(parent)
        self.stream = None
        self._poser = None
        self._observation = None
        self._writer = None
        self._recordingStart = 0.0
        self._recordedPoints = set()
        self._latest = []  # the last posed lines
        self._live = None  # what the last lines say: LineMeasurements
        self._liveTime = 0.0
        self._guide = None  # where the probe stands to the current point
        self._surface = (0, None)  # (time stamp of the mesh, Surface): the index over its triangles is worth keeping
        self._palpation = None  # which points have been taken, while recording
        self._palpated = None  # its last status
        self._fedTime = 0.0  # time of the last line that palpation was given
        self._failure = ""

    # Protocol

    def planProtocol(self):
        """Place the palpation points on the outer table; writes ProtocolPoints and Protocol. Returns a message."""
        from CranioNavLib.slicer_files import LabelledPoints
        from ModuleUltrasoundLib.protocol import plan_protocol

        landmarks = scene_data.get_points("LandmarksCT") if self._count("LandmarksCT") else None
        planned = plan_protocol(
            scene_data.get_surface("OuterTable"),
            landmarks.positions_mm if landmarks else None,
            landmarks.labels if landmarks else None,
        )
        node = scene_data.set_points("ProtocolPoints", LabelledPoints(planned.labels, planned.positions_ras_mm))
        for axis, name in enumerate(NORMALS):
            scene_data.add_measurement(node, name, planned.normals[:, axis])
        self._goTo(0)
        missing = f"; no bone to stand on for {', '.join(planned.left_out)}" if planned.left_out else ""
        return f"{len(planned.labels)} points{missing}"

    def planProtocolBlocked(self):
        """Why no points can be placed now."""
        return "" if scene.find("OuterTable") is not None else "find the bone in the registration module first"

    def protocolPoints(self):
        """Positions (N, 3) in RAS, outward normals (N, 3) and labels of the planned points."""
        import numpy as np

        points = scene_data.get_points("ProtocolPoints")
        columns = scene_data.read_measurements(scene.find("ProtocolPoints"))
        if not all(name in columns and len(columns[name]) == len(points) for name in NORMALS):
            raise InputError("the palpation points were edited by hand and have no normals any more; plan them again")
        return points.positions_mm, np.stack([columns[name] for name in NORMALS], axis=1), points.labels

    def nextPoint(self):
        """Go on to the next point of the protocol; the present one may be taken later."""
        self._goTo(min(self.currentIndex() + 1, self._count("ProtocolPoints") - 1))

    def nextPointBlocked(self):
        """Why there is no next point."""
        return "" if self._count("ProtocolPoints") else "plan the points first"

    def previousPoint(self):
        """Go back to the point before."""
        self._goTo(max(self.currentIndex() - 1, 0))

    def previousPointBlocked(self):
        """Why there is no point before."""
        return self.nextPointBlocked()

    def currentIndex(self):
        """Index of the point to palpate now; -1 without a protocol."""
        node = scene.find("Protocol")
        text = node.GetParameter(CURRENT_POINT) if node is not None else ""
        return int(text) if text and self._count("ProtocolPoints") else -1

    def _goTo(self, index):
        """Ask for a point; where it is expected on the patient follows from the registration, once there is one."""
        import numpy as np
        from CranioNavLib.rigid import invert_rigid, transform_points

        scene.find_or_create("Protocol").SetParameter(CURRENT_POINT, str(index))
        if self._palpation is not None and index >= 0:
            expected = None
            if self._registered():
                target = np.array(scene.find("ProtocolPoints").GetNthControlPointPosition(index))[None]
                expected = transform_points(invert_rigid(scene_data.get_transform("ReferenceToRas")), target)[0]
            self._palpation.aim(index, expected)

    def _registered(self):
        node = scene.find("ReferenceToRas")
        return node is not None and bool(node.GetAttribute(scene.STATUS_ATTRIBUTE))

    # Device

    def connect(self):
        """Begin to take lines from the device that the parameters name."""
        from ModuleUltrasoundLib.line_stream import LinePoser, LineStream

        device = self.createPlugin("amode", self.parameters().read().device)
        self._failure, self._poser = "", LinePoser()
        self._observation = scene.observe("ProbeToReference", self._takePose)
        self.stream = LineStream(device)
        self.stream.start()
        return f"connecting to {device.title}"

    def connectBlocked(self):
        """Why no device can be connected now."""
        return "disconnect first" if self.stream is not None else ""

    def disconnect(self):
        """Let go of the device."""
        if self._writer is not None:
            self._closeRecording()
        if self._observation is not None:
            self._observation.stop()
        if self.stream is not None:
            self.stream.stop()
        self.stream = self._poser = self._observation = self._live = self._guide = self._palpation = None
        self._latest = []

    def disconnectBlocked(self):
        """Why there is nothing to disconnect."""
        return self._notConnected()

    def poll(self):
        """Take over the lines that came since the last call. Main thread only."""
        if self.stream is None:
            return
        try:
            lines = self.stream.poll()
        except InputError as error:
            self.disconnect()
            self._failure = str(error)
            raise
        for line in lines:
            self._poser.add_line(line, self.currentIndex())
        posed = self._poser.ready()
        if self._writer is not None:
            for item in posed:
                self._record(item)
        self._latest = (self._latest + posed)[-LIVE_LINES:]
        self._showLive()

    def _takePose(self, node):
        pose = scene_data.get_pose("ProbeToReference")
        if pose.host_time_s == pose.host_time_s and self._poser is not None:
            self._poser.add_pose(pose.matrix, pose.status, pose.host_time_s)

    def _showLive(self):
        """The last line as a table, and what the last lines say of the depth; a few times a second."""
        import time

        from ModuleUltrasoundLib.line_stream import recording_of
        from ModuleUltrasoundLib.measure import measure_lines

        now = time.monotonic()
        if not self._latest or now < self._liveTime + LIVE_EVERY_S:
            return
        self._liveTime = now
        samples, rate = self._latest[-1].line.samples, self.stream.acquisition.sampling_hz
        scene_data.set_table("ALine", {"time (µs)": (1e6 / rate * _indices(samples)).tolist(), "amplitude": samples.tolist()})
        self._live = measure_lines(recording_of(self._latest, self.stream.acquisition), self.parameters().read().echo_settings())
        self._takePoints()
        self._steer()

    def _takePoints(self):
        """A point on which the probe has rested long enough is taken, and the next one is asked for."""
        from ModuleUltrasoundLib.palpation import lines_of

        if self._palpation is None:
            return
        new = False
        for line in lines_of(self._live, [item.line.host_time_s for item in self._latest]):
            if line.time_s <= self._fedTime:
                continue
            self._fedTime = line.time_s
            self._palpated = self._palpation.add(line)
            if self._palpated.new_point is not None:
                new = True
                if self._palpated.target is not None:
                    self._goTo(self._palpated.target)
        if new:
            self._showTaken()

    def _showTaken(self):
        """The points taken so far as SurfacePoints; measuring the whole recording replaces them at the end."""
        from ModuleUltrasoundLib.palpation import to_bone_points

        taken, wanted = self._palpation.taken, self.parameters().read()
        if not taken:
            scene.release("SurfacePoints")
            return
        lines, labels = [point.line for point in taken], [point.label for point in taken]
        scene_data.set_bone_points(to_bone_points(lines, labels, wanted.speed_of_sound_m_s, wanted.speed_of_sound_sd_m_s))

    def _steer(self):
        """Where the probe stands to the current point, under the registration in force."""
        from ModuleUltrasoundLib.guidance import guide

        index, pose = self.currentIndex(), scene_data.get_pose("ProbeToReference")
        self._guide = None
        if index < 0 or pose.matrix is None or not self._registered() or scene.find("OuterTable") is None:
            return
        positions, normals, _ = self.protocolPoints()
        probe_to_ras = scene_data.get_transform("ReferenceToRas") @ pose.matrix
        self._guide = guide(probe_to_ras, self._outerTable(), positions[index], normals[index])

    def _outerTable(self):
        stamp = scene.find("OuterTable").GetPolyData().GetMTime()
        if self._surface[0] != stamp:
            self._surface = (stamp, scene_data.get_surface("OuterTable"))
        return self._surface[1]

    # Recording

    def startRecording(self):
        """Record every line with its pose into `recording_path`; points of the protocol are taken by resting on them."""
        from CranioNavLib.files import set_aside
        from CranioNavLib.sequence_metafile import RecordingWriter
        from ModuleUltrasoundLib.palpation import Palpation

        path = self.parameters().read().recording_path
        earlier = set_aside(path)
        first = self._latest[-1].line
        self._recordingStart, self._recordedPoints = first.host_time_s, set()
        self._writer = RecordingWriter(path, len(first.samples), self.stream.acquisition)
        if self._count("ProtocolPoints"):
            self._palpation, self._fedTime = Palpation(scene_data.get_points("ProtocolPoints").labels), first.host_time_s
            self._goTo(self.currentIndex())
        return f"recording into {path}" + (f"; the one before is kept as {earlier.name}" if earlier is not None else "")

    def startRecordingBlocked(self):
        """Why nothing can be recorded now."""
        if self._writer is not None:
            return "already recording"
        if not self._latest:
            return self._notConnected() or "no line has come yet"
        return "" if self.parameters().read().recording_path else "choose a file first"

    def stopRecording(self):
        """Finish the file and measure it."""
        self._closeRecording()
        return self.measureRecording()

    def stopRecordingBlocked(self):
        """Why there is no recording to stop."""
        return "" if self._writer is not None else "not recording"

    def _closeRecording(self):
        for item in self._poser.ready(everything=True):
            self._record(item)
        self._writer.close()
        self._writer = self._palpation = self._palpated = None

    def undoPoint(self):
        """Take back the last point and return to it. Returns a message."""
        point = self._palpation.undo()
        self._goTo(point.target)
        self._showTaken()
        return f"{point.label} taken back"

    def undoPointBlocked(self):
        """Why there is no point to take back."""
        return "" if self._palpation is not None and self._palpation.taken else "no point has been taken in this recording"

    def _record(self, item):
        if item.line.host_time_s <= self._recordingStart and self._writer.count:
            return
        pose = item.pose
        self._writer.append(
            max(0.0, item.line.host_time_s - self._recordingStart),
            {"ProbeToReference": pose.tool_to_tracker if pose.usable else None},
            {"ProbeToReference": "OK" if pose.usable else ("MISSING" if pose.status.value == "STALE" else pose.status.value)},
            item.line.samples,
            item.palpation_point,
        )
        if pose.usable:
            self._recordedPoints.add(item.palpation_point)

    # Bone points

    def measureRecording(self):
        """Find the bone in every line of `recording_path`; good ones become SurfacePoints."""
        from CranioNavLib.sequence_metafile import read_recording
        from ModuleUltrasoundLib.measure import bone_points, measure_lines

        wanted = self.parameters().read()

        def measure(progress: Progress):
            progress("reading the recording", 0.05)
            recording = read_recording(wanted.recording_path)
            progress("looking for the bone echo", 0.2)
            measured = measure_lines(recording, wanted.echo_settings())
            return bone_points(recording, measured), int(measured.accepted.sum()), len(measured)

        def take(found):
            points, accepted, lines = found
            scene_data.set_bone_points(points)
            return f"{len(points)} bone points from {accepted} of {lines} lines"

        return Task("Measure recording", measure, take)

    def measureRecordingBlocked(self):
        """Why nothing can be measured now."""
        if self._writer is not None:
            return "stop the recording first"
        return "" if self.parameters().read().recording_path else "choose a recording first"

    # What the panel shows

    def live(self):
        """For a drawing of the last line: its samples, rate in Hz, and what was measured (LineMeasurements); None without one."""
        if not self._latest or self._live is None or not len(self._live):
            return None
        return self._latest[-1].line.samples, self.stream.acquisition.sampling_hz, self._live

    def guide(self):
        """Where the probe stands to the current point (guidance.Guide); None without a registration or a live probe."""
        return self._guide

    def taken(self):
        """Labels of the points taken in this recording."""
        return [point.label for point in self._palpation.taken] if self._palpation is not None else []

    def connection(self):
        """Connected, or why not."""
        if self.stream is None:
            return Reading(self._failure or "not connected", Level.BAD if self._failure else Level.PLAIN)
        state = self.stream.state
        return Reading(state.problem or f"{state.lines} lines", Level.GOOD if state.connected else Level.WARNING)

    def probePose(self):
        """Whether the scene has a live pose of the probe."""
        status = scene_data.get_pose("ProbeToReference").status
        return Reading("in view", Level.GOOD) if status == "OK" else Reading(f"not in view ({status.lower()})", Level.BAD)

    def depth(self):
        """The bone's depth under the probe now; None while there is no trustworthy echo."""
        if self._live is None or not len(self._live):
            return None
        if not self._live.accepted[-1]:
            from ModuleUltrasoundLib.quality import reason_in_words

            return Reading(reason_in_words(self._live.reasons[-1]), Level.WARNING)
        return Reading(f"{self._live.depths_mm[-1]:.1f}", Level.GOOD)

    def quality(self):
        """Probability that the depth is right to half a millimetre."""
        if self._live is None or not len(self._live):
            return None
        value = float(self._live.qualities[-1])
        good = value >= self.parameters().read().quality_gate
        return Reading(f"{value:.2f}", Level.GOOD if good else Level.WARNING)

    def currentPoint(self):
        """The point to palpate now."""
        index = self.currentIndex()
        if index < 0:
            return None
        return Reading(f"{index + 1}. {scene.find('ProtocolPoints').GetNthControlPointLabel(index)}")

    def guidance(self):
        """What to do with the probe now."""
        if self._guide is None:
            return None
        return Reading(self._guide.instruction, Level.GOOD if self._guide.on_target and self._guide.aligned else Level.WARNING)

    def tilt(self):
        """Angle between the beam and the bone's normal."""
        if self._guide is None:
            return None
        return Reading(f"{self._guide.angle_deg:.0f}", Level.GOOD if self._guide.aligned else Level.WARNING)

    def dwell(self):
        """How many points are taken, and what the present one still lacks."""
        if self._palpated is None:
            return None
        done = f"{self._palpated.taken} of {self._palpated.total} points; rested {self._palpated.dwell:.0%} of the time needed"
        return Reading("; ".join(filter(None, [done, self._palpated.reason])))

    def recorded(self):
        """How much has been recorded."""
        if self._writer is None:
            return None
        return Reading(f"{self._writer.count} lines at {len(self._recordedPoints)} points")

    def pointCount(self):
        """How many bone points there are."""
        count = self._count("SurfacePoints")
        return Reading(str(count)) if count else None

    def protocolStatus(self):
        """Whether the points are planned."""
        done = self._count("ProtocolPoints") > 0
        return StepStatus(
            StepState.DONE if done else StepState.TODO, "" if done else self.planProtocolBlocked() or "plan the points"
        )

    def deviceStatus(self):
        """Whether lines arrive."""
        if self.stream is None:
            return StepStatus(StepState.ATTENTION if self._failure else StepState.TODO, self._failure or "connect the device")
        state = self.stream.state
        return StepStatus(StepState.DONE if state.connected else StepState.ATTENTION, state.problem)

    def palpationStatus(self):
        """Whether something is being or has been recorded."""
        if self._writer is not None:
            return StepStatus(StepState.ATTENTION, "recording; stop when all points are palpated")
        done = Path(self.parameters().read().recording_path).is_file()
        return StepStatus(StepState.DONE if done else StepState.TODO, "" if done else self.startRecordingBlocked() or "record")

    def measureStatus(self):
        """Whether there are bone points."""
        done = self._count("SurfacePoints") > 0
        return StepStatus(
            StepState.DONE if done else StepState.TODO, "" if done else self.measureRecordingBlocked() or "measure the recording"
        )

    def _count(self, role):
        node = scene.find(role)
        return node.GetNumberOfControlPoints() if node is not None else 0

    def _notConnected(self):
        return "" if self.stream is not None else "connect the device first"


def _indices(samples):
    import numpy as np

    return np.arange(len(samples))


class ModuleUltrasoundTest(ScriptedLoadableModuleTest):
    """Simulated probe and tracker on a virtual patient: the recorded lines become bone points that lie on the bone."""

    POINTS = 3
    LARGEST_DISTANCE_MM = 2.0  # simulated: depth error at an unknown speed of sound, and the tracker's own
    SECONDS_A_POINT = 2.5  # of which the hand takes one to get there

    def setUp(self):
        """A fresh scene and a simulated patient of its own."""
        from CranioNavLib.phantom import make_patient
        from CranioNavLib.phantom.session import SimulatedSession, use_session

        slicer.mrmlScene.Clear(False)
        self.session = SimulatedSession(make_patient(None, seed=2), seed=2)
        use_session(self.session)
        self.logic = ModuleUltrasoundLogic()

    def tearDown(self):
        """Let go of the device."""
        from CranioNavLib.phantom.session import use_session

        self.logic.disconnect()
        use_session(None)

    def runTest(self):
        """The scenario."""
        self.setUp()
        try:
            self.test_palpation_becomes_bone_points()
        finally:
            self.tearDown()

    def test_palpation_becomes_bone_points(self):
        """Plan, connect, palpate three points, stop: SurfacePoints lie on the patient's bone."""
        import tempfile

        from CranioNavLib.rigid import transform_points
        from CranioNavLib.slicer_files import LabelledPoints
        from ModuleTrackingLib.pose_stream import PoseStream
        from ModuleTrackingLib.tracker import TRACKERS

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

    def _palpate(self, poses):
        """The hand goes to the point that is asked for and rests there until it is taken, or is skipped."""
        asked = self.logic.currentIndex()
        self.session.hold_probe_at(asked)
        for _ in range(10):
            self._run(poses, self.SECONDS_A_POINT / 5)
            if self.logic.currentIndex() != asked:
                return
        self.logic.nextPoint()

    def _run(self, poses, seconds):
        """The event loop, for some seconds: the tracking module's part writes the probe's pose, ours reads it."""
        import time

        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for frame in poses.poll():
                time_s = frame[0].host_time_s
                pose = poses.in_reference_at("Probe", time_s)
                scene_data.set_pose("ProbeToReference", pose.tool_to_reference, pose.status.value, time_s)
            self.logic.poll()
            time.sleep(POLL_MS / 1000)
