"""The page's tones, made by the browser's own oscillator; the server says through the state variable `cue` which."""

from __future__ import annotations

from trame.widgets import client, html

# [frequency in Hz, start in s, length in s] of each tone of a cue
PLAY = """
(() => {
  if (window.cranionavSounds) return;  // another layout draws the page anew, and with it this script
  window.cranionavSounds = true;
  const TONES = {
    taken: [[880, 0, 0.09], [1320, 0.1, 0.14]],
    refused: [[196, 0, 0.18], [156, 0.2, 0.28]],
    lost: [[660, 0, 0.12], [520, 0.15, 0.12], [390, 0.3, 0.25]],
  };
  let audio = null;
  const wake = () => {  // browsers are silent until the user has touched the page
    audio = audio || new (window.AudioContext || window.webkitAudioContext)();
    if (audio.state === 'suspended') audio.resume();
  };
  window.addEventListener('pointerdown', wake, true);
  window.addEventListener('keydown', wake, true);
  const play = (name, pitch) => {
    if (!audio) return;
    for (const [hertz, start, length] of TONES[name] || [[pitch, 0, 0.06]]) {
      const tone = audio.createOscillator(), loudness = audio.createGain(), begin = audio.currentTime + start;
      tone.type = name === 'refused' ? 'triangle' : 'sine';
      tone.frequency.value = hertz;
      loudness.gain.setValueAtTime(0, begin);
      loudness.gain.linearRampToValueAtTime(name === 'tilt' ? 0.06 : 0.2, begin + 0.01);
      loudness.gain.linearRampToValueAtTime(0, begin + length);
      tone.connect(loudness).connect(audio.destination);
      tone.start(begin);
      tone.stop(begin + length + 0.02);
    }
  };
  let heard = null, muted = null, restoring = false;
  const keepMuted = (now) => {  // each window's own choice, kept by its browser
    const kept = window.localStorage.getItem('cranionav-muted');
    if (muted === null) {
      restoring = kept === 'true' && now !== 'true';
      if (restoring) trame.state.set('muted', true);
    } else if (restoring) restoring = now !== 'true';
    else if (now !== kept) window.localStorage.setItem('cranionav-muted', now);
    muted = now;
  };
  setInterval(() => {
    const cue = document.querySelector('[data-cue]');
    if (!cue) return;
    keepMuted(cue.dataset.muted);
    if (cue.dataset.count === heard) return;
    const first = heard === null;
    heard = cue.dataset.count;
    if (first || cue.dataset.muted === 'true') return;
    cue.dataset.played = cue.dataset.name;
    play(cue.dataset.name, Number(cue.dataset.pitch));
  }, 50);
})();
"""


def draw_sounds() -> None:
    """The element that carries the cue, and the script that plays it."""
    attributes = [
        "data-cue",
        ':data-name="cue.name"',
        ':data-count="cue.count"',
        ':data-pitch="cue.pitch"',
        ':data-muted="muted"',
    ]
    html.Div(style="display: none", raw_attrs=attributes)
    client.Script(PLAY)
