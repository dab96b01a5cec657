"""Films the workstation doing a whole procedure with its simulated devices: docs/pictures/workstation.webp, about a minute.

    python docs/make_animation.py [-o FILE]

Everything in the pictures is the application itself, in a headless Chromium; waiting is left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import io
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
SIZE = (1024, 640)
LONG_S, SHORT_S = 1.6, 0.4  # how long a still picture is shown, and one of a movement
QUALITY = 55


class Film:
    """Pictures of a page with the time that each is shown; one that shows nothing new makes the last one last longer."""

    def __init__(self, page: Any) -> None:
        self._page = page
        self.pictures: list[Image.Image] = []
        self.seconds: list[float] = []
        self._last = b""

    def take(self, seconds: float = LONG_S) -> None:
        """One picture."""
        shot = self._page.screenshot(type="png")
        if shot == self._last:
            self.seconds[-1] += seconds
            return
        self._last = shot
        self.pictures.append(Image.open(io.BytesIO(shot)).convert("RGB").resize(SIZE, Image.Resampling.LANCZOS))
        self.seconds.append(seconds)

    def take_several(self, count: int, every_s: float) -> None:
        """Pictures of a movement."""
        for _ in range(count):
            begun = time.monotonic()
            self.take(SHORT_S)
            self._page.wait_for_timeout(max(0.0, 1000 * (every_s - (time.monotonic() - begun))))

    def save(self, path: Path) -> None:
        """As an animated WebP that repeats."""
        durations = [round(1000 * seconds) for seconds in self.seconds]
        self.pictures[0].save(
            path, save_all=True, append_images=self.pictures[1:], duration=durations, loop=0, quality=QUALITY, method=2
        )


def prepare(user: Any, film: Film) -> None:
    """CT, bone, devices, calibration."""
    film.take()
    user.press("ct", "layPatient")
    user.sees("ct", "simulated patient: ")
    user.page.wait_for_timeout(2000)
    film.take()
    user.next("ct")
    user.press("bone", "segmentBone")
    film.take(1.0)
    user.sees("bone", "on the outer table")
    user.page.wait_for_timeout(2500)
    film.take()
    user.next("bone")
    user.press("devices", "connect", 0)
    user.sees("devices", r"\d+ frames a second")
    user.press("devices", "connect", 1)
    user.sees("devices", r"[1-9]\d* lines")
    film.take_several(3, 1.0)
    user.next("devices")
    user.press("calibration", "pivotStylus")
    user.page.wait_for_timeout(2500)
    user.press("calibration", "startPivot")
    film.take_several(5, 1.5)
    user.sees("calibration", r"SD \d+\.\d+ mm")
    film.take()


def register(user: Any, film: Film) -> None:
    """Landmarks, then ultrasound."""
    user.next("calibration")
    film.take()
    user.digitise_landmarks()
    film.take()
    user.press("landmarks", "registerLandmarks")
    user.sees("landmarks", r"4 landmark pairs, FRE \d")
    user.page.wait_for_timeout(1500)
    film.take(2.0)
    user.next("landmarks")
    user.press("ultrasound", "planProtocol")
    user.sees("ultrasound", "18 points")
    user.press("ultrasound", "startRecording")
    user.press("ultrasound", "palpateAll")
    film.take_several(36, 2.0)
    user.sees("ultrasound", r"1[5-8] of 18 points")
    user.press("ultrasound", "stopRecording")
    user.sees("ultrasound", r"\d+ bone points from")
    film.take()
    user.press("ultrasound", "registerSurface")
    film.take(1.0)
    user.sees("ultrasound", "(accepted|warning) after")
    user.page.wait_for_timeout(2000)
    film.take(3.0)


def finish(user: Any, film: Film) -> None:
    """Verification, navigation, report."""
    user.next("ultrasound")
    user.press("verification", "measureTargets")
    user.press("verification", "verify")
    user.sees("verification", r"TRE \d+\.\d+ mm \(mean\)")
    user.page.wait_for_timeout(1500)
    film.take(3.0)
    user.next("verification")
    user.press("navigation", "tourTargets")
    user.sees("navigation", r"To the bone\s+\d+\.\d mm")
    film.take_several(24, 0.8)
    user.next("navigation")
    user.press("report", "writeReport")
    film.take(1.0)
    user.sees("report", "written; ")
    film.take(3.0)


def user_module() -> Any:
    """The tests' user of the workstation."""
    spec = importlib.util.spec_from_file_location("workstation_user", ROOT / "Testing" / "Python" / "workstation_user.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["workstation_user"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main() -> None:
    """Film, and say how long and how large it has become."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "pictures" / "workstation.webp")
    wanted = parser.parse_args()
    users = user_module()
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
