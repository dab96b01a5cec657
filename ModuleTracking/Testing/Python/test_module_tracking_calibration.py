"""The tracking module's calibration and reference base on the real scene."""

from __future__ import annotations

import numpy as np
from CranioNavLib import scene_data
from CranioNavLib.panel import Level, StepState
from CranioNavLib.rigid import rigid, rigid_from_vector
from ModuleTrackingLib.tracker import ToolInfo
from obedient_tracker import DIVOT, TIP, ObedientTracker, Script, pivoting, run_for, run_until, seen, still

import ModuleTracking as module


def begin_pivot(logic):
    logic.connect()
    run_until(logic, seen())
    logic.parameters().change(pivot_s=1.0)
    logic.startPivot()


def test_pivoting_calibrates_the_tip_and_the_scene_shows_it_from_then_on(a_logic):
    Script.tools = {"Stylus": pivoting}
    begin_pivot(a_logic)
    assert a_logic.digitiseBlocked() == "a tool is being calibrated"
    run_until(a_logic, lambda: "Stylus" in a_logic.calibrator.found)
    np.testing.assert_allclose(a_logic.calibrator.found["Stylus"].tool_to_marker[:3, 3], TIP, atol=1e-6)
    run_for(a_logic, 0.1)
    np.testing.assert_allclose(scene_data.get_transform("StylusToReference")[:3, 3], DIVOT, atol=1e-6)
    assert a_logic.calibrationStatus().state is StepState.DONE


def test_a_tool_held_still_cannot_be_calibrated_and_the_panel_says_why(a_logic):
    begin_pivot(a_logic)
    run_until(a_logic, lambda: not a_logic.calibrator.busy)
    assert "Stylus" not in a_logic.calibrator.found
    assert "tilt" in a_logic.pivotProgress().text
    assert a_logic.calibrationStatus().state is StepState.ATTENTION


def calibrate_stylus(logic):
    Script.tools = {"Stylus": pivoting}
    begin_pivot(logic)
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
    monkeypatch.setattr(ObedientTracker, "tools", property(lambda self: changed))
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
