"""Tracking as 3D Slicer sees it: module, widget, logic, self-test. Wiring only; the work stands in ModuleTrackingLib."""

from __future__ import annotations

import sys
from pathlib import Path

_HERE = Path(__file__).resolve().parent
for _folder in (_HERE, _HERE.parent / "Shared"):
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
from CranioNavLib.panel import Level, Reading, StepState, StepStatus  # noqa: E402
from ModuleTrackingLib.base_watch import BaseWatch  # noqa: E402
from ModuleTrackingLib.panel_description import PANEL, PointList, Tool, TrackingParameters  # noqa: E402
from ModuleTrackingLib.tool_calibrator import Kind, ToolCalibrator, geometry_of  # noqa: E402
from ModuleTrackingLib.tracker import PoseStatus, TrackerError  # noqa: E402

POLL_MS = 5
MOST_SHOWN = 300  # poses of a pivoting tool that its drawing is made of
APART_MM = 2.0  # a point so near to the one read before is the same one again
PLANNED = {PointList.LANDMARKS: "LandmarksCT", PointList.TARGETS: "TargetsCT"}  # where the names of the points come from
CHECK_S, CHECK_FRAMES = 0.5, 150  # a stylus that rests so long in the divot checks the base by itself; so many poses of it
TIP_HISTORY = 4096  # tip positions kept a tool: half a minute at 120 Hz
LEVELS = {PoseStatus.OK: Level.GOOD, PoseStatus.OUT_OF_VOLUME: Level.WARNING}


class ModuleTracking(ScriptedLoadableModule):
    """What 3D Slicer's module list says."""

    def __init__(self, parent=None):
        super().__init__(parent)
        describeModule(self.parent, "CranioNav Tracking", PANEL, [])


class ModuleTrackingWidget(PanelOfDevice, ScriptedLoadableModuleWidget):
    """The panel inside 3D Slicer. Tracking goes on while another module is shown."""

    panelDescription = PANEL
    pollMs = POLL_MS

    def createLogic(self):
        """The module's logic."""
        return ModuleTrackingLogic()


class ModuleTrackingLogic(ParametersInScene, ScriptedLoadableModuleLogic):
    """Frames of the tracker in, nodes out; `poll` is called by whoever owns the event loop."""

    parameterClass = TrackingParameters
    sessionRole = "TrackingSession"
    refusals = (TrackerError,)

    def __init__(self, parent=None):
        super().__init__(parent)
        self.stream = None
        self._recorder = None
        self._sharing = None
        self._tips = {}  # tool name -> [(time in s, ToolToReference)] of the last frames
        self._calibrator = ToolCalibrator()
        self._base = BaseWatch()
        self._identified = False  # since the tracker connected: do calibrations and check point belong to its tools?
        self._failure = ""  # why there is no connection

    # Connection

    def connect(self):
        """Open the tracker that the parameters name; poses arrive through `poll`."""
        from ModuleTrackingLib.pose_stream import PoseStream

        tracker = self.createPlugin("tracker", self.parameters().read().tracker)
        self._failure, self._identified = "", False
        self.stream = PoseStream(tracker, {tool: found.tool_to_marker for tool, found in self._calibrator.found.items()})
        self.stream.start()
        return f"connecting to {tracker.title}"

    def connectBlocked(self):
        """Why no tracker can be connected now."""
        return "disconnect first" if self.stream is not None else ""

    def disconnect(self):
        """Stop tracking; every tool is missing from now on."""
        self.stopRecording()
        self.stopSharing()
        self.cancelPivot()
        if self.stream is not None:
            self.stream.stop()
            self.stream = None
            for name in Tool:
                scene_data.set_pose(f"{name.value}ToReference", None, PoseStatus.MISSING.value, 0.0)
        self._tips.clear()

    def disconnectBlocked(self):
        """Why there is nothing to disconnect."""
        return self._notConnected()

    def poll(self):
        """Take over the frames that came since the last call and write the tools' nodes. Main thread only."""
        if self.stream is None:
            return
        try:
            frames = self.stream.poll()
        except InputError as error:
            self.stream.stop()
            self.stream, self._failure = None, str(error)
            raise
        for frame in frames:
            self._writeFrame(frame)
        self._writeStale()
        if self._recorder is not None:
            self._recorder.add_frames(frames)
        if self._sharing is not None:
            self._share(frames)
        self._finishCalibration()
        self._watchBase()

    def _writeFrame(self, frame):
        """Every tool at the time of this frame, in Reference."""
        base = next((pose for pose in frame if pose.tool == "Reference"), None)
        if base is not None and base.usable:
            scene_data.set_transform("ReferenceToTracker", base.tool_to_tracker)
        for pose in frame:
            role = f"{pose.tool}ToReference"
            if role not in scene.ROLES:
                continue
            relative = self.stream.in_reference_at(pose.tool, pose.host_time_s)
            matrix = relative.tool_to_reference if relative.usable else None
            scene_data.set_pose(role, matrix, relative.status.value, pose.host_time_s)
            if matrix is not None:
                tips = self._tips.setdefault(pose.tool, [])
                tips.append((pose.host_time_s, matrix))
                del tips[:-TIP_HISTORY]
                self._calibrator.add(pose.tool, matrix)

    def _writeStale(self):
        """Tools without news lose their pose in the scene, too, even if others or old frames go on coming."""
        base = self.stream.is_live("Reference")
        for tool in (tool.value for tool in Tool):
            if (base and self.stream.is_live(tool)) or tool not in self.stream.tool_names:
                continue
            current = self.stream.current_in_reference(tool)
            if not current.usable and scene_data.get_pose(f"{tool}ToReference").status != current.status.value:
                scene_data.set_pose(f"{tool}ToReference", None, current.status.value, current.host_time_s)

    # Calibration

    def startPivot(self):
        """Collect poses of the chosen tool, tilted to all sides, for `pivot_s`; `poll` then calibrates its tip."""
        self._calibrate(Kind.PIVOT)
        return f"pivot the {self._tool().lower()} for {self.parameters().read().pivot_s:.0f} s"

    def startPivotBlocked(self):
        """Why no tool can be calibrated now."""
        return self._notConnected() or self._calibrating()

    def startSpin(self):
        """Collect poses of the chosen tool, rolled about itself, for `pivot_s`; `poll` then finds its axis."""
        self._calibrate(Kind.SPIN)
        return f"roll the {self._tool().lower()} for {self.parameters().read().pivot_s:.0f} s"

    def startSpinBlocked(self):
        """Why no axis can be found now."""
        known = "" if self._tool() in self._calibrator.found else "pivot the tool first"
        return self._notConnected() or self._calibrating() or known

    def cancelPivot(self):
        """Forget the poses collected."""
        self._calibrator.cancel()

    def cancelPivotBlocked(self):
        """Why there is nothing to cancel."""
        return "" if self._calibrator.busy else "no tool is being calibrated"

    def _tool(self):
        return self.parameters().read().tool.value

    def _calibrating(self):
        return "a tool is being calibrated" if self._calibrator.busy else ""

    def _calibrate(self, kind):
        import time

        self._useFolder()
        self._calibrator.begin(kind, self._tool(), time.monotonic() + self.parameters().read().pivot_s)
        self._useCalibration(self._tool())

    def _finishCalibration(self):
        import time

        self._identify()
        tool = self._calibrator.busy
        if tool and self._calibrator.finish(time.monotonic(), geometry_of(tool, self.stream.tools)) is not None:
            self._useCalibration(tool)

    def _identify(self):
        """Once the tracker has told its tools: take up what is saved of them, and drop what is of others."""
        if self._identified or not self.stream.state.connected or not self.stream.tools:
            return
        self._identified = True
        self._useFolder()
        for tool in (tool.value for tool in Tool):
            self._calibrator.load(tool, geometry_of(tool, self.stream.tools))
            self._useCalibration(tool)
        self._base.load(self._referenceId())

    def _useFolder(self):
        self._calibrator.folder = self._base.folder = self.parameters().read().calibration_folder

    def _useCalibration(self, tool):
        """What is known of a tool, into the stream; tips of before are no longer comparable."""
        known, before = self._calibrator.tool_to_marker(tool), self.stream.calibrations.get(tool)
        if known is before:
            return
        if known is None:
            del self.stream.calibrations[tool]
        else:
            self.stream.calibrations[tool] = known
        self._tips.pop(tool, None)

    # The reference base

    def storeCheckPoint(self):
        """Keep where the stylus rests now, in the divot on the clamp. Returns a message."""
        self._useFolder()
        self._base.store(self._restingTips(Tool.STYLUS.value), self._referenceId())
        return self._base.words()

    def storeCheckPointBlocked(self):
        """Why the divot cannot be stored now."""
        return self._notConnected() or self._calibrating()

    def checkBase(self):
        """Compare the divot with the stored place. Returns a message."""
        return self._base.check(self._restingTips(Tool.STYLUS.value)).message

    def checkBaseBlocked(self):
        """Why the base cannot be checked now."""
        return self.storeCheckPointBlocked() or ("" if self._base.point is not None else "store the check point first")

    def _watchBase(self):
        """A stylus that rests in the divot checks the base by itself."""
        tips = self._tips.get(Tool.STYLUS.value)
        if self._base.point is not None and tips and not self._calibrator.busy:
            since = tips[-1][0] - CHECK_S
            if tips[0][0] <= since:
                self._base.notice([pose[:3, 3] for time_s, pose in tips[-CHECK_FRAMES:] if time_s > since])

    def _referenceId(self):
        return geometry_of("Reference", self.stream.tools).tool_id

    # Points

    def digitise(self):
        """Add the resting tip of the chosen tool to the chosen list. Returns a message."""
        wanted = self.parameters().read()
        tips = self._restingTips(wanted.tool.value)  # before the first imports: they may outlast the tips

        from CranioNavLib.slicer_files import LabelledPoints, add_points
        from ModuleTrackingLib.digitise import rest_of_tip

        rest = rest_of_tip(tips)
        label = self._nextLabel(wanted.points)
        node = scene.find_or_create(wanted.points.value)
        self._refuseTwice(node, rest.position_mm, label)
        add_points(node, LabelledPoints((label,), rest.position_mm[None]))
        return f"{label}: {rest.samples} samples, spread {rest.spread_mm:.2f} mm (RMS)"

    def _refuseTwice(self, node, position, label):
        """A key pressed twice must not make the next point of the place of the last."""
        import numpy as np

        last = node.GetNumberOfControlPoints() - 1
        if last >= 0 and np.linalg.norm(np.array(node.GetNthControlPointPosition(last)) - position) < APART_MM:
            raise InputError(
                f"the tip still rests on {node.GetNthControlPointLabel(last)}; move it to {label} and read the point"
            )

    def digitiseBlocked(self):
        """Why no point can be read now."""
        if self._allRead(self.parameters().read().points):
            return "every planned point is read; undo the last to read it again"
        return self._notConnected() or self._calibrating()

    def _restingTips(self, tool):
        """The tool's tips of the last `rest_s`, in Reference."""
        current = self.stream.current_in_reference(tool)
        if not current.usable:
            raise InputError(f"the {tool.lower()} has no pose ({current.reason}); show it to the camera and read the point again")
        since = current.host_time_s - self.parameters().read().rest_s
        return [pose[:3, 3] for taken, pose in self._tips.get(tool, []) if taken > since]

    def undoPoint(self):
        """Remove the last point of the chosen list. Returns a message."""
        node = scene.find(self.parameters().read().points.value)
        last = node.GetNumberOfControlPoints() - 1
        label = node.GetNthControlPointLabel(last)
        node.RemoveNthControlPoint(last)
        return f"{label} removed"

    def undoPointBlocked(self):
        """Why there is no point to remove."""
        node = scene.find(self.parameters().read().points.value)
        return "" if node is not None and node.GetNumberOfControlPoints() else "the list has no points"

    def _nextLabel(self, points):
        """The first planned label that is not taken yet; a number where nothing is planned."""
        taken = self._labels(points.value)
        free = [label for label in self._planned(points) if label not in taken]
        if free:
            return free[0]
        letter = {PointList.LANDMARKS: "L", PointList.BONE: "B", PointList.TARGETS: "T", PointList.PLAUSIBILITY: "P"}[points]
        return f"{letter}{len(taken) + 1}"

    def _planned(self, points):
        return self._labels(PLANNED[points]) if points in PLANNED else []

    def _allRead(self, points):
        return bool(self._planned(points)) and set(self._planned(points)) <= set(self._labels(points.value))

    def _labels(self, role):
        node = scene.find(role)
        return [node.GetNthControlPointLabel(i) for i in range(node.GetNumberOfControlPoints())] if node is not None else []

    # Recording

    def startRecording(self):
        """Record all tools into `recording_path`. Returns a message."""
        from ModuleTrackingLib.recorder import SessionRecorder

        path = self.parameters().read().recording_path
        self._recorder = SessionRecorder(path, self.stream)
        return f"recording into {path}"

    def startRecordingBlocked(self):
        """Why nothing can be recorded now."""
        if self._recorder is not None:
            return "already recording"
        return self._notConnected() or ("" if self.parameters().read().recording_path else "choose a file first")

    def stopRecording(self):
        """Finish the recording. Returns a message."""
        if self._recorder is None:
            return ""
        recorder, self._recorder = self._recorder, None
        recorder.close()
        return f"{recorder.state.frames} frames in {recorder.state.path}"

    def stopRecordingBlocked(self):
        """Why there is no recording to stop."""
        return "" if self._recorder is not None else "not recording"

    # Sharing

    def startSharing(self):
        """Serve what is tracked over OpenIGTLink, on this computer only. Returns a message."""
        from ModuleTrackingLib.sharing import Sharing

        self._sharing = Sharing(self.parameters().read().share_port)
        return f"OpenIGTLink at {self._sharing.address}"

    def startSharingBlocked(self):
        """Why nothing can be shared now."""
        return self._notConnected() or ("already shared" if self._sharing is not None else "")

    def stopSharing(self):
        """Close the server."""
        if self._sharing is not None:
            self._sharing.close()
            self._sharing = None

    def stopSharingBlocked(self):
        """Why there is no server to close."""
        return "" if self._sharing is not None else "not shared"

    def _share(self, frames):
        self._sharing.add_frames(frames)
        node = scene.find("ReferenceToRas")
        registered = node is not None and bool(node.GetAttribute(scene.STATUS_ATTRIBUTE))
        self._sharing.add_transform("ReferenceToRas", scene_data.get_transform("ReferenceToRas") if registered else None)

    def sharing(self):
        """Who listens."""
        return Reading(self._sharing.words(), Level.GOOD) if self._sharing is not None else None

    # What the panel shows

    def recording(self):
        """What has been recorded so far."""
        if self._recorder is None:
            return None
        state = self._recorder.state
        return Reading(f"{state.frames} frames, {state.seconds:.1f} s, {state.without_probe} without the probe")

    def connection(self):
        """Connected and at which rate, or why not."""
        if self.stream is None:
            return Reading(self._failure or "not connected", Level.BAD if self._failure else Level.PLAIN)
        state = self.stream.state
        if not state.connected:
            return Reading(state.problem, Level.WARNING)
        return Reading(f"{state.rate_hz:.0f} frames a second", Level.GOOD)

    def referenceTool(self):
        """The reference base."""
        if self.stream is None:
            return None
        pose = self.stream.current("Reference")
        if self._base.loose:
            return Reading(self._base.words(), Level.BAD)
        return Reading(", ".join(pose.flags) or pose.status.value, LEVELS.get(pose.status, Level.BAD))

    def probeTool(self):
        """The probe."""
        return self._seen("Probe")

    def stylusTool(self):
        """The stylus."""
        return self._seen("Stylus")

    def sphereTool(self):
        """The sphere tool."""
        return self._seen("Sphere")

    def _seen(self, tool):
        if self.stream is None:
            return None
        pose = self.stream.current_in_reference(tool)
        return Reading(pose.reason or pose.status.value, LEVELS.get(pose.status, Level.BAD))

    def pivotProgress(self):
        """How many poses have been collected, or why they were refused."""
        if self._calibrator.busy:
            return Reading(f"{len(self._calibrator.poses)} poses")
        return Reading(self._calibrator.failure, Level.BAD) if self._calibrator.failure else None

    def pivotAdvice(self):
        """To which side the tool has to be tilted further, while it is being pivoted."""
        found = self._tiltCoverage()
        if found is None:
            return None
        return Reading(found.advice or "every side is covered", Level.WARNING if found.advice else Level.GOOD)

    def pivotCone(self):
        """A drawing of the sides to which the tool has been tilted; None while it is not being pivoted."""
        from ModuleTrackingLib.calibration.coverage import draw_coverage

        found = self._tiltCoverage()
        return draw_coverage(found) if found is not None else None

    def _tiltCoverage(self):
        import numpy as np
        from CranioNavLib.rigid import invert_rigid
        from ModuleTrackingLib.calibration.coverage import tilt_coverage

        if self._calibrator.kind is not Kind.PIVOT:
            return None
        camera = np.zeros(3)
        if scene.find("ReferenceToTracker") is not None:
            camera = invert_rigid(scene_data.get_transform("ReferenceToTracker"))[:3, 3]
        poses = self._calibrator.poses
        return tilt_coverage(poses[:: -(1 + len(poses) // MOST_SHOWN)][::-1], camera) if poses else None  # the last stays

    def calibration(self):
        """The calibration of the chosen tool."""
        words = self._calibrator.words(self._tool())
        return Reading(words, Level.GOOD) if words else None

    def baseCheck(self):
        """Whether the reference base still sits where it sat."""
        checked = Level.GOOD if self._base.result is not None else Level.PLAIN
        return Reading(self._base.words(), Level.BAD if self._base.loose else checked)

    def nextPoint(self):
        """The label that the next point gets."""
        points = self.parameters().read().points
        return Reading("all are read", Level.GOOD) if self._allRead(points) else Reading(self._nextLabel(points))

    def trackerStatus(self):
        """Whether poses arrive."""
        if self.stream is None:
            return StepStatus(StepState.ATTENTION if self._failure else StepState.TODO, self._failure or "connect the tracker")
        state = self.stream.state
        return StepStatus(StepState.DONE if state.connected else StepState.ATTENTION, state.problem)

    def calibrationStatus(self):
        """Whether the chosen tool is calibrated."""
        if self._calibrator.failure and self.stream is not None:
            return StepStatus(StepState.ATTENTION, self._calibrator.failure)
        done = self._tool() in self._calibrator.found
        return StepStatus(StepState.DONE if done else StepState.TODO, "" if done else "pivot the tool, unless it is calibrated")

    def baseStatus(self):
        """Whether the base is known to be loose; a check point is worth its minute, but no step waits for it."""
        wrong = self._base.loose or bool(self._base.refused and self._base.point is None)
        return StepStatus(StepState.ATTENTION if wrong else StepState.DONE, self._base.words())

    def pointsStatus(self):
        """Whether every planned landmark is digitised."""
        missing = [label for label in self._labels("LandmarksCT") if label not in self._labels("LandmarksPatient")]
        if missing or not self._labels("LandmarksPatient"):
            return StepStatus(StepState.TODO, f"still to touch: {', '.join(missing)}" if missing else "touch the landmarks")
        return StepStatus(StepState.DONE)

    def _notConnected(self):
        return "" if self.stream is not None else "connect the tracker first"


class ModuleTrackingTest(ScriptedLoadableModuleTest):
    """A stylus of the simulated tracker is calibrated, touches the landmarks, and is recorded."""

    TIP_TOLERANCE_MM = 0.5  # simulated: tracker 0.25 mm, some hundred poses
    LANDMARK_TOLERANCE_MM = 12.0  # simulated: four times the SD of finding a landmark; the test is of the wiring

    def setUp(self):
        """A fresh scene and a simulated patient of its own."""
        from CranioNavLib.phantom import make_patient
        from CranioNavLib.phantom.session import SimulatedSession, use_session

        slicer.mrmlScene.Clear(False)
        self.session = SimulatedSession(make_patient(None, seed=3), seed=3)
        use_session(self.session)
        self.logic = ModuleTrackingLogic()
        self.logic.parameters().change(tracker="simulated")
        settings = self.logic.pluginSettings("tracker", "simulated")
        settings.change(rate_hz=60.0, calibrated=False)

    def tearDown(self):
        """Let go of the tracker."""
        from CranioNavLib.phantom.session import use_session

        self.logic.disconnect()
        use_session(None)

    def runTest(self):
        """The scenarios."""
        self.setUp()
        try:
            self.test_pivot_landmarks_and_recording()
        finally:
            self.tearDown()

    def test_pivot_landmarks_and_recording(self):
        """Pivot calibration finds the tip; digitised landmarks lie where the patient has them; the file holds them all."""
        import tempfile

        import numpy as np
        from CranioNavLib.phantom import constants
        from CranioNavLib.rigid import transform_points
        from CranioNavLib.sequence_metafile import read_recording
        from CranioNavLib.slicer_files import LabelledPoints

        patient, logic = self.session.patient, self.logic
        scene_data.set_points("LandmarksCT", LabelledPoints(patient.landmark_labels, patient.landmarks_ras_mm))
        logic.connect()
        self.session.pivot("Stylus")
        self._run(1.5)
        logic.parameters().change(tool=Tool.STYLUS, pivot_s=5.0)
        logic.startPivot()
        self._run(5.3)
        assert "Stylus" in logic._calibrator.found, logic.pivotProgress()
        error = np.linalg.norm(logic._calibrator.found["Stylus"].tool_to_marker[:3, 3] - constants.STYLUS_TIP_MM)
        assert error < self.TIP_TOLERANCE_MM, f"tip is wrong by {error:.2f} mm"
        self.delayDisplay(f"tip found to {error:.2f} mm")
        with tempfile.TemporaryDirectory() as folder:
            logic.parameters().change(recording_path=f"{folder}/session.igs.mha")
            self.session.pivot("Probe")  # in view: a recording without the probe is refused
            logic.startRecording()
            for index in range(len(patient.landmarks_ras_mm)):
                self.session.touch_landmark(index)
                self._run(2.2)
                logic.digitise()
            logic.stopRecording()
            recording = read_recording(f"{folder}/session.igs.mha")
        touched = scene_data.get_points("LandmarksPatient")
        assert touched.labels == tuple(patient.landmark_labels)
        truth = transform_points(patient.ras_to_reference, patient.landmarks_ras_mm)
        assert np.linalg.norm(touched.positions_mm - truth, axis=1).max() < self.LANDMARK_TOLERANCE_MM
        assert "StylusToReference" in recording.other_transforms
        self.session.put_away("Stylus")
        self._run(0.5)
        assert scene_data.get_pose("StylusToReference").matrix is None

    def _run(self, seconds):
        """The event loop, for some seconds."""
        import time

        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.logic.poll()
            time.sleep(POLL_MS / 1000)
