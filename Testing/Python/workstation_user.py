"""A user of the workstation, for the tests: a browser, clicks, and eyes."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_MS = 240_000  # a busy machine; nothing here is timed
BROWSER = "/usr/bin/chromium"
FLAGS = "--no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking --disable-component-update"


@contextmanager
def served(folder: Path, synthetic: bool = False, *arguments: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """`cranionav workstation` in a process of its own, and its address, which is the first line that it prints."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    if synthetic:
        environment["CRANIONAV_SIMULATED_HEAD"] = "synthetic"
    command = [sys.executable, "-m", "Workstation", "workstation", "--no-browser", "--case", str(folder), *arguments]
    with (
        (folder.parent / "workstation.log").open("w") as log,
        subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=log, text=True) as process,
    ):
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip(), process
        finally:
            process.send_signal(signal.SIGKILL)


class User:
    """Clicks what is named and waits for what is to be seen."""

    def __init__(self, page: Any, pictures: Path | None = None) -> None:
        self.page, self._pictures = page, pictures
        page.set_default_timeout(PATIENCE_MS)
        self.defects: list[str] = []
        page.on("pageerror", lambda error: self.defects.append(str(error)))

    def open(self, url: str) -> None:
        """Go to the page and wait until it can be used."""
        self.page.goto(url)
        self.page.locator("[data-step=ct]").wait_for()

    def step(self, name: str) -> None:
        """Open a step of the procedure."""
        self.page.locator(f"[data-step={name}]").click()

    def next(self, step: str) -> None:
        """Press the open step's way on."""
        self.page.locator(f"[data-panel={step}] [data-go=next]").click()

    def press(self, step: str, action: str, which: int = 0) -> None:
        """Press a button of a step once it can be pressed."""
        button = self.page.locator(f"[data-panel={step}] [data-action={action}]").nth(which)
        button.and_(self.page.locator(":not([disabled])")).click()

    def follow(self, step: str, action: str) -> None:
        """Press the bright button at the top of a step once it is that one."""
        self.page.locator(f"[data-panel={step}] [data-offer={action}]").click()

    def sees(self, step: str, text: str) -> str:
        """Wait until a text (a regular expression) stands in a step; the step's text."""
        self.page.locator(f"[data-panel={step}]").filter(has_text=re.compile(text)).wait_for()
        return str(self.page.locator(f"[data-panel={step}]").inner_text())

    def reading(self, step: str, name: str) -> str:
        """What a read-out shows."""
        return str(self.page.locator(f"[data-panel={step}] [data-reading={name}]").first.inner_text())

    def slices(self) -> list[str]:
        """Where the slices stand, by the sliders below them."""
        return [str(slider.get_attribute("aria-valuenow")) for slider in self.page.locator("[role=slider]").all()]

    def waits_until(self, holds: Callable[[], bool]) -> None:
        """Look again and again."""
        for _ in range(PATIENCE_MS // 500):
            if holds():
                return
            self.page.wait_for_timeout(500)
        raise AssertionError("waited in vain")

    def digitise_landmarks(self) -> None:
        """Let the simulated hand touch each landmark and read it, as the screen says."""
        for number in range(4):
            asked = self.reading("landmarks", "nextPoint")
            self.press("landmarks", "touchNextLandmark")
            for _ in range(10):  # a hand on its way is refused, in words; then one tries again
                self.page.wait_for_timeout(2500)
                self.press("landmarks", "digitise")
                self.page.wait_for_timeout(700)
                if self.reading("landmarks", "nextPoint") != asked:
                    break
            assert self.reading("landmarks", "nextPoint") != asked, f"landmark {number + 1} is not read"

    def picture(self, name: str) -> None:
        """Keep pictures of the page in the two sizes that it has to fit."""
        if self._pictures is None:
            return
        for width, height in ((1920, 1080), (1280, 800)):
            self.page.set_viewport_size({"width": width, "height": height})
            self.page.wait_for_timeout(1500)
            self.page.screenshot(path=self._pictures / f"workstation-{name}-{width}x{height}.png")


@contextmanager
def browsing(pictures: Path | None = None) -> Iterator[User]:
    """A user with a headless Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=FLAGS.split())
        try:
            yield User(browser.new_page(viewport={"width": 1280, "height": 800}), pictures)
        finally:
            browser.close()
