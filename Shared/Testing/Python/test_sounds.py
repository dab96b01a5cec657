"""When something is heard: one cue for what has happened since the last look, the gravest first."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from CranioNavLib import host, scene, scene_data
from CranioNavLib.panel import Level
from CranioNavLib.slicer_files import LabelledPoints, load_scene, save_scene
from CranioNavLib.sounds import Cues, Situation, TiltTone, situation, sound_parameters, sounds_are_on
from ModuleUltrasoundLib.palpation.guidance import cue


@pytest.fixture
def an_empty_scene():
    host.scene().Clear(False)
    yield host.scene()
    host.scene().Clear(False)


def heard(*moments: Situation) -> list[str]:
    cues = Cues()
    return [cue["name"] if (cue := cues.next(moment)) else "" for moment in moments]


def test_a_point_more_is_heard_and_a_loaded_list_is_not():
    assert heard(Situation(3), Situation(4), Situation(4), Situation(9), Situation(8)) == ["", "taken", "", "", ""]


def test_a_tool_that_leaves_is_heard_above_all():
    both = frozenset({"Stylus", "Probe"})
    assert heard(Situation(1, (), both), Situation(2, ("no",), frozenset({"Stylus"})))[-1] == "lost"
    assert heard(Situation(tools=frozenset()), Situation(tools=both))[-1] == ""


def test_the_same_refusal_is_heard_once_and_a_second_of_the_same_words_again():
    first, second = ["no"], ["no"]
    moments = [Situation(), Situation(refusals=(first,)), Situation(refusals=(first,)), Situation(refusals=(second,))]
    assert heard(*moments) == ["", "refused", "", "refused"]


def test_each_cue_has_a_number_of_its_own():
    cues = Cues()
    numbers = [cues.next(Situation(taken)) for taken in range(4)][1:]
    assert [one["count"] for one in numbers] == [1, 2, 3]


def guide_at(angle_deg: float, on_target: bool = True) -> SimpleNamespace:
    return SimpleNamespace(cue=cue(angle_deg), on_target=on_target)


def test_the_tilts_tone_is_the_guides_own_and_falls_silent_off_the_point():
    tone = TiltTone()
    told = [tone.next(guide_at(angle)) for angle in (15.0, 15.0, 5.0, 1.0)]
    assert [one["count"] for one in told] == [1, 2, 3, 4], "the page hears that the tilt is still known"
    assert told[0]["rate"] < told[2]["rate"]
    assert told[0]["pitch"] < told[2]["pitch"] < told[3]["pitch"]
    assert told[3]["rate"] == 0.0, "square: a steady tone"
    silent = {"rate": 0.0, "pitch": 0.0, "count": 0}
    assert tone.next(guide_at(1.0, on_target=False)) == tone.next(None) == silent


def test_a_guide_that_nothing_renews_is_no_news():
    """Lines have stopped: the last tilt must not be heard as one that stays."""
    tone, guide = TiltTone(), guide_at(5.0)
    assert tone.next(guide)["count"] == tone.next(guide)["count"] != tone.next(guide_at(5.0))["count"]


def test_sounds_are_on_until_somebody_switches_them_off_and_a_saved_scene_keeps_that(an_empty_scene, tmp_path):
    assert sounds_are_on()
    assert scene.find("Sounds") is None, "to ask makes no node"
    sound_parameters().change(sounds=False)
    save_scene(tmp_path / "s.mrb")
    an_empty_scene.Clear(False)
    assert sounds_are_on()
    load_scene(tmp_path / "s.mrb")
    assert not sounds_are_on()


def test_the_moment_is_what_the_scene_and_the_panels_say(an_empty_scene):
    refused, fine = SimpleNamespace(level=Level.BAD), SimpleNamespace(level=Level.GOOD)
    models = [SimpleNamespace(message=refused), SimpleNamespace(message=fine)]
    scene_data.set_points("ClampPins", LabelledPoints(("C1", "C2"), np.eye(2, 3)))
    scene_data.set_pose("StylusToReference", np.eye(4), "OK", 1.0)
    scene_data.set_pose("ProbeToReference", None, "MISSING", 1.0)
    now = situation(models, 3)
    assert (now.taken, now.refusals, now.tools) == (5, (refused,), frozenset({"Stylus"}))
