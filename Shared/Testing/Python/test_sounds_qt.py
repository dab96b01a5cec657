"""The cues inside 3D Slicer: on its QSoundEffect, here a stand-in; on the computer's beep where that lacks or fails."""

from __future__ import annotations

import logging
import os
from types import SimpleNamespace

import numpy as np
import pytest

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
pytest.importorskip("PySide6.QtWidgets", exc_type=ImportError)

from CranioNavLib import host, panel_qt_widgets, scene_data, sounds_qt
from CranioNavLib.panel import Level
from CranioNavLib.slicer_files import LabelledPoints
from CranioNavLib.sounds import NEWS_S, sound_parameters, sounds_are_on
from CranioNavLib.sounds_qt import PITCHES_HZ, TICK_MS, Beeper, PanelSounds, SoundEffects, Source, best_instrument
from CranioNavLib.tones import CROSSING_S, CUES, PIECE_S
from ModuleUltrasoundLib.palpation.guidance import cue


class StandInEffect:
    """What is used of QSoundEffect."""

    made, loads, fails = [], True, False

    def __init__(self):
        self.plays, self.playing = 0, False
        StandInEffect.made.append(self)

    def setSource(self, url):
        self.name = url.fileName().partition(".")[0]

    def isLoaded(self):
        return StandInEffect.loads

    def isPlaying(self):
        return self.playing

    def play(self):
        if StandInEffect.fails:
            raise ValueError("no such slot")
        self.plays, self.playing = self.plays + 1, True

    def stop(self):
        self.playing = False


@pytest.fixture(autouse=True)
def qt():
    StandInEffect.made, StandInEffect.loads, StandInEffect.fails = [], True, False
    toolkit = panel_qt_widgets.toolkit()
    app = toolkit.QApplication.instance() or toolkit.QApplication([])
    host.scene().Clear(False)
    yield toolkit
    host.scene().Clear(False)
    app.processEvents()


def played():
    """How often each sound was played."""
    return {effect.name: effect.plays for effect in StandInEffect.made if effect.plays}


def steady_sounds():
    """Whether a piece of the steady tone is being played."""
    return any(effect.playing for effect in StandInEffect.made if effect.name.startswith("steady"))


# The instrument


@pytest.mark.parametrize("name", CUES)
def test_each_cue_has_a_sound_of_its_own(name):
    SoundEffects(StandInEffect).cue(name)
    assert played() == {name: 1}


@pytest.mark.parametrize("angle_deg", [25.0, 12.0, 6.0, 2.5])
def test_beeps_come_at_the_guides_rate_and_nearest_pitch(angle_deg):
    wanted, instrument = cue(angle_deg), SoundEffects(StandInEffect)
    for tick in range(round(10e3 / TICK_MS)):
        instrument.tilt(wanted.rate_hz, wanted.pitch_hz, 100.0 + tick * TICK_MS / 1000)
    ((name, count),) = played().items()
    assert count == pytest.approx(10 * wanted.rate_hz, abs=1.5)
    assert abs(np.log2(float(name.partition("-")[2]) / wanted.pitch_hz)) < 1.6 / 12, "within one and a half semitones"


def test_beeps_quicken_at_once_and_a_late_tick_brings_no_crowd():
    instrument = SoundEffects(StandInEffect)
    instrument.tilt(0.5, 311.0, 100.0)
    instrument.tilt(10.0, 880.0, 100.05)
    instrument.tilt(10.0, 880.0, 100.16)
    assert sum(played().values()) == 2
    instrument.tilt(10.0, 880.0, 103.0)
    instrument.tilt(10.0, 880.0, 103.01)
    assert sum(played().values()) == 3


def test_the_steady_tone_goes_on_while_it_is_told_and_would_end_by_itself():
    instrument = SoundEffects(StandInEffect)
    for tick in range(200):
        instrument.tilt(0.0, 880.0, 100.0 + 0.025 * tick)
    assert played() == {"steady-0": 3, "steady-1": 3}, "by turns, one every 0.9 s of 5 s"
    assert PIECE_S <= NEWS_S, "a window that hangs falls silent"
    assert CROSSING_S > 2 * TICK_MS / 1000
    instrument.tilt(0.0, 0.0, 105.0)
    assert not steady_sounds()
    instrument.tilt(6.0, 500.0, 105.1)
    instrument.tilt(0.0, 880.0, 105.2)
    assert steady_sounds()
    instrument.tilt(6.0, 500.0, 105.3)
    assert not steady_sounds()


def test_where_qt_has_no_sounds_one_line_says_so_and_cues_beep(monkeypatch, caplog):
    beeps = []
    monkeypatch.setattr(host, "sound_effect_class", lambda: None)
    monkeypatch.setattr(host, "beep", lambda: beeps.append(1))
    with caplog.at_level(logging.WARNING):
        instrument = best_instrument()
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "beep" in caplog.text
    instrument.cue("taken")
    instrument.tilt(5.0, 440.0, 1.0)
    assert beeps == [1]
    assert instrument.limits


def test_a_qt_that_is_not_what_it_should_be_ends_in_beeps_and_no_exception(monkeypatch, caplog):
    monkeypatch.setattr(host, "sound_effect_class", lambda: object)
    assert isinstance(best_instrument(), Beeper)
    assert len(caplog.records) == 1


def test_inside_the_application_its_own_sound_effect_is_asked_for(monkeypatch):
    import sys

    import slicer

    monkeypatch.setattr(slicer, "app", object(), raising=False)
    monkeypatch.setitem(sys.modules, "qt", SimpleNamespace(QSoundEffect=StandInEffect))
    assert host.sound_effect_class() is StandInEffect
    host.beep()  # this build has no QApplication for Python: silent, no exception
    monkeypatch.setitem(sys.modules, "qt", SimpleNamespace())
    assert host.sound_effect_class() is None


# What is listened to


class Listening:
    """Two panels, listened to by a clock that is set."""

    def __init__(self, make=lambda: SoundEffects(StandInEffect)):
        self.now_s, self.palpated, self.guide = 100.0, 0, None
        self.models = [SimpleNamespace(message=SimpleNamespace(level=Level.PLAIN)) for _ in range(2)]
        self.sounds = PanelSounds(make, lambda: self.now_s)
        self.sources = [
            Source(self.models[0], lambda: self.palpated, lambda: self.guide),
            Source(self.models[1], lambda: 0, lambda: None),
        ]
        for source in self.sources:
            self.sounds.join(source)
        self.go(0.2)

    def go(self, seconds):
        for _ in range(round(1000 * seconds / TICK_MS)):
            self.now_s += TICK_MS / 1000
            self.sounds.listen()


@pytest.fixture
def listening():
    one = Listening()
    yield one
    for source in one.sources:
        one.sounds.leave(source)


def guide_at(angle_deg):
    return SimpleNamespace(cue=cue(angle_deg), on_target=True)


def test_a_point_taken_a_refusal_and_a_lost_tool_are_each_heard_once(listening):
    assert played() == {}
    listening.palpated = 1
    listening.go(1.0)
    assert played() == {"taken": 1}
    scene_data.set_points("LandmarksPatient", LabelledPoints(("Nasion",), np.zeros((1, 3))))
    listening.go(1.0)
    assert played() == {"taken": 2}
    listening.models[1].message = SimpleNamespace(level=Level.BAD)
    listening.go(1.0)
    assert played() == {"taken": 2, "refused": 1}
    scene_data.set_pose("ProbeToReference", np.eye(4), "OK", 1.0)
    listening.go(1.0)
    scene_data.set_pose("ProbeToReference", None, "MISSING", 2.0)
    listening.go(1.0)
    assert played() == {"taken": 2, "refused": 1, "lost": 1}


def test_the_tilt_is_heard_while_it_is_known(listening):
    for _ in range(20):
        listening.guide = guide_at(8.0)
        listening.go(0.1)
    heard = sum(played().values())
    assert heard == pytest.approx(2 * cue(8.0).rate_hz, abs=2)
    listening.go(NEWS_S + 0.1)  # no line comes any more
    stopped = sum(played().values())
    listening.go(2.0)
    assert sum(played().values()) == stopped


def test_switched_off_nothing_is_heard_and_what_was_missed_is_not_made_up_for(listening):
    listening.guide = guide_at(0.5)
    listening.go(0.2)
    assert steady_sounds()
    sound_parameters().change(sounds=False)
    listening.palpated = 1
    listening.go(0.3)
    assert not steady_sounds()
    sound_parameters().change(sounds=True)
    listening.go(0.3)
    assert "taken" not in played()
    listening.palpated = 2
    listening.go(0.3)
    assert played()["taken"] == 1


def test_an_instrument_that_fails_is_put_away_with_one_line_and_no_exception(listening, monkeypatch, caplog):
    beeps = []
    monkeypatch.setattr(host, "beep", lambda: beeps.append(1))
    StandInEffect.fails = True
    for count in (1, 2, 3):
        listening.palpated = count
        listening.go(0.3)
    assert len(caplog.records) == 1
    assert len(beeps) == 2, "the first was lost with the instrument"


def test_sounds_that_never_load_are_beeps(listening, monkeypatch, caplog):
    monkeypatch.setattr(host, "beep", lambda: None)
    monkeypatch.setattr(sounds_qt, "LOADING_S", -1.0)
    StandInEffect.loads = False
    listening.palpated = 1
    listening.go(0.3)
    assert isinstance(listening.sounds.instrument, Beeper)
    assert "cannot load" in caplog.text


def test_a_panel_that_is_closed_is_heard_no_more(listening):
    listening.guide = guide_at(0.5)
    listening.go(0.2)
    for source in listening.sources:
        listening.sounds.leave(source)
    assert not steady_sounds()
    assert listening.sounds.instrument is None, "sounds must not outlive the application"
    listening.sounds.join(listening.sources[0])
    listening.go(0.2)
    assert isinstance(listening.sounds.instrument, SoundEffects)


# The modules' widgets


@pytest.fixture
def heard_by_all(monkeypatch):
    sounds = PanelSounds(lambda: SoundEffects(StandInEffect))
    monkeypatch.setattr(sounds_qt, "SOUNDS", sounds)
    return sounds


def test_the_modules_are_listened_to_together_until_they_are_unloaded(heard_by_all):
    widgets = [
        getattr(__import__(name), f"{name}Widget")() for name in ("ModuleTracking", "ModuleUltrasound", "ModuleRegistration")
    ]
    for widget in widgets:
        widget.setup()
    ultrasound = widgets[1]
    ultrasound.enter()
    ultrasound.logic._guide = guide_at(0.5)
    assert ultrasound.probeGuide() is ultrasound.logic.guide()
    ultrasound.exit()
    assert ultrasound.probeGuide() is None, "its panel is not shown"
    for widget in widgets:
        widget.cleanup()
    assert heard_by_all._sources == []


def test_the_switch_in_the_panel_reaches_the_scene_and_the_other_panels(heard_by_all):
    one, other = (__import__(name) for name in ("ModuleTracking", "ModuleRegistration"))
    widgets = [one.ModuleTrackingWidget(), other.ModuleRegistrationWidget()]
    for widget in widgets:
        widget.setup()
    switches = [widget.panel.sounds for widget in widgets]
    assert [switch.value() for switch in switches] == [True, True]
    switches[0].input.setChecked(False)
    assert not sounds_are_on()
    widgets[1].enter()
    assert switches[1].value() is False
    assert switches[1].input.text() == "Sounds"
    assert "lost tool" in switches[1].input.toolTip()
    for widget in widgets:
        widget.cleanup()


def test_the_switch_says_what_this_computer_cannot_play(monkeypatch):
    monkeypatch.setattr(sounds_qt, "SOUNDS", PanelSounds(Beeper))
    widget = __import__("ModuleUltrasound").ModuleUltrasoundWidget()
    widget.setup()
    assert widget.panel.sounds.input.toolTip().endswith(Beeper.limits)
    widget.cleanup()


def test_pitches_that_are_kept_ready_span_those_of_the_guide():
    assert PITCHES_HZ[0] == pytest.approx(cue(30.0).pitch_hz, rel=0.01)
    assert PITCHES_HZ[-1] == pytest.approx(cue(0.0).pitch_hz, rel=0.01)
