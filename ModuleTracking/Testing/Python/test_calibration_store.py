"""Calibrations on disk: kept whole, and refused for any other tool."""

from __future__ import annotations

import json

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from ModuleTrackingLib.calibration import ToolCalibration, ToolGeometry, load_calibration, save_calibration
from scripted_tracker import a_pose

MARKERS = np.array([[0, 0, 0], [50, 0, 0], [0, 60, 0], [-40, -30, 5.0]])


@pytest.fixture
def a_calibration():
    geometry = ToolGeometry.of("8700340 / 0123ABCD", MARKERS)
    return ToolCalibration("Stylus", geometry, a_pose(1), np.diag([0.01, 0.02, 0.09]), 0.31, "pivot", 412)


@pytest.fixture
def a_path(tmp_path, a_calibration):
    save_calibration(tmp_path / "stylus.json", a_calibration)
    return tmp_path / "stylus.json"


def test_a_calibration_is_read_as_it_was_saved(a_path, a_calibration):
    read = load_calibration(a_path, "Stylus", a_calibration.geometry)
    np.testing.assert_allclose(read.tool_to_marker, a_calibration.tool_to_marker, atol=1e-12)
    np.testing.assert_array_equal(read.covariance, a_calibration.covariance)
    assert (read.rms_mm, read.method, read.samples) == (0.31, "pivot", 412)
    assert read.error_mm == pytest.approx(0.3)
    assert read.date.startswith("20")
    assert json.loads(a_path.read_text())["error_mm"] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("tool", "geometry", "message"),
    [
        ("Probe", ToolGeometry.of("8700340 / 0123ABCD", MARKERS), "calibrates the stylus, not the probe"),
        ("Stylus", ToolGeometry.of("8700340 / 9999", MARKERS), "it is of tool '8700340 / 0123ABCD', this is '8700340 / 9999'"),
        ("Stylus", ToolGeometry.of("8700340 / 0123ABCD", MARKERS[:3]), "had 4 markers then and has 3 now"),
        ("Stylus", ToolGeometry.of("8700340 / 0123ABCD", MARKERS + [0, 0, 0.4]), "0.40 mm from where it was"),
    ],
)
def test_another_tool_s_calibration_is_refused(a_path, tool, geometry, message):
    with pytest.raises(InputError, match=message):
        load_calibration(a_path, tool, geometry)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("tool_to_marker", np.zeros((4, 4)).tolist()),
        ("covariance", [[1, 2], [3, 4]]),
        ("rms_mm", "big"),
        ("markers_mm", [[1, 2]]),
    ],
)
def test_a_damaged_field_is_refused(a_path, a_calibration, field, value):
    values = json.loads(a_path.read_text())
    values[field] = value
    a_path.write_text(json.dumps(values))
    with pytest.raises(InputError, match="not a calibration"):
        load_calibration(a_path, "Stylus", a_calibration.geometry)


@pytest.mark.parametrize("text", ["", "[]", "{}", "{"])
def test_another_file_is_refused(a_path, a_calibration, text):
    a_path.write_text(text)
    with pytest.raises(InputError, match="calibrate the stylus again"):
        load_calibration(a_path, "Stylus", a_calibration.geometry)
