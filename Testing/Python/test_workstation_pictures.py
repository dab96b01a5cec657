"""Pictures on their way to the windows: the newest or none, and a window is told how old what it shows has become."""

from __future__ import annotations

import asyncio
import io
import json
import re
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from Testing.Python import workstation_user as user_module
from Workstation.web.pictures import HEADER, MOST_ON_THEIR_WAY, PICTURES, Pictures, Viewer, encoded
from Workstation.web.pictures_view import SCRIPT


class Socket:
    """What a window gets."""

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.told: dict[str, float] = {}

    async def send_bytes(self, data: bytes) -> None:
        self.numbers.append(HEADER.unpack_from(data)[0])

    async def send_str(self, text: str) -> None:
        self.told = json.loads(text)


def while_sending(viewer: Viewer, deeds: Any) -> None:
    """Carry out `deeds()` while the viewer sends."""

    async def run() -> None:
        task = asyncio.create_task(viewer.send(lambda: ["axial"]))
        await deeds()
        task.cancel()

    asyncio.run(run())


def begun(pictures: Pictures, viewer: Viewer) -> None:
    viewer.offer(pictures.begun("axial"))


def test_a_window_that_has_not_drawn_gets_no_more_and_then_only_the_newest():
    pictures, viewer = Pictures(), Viewer(Socket())

    async def deeds() -> None:
        for _ in range(9):
            begun(pictures, viewer)
            await asyncio.sleep(0.01)
        assert viewer._socket.numbers == list(range(1, MOST_ON_THEIR_WAY + 1))
        assert not viewer.takes("axial")
        viewer.drew("axial", 1)
        await asyncio.sleep(0.01)
        assert viewer._socket.numbers[MOST_ON_THEIR_WAY:] == [9]

    while_sending(viewer, deeds)


def test_a_picture_is_outdated_since_its_view_was_asked_for_another_one():
    pictures, viewer = Pictures(), Viewer(Socket())
    viewer._joined_s -= 3.0
    assert abs(viewer.behind_s("axial", time.monotonic()) - 3.0) < 0.1  # nothing shown yet

    async def deeds() -> None:
        begun(pictures, viewer)
        await asyncio.sleep(0.01)
        viewer.drew("axial", 1)
        now_s = time.monotonic()
        assert viewer.behind_s("axial", now_s) == 0.0
        pictures.outdated("axial")
        pictures.outdated("axial")
        assert abs(viewer.behind_s("axial", now_s + 2.0) - 2.0) < 0.1
        begun(pictures, viewer)  # painted, but not drawn yet
        await asyncio.sleep(0.01)
        assert viewer.behind_s("axial", now_s + 2.0) > 1.9
        viewer.drew("axial", 2)
        assert viewer.behind_s("axial", now_s + 2.0) == 0.0

    while_sending(viewer, deeds)


def test_the_window_is_told_how_old_its_pictures_are_though_none_can_be_painted():
    pictures, viewer = Pictures(), Viewer(Socket())

    async def deeds() -> None:
        begun(pictures, viewer)
        await asyncio.sleep(0.01)
        viewer.drew("axial", 1)
        pictures.outdated("axial")
        await asyncio.sleep(0.7)
        assert viewer._socket.told["axial"] > 0.3

    while_sending(viewer, deeds)


def test_a_window_that_closes_while_a_picture_is_on_its_way_is_let_go_quietly():
    class Closed(Socket):
        async def send_bytes(self, data: bytes) -> None:
            raise ConnectionResetError("Cannot write to closing transport")

    pictures, viewer = Pictures(), Viewer(Closed())

    async def deeds() -> None:
        sending = asyncio.create_task(viewer.send(lambda: ["axial"]))
        begun(pictures, viewer)
        await asyncio.wait_for(sending, 2)  # it ends, and with no error

    asyncio.run(deeds())


def test_a_picture_is_encoded_the_right_way_up():
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:20] = (255, 0, 0)  # the lower half, as rows go from the bottom up
    picture = np.asarray(Image.open(io.BytesIO(encoded(pixels, 90))))
    assert picture.shape == (40, 60, 3)
    assert picture[30, 30, 0] > 200
    assert picture[10, 30].max() < 50


PAGE = """<!doctype html><div class="view"><canvas data-picture="axial" style="width: 120px; height: 80px"></canvas>
<div data-behind="axial" style="display: none"></div></div><script>{script}</script>"""


class Room:
    """The pictures' side of the workstation, with an event loop in a thread of its own, and a page with one view."""

    def __init__(self) -> None:
        self.pictures, self.loop, self.url = Pictures(), asyncio.new_event_loop(), ""
        self._thread = threading.Thread(target=self.loop.run_forever, daemon=True)

    def __enter__(self) -> Room:
        self._thread.start()
        self.url = asyncio.run_coroutine_threadsafe(self._serve(), self.loop).result(20)
        return self

    def __exit__(self, *_: object) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()

    async def _serve(self) -> str:
        from aiohttp import web

        application = web.Application()
        application.router.add_get(f"/{PICTURES}", self.pictures.serve)
        application.router.add_get("/", self._page)
        runner = web.AppRunner(application)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        return f"http://127.0.0.1:{runner.addresses[0][1]}/"

    async def _page(self, _: Any) -> Any:
        from aiohttp import web

        return web.Response(text=PAGE.format(script=SCRIPT), content_type="text/html")

    def does(self, what: Any) -> None:
        self.loop.call_soon_threadsafe(what)

    def paint(self, level: int) -> None:
        """A grey picture of the view."""

        def offer() -> None:
            picture = self.pictures.begun("axial")
            picture.content = encoded(np.full((40, 60, 3), level, np.uint8), 90)
            self.pictures.offer(picture)

        self.does(offer)


@pytest.mark.skipif(not Path(user_module.BROWSER).exists(), reason="no Chromium on this machine")
def test_a_view_says_that_its_picture_is_old_and_no_longer_when_it_is_not():
    grey = """() => {
      const copy = new OffscreenCanvas(60, 40).getContext('2d');
      copy.drawImage(document.querySelector('canvas'), 0, 0);
      return copy.getImageData(30, 20, 1, 1).data[0];
    }"""
    with Room() as room, user_module.browsing() as user:
        page, sign = user.page, user.page.locator("[data-behind]")
        page.goto(room.url)
        room.paint(200)
        page.wait_for_function(f"({grey})() > 190")
        assert not sign.is_visible()
        room.does(lambda: room.pictures.outdated("axial"))  # nobody paints
        sign.filter(has_text=re.compile(r"picture 0\.[6-9] s old")).wait_for()
        sign.filter(has_text=re.compile(r"picture 1\.\d s old")).wait_for()
        room.paint(100)
        page.wait_for_function(f"({grey})() < 110")
        sign.wait_for(state="hidden")
        room.does(lambda: time.sleep(2))  # the server is stuck, so that nobody knows whether there is more to be shown
        sign.filter(has_text=re.compile(r"picture [01]\.\d s old")).wait_for()
        sign.wait_for(state="hidden")
        page.evaluate("() => { window.view = document.querySelector('.view'); window.view.remove(); }")
        room.paint(50)  # another layout is open meanwhile
        page.wait_for_timeout(300)
        page.evaluate("() => document.body.append(window.view)")
        page.wait_for_function(f"({grey})() < 60")
        room.paint(150)  # it goes on being drawn
        page.wait_for_function(f"({grey})() > 140")
        assert user.defects == []
