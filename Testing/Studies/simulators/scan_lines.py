"""Simulated A-lines of a hand-held scan over a head: reflectivity over time, the losses on the way, pulse, receiver, converter.

Other families shape an echo and put it in. Here a line is a train of reflections on a fine grid of time: facets of a rough bone
over the whole footprint of a diffracting beam, facets of interfaces that are tilted on their own, scatterers, diploe behind an
outer table of drawn thickness. What lies in the tissue comes again through the delay line. Then all of it is attenuated by when
it arrives, with the dispersion that causality asks for, and meets the pulse. Shallow bone stands near the main bang, delay lines
may be too short and drift, layers run close above bone, the hand lands and lifts, and a gap may open in the bone.
What a recording is drawn from, and how the hand moves, is in scan_plan.py, what reflects in scan_echoes.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.scan_echoes import Floats, Scene, draw_reflections, draw_scene
from Testing.Studies.simulators.scan_plan import (
    EDGE,
    GAP,
    Array,
    Setup,
    World,
    acquisition_of,
    draw_hand,
    draw_poses,
    draw_setup,
    draw_statuses,
    kinds,
    wander,
)

Complex = npt.NDArray[np.complex64]

NEPER = np.log(10) / 20  # a decibel
STEP_DB, MOST_DB = 3.0, 75.0  # losses are exact at every third decibel, and stop growing
FAINT = 1e-4  # of the pulse's spectrum: not simulated
LASTS = 3.5  # of the pulse, to each side, over bandwidth and centre
NEAR_MM = 0.35  # the bone's echo, not the diploe's
SOFT_MM = 9.0, 12.0  # without bone the scatter there stands over the noise


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, World]:
    """A recording of about `frames` lines (a person goes to whole places), the truth about it, and what it was drawn from."""
    setup = setup or draw_setup(rng)
    hand = draw_hand(rng, setup, frames)
    scene = draw_scene(rng, setup, hand)
    bone, rest, missing = draw_reflections(rng, scene)
    received = _Received(_through(scene, bone), _through(scene, rest))
    peak = _bone_peak(scene, received.bone)
    lines, noise, bits = _receive(rng, scene, received, missing, peak)
    statuses = draw_statuses(rng, len(lines))
    tracked = np.array(statuses) == "OK"
    poses = draw_poses(rng, hand, scene.probe.length_mm)
    numbered = not setup.sweeps and rng.random() < 0.7
    recording = Recording(
        lines=lines,
        acquisition=acquisition_of(setup, scene.probe),
        probe_to_reference=np.where(tracked[:, None, None], poses, np.nan),
        statuses=statuses,
        timestamps_s=np.asarray(np.arange(len(lines)) * setup.line_s + rng.uniform(0, 100), dtype=float),
        palpation_points=hand.place + 1 if numbered else np.full(len(lines), -1),
    )
    answers = (peak > 0) & (missing <= GAP)
    snr_db = np.where(answers, 20 * np.log10(np.maximum(peak, 1e-12) / noise), -np.inf)
    truth = Truth(np.where(answers, hand.depth_mm, np.nan), hand.angle_deg, setup.speed_m_s, snr_db)
    ignore = (missing > EDGE) & (missing <= GAP) & hand.contact
    return recording, truth, World(**vars(setup), probe=scene.probe, bits=bits, kind=kinds(setup, hand, missing), ignore=ignore)


def _through(scene: Scene, reflections: Floats) -> Complex:
    """Lines (n, samples) of `reflections` after attenuation by when they arrive, and the pulse; analytic.

    The losses of a few depths are exact, and blended between. Each is worked out on the stretch around its depth alone.
    """
    setup, finer, rate = scene.setup, scene.finer, scene.rate_mhz
    used = np.flatnonzero(reflections.any(axis=0))
    out = np.zeros((len(reflections), scene.samples), dtype=np.complex64)
    if not len(used):
        return out
    spacing_mm = STEP_DB / setup.loss_db_mm
    steps = int(min(scene.span_mm / spacing_mm, MOST_DB / STEP_DB)) + 2
    per_step = float(setup.echo_us(np.array(spacing_mm))) * rate
    skin = float(scene.face_us.mean()) * rate
    guard = (int(LASTS / (scene.probe.bandwidth * setup.centre_mhz) * rate) // finer + 1) * finer
    for step in range(steps):
        begin = int(used[0]) if step == 0 else max(int(used[0]), int(skin + (step - 1) * per_step))
        end = min(int(used[-1]) + 1, scene.size if step == steps - 1 else int(skin + (step + 1) * per_step) + 1)
        begin -= begin % finer
        if begin >= end:
            continue
        at = (np.arange(begin, end) - skin) / per_step - step
        share = np.clip(1 - np.abs(at), 0, 1)
        if step == 0:
            share[at < 0] = 1
        if step == steps - 1:
            share[at > 0] = 1
        size = scipy.fft.next_fast_len(-(-(end - begin + 2 * guard) // finer)) * finer
        part = np.zeros((len(out), size), dtype=np.float32)
        np.multiply(reflections[:, begin:end], share.astype(np.float32), out=part[:, guard : guard + end - begin])
        heard = _heard(scene, scipy.fft.rfft(part, axis=1), size, step)
        first = (begin - guard) // finer
        lower, upper = max(first, 0), min(first + size // finer, scene.samples)
        out[:, lower:upper] += heard[:, lower - first : upper - first]
    return out


def _heard(scene: Scene, spectra: Complex, size: int, step: int) -> Complex:
    """Analytic signals at the line's own rate of `spectra` on the fine grid, after `step` times STEP_DB of loss and the pulse."""
    setup, coarse = scene.setup, size // scene.finer
    mhz = np.asarray(np.arange(coarse // 2 + 1) * (scene.rate_mhz / size), dtype=float)
    pulse = scene.pulse.spectrum(mhz)
    loud = np.flatnonzero(np.abs(pulse) > FAINT * np.abs(pulse).max())
    band = slice(int(loud[0]), int(loud[-1]) + 1)
    mhz = mhz[band]
    nepers = NEPER * STEP_DB * step * mhz / setup.centre_mhz
    octaves = np.log(np.maximum(mhz, 1e-3) / setup.centre_mhz)
    transfer = pulse[band] * np.exp(-nepers * (1 - 2j / np.pi * (octaves - 1)))  # Kramers-Kronig; group speed right at the centre
    analytic = np.zeros((len(spectra), coarse), dtype=np.complex64)
    np.multiply(spectra[:, band], (2 * transfer / scene.finer).astype(np.complex64), out=analytic[:, band])
    return np.asarray(scipy.fft.ifft(analytic, axis=1, overwrite_x=True))


@dataclass(frozen=True, eq=False)
class _Received:
    """Analytic lines (n, samples)."""

    bone: Complex
    rest: Complex


def _bone_peak(scene: Scene, bone: Complex) -> Array:
    """Height of the envelope of the bone's surface (n,); 0: none."""
    rate, near = scene.setup.sampling_mhz, 2 * NEAR_MM / scene.setup.mm_us
    first = np.floor((scene.bone_us - near) * rate).astype(np.int64) + 1
    columns = first[:, None] + np.arange(int(2 * near * rate) + 1)
    inside = (np.abs(columns / rate - scene.bone_us[:, None]) < near) & (columns >= 0) & (columns < bone.shape[1])
    level = np.abs(bone[np.arange(len(bone))[:, None], np.clip(columns, 0, bone.shape[1] - 1)])
    return np.asarray((level * inside).max(axis=1), dtype=float)


def _receive(
    rng: np.random.Generator, scene: Scene, received: _Received, missing: Array, peak: Array
) -> tuple[npt.NDArray[np.int16], float, int]:
    """Codes, the noise's RMS before the converter, its bits. `peak` is the bone's height (n,), `missing` the hole in it."""
    setup, hand, probe = scene.setup, scene.hand, scene.probe
    usual = scene.ground.bone_r * 10 ** (-setup.loss_db_mm * hand.depth_mm.mean() / 20)
    wave = received.bone.real + received.rest.real
    bang = _draw_bang(rng, scene, usual)
    wave += bang
    if setup.without == "soft":  # the gain is up: the scatter stands over the noise half way down
        start, stop = (int((scene.face_us.mean() + 2 * z / setup.mm_us) * setup.sampling_mhz) for z in SOFT_MM)
        middle = np.abs(received.rest[:, start:stop])
        noise = float(np.sqrt((middle**2).mean())) / 1.4 / 10 ** (rng.uniform(4, 16) / 20)
        usual = float(np.quantile(middle, 0.99))
    else:
        if not setup.without:
            good = (hand.coupling > 0.8) & (hand.angle_deg < 2) & (missing < 0.01) & hand.contact
            usual = float(np.median(peak[good])) if good.sum() > 3 else max(float(np.quantile(peak, 0.8)), 0.3 * usual)
        noise = usual / 10 ** (setup.snr_db / 20)
    _add_noise(rng, scene, wave, noise, usual)
    full = usual * (rng.uniform(0.35, 0.7) if rng.random() < 0.06 else rng.uniform(1.8, 5))  # of some the gain is too high
    full = max(full, 1.5 * noise)
    bits = int(rng.choice([10, 12, 14]))
    if probe.material and not setup.without and rng.random() < 0.5:  # the face stays on scale, if the converter allows
        full = min(max(full, 1.1 * abs(probe.face_r)), usual * 2 ** (bits - 1) / 60)
    return _convert(rng, scene, wave, full, bits), noise, bits


def _draw_bang(rng: np.random.Generator, scene: Scene, usual: float) -> Floats:
    """The transmitted pulse rings down (n, samples); without a delay line it ends before the bone."""
    setup = scene.setup
    time = np.arange(scene.samples) / setup.sampling_mhz
    dead = rng.uniform(5, 9) / setup.centre_mhz
    if not scene.probe.material:
        dead = min(dead, 0.72 * float(setup.echo_us(scene.hand.depth_mm.min())))
    ringing = np.exp(-time / (dead / 6)) * np.cos(2 * np.pi * setup.centre_mhz * 1.02 * time)
    height = rng.uniform(20, 60) * usual * (1 + 0.1 * rng.normal(size=(len(scene.skin_us), 1)))
    return np.asarray(height * ringing, dtype=np.float32)


def _add_noise(rng: np.random.Generator, scene: Scene, wave: Floats, noise: float, usual: float) -> None:
    """Put in the receiver's noise, spikes, a switching supply's hum."""
    setup, (count, samples) = scene.setup, wave.shape
    size = scipy.fft.next_fast_len(samples, real=True)
    mhz = np.fft.rfftfreq(size, 1 / setup.sampling_mhz)
    bent = np.tan(np.pi * np.minimum(mhz / setup.sampling_mhz, 0.4999))
    low, high = np.tan(np.pi * np.array([0.35 * setup.centre_mhz, _highest(setup)]) / setup.sampling_mhz)
    gain = 1 / (1 + ((bent**2 - low * high) / np.maximum(bent * (high - low), 1e-9)) ** 6)  # Butterworth, to and fro
    drawn = rng.standard_normal((count, 2 * len(mhz)), dtype=np.float32).view(np.complex64)
    drawn *= (gain * (0.5 * size * noise / np.linalg.norm(gain))).astype(np.float32)
    wave += scipy.fft.irfft(drawn, size, axis=1, overwrite_x=True)[:, :samples]
    if rng.random() < 0.12:
        for row in np.flatnonzero(rng.random(count) < 0.06):
            at = int(rng.integers(10, samples - 10))
            wave[row, at : at + 2] += rng.choice([-1, 1]) * usual * rng.uniform(0.3, 1.5)
    if rng.random() < 0.1:
        turns = 2 * np.pi * rng.uniform(0.3, 1.2) / setup.sampling_mhz * np.arange(samples)
        wave += (noise * rng.uniform(0.5, 1.2) * np.cos(turns + rng.uniform(0, 6, (count, 1)))).astype(np.float32)


def _highest(setup: Setup) -> float:
    """Upper end of the receiver's band, MHz."""
    return min(1.9 * setup.centre_mhz, 0.46 * setup.sampling_mhz)


def _convert(rng: np.random.Generator, scene: Scene, wave: Floats, full: float, bits: int) -> npt.NDArray[np.int16]:
    """Codes of a converter whose range is `full` to each side; its baseline drifts."""
    largest = 2 ** (bits - 1) - 1
    time = np.arange(wave.shape[1]) / scene.setup.sampling_mhz
    recovers = rng.normal(0, 0.03) + 0.03 * np.exp(-time / 8) * rng.normal()
    drift = 0.01 * wander(rng, len(wave), scene.setup.line_s, 0.5)
    wave *= np.float32(largest / full)
    wave += (largest * recovers).astype(np.float32)
    wave += (largest * drift).astype(np.float32)[:, None]
    return np.clip(np.rint(wave), -largest - 1, largest).astype(np.int16)
