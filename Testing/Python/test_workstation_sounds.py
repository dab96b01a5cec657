"""What is heard: one cue for what has happened since the last look, the gravest first."""

from __future__ import annotations

import pytest

from Workstation.web.sounds import Cues, Situation, pitch_of


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
    numbers = [cues.next(Situation(tilt_deg=5.0)) for _ in range(4)][1:]
    assert [one["count"] for one in numbers] == [1, 2, 3]


def test_the_pitch_rises_towards_upright():
    pitches = [pitch_of(tilt) for tilt in (60, 20, 10, 5, 0)]
    assert pitches == sorted(pitches)
    assert pitch_of(0) == pytest.approx(2 * pitch_of(10))
    assert pitch_of(-10) == pitch_of(10)
