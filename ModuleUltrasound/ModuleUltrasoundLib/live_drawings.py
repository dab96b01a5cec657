"""Live drawings: the A-line with gate, skin and echo, the bull's-eye of the tilt, the points taken, as numbers and as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import TYPE_CHECKING, Any, Optional

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from ModuleUltrasoundLib.measurement.measure import EchoSettings, LineMeasurements
    from ModuleUltrasoundLib.palpation.guidance import Guide

    Live = tuple[npt.NDArray[np.int16], float, LineMeasurements]  # samples, rate in Hz, what was measured with the last line

WIDTH, HEIGHT = 300, 76  # of the A-line's drawing
COLUMNS = 150
BULLS_EYE_DEG, RIM = 15.0, 45  # tilt at the rim, and the rim's radius in a drawing of 100 by 100
DOTS_A_ROW, DOT_PITCH, DOT_RADIUS = 9, WIDTH / 9, 12.5  # of the points of the protocol: two rows of nine
AROUND_MM = 4.0  # of tissue shown before the skin and below the deepest bone
GROUND, GATE, GOOD, WARNING, BLUE, PALE = "#10151b", "#1f2c3a", "#2fbf8f", "#f0b429", "#6cb8f0", "#cfd8dc"
DARK, GREY = "#06251b", "#90a4ae"


class PointState(str, Enum):
    """How far a point of the protocol is."""

    TAKEN = "taken"
    NOW = "now"  # asked for
    OPEN = "open"


# Of a dot: fill, stroke, its width, colour and weight of its number. Told apart without colour, too: full, thick ring, thin ring.
DOTS = {
    PointState.TAKEN: (GOOD, GOOD, 2, DARK, "bold"),
    PointState.NOW: ("none", WARNING, 4, WARNING, "bold"),
    PointState.OPEN: ("none", GREY, 1.5, PALE, "normal"),
}


def a_line(live: Optional[Live], settings: EchoSettings) -> Optional[dict[str, Any]]:
    """The last RF line as an SVG path with skin, bone and the gate between least and greatest depth; None without one."""
    from ModuleUltrasoundLib.measurement.quality import reason_in_words

    if live is None:
        return None
    samples, rate_hz, measured = live
    speed, skin_s = settings.speed_of_sound_m_s, float(measured.skin_times_s[-1])
    touches = bool(np.isfinite(skin_s))
    begin_s, end_s = 0.0, len(samples) / rate_hz
    if touches:  # the tissue, with something before and after
        end_s = min(end_s, skin_s + 2e-3 * (settings.most_depth_mm + AROUND_MM) / speed)
        begin_s = max(0.0, skin_s - 2e-3 * AROUND_MM / speed)
    path = _path(samples[int(begin_s * rate_hz) : int(end_s * rate_hz)])
    if path is None:
        return None

    def x(depth_mm: float) -> float:
        return round((skin_s + 2e-3 * depth_mm / speed - begin_s) / (end_s - begin_s) * WIDTH, 1)

    depth, accepted = float(measured.depths_mm[-1]), bool(measured.accepted[-1])
    found = touches and bool(np.isfinite(depth))
    reason = measured.reasons[-1] or "no echo"
    return {
        "path": path,
        "skin": x(0.0) if touches else None,
        "bone": x(depth) if found else None,
        "gate": [x(settings.least_depth_mm), x(settings.most_depth_mm)] if touches else None,
        "accepted": accepted,
        "text": f"bone {depth:.1f} mm deep" if found and accepted else reason_in_words(reason),
        "posed": reason != "pose missing",
    }


def _path(samples: npt.NDArray[np.int16]) -> Optional[str]:
    """From the least to the greatest value of each column; None where there are fewer samples than columns."""
    part = np.asarray(samples, dtype=float)
    if len(part) < COLUMNS:
        return None
    part = part - np.median(part)
    part = part / max(float(np.abs(part).max()), 1.0)
    first = np.arange(COLUMNS) * len(part) // COLUMNS  # sample of each column
    tops, bottoms = np.maximum.reduceat(part, first), np.minimum.reduceat(part, first)
    middle, scale = HEIGHT / 2, HEIGHT / 2 - 4
    return "".join(
        f"M{(k + 0.5) * WIDTH / COLUMNS:.1f} {middle - scale * top:.1f}V{middle - scale * bottom + 0.6:.1f}"
        for k, (top, bottom) in enumerate(zip(tops, bottoms))
    )


def bulls_eye(guide: Optional[Guide], live: Optional[Live]) -> Optional[dict[str, Any]]:
    """Where the probe's back end stands off the bone's normal, in a circle of radius 1; None without a guide."""
    from ModuleUltrasoundLib.palpation.guidance import DEFAULTS

    if guide is None:
        return None
    right, up = (float(value) / BULLS_EYE_DEG for value in guide.bulls_eye_deg)
    length = max(1.0, float(np.hypot(right, up)))
    return {
        "x": round(50 + RIM * right / length, 1),
        "y": round(50 - RIM * up / length, 1),
        "aligned": bool(guide.aligned),
        "good": bool(guide.on_target and guide.aligned and (live is None or live[2].accepted[-1])),
        "text": f"{guide.distance_mm:.0f} mm from the point, tilted by {guide.angle_deg:.0f}°",
        "ring": round(RIM * DEFAULTS.aligned_deg / BULLS_EYE_DEG, 1),
    }


def draw_a_line(line: dict[str, Any]) -> str:
    """What `a_line` gives, as SVG."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="{GROUND}"/>',
    ]
    if line["gate"]:
        first, last = line["gate"]
        parts.append(f'<rect x="{first}" width="{max(0.0, last - first):.1f}" height="{HEIGHT}" fill="{GATE}"/>')
    parts.append(f'<path d="{line["path"]}" stroke="{BLUE}" stroke-width="1.4" fill="none"/>')
    for place, color, dash in (
        (line["skin"], PALE, ' stroke-dasharray="3 3"'),
        (line["bone"], GOOD if line["accepted"] else WARNING, ' stroke-width="2"'),
    ):
        if place is not None:
            parts.append(f'<line x1="{place}" x2="{place}" y1="0" y2="{HEIGHT}" stroke="{color}"{dash}/>')
    return "".join([*parts, "</svg>"])


def draw_bulls_eye(eye: dict[str, Any]) -> str:
    """What `bulls_eye` gives, as SVG."""
    color = GOOD if eye["aligned"] else WARNING
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" width="140" height="140" viewBox="0 0 100 100">'
        f'<circle cx="50" cy="50" r="46" fill="{GROUND}" stroke="#546e7a"/>'
        f'<circle cx="50" cy="50" r="{eye["ring"]}" fill="none" stroke="{GOOD}" stroke-width="2"/>'
        '<path d="M50 4V96M4 50H96" stroke="#37474f"/>'
        f'<circle cx="{eye["x"]}" cy="{eye["y"]}" r="5" fill="{color}"/></svg>'
    )


def draw_points(states: Sequence[PointState]) -> Optional[str]:
    """The points of the protocol as numbered dots in rows of nine, as SVG; None without points."""
    if not states:
        return None
    height = DOT_PITCH * (1 + (len(states) - 1) // DOTS_A_ROW)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height:.1f}" viewBox="0 0 {WIDTH} {height:.1f}">',
        f'<rect width="{WIDTH}" height="{height:.1f}" fill="{GROUND}"/>',
    ]
    for index, state in enumerate(states):
        row, column = divmod(index, DOTS_A_ROW)
        x, y = (column + 0.5) * DOT_PITCH, (row + 0.5) * DOT_PITCH
        fill, stroke, width, ink, weight = DOTS[state]
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{DOT_RADIUS}" fill="{fill}" stroke="{stroke}" stroke-width="{width}"/>'
            f'<text x="{x:.1f}" y="{y + 4.5:.1f}" font-family="sans-serif" font-size="13" font-weight="{weight}" fill="{ink}" '
            f'text-anchor="middle">{index + 1}</text>'
        )
    return "".join([*parts, "</svg>"])
