"""What the page's own instrument plays, calculated by a browser; when it plays is tested with CranioNavLib.sounds."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from ModuleUltrasoundLib.palpation.guidance import cue

from Testing.Python import workstation_user as user_module
from Workstation.web.sounds_view import PLAY

needs_browser = pytest.mark.skipif(not Path(user_module.BROWSER).exists(), reason="no Chromium on this machine")


RATE_HZ = 16000  # Hz, of the sound that is calculated


@pytest.fixture(scope="module")
def rendered():
    """What the page's instrument plays, calculated by a browser: samples of a piece of JavaScript that plays on `it`."""
    from playwright.sync_api import sync_playwright

    script = """async ([play, seconds, rate]) => {
      const context = new OfflineAudioContext(1, seconds * rate, rate), it = window.cranionavSounds.instrument(context);
      new Function('it', 'context', play)(it, context);
      return Array.from((await context.startRendering()).getChannelData(0));
    }"""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=user_module.BROWSER, args=user_module.FLAGS.split())
        page = browser.new_page()
        page.evaluate(PLAY)
        yield lambda play, seconds=0.8: np.array(page.evaluate(script, [play, seconds, RATE_HZ]))
        browser.close()


def tones(samples: np.ndarray) -> list[tuple[float, float, float]]:
    """(beginning in s, length in s, strongest frequency in Hz) of each stretch that sounds."""
    loud = np.convolve(np.abs(samples), np.ones(80) / 80, "same") > 0.01
    edges = np.flatnonzero(np.diff(np.concatenate([[0], loud.astype(int), [0]])))
    found = []
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        spectrum = np.abs(np.fft.rfft(samples[first:end] * np.hanning(end - first), 8 * RATE_HZ))
        found.append((first / RATE_HZ, (end - first) / RATE_HZ, float(np.argmax(spectrum)) / 8))
    return found


def loudness_db(samples: np.ndarray) -> float:
    """Level as the ear weighs it (IEC 61672, A), of what sounds, below full scale."""
    spectrum, hertz = np.fft.rfft(samples), np.fft.rfftfreq(len(samples), 1 / RATE_HZ)
    f2 = hertz**2
    weight = 1.2589 * 12194**2 * f2**2 / ((f2 + 20.6**2) * np.sqrt((f2 + 107.7**2) * (f2 + 737.9**2)) * (f2 + 12194**2))
    weighed = np.fft.irfft(spectrum * weight)
    sounding = sum(length for _, length, _ in tones(samples)) * RATE_HZ
    return float(10 * np.log10(np.sum(weighed**2) / sounding))


@needs_browser
@pytest.mark.slow
def test_the_cues_differ_in_number_and_pitch_are_about_as_loud_and_none_is_clipped(rendered):
    played = {name: rendered(f"it.cue('{name}', 0.1)") for name in ("taken", "refused", "lost")}
    pitches = {name: [round(hertz) for *_, hertz in tones(samples)] for name, samples in played.items()}
    assert pitches["taken"] == pytest.approx([880, 1320], rel=0.02)
    assert pitches["refused"] == pytest.approx([311, 233], rel=0.02)
    assert pitches["lost"] == pytest.approx([660, 520, 390], rel=0.02)
    levels = {name: loudness_db(samples) for name, samples in played.items()}
    assert max(levels.values()) - min(levels.values()) < 6, levels
    assert min(levels.values()) > -25, levels
    for first, second in itertools.combinations(played, 2):
        together = rendered(f"it.cue('{first}', 0); it.cue('{second}', 0); it.tilt(0, 880, 0, 1)")
        assert np.abs(together).max() < 1.0, "clipped"
    assert max(length for samples in played.values() for _, length, _ in tones(samples)) < 0.35


@needs_browser
@pytest.mark.slow
def test_the_beeps_of_the_tilt_quicken_and_rise_and_become_one_steady_tone(rendered):
    heard_of = {}
    for angle in (25.0, 12.0, 6.0, 2.5):
        wanted = cue(angle)
        call = f"for (let k = 0; k < 60; k++) it.tilt({wanted.rate_hz}, {wanted.pitch_hz}, k / 20, k / 20 + 0.15)"  # every 50 ms
        found = tones(rendered(call, 3.0))
        assert np.diff([begin for begin, *_ in found]) == pytest.approx(1 / wanted.rate_hz, abs=0.004)
        assert np.array([hertz for *_, hertz in found]) == pytest.approx(wanted.pitch_hz, rel=0.03)
        heard_of[angle] = len(found)
    assert sorted(heard_of.values()) == list(heard_of.values()), "the nearer to square, the more"
    steady = tones(rendered("for (let k = 0; k < 20; k++) it.tilt(0, 880, k / 20, k / 20 + 0.15); it.tilt(0, 0, 1, 1.15)", 2.0))
    assert [(round(begin, 1), round(length, 1), round(hertz)) for begin, length, hertz in steady] == [(0.0, 1.0, 880)]


@needs_browser
@pytest.mark.slow
def test_what_is_muted_falls_silent_at_once_in_the_middle_of_a_tone(rendered):
    muted = rendered("it.tilt(0, 880, 0, 1); context.suspend(0.5).then(() => { it.mute(true); context.resume(); })")
    assert np.abs(muted[: RATE_HZ // 2]).max() == pytest.approx(0.1, rel=0.05)
    assert np.abs(muted[int(0.6 * RATE_HZ) :]).max() < 1e-4
