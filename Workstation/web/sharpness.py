"""Slices that follow a tool get fewer pixels where the machine has no time for all; once nothing moves they get all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

STEPS = (1.0, 0.85, 0.7, 0.6, 0.5)  # share of the view's pixels, each way
SLOW_S, QUICK_S = 0.007, 0.0015  # how late rounds begin on average: fewer pixels are needed, more may be possible
SETTLING_S = 1.5  # after a change, before the next one is thought of
ENOUGH = 45_000  # pixels of a view; with fewer there is little to be gained
FIRST_TRIAL_S, LAST_TRIAL_S = 10.0, 160.0  # until more pixels are tried again; twice as long each time that it was in vain


class Sharpness:
    """Decides how sharp the slices are. `apply` is given the share of the pixels, each way."""

    def __init__(self, apply: Callable[[float], None]) -> None:
        self._apply, self._applied = apply, 1.0
        self._step, self._trial_s = 0, FIRST_TRIAL_S
        self._changed_s, self._tried = 0.0, False  # whether the last change was a trial of more pixels

    def look(self, now_s: float, late_s: float, moving: bool) -> None:
        """Think it over; `late_s` is how late rounds of painting begin, `moving` whether the slices follow a tool that moves."""
        if moving and self._applied == STEPS[self._step] and now_s > self._changed_s + SETTLING_S:
            if late_s > SLOW_S and self._step < len(STEPS) - 1:
                if self._tried:
                    self._trial_s = min(2 * self._trial_s, LAST_TRIAL_S)
                self._step, self._changed_s, self._tried = self._step + 1, now_s, False
            elif late_s < QUICK_S and self._step > 0 and now_s > self._changed_s + self._trial_s:
                self._step, self._changed_s, self._tried = self._step - 1, now_s, True
        wanted = STEPS[self._step] if moving else 1.0
        if wanted != self._applied:
            self._applied, self._changed_s = wanted, now_s
            self._apply(wanted)


def resize_slice(view: Any, adapter: Any, share: float) -> None:
    """Give a slice view this share of the pixels that it has on the page, each way (trame-rca's adapter); it shows the same."""
    node, now = view.get_view_node(), view.render_window().GetSize()
    pixels = now[0] * now[1] / adapter.scale**2
    extent, middle = node.GetFieldOfView(), node.GetXYZOrigin()
    adapter.scale = min(1.0, max(share, (ENOUGH / max(pixels, 1)) ** 0.5))
    node.SetFieldOfView(*extent)
    node.SetXYZOrigin(*middle)
