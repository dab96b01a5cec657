"""Paints the views in rounds, no more often than machine and windows can afford; devices and clicks are served in between."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from slicer import vtkMRMLLayerDisplayableManager
from trame_slicer.rca_view.rca_view_factory import RemoteViewFactory
from trame_slicer.views import ScheduledRenderStrategy, SliceView, ThreeDView, ViewType
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkImageData

from Workstation.web.pictures import Pictures, encoded
from Workstation.web.view_frame import SliceSliders, slice_frame, threed_frame

FASTEST_S = 1 / 25  # between two rounds; what is left of the machine is the browser's
PATIENCE_S = 0.15  # with a view whose last picture is on its way to the screen
LOG = logging.getLogger(__name__)


class Painter:
    """Paints in rounds: what is new is brought into the scene, then each view that has asked for it is painted once."""

    def __init__(self, pictures: Pictures) -> None:
        self.muted = False  # requests are dropped: what changes now is not drawn
        self.moving = False  # requests come from tools that move; all else stands still
        self.late_s = 0.0  # how long after it could have begun a round begins, on average of the last ones
        self.before_round: Callable[[], None] = bool
        self.pictures = pictures
        pictures.freed = self.wake
        self._wanted: dict[str, PacedRendering] = {}
        self._known: dict[str, PacedRendering] = {}  # all that ever asked
        self._asked_s = 0.0  # the first of the requests that wait
        self._news: asyncio.Event | None = None

    @contextmanager
    def while_moving(self) -> Iterator[None]:
        """Requests within come from tools that move: views that keep a picture of what stands still may use it."""
        self.moving = True
        try:
            yield
        finally:
            self.moving = False

    def ask(self, name: str, view: PacedRendering) -> None:
        """A view wants to be painted."""
        if not self._wanted:
            self._asked_s = time.monotonic()
        self._wanted[name] = self._known[name] = view
        self.pictures.outdated(name)
        self.wake()

    @property
    def waits(self) -> bool:
        """Whether a round is to come: it will bring in what is new by itself."""
        return bool(self._wanted)

    def wake(self) -> None:
        """Something may have become possible."""
        if self._news is not None:
            self._news.set()

    async def run(self, **_: Any) -> None:
        """Paint for ever. In the server's event loop."""
        self._news = asyncio.Event()
        next_s = 0.0
        while True:
            self._news.clear()
            if not self._ready() or self._soon():
                with suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(self._news.wait(), PATIENCE_S)
                continue
            await asyncio.sleep(max(0.0, next_s - time.monotonic()))
            begun_s = time.monotonic()
            self.late_s += 0.1 * (min(begun_s - max(self._asked_s, next_s), PATIENCE_S) - self.late_s)
            next_s = begun_s + FASTEST_S
            self._attempt(self.before_round)
            for name in self._ready():
                self._attempt(self._wanted.pop(name).paint)
                await asyncio.sleep(0)  # whatever has come meanwhile is served now

    def _ready(self) -> list[str]:
        """Views that want a picture which could go out at once; the quickest first, as the others wait for it."""
        ready = [name for name, view in self._wanted.items() if self._takes(view)]
        return sorted(ready, key=lambda name: self._wanted[name].takes_s)

    def _takes(self, view: PacedRendering) -> bool:
        return self.pictures.takes(view.name)

    def _soon(self) -> bool:
        """Whether a view that was painted just now will take another picture in a moment: then all are painted together."""
        now_s = time.monotonic()
        return any(now_s < view.painted_s + PATIENCE_S and not self._takes(view) for view in self._known.values())

    def _attempt(self, what: Callable[[], None]) -> None:
        try:
            what()
        except Exception:  # one view's defect must not stop the others
            LOG.exception("a view could not be painted")


class WindowPicture:
    """The picture of a render window, drawn anew each time."""

    def __init__(self, window: Any) -> None:
        self._window = window

    def draw(self) -> Any:
        """Pixels (height, width, 3) from the bottom up; nobody else writes into them."""
        self._window.Render()
        return pixels_of(self._window)

    def forget(self) -> None:
        """Nothing is kept."""


class PacedRendering(ScheduledRenderStrategy):  # type: ignore[misc]
    """A view's requests go to the painter; `source` draws its picture, which is encoded and on its way before the next one.

    It is encoded here and not in a thread: that one would have to wait until the next view has been drawn.
    """

    def __init__(self, name: str, source: Any, painter: Painter, quality: int) -> None:
        super().__init__()
        self.source, self.painted_s, self.takes_s = source, 0.0, 0.0
        self.name, self._painter, self._quality = name, painter, quality

    def schedule_render(self) -> None:
        """Ask for a picture."""
        if self._painter.muted:
            return
        if not self._painter.moving:
            self.source.forget()
        self._painter.ask(self.name, self)

    def paint(self) -> None:
        """Draw, encode, and offer to the windows. In the event loop."""
        picture, self.painted_s = self._painter.pictures.begun(self.name), time.monotonic()
        picture.content = encoded(self.source.draw(), self._quality)
        self._painter.pictures.offer(picture)
        self.takes_s += 0.1 * (time.monotonic() - self.painted_s - self.takes_s)  # on average of the last ones


def pixels_of(window: Any) -> Any:
    """What a window shows, (height, width, 3) from the bottom up."""
    image = vtkImageData()  # a new one each time, so that it may be encoded while the next is drawn
    vtkMRMLLayerDisplayableManager.RenderWindowBufferToImage(window, image)
    width, height, _ = image.GetDimensions()
    return vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width, 3)


def register_quiet_factories(view_manager: Any, server: Any, sliders: SliceSliders) -> list[Any]:
    """Views for the page that do not render while they are made, as nobody looks at them yet. Returns slices' and 3-D's."""
    factories = []
    for kind, view_type, controls in (
        (SliceView, ViewType.SLICE_VIEW, partial(slice_frame, sliders)),
        (ThreeDView, ViewType.THREE_D_VIEW, threed_frame),
    ):
        quiet = partial(kind, scheduled_render_strategy=ScheduledRenderStrategy())
        factories.append(RemoteViewFactory(server, quiet, view_type, populate_view_ui_f=controls))
        view_manager.register_factory(factories[-1])
    return factories


def pace(view: Any, area: str, painter: Painter, quality: int, source: Any = None) -> None:
    """Let the painter paint a view; costly smoothing of edges is left out, as there is no graphics card to do it."""
    window = view.render_window()
    window.SetMultiSamples(0)
    paced = PacedRendering(area, source or WindowPicture(window), painter, quality)
    view._scheduled_render._scheduler.schedule_render = paced.schedule_render  # asked when the page resizes the view
    view.set_scheduled_render(paced)
