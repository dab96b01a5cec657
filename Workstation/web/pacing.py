"""Paints the views in turn, no more often than the machine can afford, so that devices and clicks are served in between."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from trame_slicer.rca_view.rca_view_factory import RemoteViewFactory
from trame_slicer.views import ScheduledRenderStrategy, SliceView, ThreeDView, ViewType

from Workstation.web.view_frame import slice_frame, threed_frame

FASTEST_S = 1 / 30  # between two pictures of one view
SHARE = 0.8  # of the event loop's time that painting may take while there is always something to paint
MOST_ENCODING = 2  # pictures of one view on their way; a further one would only be older when it arrives
LOG = logging.getLogger(__name__)


class Painter:
    """Paints the views that have asked for it, one at a time, the one that has waited longest first."""

    def __init__(self) -> None:
        self.muted = False  # requests are dropped: what changes now is not drawn
        self.moving = False  # requests come from tools that move; all else stands still
        self._wanted: dict[str, PacedRendering] = {}
        self._news: asyncio.Event | None = None

    @contextmanager
    def while_moving(self) -> Iterator[None]:
        """Requests within come from tools that move: views that keep a picture of what stands still may use it."""
        self.moving = True
        try:
            yield
        finally:
            self.moving = False

    def waits_for(self, names: frozenset[str]) -> bool:
        """Whether one of these views is still to be painted."""
        return not names.isdisjoint(self._wanted)

    def ask(self, name: str, view: PacedRendering) -> None:
        """A view wants to be painted."""
        self._wanted.setdefault(name, view)
        if self._news is not None:
            self._news.set()

    async def run(self, **_: Any) -> None:
        """Paint for ever. In the server's event loop."""
        self._news = asyncio.Event()
        while True:
            ready = [(view.last_s, name) for name, view in self._wanted.items() if view.can_take_one()]
            if not ready:
                self._news.clear()
                pause = FASTEST_S if self._wanted else None
                with suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(self._news.wait(), pause)
                continue
            last_s, name = min(ready)
            too_early_s = last_s + FASTEST_S - time.monotonic()
            if too_early_s > 0:
                await asyncio.sleep(too_early_s)
                continue  # another view may have been asked for that has waited longer
            await asyncio.sleep(self._paint(self._wanted.pop(name)))

    def _paint(self, view: PacedRendering) -> float:
        """Returns for how long to let others work."""
        begun = time.monotonic()
        try:
            view.paint()
        except Exception:  # one view's defect must not stop the others
            LOG.exception("a view could not be painted")
        return (time.monotonic() - begun) * (1 / SHARE - 1)


class PacedRendering(ScheduledRenderStrategy):  # type: ignore[misc]
    """A view's requests go to the painter; `scheduler` (trame-rca's) renders, encodes and sends one picture."""

    def __init__(self, name: str, scheduler: Any, painter: Painter, quality: int) -> None:
        super().__init__()
        self._name, self._scheduler, self._painter, self._quality = name, scheduler, painter, quality
        self.last_s = 0.0
        self.changed: Callable[[], None] = bool  # called when more than a moving tool has changed
        scheduler.schedule_render = self.schedule_render  # of its own accord it renders when the page resizes the view

    def draw_with(self, pictures: Any) -> None:
        """Let another object make the pictures (its `img_cols_rows`); it is told when more than a moving tool has changed."""
        self._scheduler._rca, self.changed = pictures, pictures.forget

    def schedule_render(self) -> None:
        """Ask for a picture."""
        if self._painter.muted:
            return
        if not self._painter.moving:
            self.changed()
        self._painter.ask(self._name, self)

    def can_take_one(self) -> bool:
        """Whether the pictures before are on their way."""
        return bool(self._scheduler._push_queue.qsize() < MOST_ENCODING)

    def paint(self) -> None:
        """Render, and have the picture encoded and sent."""
        self.last_s = time.monotonic()
        self._scheduler._render_frame(self._quality)


def register_quiet_factories(view_manager: Any, server: Any, quality: int) -> None:
    """Views for the page that do not render while they are made, as nobody looks at them yet."""
    for kind, view_type, controls in (
        (SliceView, ViewType.SLICE_VIEW, slice_frame),
        (ThreeDView, ViewType.THREE_D_VIEW, threed_frame),
    ):
        quiet = partial(kind, scheduled_render_strategy=ScheduledRenderStrategy())
        view_manager.register_factory(
            RemoteViewFactory(server, quiet, view_type, populate_view_ui_f=controls, interactive_quality=quality)
        )


def pace(views: list[Any], painter: Painter, quality: int) -> dict[str, PacedRendering]:
    """Let one painter paint all views; costly smoothing of edges is left out, as there is no graphics card to do it."""
    paced = {}
    for view in views:
        view.render_window().SetMultiSamples(0)
        name = view.get_view_node_id()
        paced[name] = PacedRendering(name, view._scheduled_render._scheduler, painter, quality)
        view.set_scheduled_render(paced[name])
    return paced
