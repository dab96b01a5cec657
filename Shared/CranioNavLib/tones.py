"""The tones of all cues as numbers: the browser plays them with oscillators, Qt from samples."""

from __future__ import annotations

import wave
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from CranioNavLib.rigid import Array

RATE_HZ = 44100
RAMP_S = 0.01  # a tone swells and fades for so long, or it would click
BEEP_S = 0.05  # of the tilt
TILT_PEAK = 0.1
PIECE_S, CROSSING_S = 1.0, 0.1  # of the steady tone where it is played in pieces: its length, and how long two sound at once
REST_S = 0.06  # of silence behind: Qt may keep the last 20 ms of a sound back, and play them before the next


@dataclass(frozen=True)
class Cue:
    """One cue: the form of its wave, its peak (1: full scale), and frequency in Hz, begin and length in s of each tone."""

    form: str  # "sine", "triangle", "sawtooth"
    peak: float
    tones: tuple[tuple[float, float, float], ...]


# Small loudspeakers play little below 250 Hz, so that the low ones have overtones; peaks by what the ear makes of them. Two at
# once with the tilt stay unclipped.
CUES = {
    "taken": Cue("sine", 0.25, ((880.0, 0.0, 0.09), (1320.0, 0.1, 0.14))),
    "refused": Cue("sawtooth", 0.4, ((311.0, 0.0, 0.18), (233.0, 0.2, 0.28))),
    "lost": Cue("triangle", 0.4, ((660.0, 0.0, 0.12), (520.0, 0.15, 0.12), (390.0, 0.3, 0.25))),
}
FORMS = {
    "sine": lambda turns: np.sin(2 * np.pi * turns),
    "triangle": lambda turns: 2 / np.pi * np.arcsin(np.sin(2 * np.pi * turns)),
    "sawtooth": lambda turns: 2 * ((turns + 0.5) % 1.0) - 1.0,
}


def tone(form: str, hertz: float, peak: float, length_s: float, ramp_s: float = RAMP_S) -> Array:
    """(N,) one tone that swells and fades."""
    times = np.arange(round(length_s * RATE_HZ)) / RATE_HZ
    loudness = np.clip(np.minimum(times, length_s - times) / ramp_s, 0.0, 1.0)
    samples: Array = peak * loudness * np.asarray(FORMS[form](hertz * times), dtype=float)
    return samples


def cue_samples(name: str) -> Array:
    """(N,) a cue."""
    cue = CUES[name]
    samples: Array = np.zeros(round(max(begin + length for _, begin, length in cue.tones) * RATE_HZ))
    for hertz, begin, length in cue.tones:
        played = tone(cue.form, hertz, cue.peak, length)
        first = round(begin * RATE_HZ)
        samples[first : first + len(played)] += played[: len(samples) - first]
    return samples


def beep_samples(pitch_hz: float) -> Array:
    """(N,) one beep of the tilt."""
    return tone("sine", pitch_hz, TILT_PEAK, BEEP_S)


def steady_samples(pitch_hz: float) -> Array:
    """(N,) a piece of the steady tone; the next swells while it fades."""
    return tone("sine", pitch_hz, TILT_PEAK, PIECE_S, CROSSING_S)


def write_wave(path: Path, samples: Array) -> None:
    """Write samples (1: full scale), and silence, as a WAV file: 16 bit, one channel, which every Qt plays."""
    samples = np.concatenate([samples, np.zeros(round(REST_S * RATE_HZ))])
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(RATE_HZ)
        file.writeframes(np.round(32767 * np.clip(samples, -1.0, 1.0)).astype("<i2").tobytes())
