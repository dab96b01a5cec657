"""Plays the cues with Qt, for the panels inside 3D Slicer: what is heard, and when, is that of the web page."""

from __future__ import annotations

import logging
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from CranioNavLib import host
from CranioNavLib.panel_model import PanelModel
from CranioNavLib.panel_qt_widgets import Ticker, toolkit
from CranioNavLib.sounds import NEWS_S, Cues, TiltTone, situation, sounds_are_on
from CranioNavLib.tones import CROSSING_S, CUES, PIECE_S, beep_samples, cue_samples, steady_samples, write_wave

LOG = logging.getLogger(__name__)
TICK_MS = 25  # the quickest beeps of the tilt come every 83 ms
LOOK_S = 0.1  # how often the scene and the panels are looked at
PITCHES_HZ = tuple(311.0 * 2.0 ** (step / 4) for step in range(7))  # of beeps that are kept ready: minor thirds up to 880 Hz
STEADY_HZ = 880.0
LOADING_S = 5.0  # a sound that is not loaded by then never will be
REFUSED = (AttributeError, TypeError, ValueError, RuntimeError, OSError)  # what a Qt that lacks something raises from Python


class Instrument(Protocol):
    """What cues and tilt are played on."""

    limits: str  # what it cannot do, in words; "" if nothing

    def cue(self, name: str) -> None:
        """Play one of CUES."""

    def tilt(self, rate_hz: float, pitch_hz: float, now_s: float) -> None:
        """Called every `TICK_MS`: beeps a second (0: a steady tone), their pitch (0: silence), and the time."""


class Beeper:
    """All that is left where Qt has no sounds: the computer's own beep for every cue, and nothing for the tilt."""

    limits = "this Qt can only beep: cues sound alike, and the tilt is not heard"

    def cue(self, name: str) -> None:
        """Beep."""
        host.beep()

    def tilt(self, rate_hz: float, pitch_hz: float, now_s: float) -> None:
        """Nothing: a beep that sounds all the time would hide those that count."""


class SoundEffects:
    """Plays with QSoundEffect, of Qt Multimedia: 3D Slicer 5 has it, and so has PySide6 with its add-ons.

    Parameters
    ----------
    kind : type
        QSoundEffect.

    Raises
    ------
    REFUSED
        It is not what it should be.
    """

    limits = ""

    def __init__(self, kind: Any) -> None:
        self._kind, self._made_s = kind, time.monotonic()
        self._folder = tempfile.TemporaryDirectory(prefix="cranionav-sounds-")  # removed when the process ends
        self._cues = {name: self._effect(name, cue_samples(name)) for name in CUES}
        self._beeps = [self._effect(f"beep-{round(pitch)}", beep_samples(pitch)) for pitch in PITCHES_HZ]
        self._pieces = [self._effect(f"steady-{turn}", steady_samples(STEADY_HZ)) for turn in (0, 1)]  # played by turns
        self._next_s = 0.0  # when the next beep, or piece, is due
        self._steady = False

    def cue(self, name: str) -> None:
        """Play one of CUES."""
        effect = self._cues[name]
        if not effect.isLoaded() and time.monotonic() > self._made_s + LOADING_S:
            raise RuntimeError("Qt cannot load sounds")
        effect.play()

    def tilt(self, rate_hz: float, pitch_hz: float, now_s: float) -> None:
        """Beep when it is time to; the steady tone is played by pieces, so that it ends when this is not called any more."""
        steady = bool(pitch_hz) and not rate_hz
        if steady != self._steady or not pitch_hz:
            self._hush()
        self._steady = steady
        if not pitch_hz:
            return
        period_s = PIECE_S - CROSSING_S if steady else 1 / rate_hz
        self._next_s = min(self._next_s, now_s + period_s)
        if now_s < self._next_s:
            return
        (self._pieces[0] if steady else self._beeps[_nearest(pitch_hz)]).play()
        self._pieces.reverse()
        due_s = self._next_s + period_s  # keeps the rhythm where ticks come late
        self._next_s = due_s if due_s > now_s else now_s + period_s

    def _hush(self) -> None:
        """Silence now; what comes next begins at once."""
        self._next_s = 0.0
        for piece in self._pieces:
            if piece.isPlaying():
                piece.stop()

    def _effect(self, name: str, samples: Any) -> Any:
        path = Path(self._folder.name) / f"{name}.wav"
        write_wave(path, samples)
        effect = self._kind()
        effect.setSource(toolkit().QUrl.fromLocalFile(str(path)))
        return effect


def _nearest(pitch_hz: float) -> int:
    """Index of the pitch that is the fewest semitones away."""
    return min(range(len(PITCHES_HZ)), key=lambda index: abs(math.log(PITCHES_HZ[index] / pitch_hz)))


def best_instrument() -> Instrument:
    """QSoundEffect where this Qt has it, else the computer's beep, with one line in the log that says so."""
    kind = host.sound_effect_class()
    if kind is None:
        LOG.warning("no Qt Multimedia in this Qt: cues are the computer's beep, the probe's tilt is silent")
        return Beeper()
    try:
        return SoundEffects(kind)
    except REFUSED as error:
        LOG.warning("Qt Multimedia refuses (%s): cues are the computer's beep, the probe's tilt is silent", error)
        return Beeper()


@dataclass(frozen=True, eq=False)
class Source:
    """A module's panel as it is listened to."""

    model: PanelModel
    palpated: Callable[[], int]  # points taken in the recording under way
    guide: Callable[[], Any]  # where the probe stands, while the user looks at it; else None


class PanelSounds:
    """Listens to the panels of all modules: one for the process, for a tool that is lost is lost once."""

    def __init__(self, make: Callable[[], Instrument] = best_instrument, clock: Callable[[], float] = time.monotonic) -> None:
        self._make, self._clock = make, clock
        self.instrument: Instrument | None = None  # made when the first panel joins
        self._sources: list[Source] = []
        self._ticker: Ticker | None = None
        self._cues, self._tilt = Cues(), TiltTone()
        self._tone, self._tone_s = self._tilt.next(None), 0.0  # as last told, and when it was news
        self._look_s = 0.0

    def join(self, source: Source) -> None:
        """Listen to a panel, too."""
        self._sources.append(source)
        self._cues = Cues()  # what it has to say already is no news
        if self.instrument is None:
            self.instrument = self._make()
        if self._ticker is None:
            self._ticker = Ticker(None, TICK_MS, self.listen)
        self._ticker.start()

    @property
    def limits(self) -> str:
        """What cannot be heard on this computer, in words; "" if nothing."""
        return self.instrument.limits if self.instrument is not None else ""

    def leave(self, source: Source) -> None:
        """Listen to it no more; the last one ends it all, for sounds must not outlive the application."""
        if source in self._sources:
            self._sources.remove(source)
        if not self._sources and self._ticker is not None:
            self._ticker.stop()
            self._play(lambda instrument: instrument.tilt(0.0, 0.0, self._clock()))
            self._ticker = self.instrument = None

    def listen(self) -> None:
        """What the timer does."""
        now_s, on = self._clock(), sounds_are_on()
        if now_s >= self._look_s:
            self._look_s = now_s + LOOK_S
            palpated = sum(source.palpated() for source in self._sources)
            cue = self._cues.next(situation([source.model for source in self._sources], palpated))
            self._hear_tilt(now_s)
            if on and cue is not None:
                self._play(lambda instrument: instrument.cue(cue["name"]))
        known = on and now_s < self._tone_s + NEWS_S
        rate_hz, pitch_hz = (self._tone["rate"], self._tone["pitch"]) if known else (0.0, 0.0)
        self._play(lambda instrument: instrument.tilt(rate_hz, pitch_hz, now_s))

    def _hear_tilt(self, now_s: float) -> None:
        guides = [guide for guide in (source.guide() for source in self._sources) if guide is not None]
        tone = self._tilt.next(guides[0] if guides else None)
        if tone["count"] != self._tone["count"]:
            self._tone_s = now_s
        self._tone = tone

    def _play(self, what: Callable[[Instrument], None]) -> None:
        """On the instrument that there is; one that fails is put away, for good."""
        if self.instrument is None:
            return
        try:
            what(self.instrument)
        except REFUSED as error:
            LOG.warning("no sound any more (%s): cues are the computer's beep, the probe's tilt is silent", error)
            self.instrument = Beeper()


SOUNDS = PanelSounds()
