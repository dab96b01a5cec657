"""The page's SVG for the live drawings; numbers come from drawings.py through the state variable `live`."""

from __future__ import annotations

from ModuleUltrasoundLib.live_drawings import HEIGHT, WIDTH
from trame.widgets import html

from Workstation.web import words

GOOD, WARNING, BLUE = "#2fbf8f", "#f0b429", "#6cb8f0"
A_LINE = f"""
<svg viewBox="0 0 {WIDTH} {HEIGHT + 14}" width="100%" role="img" aria-label="{words.A_LINE}">
  <rect x="0" y="0" width="{WIDTH}" height="{HEIGHT}" fill="#10151b" rx="4"/>
  <rect v-if="live.line.gate" :x="live.line.gate[0]" y="0" :width="Math.max(0, live.line.gate[1] - live.line.gate[0])"
    height="{HEIGHT}" fill="#1f2c3a"/>
  <path :d="live.line.path" stroke="{BLUE}" stroke-width="1.4" fill="none"/>
  <g v-if="live.line.skin !== null"><line :x1="live.line.skin" :x2="live.line.skin" y1="0" y2="{HEIGHT}" stroke="#cfd8dc"
    stroke-dasharray="3 3"/><text :x="live.line.skin + 3" y="11" fill="#cfd8dc" font-size="11">{words.SKIN}</text></g>
  <g v-if="live.line.bone !== null"><line :x1="live.line.bone" :x2="live.line.bone" y1="0" y2="{HEIGHT}"
    :stroke="live.line.accepted ? '{GOOD}' : '{WARNING}'" stroke-width="2"/>
    <text :x="live.line.bone + 3" y="{HEIGHT - 4}" font-size="11"
    :fill="live.line.accepted ? '{GOOD}' : '{WARNING}'">{words.BONE}{{{{ live.line.accepted ? '' : '?' }}}}</text></g>
  <text x="0" y="{HEIGHT + 12}" fill="#b0bec5" font-size="11">{words.A_LINE_HINT}</text>
</svg>"""
BULLS_EYE = f"""
<svg viewBox="0 0 100 100" width="96" role="img" aria-label="{words.TILT_OF_PROBE}">
  <circle cx="50" cy="50" r="46" fill="#10151b" stroke="#546e7a"/>
  <circle cx="50" cy="50" r="23" fill="none" stroke="#37474f"/>
  <circle cx="50" cy="50" :r="live.eye.ring" fill="none" stroke="{GOOD}" stroke-width="2"/>
  <line x1="50" y1="4" x2="50" y2="96" stroke="#37474f"/><line x1="4" y1="50" x2="96" y2="50" stroke="#37474f"/>
  <circle :cx="live.eye.x" :cy="live.eye.y" r="5" :fill="live.eye.aligned ? '{GOOD}' : '{WARNING}'"/>
</svg>"""
DOTS = """
<div class="d-flex flex-wrap" style="gap: 6px">
  <div v-for="(one, index) in live.points" :key="index" :title="one.label" :class="'dot dot-' + one.state">{{ index + 1 }}</div>
</div>"""
STYLE = f"""
.dot {{ width: 27px; height: 27px; border-radius: 50%; text-align: center; line-height: 23px; font-size: 13px;
  border: 2px solid #546e7a; }}
.dot-taken {{ background: {GOOD}; border-color: {GOOD}; color: #06251b; font-weight: 700; }}
.dot-now {{ border-color: {WARNING}; color: {WARNING}; font-weight: 700; }}
"""


def draw_live(step: str) -> None:
    """The drawings that belong to a step of the procedure, in the current trame context."""
    if step not in ("devices", "ultrasound"):
        return
    # while a recording has been measured and none runs, the line says nothing that is needed
    wanted = "live.line" + (" && !live.measured" if step == "ultrasound" else "")
    with html.Div(classes="in-sight mb-3", raw_attrs=['data-drawing="live"']):
        if step == "ultrasound":
            html.Div(DOTS, v_if="live.points.length", classes="mb-2")
            with html.Div(v_if="live.eye", classes="d-flex align-center mb-2", style="gap: 12px"):
                html.Div(BULLS_EYE)
                html.Div("{{ (live.eye.good ? '✓ ' : '! ') + live.eye.text }}", classes="text-h6")
        html.Div(A_LINE, v_if=wanted)
        said = wanted + (" && live.line.posed" if step == "devices" else "")  # the probe need not be in view yet
        html.Div("{{ (live.line.accepted ? '' : '! ') + live.line.text }}", v_if=said, classes="text-h6")
