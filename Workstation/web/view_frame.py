"""What is written over each view by the page: its name, the sides of the patient, the slice's slider, the colour scale."""

from __future__ import annotations

from typing import Any

from trame.widgets import html
from trame_slicer.app.logic.slice_view_logic import get_view_slider_typed_state
from trame_slicer.app.ui.slider import Slider

from Workstation.web import words
from Workstation.web.pictures_view import draw_picture

PLACES = (
    "left: 8px; top: 50%; transform: translateY(-50%)",
    "right: 8px; top: 50%; transform: translateY(-50%)",
    "left: 50%; top: 4px; transform: translateX(-50%)",
    "left: 50%; bottom: 34px; transform: translateX(-50%)",
)
STYLE = """
.over { position: absolute; pointer-events: none; color: #e8eef2; text-shadow: 0 0 4px #000, 0 0 2px #000; font-size: 18px; }
.over-name { left: 8px; top: 4px; font-size: 15px; opacity: 0.85; }
.slice-slider * { transition: none !important; }
.legend { left: 12px; bottom: 10px; width: min(240px, 100% - 24px); font-size: 15px; }
.legend-bar { height: 12px; border: 1px solid #90a4ae; }
"""
LEGEND = """
<div>{{ legend.title }}</div>
<div class="legend-bar" :style="{ background: legend.gradient }"></div>
<div class="d-flex justify-space-between"><span v-for="one in legend.ticks" :key="one">{{ one }}</span></div>
<div v-if="legend.note">{{ legend.note }}</div>"""


class SliceSliders:
    """The slices' sliders, brought up to date now and then: each change of one redraws the page's text."""

    def __init__(self) -> None:
        self._states: list[tuple[Any, Any]] = []
        self._moved: set[int] = set()

    def state_of(self, server: Any, view: Any) -> Any:
        """The state of a new slider for a slice view."""
        state, index = get_view_slider_typed_state(server, view), len(self._states)
        self._states.append((view, state))
        view.modified.connect(lambda *_: self._moved.add(index))
        state.bind_changes({state.name.value: lambda value: self._move(view, state, value)})
        self._show(view, state)
        return state

    def refresh(self) -> None:
        """Show where the slices are now."""
        for index in self._moved:
            self._show(*self._states[index])
        self._moved.clear()

    def _show(self, view: Any, state: Any) -> None:
        with state.suppress_change_listeners():
            state.data.min_value, state.data.max_value = view.get_slice_range()
            state.data.step = view.get_slice_step()
            state.data.value = view.get_slice_value()

    def _move(self, view: Any, state: Any, value: float) -> None:
        with state.suppress_change_listeners():
            view.set_slice_value(value)


def slice_frame(sliders: SliceSliders, server: Any, view_id: str, view: Any) -> None:
    """Over a slice view."""
    name = view.get_orientation()
    draw_picture(view_id)
    html.Div(name, classes="over over-name")
    for side, place in zip(words.SIDES.get(name, ()), PLACES, strict=False):
        html.Div(side, classes="over", style=place)
    with html.Div(classes="slice-slider-gutter", style="position: absolute; bottom: 0; left: 0; width: 100%;"):
        Slider(classes="slice-slider", typed_state=sliders.state_of(server, view), theme="dark", dense=True)


def threed_frame(server: Any, view_id: str, view: Any) -> None:
    """Over a 3-D view."""
    draw_picture(view_id)
    html.Div(words.SOLID, classes="over over-name")
    html.Div(LEGEND, v_if="legend", classes="over legend", raw_attrs=["data-legend"])
