"""The tracking module's logic on the real scene, with a tracker that does exactly what the test says."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.openigtlink import IgtlClient
from CranioNavLib.openigtlink.messages import Transform
from CranioNavLib.panel import Level, StepState
from CranioNavLib.parameters import Parameters
from CranioNavLib.rigid import invert_rigid, rigid, rigid_from_vector
from CranioNavLib.sequence_metafile import read_recording
from CranioNavLib.slicer_files import LabelledPoints
from ModuleTrackingLib.panel_description import PointList, Tool
from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, ToolInfo, ToolPose, Tracker, TrackerError

import ModuleTracking as module

BASE = rigid_from_vector([0.2, -0.1, 0.4], [30, -40, 1500])  # ReferenceToTracker
TIP = np.array([1.0, -2.0, 120.0])  # of the stylus, in its marker's frame
DIVOT = np.array([40.0, 25.0, 10.0])  # in Reference


class Script:
    """What the scripted tracker sees; shared by test and plugin."""

    refuse = ""
    broken = False
    silent: tuple = ()  # tools that the tracker says nothing of, not even that they are missing
    tools: dict = {}  # tool -> ToolToReference, or a function of the frame's number  # noqa: RUF012


@TRACKERS.register
class ScriptedTracker(Tracker):
    name = "scripted"
    title = "Scripted"

    @dataclass(frozen=True)
    class Settings(Parameters):
        pass

    def open(self):
        if Script.refuse:
            raise InputError(Script.refuse)
        self.frame = 0

    def start(self):
        pass

    def stop(self):
        pass

    def close(self):
        pass

    @property
    def tools(self):
        return [ToolInfo(name) for name in ("Reference", "Stylus", "Probe")]

    def read(self, timeout_s=1.0):
        time.sleep(0.004)
        if Script.broken:
            raise TrackerError("the cable fell out; plug it in")
        self.frame += 1
        now = time.monotonic()
        poses = [ToolPose("Reference", BASE, PoseStatus.OK, now, frame_number=self.frame)]
        if "Reference" in Script.silent:
            return []
        for name in {"Stylus", "Probe"}.difference(Script.silent):
            pose = Script.tools.get(name)
            pose = pose(self.frame) if callable(pose) else pose
            status = PoseStatus.OK if pose is not None else PoseStatus.MISSING
            poses.append(ToolPose(name, None if pose is None else BASE @ pose, status, now, frame_number=self.frame))
        return poses


def pivoting(frame):
    """The stylus' marker while its tip rests in the divot."""
    turn = rigid_from_vector([0.5 * np.sin(frame / 7), 0.5 * np.sin(frame / 11), 0.3 * np.sin(frame / 5)], np.zeros(3))
    return rigid(np.eye(3), DIVOT) @ turn @ rigid(np.eye(3), -TIP)


@pytest.fixture
def a_logic():
    host.scene().Clear(False)
    Script.silent = ()
    Script.refuse, Script.broken, Script.tools = "", False, {"Stylus": rigid(np.eye(3), DIVOT)}
    logic = module.ModuleTrackingLogic()
    logic.parameters().change(tracker="scripted", rest_s=0.1)
    yield logic
    logic.disconnect()
    host.scene().Clear(False)


def run_until(logic, done, limit_s=10.0):
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        logic.poll()
        if done():
            return
        time.sleep(0.005)
    raise AssertionError("waited in vain")


def seen(tool="Stylus"):
    return lambda: scene_data.get_pose(f"{tool}ToReference").matrix is not None


def run_for(logic, seconds):
    end = time.monotonic() + seconds
    run_until(logic, lambda: time.monotonic() > end)


def read_point(logic):
    """Read the resting tip as a user does: try again while it is refused."""
    for _ in range(40):
        run_for(logic, 0.25)
        try:
            return logic.digitise()
        except InputError:
            continue
    return logic.digitise()


def test_poses_reach_the_scene_relative_to_the_reference_base(a_logic):
    a_logic.connect()
    run_until(a_logic, seen())
    np.testing.assert_allclose(scene_data.get_transform("StylusToReference")[:3, 3], DIVOT, atol=1e-9)
    np.testing.assert_allclose(scene_data.get_transform("ReferenceToTracker"), BASE, atol=1e-9)
    assert scene.find("StylusToReference").GetParentTransformNode() is scene.find("ReferenceToRas")
    run_for(a_logic, 0.05)
    assert a_logic.connection().level is Level.GOOD
    assert a_logic.stylusTool().text == "OK"
    assert a_logic.trackerStatus().state is StepState.DONE


def test_a_lost_tool_has_no_pose_in_the_scene(a_logic):
    a_logic.connect()
    run_until(a_logic, seen())
    Script.tools = {}
    run_until(a_logic, lambda: scene_data.get_pose("StylusToReference").status == "MISSING")
    assert scene_data.get_pose("StylusToReference").matrix is None
    assert a_logic.stylusTool().level is Level.BAD


@pytest.mark.parametrize("silent", [("Reference", "Stylus", "Probe"), ("Stylus",)], ids=["nothing comes", "others go on"])
def test_a_tool_without_news_for_200_ms_is_lost_at_the_next_poll(a_logic, silent):
    a_logic.connect()
    run_until(a_logic, seen())
    Script.silent = silent
    end = time.monotonic() + 0.05
    run_until(a_logic, lambda: time.monotonic() > end)  # what was on its way has come
    latest = scene_data.get_pose("StylusToReference")
    assert latest.matrix is not None
    a_logic.stream._clock = lambda: latest.host_time_s + 0.199
    a_logic.poll()
    assert scene_data.get_pose("StylusToReference").matrix is not None
    a_logic.stream._clock = lambda: latest.host_time_s + 0.201
    a_logic.poll()
    assert (scene_data.get_pose("StylusToReference").matrix, scene_data.get_pose("StylusToReference").status) == (None, "STALE")
    assert "no news" in a_logic.stylusTool().text


def test_a_tracker_that_fails_loses_all_tools_and_comes_back_by_itself(a_logic):
    a_logic.connect()
    run_until(a_logic, seen())
    Script.broken = True
    run_until(a_logic, lambda: not a_logic.stream.state.connected)
    run_until(a_logic, lambda: scene_data.get_pose("StylusToReference").matrix is None)
    assert "cable" in a_logic.connection().text
    Script.broken = False
    run_until(a_logic, seen())


def test_a_tracker_that_refuses_its_settings_says_so_and_can_be_tried_again(a_logic):
    Script.refuse = "no such port COM9; give another"
    a_logic.connect()
    with pytest.raises(InputError, match="COM9"):
        run_until(a_logic, lambda: False)
    assert a_logic.stream is None
    assert "COM9" in a_logic.connection().text
    assert a_logic.trackerStatus().state is StepState.ATTENTION
    assert a_logic.connectBlocked() == ""


def test_pivoting_calibrates_the_tip_and_the_scene_shows_it_from_then_on(a_logic):
    Script.tools = {"Stylus": pivoting}
    a_logic.connect()
    run_until(a_logic, seen())
    a_logic.parameters().change(pivot_s=1.0)
    a_logic.startPivot()
    assert a_logic.digitiseBlocked() == "a tool is being calibrated"
    run_until(a_logic, lambda: "Stylus" in a_logic.calibrator.found)
    np.testing.assert_allclose(a_logic.calibrator.found["Stylus"].tool_to_marker[:3, 3], TIP, atol=1e-6)
    run_for(a_logic, 0.1)
    np.testing.assert_allclose(scene_data.get_transform("StylusToReference")[:3, 3], DIVOT, atol=1e-6)
    assert a_logic.calibrationStatus().state is StepState.DONE


def test_a_tool_held_still_cannot_be_calibrated_and_the_panel_says_why(a_logic):
    a_logic.connect()
    run_until(a_logic, seen())
    a_logic.parameters().change(pivot_s=1.0)
    a_logic.startPivot()
    run_until(a_logic, lambda: not a_logic.calibrator.busy)
    assert "Stylus" not in a_logic.calibrator.found
    assert "tilt" in a_logic.pivotProgress().text
    assert a_logic.calibrationStatus().state is StepState.ATTENTION


def test_points_get_the_planned_labels_in_order_and_can_be_undone(a_logic):
    planned = LabelledPoints(("Nasion", "Left", "Right"), np.eye(3) * 50)
    scene_data.set_points("LandmarksCT", planned)
    a_logic.connect()
    places = DIVOT + planned.positions_mm
    for label, place in zip(planned.labels, places, strict=True):
        Script.tools = {"Stylus": rigid(np.eye(3), place)}
        assert a_logic.nextPoint().text == label
        read_point(a_logic)
    touched = scene_data.get_points("LandmarksPatient")
    assert touched.labels == planned.labels
    np.testing.assert_allclose(touched.positions_mm, places, atol=1e-9)
    assert a_logic.nextPoint().text == "all are read"
    assert "every planned point is read" in a_logic.digitiseBlocked()
    assert a_logic.pointsStatus().state is StepState.DONE
    assert a_logic.undoPoint() == "Right removed"
    assert a_logic.nextPoint().text == "Right"
    assert "Right" in a_logic.pointsStatus().text


def test_a_key_pressed_twice_does_not_make_two_points_of_one_place(a_logic):
    scene_data.set_points("LandmarksCT", LabelledPoints(("Nasion", "Left", "Right"), np.eye(3) * 50))
    a_logic.connect()
    read_point(a_logic)
    with pytest.raises(InputError, match="still rests on Nasion; move it to Left"):
        a_logic.digitise()
    assert scene_data.get_points("LandmarksPatient").labels == ("Nasion",)


def test_a_moving_tip_is_no_point(a_logic):
    Script.tools = {"Stylus": lambda frame: rigid(np.eye(3), DIVOT + [frame, 0, 0])}
    a_logic.connect()
    run_until(a_logic, seen())
    run_for(a_logic, 0.2)
    with pytest.raises(InputError, match="hold it still"):
        a_logic.digitise()
    assert scene.find("LandmarksPatient") is None


def test_a_tool_out_of_view_is_no_point(a_logic):
    a_logic.connect()
    run_until(a_logic, seen())
    Script.tools = {}
    run_until(a_logic, lambda: scene_data.get_pose("StylusToReference").matrix is None)
    with pytest.raises(InputError, match="stylus has no pose"):
        a_logic.digitise()


def test_points_go_to_the_list_that_is_chosen(a_logic):
    a_logic.connect()
    a_logic.parameters().change(points=PointList.PLAUSIBILITY, tool=Tool.STYLUS)
    run_for(a_logic, 0.2)
    a_logic.digitise()
    assert scene_data.get_points("PlausibilityPoints").labels == ("P1",)
    assert scene.find("LandmarksPatient") is None


def test_what_is_recorded_is_what_was_seen(a_logic, tmp_path):
    Script.tools = {"Stylus": rigid(np.eye(3), DIVOT), "Probe": rigid(np.eye(3), [1, 2, 3])}
    a_logic.connect()
    run_until(a_logic, seen("Probe"))
    a_logic.parameters().change(recording_path=str(tmp_path / "all.igs.mha"))
    a_logic.startRecording()
    run_for(a_logic, 0.4)
    assert "frames" in a_logic.recording().text
    assert "all.igs.mha" in a_logic.stopRecording()
    recording = read_recording(tmp_path / "all.igs.mha")
    assert len(recording) > 5
    np.testing.assert_allclose(recording.probe_to_reference[0], rigid(np.eye(3), [1, 2, 3]), atol=1e-6)
    np.testing.assert_allclose(recording.other_transforms["ReferenceToTracker"][0], BASE, atol=1e-6)
    stylus = recording.other_transforms["StylusToTracker"][0]
    np.testing.assert_allclose((invert_rigid(BASE) @ stylus)[:3, 3], DIVOT, atol=1e-6)


def test_after_disconnecting_nothing_is_live(a_logic):
    a_logic.connect()
    run_until(a_logic, seen())
    a_logic.disconnect()
    a_logic.poll()
    assert scene_data.get_pose("StylusToReference").matrix is None
    assert a_logic.stylusTool() is None
    assert a_logic.digitiseBlocked() == "connect the tracker first"


def still(place):
    """The stylus' marker while its tip rests there, a little differently in every frame."""
    return lambda frame: rigid(np.eye(3), np.asarray(place) - TIP + 0.01 * np.sin([frame, 2 * frame, 3 * frame]))


def calibrate_stylus(logic):
    Script.tools = {"Stylus": pivoting}
    logic.connect()
    run_until(logic, seen())
    logic.parameters().change(pivot_s=1.0)
    logic.startPivot()
    run_until(logic, lambda: not logic.calibrator.busy)
    assert "Stylus" in logic.calibrator.found, logic.pivotProgress()


def test_a_base_that_moved_on_its_clamp_is_told_by_touching_the_divot_again(a_logic, tmp_path):
    a_logic.parameters().change(calibration_folder=str(tmp_path))
    calibrate_stylus(a_logic)
    assert a_logic.checkBaseBlocked() == "store the check point first"
    assert "no check point" in a_logic.baseCheck().text
    Script.tools = {"Stylus": still(DIVOT)}
    run_for(a_logic, 0.5)
    a_logic.storeCheckPoint()
    assert "not checked since" in a_logic.baseCheck().text
    assert "sits firmly" in a_logic.checkBase()
    Script.tools = {"Stylus": still(DIVOT + [12.0, 0, 0])}  # seen from a base that slipped by 12 mm
    run_for(a_logic, 0.5)
    assert "moved by 12.0 mm" in a_logic.checkBase()
    assert a_logic.baseCheck().level is a_logic.referenceTool().level is Level.BAD
    assert a_logic.baseStatus().state is StepState.ATTENTION
    Script.tools = {"Stylus": still(DIVOT)}
    run_until(a_logic, lambda: "sits firmly" in a_logic.baseCheck().text)  # nobody pressed anything
    Script.tools = {"Stylus": still(DIVOT + [0, 3.0, 0])}
    run_until(a_logic, lambda: "moved by 3.0 mm" in a_logic.baseCheck().text)


def test_what_was_calibrated_is_there_again_and_only_for_the_same_tool(a_logic, tmp_path, monkeypatch):
    a_logic.parameters().change(calibration_folder=str(tmp_path))
    calibrate_stylus(a_logic)
    Script.tools = {"Stylus": still(DIVOT)}
    run_for(a_logic, 0.3)
    a_logic.storeCheckPoint()
    a_logic.disconnect()
    other = module.ModuleTrackingLogic()
    other.connect()
    run_until(other, lambda: "Stylus" in other.calibrator.found)
    run_until(other, lambda: other.base.point is not None)
    run_for(other, 0.1)
    np.testing.assert_allclose(scene_data.get_transform("StylusToReference")[:3, 3], DIVOT, atol=0.1)
    other.disconnect()
    changed = [ToolInfo(name, definition="another marker") for name in ("Reference", "Stylus", "Probe")]
    monkeypatch.setattr(ScriptedTracker, "tools", property(lambda self: changed))
    for logic in (other, module.ModuleTrackingLogic()):  # one that remembers, one that reads the folder
        logic.connect()
        run_until(logic, lambda logic=logic: logic._identified)
        assert "Stylus" not in logic.calibrator.found
        assert "does not fit" in logic.calibrationStatus().text
        assert "another reference tool" in logic.baseCheck().text or "belongs to reference tool" in logic.baseCheck().text
        logic.disconnect()


def test_a_rolled_tool_gets_its_axis(a_logic):
    a_logic.connect()
    run_until(a_logic, seen())
    assert a_logic.startSpinBlocked() == "pivot the tool first"
    a_logic.disconnect()
    calibrate_stylus(a_logic)
    axis = np.array([0.6, 0.0, 0.8])
    turn = lambda frame: rigid_from_vector(axis * frame / 20, np.zeros(3))  # noqa: E731
    Script.tools = {"Stylus": lambda frame: rigid(np.eye(3), DIVOT) @ turn(frame) @ rigid(np.eye(3), -TIP)}
    run_for(a_logic, 0.1)
    a_logic.parameters().change(pivot_s=2.0)
    a_logic.startSpin()
    run_until(a_logic, lambda: not a_logic.calibrator.busy)
    found = a_logic.calibrator.found["Stylus"]
    assert found.method == "pivot and spin", a_logic.pivotProgress()
    np.testing.assert_allclose(found.tool_to_marker[:3, 2], axis, atol=1e-6)
    np.testing.assert_allclose(found.tool_to_marker[:3, 3], TIP, atol=1e-6)
    run_for(a_logic, 0.1)
    np.testing.assert_allclose(scene_data.get_transform("StylusToReference")[:3, 3], DIVOT, atol=1e-6)


def test_what_is_tracked_and_registered_is_shared_with_openigtlink_clients(a_logic):
    a_logic.connect()
    run_until(a_logic, seen())
    a_logic.parameters().change(share_port=0)
    address = a_logic.startSharing().split()[-1]
    scene_data.set_transform("ReferenceToRas", BASE)
    heard = {}
    with closing(IgtlClient("127.0.0.1", int(address.rsplit(":", 1)[1]))) as client:

        def listen():
            heard.update({message.device: message.matrix for message in client.receive(0.001) if isinstance(message, Transform)})
            return {"StylusToReference", "StylusToTracker", "ReferenceToTracker"} <= heard.keys()

        run_until(a_logic, listen)
        assert "1 client" in a_logic.sharing().text
        assert "ReferenceToRas" not in heard  # not registered yet
        scene.find("ReferenceToRas").SetAttribute(scene.STATUS_ATTRIBUTE, "accepted")
        run_until(a_logic, lambda: listen() and "ReferenceToRas" in heard)
    np.testing.assert_allclose(heard["StylusToReference"][:3, 3], DIVOT, atol=1e-4)
    np.testing.assert_allclose(heard["ReferenceToRas"], BASE, atol=1e-4)
    a_logic.disconnect()
    assert a_logic.sharing() is None
