"""The views' pictures on their way to the browser windows: the newest or none, and how old what a window shows has become.

A window says when a picture is on its screen, and only then gets another one: nothing queues up that would be old on arrival,
and a slow window holds up no other. A picture is outdated from the moment at which its view was asked for another one.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
import time
from collections import defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

PICTURES = "pictures"  # address
MOST_ON_THEIR_WAY = 2  # pictures of one view to one window: the next is painted while the last is being drawn
BEAT_S = 0.2  # between two words on how old the pictures are
HEADER = struct.Struct("<IB")  # number, length of the view's name, which follows


@dataclass(eq=False)
class Picture:
    """One picture of a view."""

    area: str  # the view's name in the page
    number: int
    content: bytes = b""  # JPEG
    outdated_s: float | None = None  # since when (monotonic) the view should show something else

    def packed(self) -> bytes:
        """As the page takes it."""
        name = self.area.encode()
        return HEADER.pack(self.number, len(name)) + name + self.content


class Viewer:
    """A browser window that is shown pictures."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._pending: dict[str, Picture] = {}
        self._sent: dict[str, deque[Picture]] = defaultdict(deque)
        self._shown: dict[str, Picture] = {}
        self._joined_s = time.monotonic()
        self._news = asyncio.Event()

    def takes(self, area: str) -> bool:
        """Whether a new picture of a view would go out at once."""
        return area not in self._pending and len(self._sent[area]) < MOST_ON_THEIR_WAY

    def offer(self, picture: Picture) -> None:
        """A picture is ready; one of the same view that has not gone out yet never will."""
        self._pending[picture.area] = picture
        self._news.set()

    def drew(self, area: str, number: int) -> None:
        """The window has a picture on its screen."""
        sent = self._sent.get(area)
        while sent and sent[0].number <= number:
            self._shown[area] = sent.popleft()
        self._news.set()

    def behind_s(self, area: str, now_s: float) -> float:
        """For how long the view should have shown something else in this window."""
        shown = self._shown.get(area)
        since = self._joined_s if shown is None else shown.outdated_s
        return now_s - since if since is not None else 0.0

    async def send(self, areas: Callable[[], list[str]]) -> None:
        """Send what there is, and how old it is, until the window is gone."""
        with contextlib.suppress(ConnectionError):  # it closed while something was on its way
            await self._send(areas)

    async def _send(self, areas: Callable[[], list[str]]) -> None:
        told_s = 0.0
        while True:
            for area in [one for one in self._pending if len(self._sent[one]) < MOST_ON_THEIR_WAY]:
                picture = self._pending.pop(area)
                self._sent[area].append(picture)
                await self._socket.send_bytes(picture.packed())
            now_s = time.monotonic()
            if now_s >= told_s + BEAT_S:
                told_s = now_s
                await self._socket.send_str(json.dumps({area: round(self.behind_s(area, now_s), 2) for area in areas()}))
            self._news.clear()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._news.wait(), max(0.0, told_s + BEAT_S - now_s))


class Pictures:
    """Knows the newest picture of each view and who is to see it. In the event loop's thread."""

    def __init__(self) -> None:
        self.freed: Callable[[], None] = bool  # called when a window may take more
        self._viewers: set[Viewer] = set()
        self._newest: dict[str, Picture] = {}  # the one that shows the view as it was last painted
        self._ready: dict[str, Picture] = {}  # the last one that can be sent

    def takes(self, area: str) -> bool:
        """Whether any window could be sent a picture of a view at once."""
        return any(viewer.takes(area) for viewer in self._viewers)

    def outdated(self, area: str) -> None:
        """A view is to show something else from now on."""
        newest = self._newest.setdefault(area, Picture(area, 0))
        if newest.outdated_s is None:
            newest.outdated_s = time.monotonic()

    def begun(self, area: str) -> Picture:
        """A view is about to be painted: what changes from now on outdates the new picture."""
        before = self._newest.get(area)
        picture = self._newest[area] = Picture(area, before.number + 1 if before is not None else 1)
        return picture

    def offer(self, picture: Picture) -> None:
        """A picture is ready."""
        self._ready[picture.area] = picture
        for viewer in self._viewers:
            viewer.offer(picture)

    async def serve(self, request: Any) -> Any:
        """A window's websocket: pictures one way, the numbers of those drawn the other."""
        from aiohttp import web

        socket = web.WebSocketResponse(heartbeat=10, compress=False, max_msg_size=4096)
        await socket.prepare(request)
        viewer = Viewer(socket)
        for picture in self._ready.values():
            viewer.offer(picture)
        self._viewers.add(viewer)
        sending = asyncio.create_task(viewer.send(lambda: list(self._newest)))
        self.freed()
        try:
            async for message in socket:
                area, number = json.loads(message.data)
                viewer.drew(str(area), int(number))
                self.freed()
        except (TypeError, ValueError):
            await socket.close(message=b"expected the view and the number of a picture")
        finally:
            self._viewers.discard(viewer)
            sending.cancel()
        return socket


def encoded(pixels: npt.NDArray[np.uint8], quality: int) -> bytes:
    """JPEG of pixels (height, width, 3) from the bottom up. In any thread."""
    from io import BytesIO

    from PIL import Image

    height, width, _ = pixels.shape
    content = BytesIO()
    Image.frombuffer("RGB", (width, height), pixels, "raw", "RGB", 0, -1).save(content, "JPEG", quality=quality)
    return content.getvalue()
