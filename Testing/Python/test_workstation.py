"""The workstation, used as a user does: clicks and eyes on the page, nothing called behind it."""

from __future__ import annotations

import json
import re
import signal
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from Testing.Python import workstation_user as user_module

browsing, served, User = user_module.browsing, user_module.served, user_module.User

needs_browser = pytest.mark.skipif(not Path(user_module.BROWSER).exists(), reason="no Chromium on this machine")


@pytest.fixture
def pictures() -> Path:
    folder = Path(__file__).resolve().parents[1] / "artefacts"
    folder.mkdir(exist_ok=True)
    return folder


def prepare(user):
    """CT, bone, devices and the stylus' tip."""
    user.press("ct", "layPatient")
    user.sees("ct", "simulated patient: sample head")
    user.picture("1-ct")
    user.next("ct")
    user.follow("bone", "segmentBone")
    user.sees("bone", "on the outer table")
    user.picture("2-bone")
    user.next("bone")
    user.follow("devices", "connect")
    user.sees("devices", r"\d+ frames a second")
    user.follow("devices", "connect")
    user.sees("devices", r"[1-9]\d* lines")
    user.picture("3-devices")
    user.next("devices")
    user.follow("calibration", "pivotStylus")
    user.sees("calibration", "the hand pivots")
    user.page.wait_for_timeout(2500)
    user.follow("calibration", "startPivot")
    user.sees("calibration", r"SD \d+\.\d+ mm")
    user.picture("4-calibration")
    user.next("calibration")


def register(user):
    """Landmarks and ultrasound points touched and registered."""
    user.digitise_landmarks()
    user.follow("landmarks", "registerLandmarks")
    user.sees("landmarks", r"4 landmark pairs, FRE \d")
    user.picture("5-landmarks")
    user.next("landmarks")
    user.follow("ultrasound", "planProtocol")
    user.sees("ultrasound", "18 points")
    user.follow("ultrasound", "startRecording")
    user.sees("ultrasound", "recording into session")
    user.follow("ultrasound", "palpateAll")
    user.page.wait_for_timeout(15_000)
    user.page.locator("[data-drawing=live] svg >> visible=true").first.wait_for()
    user.picture("6-ultrasound")
    user.sees("ultrasound", r"1[5-8] of 18 points")
    user.press("ultrasound", "stopRecording")
    user.sees("ultrasound", r"\d+ bone points from")
    user.follow("ultrasound", "registerSurface")
    user.sees("ultrasound", "(accepted|warning): ")
    user.picture("6-registered")
    user.next("ultrasound")


def verify_navigate_report(user):
    """What comes after the registration."""
    user.follow("verification", "measureTargets")
    user.follow("verification", "verify")
    said = user.sees("verification", r"TRE \d+\.\d+ mm \(mean\)")
    assert float(re.search(r"TRE (\d+\.\d+) mm \(mean\)", said).group(1)) < 2.0  # simulated; the chapter's worst mode: 2.78
    user.picture("7-verification")
    user.next("verification")
    before = user.slices()
    user.follow("navigation", "tourTargets")
    user.sees("navigation", r"To the bone\s+\d+\.\d mm")
    user.waits_until(lambda: all(now != then for now, then in zip(user.slices(), before, strict=True)))  # all follow the tip
    user.picture("8-navigation")
    user.next("navigation")
    user.follow("report", "writeReport")
    user.sees("report", "written; the registration from the files is the one on the screen")
    user.picture("9-report")


@needs_browser
@pytest.mark.slow
def test_the_whole_procedure_is_done_by_following_the_bright_button(tmp_path, pictures):
    folder = tmp_path / "session"
    with served(folder) as (url, _), browsing(pictures) as user:
        user.open(url)
        prepare(user)
        register(user)
        verify_navigate_report(user)
        with urllib.request.urlopen(f"{url}session/report.html") as report:
            assert b"<html" in report.read()
        assert str(tmp_path) not in user.page.content()
        assert user.defects == []
    written = {path.name for path in folder.iterdir()}
    assert {"ct.nrrd", "palpation.igs.mha", "report.html", "scene.mrb", "ReferenceToRas.tfm", "session.json"} <= written


@needs_browser
@pytest.mark.slow
def test_a_killed_session_goes_on_where_it_was(tmp_path):
    folder = tmp_path / "session"
    with browsing() as user:
        with served(folder, True) as (url, process):
            user.open(url)
            user.press("ct", "layPatient")
            user.sees("ct", "simulated patient: synthetic head")
            user.next("ct")
            user.press("bone", "segmentBone")
            user.sees("bone", "on the outer table")
            user.page.reload()  # what is shown is the server's: a reload loses nothing
            user.sees("bone", "on the outer table")
            while not (folder / "session.json").is_file() or not json.loads((folder / "session.json").read_text())["bone"]:
                user.page.wait_for_timeout(300)
            process.send_signal(signal.SIGKILL)
        with served(folder, True) as (url, _):
            user.open(url)
            user.press("ct", "resumeSession")
            user.sees("bone", "Done")
            assert user.page.locator("[data-step=ct] [title=done], [data-step=bone] [title=done]").count() == 2
            assert json.loads((folder / "session.json").read_text())["simulated_seed"] == 0


def test_other_pages_and_other_hosts_are_kept_out(tmp_path):
    with served(tmp_path / "session", True) as (url, _):
        assert urllib.request.urlopen(url).status == 200
        for headers in ({"Origin": "http://evil.example"}, {"Host": "evil.example"}):
            for address in (url, f"{url}pictures"):
                with pytest.raises(urllib.error.HTTPError, match="403"):
                    urllib.request.urlopen(urllib.request.Request(address, headers=headers))
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{url}session/report.html")
        with pytest.raises(urllib.error.HTTPError, match="40[34]"):
            urllib.request.urlopen(f"{url}session/..%2F..%2Fetc%2Fpasswd")


def test_another_interface_asks_for_the_token(tmp_path):
    with served(tmp_path / "session", True, "--host", "0.0.0.0") as (url, _):
        here = url.replace("0.0.0.0", "127.0.0.1")
        assert "token=" in here
        assert urllib.request.urlopen(here).status == 200
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(here.split("?")[0])
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(here.split("?")[0] + "?token=wrong")
