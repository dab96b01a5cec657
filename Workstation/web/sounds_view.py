"""The page's tones, made by the browser's own oscillators; the state says which cue, and how the probe tilts."""

from __future__ import annotations

import json

from CranioNavLib.sounds import NEWS_S
from CranioNavLib.tones import BEEP_S, CUES, RAMP_S, TILT_PEAK
from trame.widgets import client, html

# `instrument` plays into any audio context, also into one that only calculates. Each of CUES: waveform, peak, tones.
PLAY = """
(() => {
  if (window.cranionavSounds) return;  // another layout draws the page anew, and with it this script
  const CUES = $CUES$, TILT = $TILT$, BEEP_S = $BEEP_S$, RAMP_S = $RAMP_S$, NEWS_MS = $NEWS_MS$, AHEAD_S = 0.15;
  const instrument = (context) => {
    const out = context.createGain();
    out.connect(context.destination);
    const tone = (form, hertz, peak, begin, length) => {
      const source = context.createOscillator(), loudness = context.createGain();
      source.type = form;
      source.frequency.value = hertz;
      loudness.gain.setValueAtTime(0, begin);
      loudness.gain.linearRampToValueAtTime(peak, begin + RAMP_S);
      loudness.gain.setValueAtTime(peak, begin + length - RAMP_S);
      loudness.gain.linearRampToValueAtTime(0, begin + length);
      source.connect(loudness).connect(out);
      source.start(begin);
      source.stop(begin + length + 0.01);
    };
    let steady = null, next = 0;
    return {
      cue: (name, begin) => CUES[name][2].forEach(([hertz, start, length]) =>
        tone(CUES[name][0], hertz, CUES[name][1], begin + start, length)),
      tilt: (rate, pitch, from, to) => {  // the beeps that begin between two times; or the steady tone from the first on
        if (steady && (rate || !pitch)) {
          steady.level.setTargetAtTime(0, from, RAMP_S);
          steady.source.stop(from + 0.1);
          steady = null;
        }
        if (!pitch) { next = 0; return; }
        if (!rate && !steady) {
          const source = context.createOscillator(), loudness = context.createGain();
          source.frequency.value = pitch;
          loudness.gain.setValueAtTime(0, from);
          loudness.gain.linearRampToValueAtTime(TILT, from + RAMP_S);
          source.connect(loudness).connect(out);
          source.start(from);
          steady = { source, level: loudness.gain };
        }
        if (!rate) { next = 0; return; }
        for (next = Math.max(Math.min(next, to + 1 / rate), from); next < to; next += 1 / rate)
          tone('sine', pitch, TILT, next, BEEP_S);
      },
      mute: (on) => out.gain.setTargetAtTime(on ? 0 : 1, context.currentTime, RAMP_S),
    };
  };
  window.cranionavSounds = { instrument, cues: Object.keys(CUES) };
  let audio = null, player = null;
  const wake = () => {  // browsers are silent until the user has touched the page
    if (!audio) {
      audio = new (window.AudioContext || window.webkitAudioContext)();
      player = instrument(audio);
      player.mute(muted === 'true');
    }
    if (audio.state === 'suspended') audio.resume();
  };
  window.addEventListener('pointerdown', wake, true);
  window.addEventListener('keydown', wake, true);
  let heard = null, muted = null, restoring = false;
  const keepMuted = (now) => {  // each window's own choice, kept by its browser
    const kept = window.localStorage.getItem('cranionav-muted');
    if (now !== muted && player) player.mute(now === 'true');
    if (muted === null) {
      restoring = kept === 'true' && now !== 'true';
      if (restoring) trame.state.set('muted', true);
    } else if (restoring) restoring = now !== 'true';
    else if (now !== kept) window.localStorage.setItem('cranionav-muted', now);
    muted = now;
  };
  let news = '', newsAt = 0;
  const lean = (said) => {  // no news, no tone: a tilt that is not known is not to be heard as one that stays
    if (said.tilt !== news) { news = said.tilt; newsAt = performance.now(); }
    const known = Number(news) && performance.now() < newsAt + NEWS_MS;
    player.tilt(Number(said.rate), known ? Number(said.pitch) : 0, audio.currentTime, audio.currentTime + AHEAD_S);
  };
  setInterval(() => {
    const cue = document.querySelector('[data-cue]');
    if (!cue) return;
    keepMuted(cue.dataset.muted);
    if (player) lean(cue.dataset);
    if (cue.dataset.count === heard) return;
    const first = heard === null;
    heard = cue.dataset.count;
    if (first || cue.dataset.muted === 'true') return;
    cue.dataset.played = cue.dataset.name;
    if (player) player.cue(cue.dataset.name, audio.currentTime);
  }, 50);
})();
"""
for _name, _value in {
    "CUES": {name: [cue.form, cue.peak, cue.tones] for name, cue in CUES.items()},
    "TILT": TILT_PEAK,
    "BEEP_S": BEEP_S,
    "RAMP_S": RAMP_S,
    "NEWS_MS": 1000 * NEWS_S,
}.items():
    PLAY = PLAY.replace(f"${_name}$", json.dumps(_value))


def draw_sounds() -> None:
    """The element that carries the cue and the tilt, and the script that plays them."""
    attributes = [
        "data-cue",
        ':data-name="cue.name"',
        ':data-count="cue.count"',
        ':data-rate="tilt.rate"',
        ':data-pitch="tilt.pitch"',
        ':data-tilt="tilt.count"',
        ':data-muted="muted"',
    ]
    html.Div(style="display: none", raw_attrs=attributes)
    client.Script(PLAY)
