"""The workstation without a mouse: the whole procedure by keys, with a focus that is always seen and never caught."""

from __future__ import annotations

from pathlib import Path

import pytest

from Testing.Python import workstation_user as user_module

needs_browser = pytest.mark.skipif(not Path(user_module.BROWSER).exists(), reason="no Chromium on this machine")

# What has the focus: null for the page itself, else its text and what is wrong with how it is seen.
FOCUS = """() => {
  const at = document.activeElement;
  if (!at || at === document.body || at.getAttribute('tabindex') === '-1') return null;
  const ringed = (one) => getComputedStyle(one).outlineStyle === 'solid' && parseFloat(getComputedStyle(one).outlineWidth) >= 3;
  const frame = at.closest('.v-field, .v-selection-control__input') || at, box = frame.getBoundingClientRect();
  const there = document.elementFromPoint(box.x + box.width / 2, box.y + Math.min(box.height / 2, 20));
  const wrong = [];
  if (!ringed(at) && !ringed(frame)) wrong.push('no ring');
  if (!there || !(frame.contains(there) || there.contains(frame))) wrong.push('not in sight');
  const label = at.querySelector('.v-btn__content');
  if (label && label.getBoundingClientRect().width > box.width) wrong.push('cut off');
  const name = at.innerText || at.getAttribute('aria-label') || at.title || (at.closest('[data-field]') || at).className;
  return { name: String(name).slice(0, 60), wrong, data: { ...at.dataset } };
}"""


class KeyUser:
    """Presses keys and looks; has no mouse."""

    def __init__(self, user) -> None:
        self.user, self.keyboard = user, user.page.keyboard

    def focus(self):
        return self.user.page.evaluate(FOCUS)

    def tab_to(self, **data: str) -> None:
        """Tab until the focus is on what carries this."""
        for _ in range(80):
            self.keyboard.press("Tab")
            found = self.focus()
            if found is not None and data.items() <= found["data"].items():
                return
        raise AssertionError(f"Tab does not reach {data}")

    def goes_round(self, step: str) -> int:
        """Tab through all there is, and see each; how many there are."""
        self.user.page.evaluate("document.activeElement.blur()")  # the end of a round: Tab leaves the page and comes back
        for seen in range(120):
            self.keyboard.press("Tab")
            found = self.focus()
            if found is None:
                return seen
            if found["wrong"]:  # a message that comes or goes moves what lies below it
                self.user.page.wait_for_timeout(1200)
                found = self.focus()
            assert not found["wrong"], f"step {step}: {found['name']!r}: {found['wrong']}"
        raise AssertionError(f"step {step}: Tab never comes round")

    def enter(self, step: str, offered: str) -> None:
        """Press Enter once this is the bright button."""
        self.user.page.locator(f"[data-panel={step}] [data-offer={offered}].v-btn--variant-flat").wait_for()
        self.keyboard.press("Enter")

    def next(self, step: str, following: str) -> None:
        """Press Enter once the bright button leads on."""
        self.user.page.locator(f"[data-panel={step}] [data-go=next].v-btn--variant-flat").wait_for()
        self.goes_round(step)
        self.user.page.evaluate("document.activeElement.blur()")
        self.keyboard.press("Enter")
        self.user.page.locator(f"[data-panel={following}]").wait_for()


def plan_by_keys(keys: KeyUser) -> None:
    """A landmark is chosen in the list, placed where the slices cross, noticed where it cannot lie, and moved to the bone."""
    keys.tab_to(entry="Nasion")
    keys.keyboard.press("ArrowDown")
    assert keys.focus()["data"]["entry"] == "Left frontozygomatic"
    keys.keyboard.press("Enter")
    keys.user.sees("bone", "Left frontozygomatic: click on it in any view")
    for key in ("Shift+ArrowDown", "Shift+ArrowLeft") * 3:  # 30 mm towards the back and the middle: into the head
        keys.keyboard.press(key)
    keys.keyboard.press("p")
    keys.user.sees("bone", r"Left frontozygomatic lies \d+ mm from skin and bone")
    keys.enter("bone", "moveToSurface")
    keys.user.sees("bone", r"Left frontozygomatic is moved by \d+ mm to the bone")
    for _ in range(2):
        keys.keyboard.press("Control+z")
    keys.keyboard.press("Escape")


def prepare_by_keys(keys: KeyUser) -> None:
    user = keys.user
    keys.tab_to(action="layPatient")
    keys.keyboard.press("Enter")
    user.sees("ct", "simulated patient: sample head")
    keys.next("ct", "bone")
    keys.enter("bone", "segmentBone")
    user.sees("bone", "on the outer table")
    plan_by_keys(keys)
    keys.next("bone", "devices")
    keys.enter("devices", "connect")
    user.sees("devices", r"\d+ frames a second")
    keys.enter("devices", "connect")
    user.sees("devices", r"[1-9]\d* lines")
    keys.next("devices", "calibration")
    keys.enter("calibration", "pivotStylus")
    user.sees("calibration", "the hand pivots")
    user.page.wait_for_timeout(2500)
    keys.enter("calibration", "startPivot")
    user.sees("calibration", r"SD \d+\.\d+ mm")
    keys.next("calibration", "landmarks")


def register_by_keys(keys: KeyUser) -> None:
    user = keys.user
    for number in range(4):
        asked = user.reading("landmarks", "nextPoint")
        keys.enter("landmarks", "touchNextLandmark")
        for _ in range(10):
            user.page.wait_for_timeout(2500)
            keys.keyboard.press("Space")
            user.page.wait_for_timeout(700)
            if user.reading("landmarks", "nextPoint") != asked:
                break
        assert user.reading("landmarks", "nextPoint") != asked, f"landmark {number + 1} is not read"
    keys.enter("landmarks", "registerLandmarks")
    user.sees("landmarks", r"4 landmark pairs, FRE \d")
    keys.next("landmarks", "ultrasound")
    for action, seen in (("planProtocol", "18 points"), ("startRecording", "recording into session")):
        keys.enter("ultrasound", action)
        user.sees("ultrasound", seen)
    keys.enter("ultrasound", "palpateAll")
    keys.enter("ultrasound", "stopRecording")
    user.sees("ultrasound", r"\d+ bone points from")
    keys.enter("ultrasound", "registerSurface")
    user.sees("ultrasound", "(accepted|warning): ")


@needs_browser
@pytest.mark.slow
def test_the_whole_procedure_is_done_by_keys_alone(tmp_path):
    with user_module.served(tmp_path / "session") as (url, _), user_module.browsing() as user:
        keys = KeyUser(user)
        user.open(url)
        user.page.locator(".remote-controlled-area").nth(3).wait_for()
        assert keys.goes_round("ct") > 20
        prepare_by_keys(keys)
        register_by_keys(keys)
        keys.goes_round("ultrasound")
        keys.keyboard.press("n")
        keys.enter("verification", "measureTargets")
        keys.enter("verification", "verify")
        user.sees("verification", r"TRE \d+\.\d+ mm \(mean\)")
        keys.next("verification", "navigation")
        keys.tab_to(offer="tourTargets")
        keys.keyboard.press("Enter")
        user.sees("navigation", r"To the bone\s+\d+\.\d mm")
        keys.goes_round("navigation")
        keys.keyboard.press("n")
        keys.enter("report", "writeReport")
        user.sees("report", "written; the registration from the files is the one on the screen")
        keys.goes_round("report")
        keys.tab_to(file="report.html")
        keys.keyboard.press("?")
        user.page.get_by_text("Press the bright button").wait_for()
        keys.keyboard.press("Escape")
        user.page.get_by_text("Press the bright button").wait_for(state="hidden")
        assert user.defects == []
