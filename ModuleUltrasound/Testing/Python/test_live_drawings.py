"""The drawings show what was measured, where it was measured."""

from __future__ import annotations

from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from ModuleUltrasoundLib.live_drawings import (
    HEIGHT,
    WIDTH,
    PointState,
    a_line,
    bulls_eye,
    draw_a_line,
    draw_bulls_eye,
    draw_points,
)
from ModuleUltrasoundLib.measurement.measure import EchoSettings

RATE_HZ, SKIN_S, SETTINGS = 50e6, 10e-6, EchoSettings(speed_of_sound_m_s=1500.0, most_depth_mm=20.0)


def a_live_line(depth_mm=8.0, accepted=True, reason="", skin_s=SKIN_S):
    measured = SimpleNamespace(skin_times_s=[skin_s], depths_mm=[depth_mm], accepted=[accepted], reasons=[reason])
    samples = np.zeros(3000, np.int16)
    samples[round((SKIN_S + 2e-3 * 8.0 / 1500.0) * RATE_HZ)] = 1000
    return samples, RATE_HZ, measured


def places(svg, tag):
    return [one.attrib for one in ElementTree.fromstring(svg) if one.tag.endswith(tag)]


def test_skin_bone_and_gate_stand_where_they_lie_in_the_line():
    line = a_line(a_live_line(), SETTINGS)
    per_mm = WIDTH / 28.0  # 4 mm before the skin, 20 mm of tissue, 4 mm below
    assert line["skin"] == pytest.approx(4 * per_mm, abs=0.1)
    assert line["bone"] == pytest.approx(12 * per_mm, abs=0.1)
    assert line["gate"] == pytest.approx([(4 + SETTINGS.least_depth_mm) * per_mm, 24 * per_mm], abs=0.1)
    peaks = [float(piece.split()[0]) for piece in line["path"].split("M")[1:] if float(piece.split()[1].split("V")[0]) < 10]
    assert peaks == [pytest.approx(line["bone"], abs=WIDTH / 150)]
    assert line["text"] == "bone 8.0 mm deep"
    skin, bone = places(draw_a_line(line), "line")
    assert (float(skin["x1"]), float(bone["x1"])) == (line["skin"], line["bone"])


def test_a_doubtful_echo_looks_otherwise_and_says_why():
    sure, doubtful = a_line(a_live_line(), SETTINGS), a_line(a_live_line(accepted=False, reason="no contact"), SETTINGS)
    assert places(draw_a_line(sure), "line")[1]["stroke"] != places(draw_a_line(doubtful), "line")[1]["stroke"]
    assert "bone" not in doubtful["text"]
    lost = a_line(a_live_line(float("nan"), False, "no echo", float("nan")), SETTINGS)
    assert (lost["skin"], lost["bone"], lost["gate"]) == (None, None, None)
    assert places(draw_a_line(lost), "line") == []
    assert a_line(None, SETTINGS) is None


@pytest.mark.parametrize(("tilt_deg", "place"), [((0, 0), (50, 50)), ((5, 0), (65, 50)), ((0, 5), (50, 35)), ((40, 0), (95, 50))])
def test_the_bulls_eye_has_right_at_its_right_up_at_its_top_and_an_end(tilt_deg, place):
    aligned = tilt_deg == (0, 0)
    guide = SimpleNamespace(bulls_eye_deg=tilt_deg, aligned=aligned, on_target=True, distance_mm=1.0, angle_deg=max(tilt_deg))
    eye = bulls_eye(guide, None)
    spot = places(draw_bulls_eye(eye), "circle")[-1]
    assert (float(spot["cx"]), float(spot["cy"])) == pytest.approx(place)
    assert eye["good"] is aligned
    assert bulls_eye(guide, a_live_line(accepted=False))["good"] is False
    assert bulls_eye(None, None) is None


@pytest.mark.parametrize("count", [1, 9, 10, 17, 18])
def test_there_is_a_numbered_dot_a_point_inside_the_frame_and_none_over_another(count):
    svg = draw_points([PointState.TAKEN] * (count - 1) + [PointState.NOW])
    dots = np.array([[float(dot[key]) for key in ("cx", "cy", "r")] for dot in places(svg, "circle")])
    frame = ElementTree.fromstring(svg).attrib
    assert [one.text for one in ElementTree.fromstring(svg) if one.tag.endswith("text")] == [str(k + 1) for k in range(count)]
    assert len(dots) == count
    assert (dots[:, :2] - dots[:, 2:] > 0).all()
    assert (dots[:, :2] + dots[:, 2:] < [float(frame["width"]), float(frame["height"])]).all()
    gaps = np.linalg.norm(dots[:, None, :2] - dots[None, :, :2], axis=2) + 1e3 * np.eye(count)
    assert gaps.min() > 2 * dots[0, 2] + 2 or count == 1


def test_taken_asked_for_and_open_points_differ_by_more_than_their_colour():
    taken, now, still_open = places(draw_points([PointState.TAKEN, PointState.NOW, PointState.OPEN]), "circle")
    assert taken["fill"] != "none"
    assert now["fill"] == still_open["fill"] == "none"
    assert float(now["stroke-width"]) > float(still_open["stroke-width"])
    assert draw_points([]) is None


def test_nothing_is_drawn_outside_the_frame():
    path = a_line(a_live_line(), SETTINGS)["path"]
    heights = [float(piece.split()[1].split("V")[k]) for piece in path.split("M")[1:] for k in (0, 1)]
    assert min(heights) >= 0
    assert max(heights) <= HEIGHT
