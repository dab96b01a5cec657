"""Live drawings as plain numbers for the page's SVG: the A-line with gates and echo, the bull's-eye, the points taken."""

from __future__ import annotations

from typing import Any

import numpy as np
from CranioNavLib import scene

from Workstation.web import words

WIDTH, HEIGHT = 300, 76  # of the A-line's drawing
COLUMNS = 150
BULLS_EYE_DEG = 15.0  # at the rim


def a_line(logic: Any) -> dict[str, Any] | None:
    """The last RF line as an SVG path with skin, bone and the gate between least and greatest depth; None without one."""
    from ModuleUltrasoundLib.measurement.quality import reason_in_words

    live = logic.live()
    if live is None:
        return None
    samples, rate_hz, measured = live
    wanted = logic.parameters().read().echo_settings()
    speed = wanted.speed_of_sound_m_s
    skin_s = float(measured.skin_times_s[-1])
    begin_s, end_s = 0.0, len(samples) / rate_hz
    if np.isfinite(skin_s):  # the tissue, with something before and after
        end_s = min(end_s, skin_s + 2e-3 * (wanted.most_depth_mm + 4) / speed)
        begin_s = max(0.0, skin_s - 2e-3 * 4 / speed)
    part = np.asarray(samples[int(begin_s * rate_hz) : int(end_s * rate_hz)], dtype=float)
    if len(part) < COLUMNS:
        return None
    part = part - np.median(part)
    part = part / max(float(np.abs(part).max()), 1.0)
    bins = np.array_split(part, COLUMNS)
    place = np.linspace(0, WIDTH, COLUMNS)

    def x(time_s: float) -> float:
        return round(float((time_s - begin_s) / (end_s - begin_s)) * WIDTH, 1)

    middle, scale = HEIGHT / 2, HEIGHT / 2 - 4
    path = "".join(
        f"M{left:.1f} {middle - scale * piece.max():.1f}V{middle - scale * piece.min() + 0.6:.1f}"
        for left, piece in zip(place, bins, strict=True)
    )
    depth, accepted = float(measured.depths_mm[-1]), bool(measured.accepted[-1])
    found = np.isfinite(skin_s) and np.isfinite(depth)
    gate = (
        [x(skin_s + 2e-3 * mm / speed) for mm in (wanted.least_depth_mm, wanted.most_depth_mm)] if np.isfinite(skin_s) else None
    )
    reason = measured.reasons[-1] or words.NO_ECHO
    return {
        "path": path,
        "skin": x(skin_s) if np.isfinite(skin_s) else None,
        "bone": x(skin_s + 2e-3 * depth / speed) if found else None,
        "gate": gate,
        "accepted": accepted,
        "text": words.BONE_DEPTH.format(depth=depth) if found and accepted else reason_in_words(reason),
        "posed": reason != "pose missing",
    }


def bulls_eye(logic: Any) -> dict[str, Any] | None:
    """Where the probe's back end stands off the bone's normal, in a circle of radius 1; None without a guide."""
    guide, live = logic.guide(), logic.live()
    if guide is None:
        return None
    right, up = (float(value) / BULLS_EYE_DEG for value in guide.bulls_eye_deg)
    length = max(1.0, float(np.hypot(right, up)))
    return {
        "x": round(50 + 45 * right / length, 1),
        "y": round(50 - 45 * up / length, 1),
        "aligned": bool(guide.aligned),
        "good": bool(guide.on_target and guide.aligned and (live is None or live[2].accepted[-1])),
        "text": words.AT_POINT.format(distance=guide.distance_mm, angle=guide.angle_deg),
        "ring": round(45 * 2.0 / BULLS_EYE_DEG, 1),
    }


def progress(logic: Any) -> list[dict[str, Any]]:
    """One entry a planned point: taken, asked for, or open; none while a sweep is recorded, which asks for no point."""
    node = scene.find("ProtocolPoints")
    if node is None or logic.sweep is not None:
        return []
    if logic.recorded() is None and scene.find("SurfacePoints") is not None:
        return []  # palpated and measured
    taken, current = set(logic.taken()), logic.currentIndex()
    labels = [node.GetNthControlPointLabel(index) for index in range(node.GetNumberOfControlPoints())]
    return [
        {"label": label, "state": "taken" if label in taken else "now" if index == current else "open"}
        for index, label in enumerate(labels)
    ]


def drawings(logic: Any) -> dict[str, Any]:
    """All of them; `measured`: whether there are bone points and nothing is being recorded."""
    measured = logic.recorded() is None and scene.find("SurfacePoints") is not None
    return {"line": a_line(logic), "eye": bulls_eye(logic), "points": progress(logic), "measured": measured}
