"""Pictures on their way to the windows: the newest or none, and a window is told how old what it shows has become."""

from __future__ import annotations

import asyncio
import io
import json
import time
from typing import Any

import numpy as np
from PIL import Image

from Workstation.web.pictures import HEADER, MOST_ON_THEIR_WAY, Pictures, Viewer, encoded


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


def test_a_picture_is_encoded_the_right_way_up():
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:20] = (255, 0, 0)  # the lower half, as rows go from the bottom up
    picture = np.asarray(Image.open(io.BytesIO(encoded(pixels, 90))))
    assert picture.shape == (40, 60, 3)
    assert picture[30, 30, 0] > 200
    assert picture[10, 30].max() < 50
