"""The tracking module's logic on the real scene: poses, points, recording, sharing."""

from __future__ import annotations

import time
from contextlib import closing

import numpy as np
import pytest
from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.openigtlink import IgtlClient
from CranioNavLib.openigtlink.messages import Transform
from CranioNavLib.panel import Level, StepState
from CranioNavLib.rigid import invert_rigid, rigid
from CranioNavLib.sequence_metafile import read_recording
from CranioNavLib.slicer_files import LabelledPoints
from ModuleTrackingLib.panel_description import PointList, Tool
from obedient_tracker import BASE, DIVOT, Script, read_point, run_for, run_until, seen


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


def test_of_frames_that_come_together_the_scene_hears_once_and_no_tip_is_lost(a_logic):
    a_logic.connect()
    run_until(a_logic, seen())
    heard, node = [], scene.find("StylusToReference")
    tips = a_logic.tips["Stylus"]
    before = len(tips)
    tag = node.AddObserver(
        node.TransformModifiedEvent, lambda *_: heard.append(scene_data.get_pose("StylusToReference").host_time_s)
    )
    time.sleep(0.1)  # the main thread is busy; the tracker goes on
    a_logic.poll()
    node.RemoveObserver(tag)
    assert len(tips) > before + 2
    assert heard == [tips[-1][0]]


def test_a_lost_tool_has_no_pose_in_the_scene(a_logic):
    a_logic.connect()
    run_until(a_logic, seen())
    Script.tools = {}
    run_until(a_logic, lambda: scene_data.get_pose("StylusToReference").status == "MISSING")
    assert scene_data.get_pose("StylusToReference").matrix is None
    assert a_logic.stylusTool().level is Level.BAD
    assert a_logic.probeTool().level is Level.PLAIN, "one that has not been shown yet is not lost"


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


def test_markers_and_places_on_the_bone_are_read_to_verify_with_and_taken_back_in_order(a_logic):
    a_logic.connect()
    assert "the CT shows no targets" in a_logic.readMarkerBlocked()
    scene_data.set_points("TargetsCT", LabelledPoints(("T 1", "T 2"), np.eye(2, 3) * 50))
    steps = [(a_logic.readMarker, "T 1"), (a_logic.readPlausibility, "P1"), (a_logic.readMarker, "T 2")]
    for number, (read, label) in enumerate(steps):
        Script.tools = {"Stylus": rigid(np.eye(3), DIVOT + [30.0 * number, 0, 0])}
        run_for(a_logic, 0.3)
        assert read().startswith(label)
    assert "every marker is read" in a_logic.readMarkerBlocked()
    assert a_logic.checksRead().text == "2 of 2 markers, 1 place on the bone"
    assert scene.find("LandmarksPatient") is None
    assert [a_logic.undoCheck() for _ in steps] == ["T 2 removed", "P1 removed", "T 1 removed"]
    assert a_logic.undoCheckBlocked() == "nothing has been read"


@pytest.mark.parametrize(("points", "label"), [(PointList.PLAUSIBILITY, "P1"), (PointList.CLAMP, "C1")])
def test_points_go_to_the_list_that_is_chosen(a_logic, points, label):
    a_logic.connect()
    a_logic.parameters().change(points=points, tool=Tool.STYLUS)
    run_for(a_logic, 0.2)
    a_logic.digitise()
    assert scene_data.get_points(points.value).labels == (label,)
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
