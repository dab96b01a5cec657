"""The reference base: composition, refusals, and the loose clamp."""

from __future__ import annotations

import json

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from ModuleTrackingLib.reference_base import CheckPoint, check_reference_base, in_reference, store_check_point
from ModuleTrackingLib.tracker import PoseStatus, ToolPose
from scripted_tracker import a_pose, missing, ok


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def test_tool_to_reference_is_base_inverse_times_tool():
    pose = in_reference(ok("Probe", a_pose(1), 5.0), ok("Reference", a_pose(2), 5.0, error_mm=0.4))
    np.testing.assert_allclose(a_pose(2) @ pose.tool_to_reference, a_pose(1), atol=1e-9)
    assert pose.usable
    assert pose.error_mm == 0.4


@pytest.mark.parametrize("status", [PoseStatus.OUT_OF_VOLUME, PoseStatus.INVALID, PoseStatus.STALE])
def test_only_ok_poses_are_combined(status):
    doubtful = ToolPose("Probe", a_pose(1), status, 5.0, flags=("partly out of volume",))
    pose = in_reference(doubtful, ok("Reference", a_pose(2), 5.0))
    assert pose.tool_to_reference is None
    assert pose.status is status
    assert pose.reason == "Probe: partly out of volume"


def test_a_lost_base_loses_every_tool():
    pose = in_reference(ok("Probe", a_pose(1), 5.0), missing("Reference", 5.0))
    assert (pose.tool_to_reference, pose.status) == (None, PoseStatus.MISSING)


def test_poses_of_different_times_are_not_combined():
    with pytest.raises(ValueError, match=r"20\.0 ms apart"):
        in_reference(ok("Probe", a_pose(1), 5.0), ok("Reference", a_pose(2), 5.02))


def test_a_firm_base_passes_and_a_loose_one_is_told(rng, tmp_path):
    divot = np.array([30.0, -12, 55])
    store_check_point(divot + rng.normal(0, 0.25, (60, 3)), "base-1").save(tmp_path / "check.json")
    point = CheckPoint.load(tmp_path / "check.json", "base-1")
    firm = check_reference_base(point, divot + rng.normal(0, 0.25, (60, 3)))
    assert not firm.loose
    assert firm.distance_mm < 0.3
    loose = check_reference_base(point, divot + [1.5, 0, 0] + rng.normal(0, 0.25, (60, 3)))
    assert loose.loose
    assert "moved by 1." in loose.message
    assert "register again" in loose.message


def test_a_firm_base_is_almost_never_called_loose(rng):
    divot = np.zeros(3)
    point = store_check_point(divot + rng.normal(0, 0.25, (30, 3)))
    assert not any(check_reference_base(point, divot + rng.normal(0, 0.25, (30, 3))).loose for _ in range(500))


def test_a_moving_tip_is_refused(rng):
    with pytest.raises(InputError, match="hold it still"):
        store_check_point(np.linspace([0, 0, 0], [10, 0, 0], 30))


def test_too_few_touches_are_refused(rng):
    with pytest.raises(InputError, match="at least 10"):
        store_check_point(np.zeros((3, 3)))


def test_a_check_point_of_another_base_is_refused(rng, tmp_path):
    store_check_point(np.zeros((20, 3)), "base-1").save(tmp_path / "check.json")
    with pytest.raises(InputError, match="'base-1', not 'base-2'"):
        CheckPoint.load(tmp_path / "check.json", "base-2")


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", json.dumps({"position_mm": [1, 2], "sd_mm": 0, "reference_id": "", "date": ""})]
)
def test_a_damaged_check_point_is_refused(tmp_path, text):
    (tmp_path / "check.json").write_text(text)
    with pytest.raises(InputError, match="not a check point"):
        CheckPoint.load(tmp_path / "check.json")


def test_a_missing_check_point_is_refused(tmp_path):
    with pytest.raises(InputError, match="not a check point"):
        CheckPoint.load(tmp_path / "none.json")
