"""The samples of the cues: their pitches, no clicks, nothing clipped; the browser plays the same ones."""

from __future__ import annotations

import itertools
import wave

import numpy as np
import pytest
from CranioNavLib.tones import (
    CROSSING_S,
    CUES,
    PIECE_S,
    RATE_HZ,
    TILT_PEAK,
    beep_samples,
    cue_samples,
    steady_samples,
    tone,
    write_wave,
)


def strongest_hz(samples):
    spectrum = np.abs(np.fft.rfft(samples * np.hanning(len(samples)), 8 * RATE_HZ))
    return np.argmax(spectrum) / 8


@pytest.mark.parametrize("name", CUES)
def test_each_tone_of_a_cue_has_its_pitch_and_place(name):
    samples = cue_samples(name)
    assert len(samples) == round(max(begin + length for _, begin, length in CUES[name].tones) * RATE_HZ)
    for hertz, begin, length in CUES[name].tones:
        first = round(begin * RATE_HZ)
        piece = samples[first : first + round(length * RATE_HZ)]
        assert strongest_hz(piece) == pytest.approx(hertz, rel=0.02)
        assert np.abs(piece).max() == pytest.approx(CUES[name].peak, rel=0.03)


@pytest.mark.parametrize("form", ["sine", "triangle", "sawtooth"])
def test_a_tone_begins_and_ends_in_silence(form):
    samples = tone(form, 440.0, 0.4, 0.1)
    assert np.abs(samples[[0, -1]]).max() < 0.005
    assert np.abs(samples).max() == pytest.approx(0.4, rel=0.02)


def test_two_cues_at_once_with_the_tilt_are_not_clipped():
    for first, second in itertools.combinations(CUES, 2):
        assert CUES[first].peak + CUES[second].peak + TILT_PEAK < 1.0


def test_pieces_of_the_steady_tone_make_one_tone():
    piece, every = steady_samples(880.0), round((PIECE_S - CROSSING_S) * RATE_HZ)
    played = np.zeros(3 * every + len(piece))
    for number in range(4):
        played[number * every : number * every + len(piece)] += piece
    inside = np.abs(played[round(CROSSING_S * RATE_HZ) : -round(CROSSING_S * RATE_HZ)])
    loudest = inside[: len(inside) // 441 * 441].reshape(-1, 441).max(axis=1)  # of each 10 ms
    assert loudest.min() > 0.8 * TILT_PEAK
    assert loudest.max() < 1.1 * TILT_PEAK
    assert strongest_hz(piece) == pytest.approx(880.0, abs=1.0)


def test_a_beep_has_the_pitch_that_is_asked_for():
    assert strongest_hz(beep_samples(523.0)) == pytest.approx(523.0, rel=0.02)


def test_samples_come_back_from_the_file(tmp_path):
    samples = cue_samples("taken")
    write_wave(tmp_path / "taken.wav", samples)
    with wave.open(str(tmp_path / "taken.wav")) as file:
        assert (file.getnchannels(), file.getsampwidth(), file.getframerate()) == (1, 2, RATE_HZ)
        read = np.frombuffer(file.readframes(file.getnframes()), "<i2") / 32767
    np.testing.assert_allclose(read[: len(samples)], samples, atol=1 / 32767)
    assert not read[len(samples) :].any()
    assert len(read) - len(samples) == pytest.approx(0.06 * RATE_HZ)
