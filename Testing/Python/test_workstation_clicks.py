"""The views under the user's hands: landmarks placed by click and by keys, taken back, layouts, grey windows, sounds."""

from __future__ import annotations

from pathlib import Path

import pytest

from Testing.Python import workstation_user as user_module

needs_browser = pytest.mark.skipif(not Path(user_module.BROWSER).exists(), reason="no Chromium on this machine")


def saved_landmarks(folder: Path) -> dict[str, tuple[float, ...]]:
    """What the session's folder holds, RAS."""
    from CranioNavLib.slicer_files import read_points

    points = read_points(folder / "landmarks-ct.mrk.json")
    return {label: tuple(round(float(value), 2) for value in place) for label, place in zip(points.labels, points.positions_mm)}


def wait_until_saved(user, folder: Path, wanted) -> dict[str, tuple[float, ...]]:
    """The landmarks in the folder once they are as wanted; saving follows a change within seconds."""
    for _ in range(120):
        if (folder / "landmarks-ct.mrk.json").is_file() and wanted(saved_landmarks(folder)):
            return saved_landmarks(folder)
        user.page.wait_for_timeout(500)
    raise AssertionError(f"the session holds {saved_landmarks(folder)}")


def click_in_view(user, which: int, right: float, down: float) -> None:
    """Click at a place of a view, given as shares of its width and height."""
    box = user.page.locator(".layout-grid-item").nth(which).bounding_box()
    user.page.mouse.move(box["x"] + right * box["width"], box["y"] + down * box["height"])
    user.page.wait_for_timeout(1500)  # as a hand does
    user.page.mouse.click(box["x"] + right * box["width"], box["y"] + down * box["height"])


@needs_browser
@pytest.mark.slow
def test_landmarks_are_placed_moved_and_taken_back_in_the_views(tmp_path):
    import numpy as np

    folder = tmp_path / "session"
    with user_module.served(folder, True) as (url, _), user_module.browsing() as user:
        user.open(url)
        user.press("ct", "layPatient")
        user.sees("ct", "simulated patient: synthetic head")
        user.next("ct")
        user.press("bone", "segmentBone")
        user.sees("bone", "on the outer table")
        planned = wait_until_saved(user, folder, lambda found: len(found) == 4)
        entry = user.page.locator("[data-panel=bone] [data-entry=Nasion]")

        entry.click()
        user.sees("bone", "Nasion: click on it in any view")
        user.page.wait_for_timeout(1500)
        click_in_view(user, 2, 0.5, 0.42)  # 3-D: on the forehead
        on_head = wait_until_saved(user, folder, lambda found: found["Nasion"] != planned["Nasion"])
        assert {name: on_head[name] for name in list(planned)[1:]} == {name: planned[name] for name in list(planned)[1:]}
        assert 2 < np.linalg.norm(np.subtract(on_head["Nasion"], planned["Nasion"])) < 150

        entry.click()
        user.page.wait_for_timeout(1500)
        click_in_view(user, 2, 0.03, 0.5)  # beside the head
        user.sees("bone", "not placed: the click missed the head")
        click_in_view(user, 0, 0.45, 0.5)  # still asked for: a click in a slice places it
        in_slice = wait_until_saved(user, folder, lambda found: found["Nasion"] != on_head["Nasion"])
        user.sees("bone", r"Nasion lies \d+ mm from skin and bone")  # in the head, where no landmark is
        user.page.locator("[data-step=bone] [title='needs attention']").wait_for()
        user.follow("bone", "moveToSurface")
        on_bone = wait_until_saved(user, folder, lambda found: found["Nasion"] != in_slice["Nasion"])
        user.page.locator("[data-step=bone] [title=done]").wait_for()
        user.page.keyboard.press("Control+z")
        assert wait_until_saved(user, folder, lambda found: found["Nasion"] != on_bone["Nasion"]) == in_slice

        user.page.keyboard.press("Control+z")
        assert wait_until_saved(user, folder, lambda found: found["Nasion"] != in_slice["Nasion"]) == on_head
        user.page.keyboard.press("Control+z")
        assert wait_until_saved(user, folder, lambda found: found["Nasion"] != on_head["Nasion"]) == planned

        user.page.keyboard.press("Delete")
        wait_until_saved(user, folder, lambda found: "Nasion" not in found)
        user.page.keyboard.press("Shift+ArrowUp")  # 10 mm to the front
        user.page.keyboard.press("ArrowLeft")  # 1 mm to the patient's right
        user.page.keyboard.press("p")
        by_keys = wait_until_saved(user, folder, lambda found: "Nasion" in found)
        np.testing.assert_allclose(by_keys["Nasion"], np.add(on_bone["Nasion"], (1, 10, 0)), atol=0.1)  # there the slices went

        head = user.page.locator(".layout-grid-item").nth(2)
        for key in ("l", "i", "+"):
            user.page.wait_for_timeout(1000)
            before = head.screenshot()
            user.page.keyboard.press(key)
            user.page.wait_for_timeout(1000)
            assert head.screenshot() != before, f"the head stands still after {key}"
        assert user.defects == []


@needs_browser
@pytest.mark.slow
def test_layouts_windows_sounds_and_help_by_keys(tmp_path):
    with user_module.served(tmp_path / "session", True) as (url, _), user_module.browsing() as user:
        user.open(url)
        page = user.page
        views = page.locator(".layout-grid-item")
        views.nth(3).wait_for()
        for key, count in (("3", 1), ("2", 4), ("6", 4), ("1", 4)):
            page.keyboard.press(key)
            page.wait_for_function("count => document.querySelectorAll('.layout-grid-item').length === count", arg=count)
            page.locator(f'[data-layouts] [data-key="{key}"].v-btn--active').wait_for()
        for shown in ("Brain", "Skin", "Bone"):
            page.keyboard.press("w")
            page.locator("[data-windows] .v-btn--active").filter(has_text=shown).wait_for()

        page.keyboard.press("?")
        page.get_by_text("Reset all views").wait_for()
        page.keyboard.press("Escape")
        page.get_by_text("Reset all views").wait_for(state="hidden")

        cue = page.locator("[data-cue]")
        path = page.locator("[data-panel=ct] [data-field=ct_path] input").first
        path.fill("/nowhere/ct.nrrd")
        path.press("Tab")
        user.press("ct", "loadCt")  # refused, and to be heard
        page.locator("[data-cue][data-played=refused]").wait_for(state="attached")
        page.keyboard.press("m")
        page.locator("[data-cue][data-muted=true]").wait_for(state="attached")
        page.reload()  # the choice is kept
        page.locator("[data-cue][data-muted=true]").wait_for(state="attached")
        before = cue.get_attribute("data-count")
        user.press("ct", "loadCt")
        page.wait_for_function("before => document.querySelector('[data-cue]').dataset.count !== before", arg=before)
        page.wait_for_timeout(300)
        assert cue.get_attribute("data-played") is None
        page.keyboard.press("n")
        page.locator("[data-panel=bone]").wait_for()
        assert page.locator("[data-panel]").count() == 1, "more is made than the open step"
        page.keyboard.press("b")
        page.locator("[data-panel=ct]").wait_for()
        assert user.defects == []


@needs_browser
@pytest.mark.slow
def test_one_click_after_typing_is_enough(tmp_path):
    with user_module.served(tmp_path / "session", True) as (url, _), user_module.browsing() as user:
        user.open(url)
        field = user.page.locator("[data-panel=ct] [data-field=ct_path] input")
        field.fill("nowhere.nrrd")
        field.press("Enter")
        user.press("ct", "loadCt")  # the field loses the focus in this very click
        user.sees("ct", "no CT at session/nowhere.nrrd")  # a bare name is looked for in the session
