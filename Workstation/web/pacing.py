"""Renders no more often than the machine can afford, so that devices and clicks are served between the pictures."""

from __future__ import annotations

import asyncio
import time
from functools import partial
from typing import Any

from trame_slicer.rca_view.rca_view_factory import RemoteViewFactory
from trame_slicer.views import ScheduledRenderStrategy, SliceView, ThreeDView, ViewType

from Workstation.web.view_frame import slice_frame, threed_frame

FASTEST_S = 1 / 25  # between two pictures of one view
SHARE = 0.4  # of the event loop's time, for the rendering of all views together


class RenderBudget:
    """How long the views take to render, and how long each has to wait before its next picture."""

    def __init__(self) -> None:
        self._lasted_s: dict[int, float] = {}
        self.muted = False  # requests are dropped: what changes now is not drawn

    def note(self, view: Any, seconds: float) -> None:
        """A view has rendered."""
        before = self._lasted_s.get(id(view), seconds)
        self._lasted_s[id(view)] = 0.7 * before + 0.3 * seconds

    @property
    def period_s(self) -> float:
        """Between two pictures of one view."""
        return max(FASTEST_S, sum(self._lasted_s.values()) / SHARE)


class PacedRendering(ScheduledRenderStrategy):
    """Gathers the requests of a period into one picture, made by the strategy given."""

    def __init__(self, inner: ScheduledRenderStrategy, budget: RenderBudget) -> None:
        super().__init__()
        self._inner, self._budget = inner, budget
        self._pending: asyncio.TimerHandle | None = None
        self._last_s = self._begun_s = 0.0

    def set_abstract_view(self, abstract_view: Any) -> None:
        """Whose pictures they are."""
        super().set_abstract_view(abstract_view)
        self._inner.set_abstract_view(abstract_view)
        window = abstract_view.render_window()
        window.AddObserver("StartEvent", self._begin)
        window.AddObserver("EndEvent", self._end)

    def schedule_render(self) -> None:
        """Ask for a picture, now or when the period is over."""
        if self._pending is not None or self._budget.muted:
            return
        try:
            loop = asyncio.get_running_loop()
        except RuntimeError:  # while the application is built there is nobody to look
            self._inner.schedule_render()
            return
        wait_s = max(0.0, self._last_s + self._budget.period_s - time.monotonic())
        self._pending = loop.call_later(wait_s, self._fire)

    def did_render(self) -> None:
        """A picture was made."""
        self._inner.did_render()

    def _fire(self) -> None:
        self._pending, self._last_s = None, time.monotonic()
        self._inner.schedule_render()

    def _begin(self, *_: Any) -> None:
        self._begun_s = time.monotonic()

    def _end(self, *_: Any) -> None:
        self._budget.note(self.abstract_view, time.monotonic() - self._begun_s)


def register_quiet_factories(view_manager: Any, server: Any, quality: int) -> None:
    """Views for the page that do not render while they are made, as nobody looks at them yet."""
    for kind, view_type, controls in (
        (SliceView, ViewType.SLICE_VIEW, slice_frame),
        (ThreeDView, ViewType.THREE_D_VIEW, threed_frame),
    ):
        quiet = partial(kind, scheduled_render_strategy=ScheduledRenderStrategy())
        view_manager.register_factory(
            RemoteViewFactory(
                server, quiet, view_type, populate_view_ui_f=controls, target_fps=30.0, blur_fps=10.0, interactive_quality=quality
            )
        )


def pace(views: list[Any]) -> RenderBudget:
    """Let all views share one budget; costly smoothing of edges is left out, as there is no graphics card to do it."""
    budget = RenderBudget()
    for view in views:
        view.render_window().SetMultiSamples(0)
        view.set_scheduled_render(PacedRendering(view._scheduled_render, budget))
    return budget
