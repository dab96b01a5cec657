"""Films the workstation doing a whole procedure with its simulated devices: docs/pictures/workstation.webp, about a minute.

    python docs/make_animation.py [-o FILE]

Everything in the pictures is the application itself, in a headless Chromium; waiting is left out.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Error

ROOT = Path(__file__).resolve().parents[1]
SIZE = (1024, 640)
LONG_S, SHORT_S = 1.5, 0.4  # how long a still picture is shown, and one of a movement
LONGEST_S = 240.0  # of a movement, on a busy machine
QUALITY = 55


class Film:
    """Pictures of a page with the time that each is shown; one that shows nothing new makes the last one last longer."""

    def __init__(self, page: Any) -> None:
        self._page = page
        self.pictures: list[Image.Image] = []
        self.seconds: list[float] = []
        self._last = b""

    def take(self, seconds: float = LONG_S, patience_s: float = 20.0) -> bool:
        """One picture, once the views are up to date; where they do not become so in time, as they are, and False."""
        until = time.monotonic() + patience_s
        while self._is_behind() and time.monotonic() < until:
            self._page.wait_for_timeout(20)
        shot = self._page.screenshot(type="png")
        if shot == self._last:
            self.seconds[-1] += seconds
            return True
        self._last = shot
        self.pictures.append(Image.open(io.BytesIO(shot)).convert("RGB").resize(SIZE, Image.Resampling.LANCZOS))
        self.seconds.append(seconds)
        return not self._is_behind()

    def _is_behind(self) -> bool:
        return bool(self._page.locator("[data-behind]:visible").count())

    def take_until(self, over: Callable[[], bool], every_s: float, most: int, seconds: float = SHORT_S) -> None:
        """Pictures of a movement until it is over; `most` of them are kept, evenly spread, if possible of the up-to-date ones."""
        first, begun, fresh = len(self.pictures), time.monotonic(), []
        while not over() and time.monotonic() < begun + LONGEST_S:
            if self.take(seconds, patience_s=2.0):
                fresh.append(len(self.pictures) - 1)
            self._page.wait_for_timeout(1000 * every_s)
        good = sorted(set(fresh)) if len(set(fresh)) >= most // 3 else list(range(first, len(self.pictures)))
        kept = sorted({good[round(i * (len(good) - 1) / (most - 1))] for i in range(most)})
        self.pictures[first:] = [self.pictures[i] for i in kept]
        self.seconds[first:] = [seconds for _ in kept]

    def save(self, path: Path) -> None:
        """As an animated WebP that repeats."""
        durations = [round(1000 * seconds) for seconds in self.seconds]
        self.pictures[0].save(
            path, save_all=True, append_images=self.pictures[1:], duration=durations, loop=0, quality=QUALITY, method=4
        )


def follow(user: Any, step: str, action: str) -> None:
    """Press the bright button of the open step once it is this one."""
    user.page.locator(f"[data-panel={step}] [data-offer={action}]").click()


def is_offered(user: Any, step: str, action: str) -> bool:
    """Whether that is the bright button now."""
    return bool(user.page.locator(f"[data-panel={step}] [data-offer={action}]").count())


def prepare(user: Any, film: Film) -> None:
    """CT, bone, devices, calibration."""
    film.take()
    user.press("ct", "layPatient")
    user.sees("ct", "Done")
    user.page.wait_for_timeout(2000)
    film.take(2.0)
    user.next("ct")
    film.take(1.0)
    follow(user, "bone", "segmentBone")
    user.sees("bone", "Done")
    user.page.wait_for_timeout(2500)
    film.take(2.0)
    user.next("bone")
    for _ in ("tracker", "probe"):
        film.take(1.0)
        follow(user, "devices", "connect")
        user.page.wait_for_timeout(2500)
    user.sees("devices", "Done")
    film.take(2.0)
    user.next("devices")
    film.take(1.0)
    follow(user, "calibration", "pivotStylus")
    user.page.wait_for_timeout(2500)
    follow(user, "calibration", "startPivot")
    film.take_until(lambda: "SD " in user.page.inner_text("[data-panel=calibration]"), 0.5, most=6)
    film.take()


def register(user: Any, film: Film) -> None:
    """Landmarks, then ultrasound."""
    user.next("calibration")
    film.take(1.0)
    while not is_offered(user, "landmarks", "registerLandmarks"):
        with contextlib.suppress(Error):  # the button may change under the mouse
            user.page.locator("[data-panel=landmarks] [data-offer]").first.click(timeout=2000)
        user.page.wait_for_timeout(1800)
        film.take(SHORT_S)
    film.take(1.0)
    follow(user, "landmarks", "registerLandmarks")
    user.sees("landmarks", "Done")
    user.page.wait_for_timeout(2500)
    film.take(2.5)
    user.next("landmarks")
    film.take(1.0)
    follow(user, "ultrasound", "planProtocol")
    follow(user, "ultrasound", "startRecording")
    follow(user, "ultrasound", "palpateAll")
    film.take_until(lambda: is_offered(user, "ultrasound", "stopRecording"), 0.8, most=34)
    film.take()
    follow(user, "ultrasound", "stopRecording")
    follow(user, "ultrasound", "registerSurface")
    user.sees("ultrasound", "Done")
    user.page.wait_for_timeout(3000)
    film.take(3.0)


def finish(user: Any, film: Film) -> None:
    """Verification, navigation, report."""
    user.next("ultrasound")
    film.take(1.0)
    follow(user, "verification", "measureTargets")
    follow(user, "verification", "verify")
    user.sees("verification", "Done")
    user.page.wait_for_timeout(2000)
    film.take(3.0)
    user.next("verification")
    follow(user, "navigation", "tourTargets")
    user.sees("navigation", r"To the bone\s+\d+\.\d mm")
    film.take_until(lambda: is_offered(user, "navigation", "tourTargets"), 0.4, most=26)
    user.next("navigation")
    film.take(1.0)
    follow(user, "report", "writeReport")
    user.sees("report", "Done")
    user.page.wait_for_timeout(1500)
    film.take(3.0)


def main() -> None:
    """Film, and say how long and how large it has become."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "pictures" / "workstation.webp")
    wanted = parser.parse_args()
    from Testing.Python import workstation_user as users

    with (
        tempfile.TemporaryDirectory() as scratch,
        users.served(Path(scratch) / "session") as (url, _),
        users.browsing() as user,
    ):
        user.open(url)
        user.page.wait_for_timeout(1500)
        film = Film(user.page)
        for part in (prepare, register, finish):
            part(user, film)
    film.save(wanted.output)
    megabytes = wanted.output.stat().st_size / 1e6
    print(f"{wanted.output.name}: {len(film.pictures)} pictures, {sum(film.seconds):.0f} s, {megabytes:.1f} MB")


if __name__ == "__main__":
    main()
