"""Simulated A-lines of a tremulous hand over spheres of bone: five delay lines, gel with air behind, tissue seen to go on.

What the other families lack: set-up and head are drawn until they go together (deep places, lossy tissue and high frequencies do
not meet); the mirror's echo comes from the nearest point of a sphere while the diffuse one follows the beam; every echo, the
layers' too, is dimmed at every frequency by a round element's lobe; the pulse has any phase and rings once more; a film of gel
with air behind is a ladder of echoes; tissue without bone shows by its texture that it goes on; the receiver may amplify with
depth. What a recording is drawn from is in sphere_plan.py, the hand in sphere_hand.py, what answers in sphere_echoes.py.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.line_truth import Truth
from Testing.Studies.simulators.sphere_echoes import (
    NEPER,
    Band,
    Complex,
    Floats,
    Scene,
    bone_echoes,
    draw_scene,
    other_echoes,
    square_echo,
)
from Testing.Studies.simulators.sphere_hand import draw_poses, draw_statuses
from Testing.Studies.simulators.sphere_plan import Array, Setup, World, draw_setup

WINDOW_MM = (19, 25)  # of tissue that the lines cover
ABOUT_BONE_MM = 1.5  # the peak of bone's echo is looked for
TEXTURE_FROM_MM = 0.2
PICKUP_MHZ = 0.1


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines (at least LEAST_LINES), the truth about it, and what it was drawn from."""
    setup = setup or draw_setup(rng)
    scene = draw_scene(rng, setup, frames)
    hand, count = scene.hand, len(scene.skin_us)
    last_us = float(scene.skin_us.max()) + 2 * rng.uniform(*WINDOW_MM) / setup.mm_us
    band = Band(setup, int(last_us * setup.sampling_mhz))
    bone = band.analytic(bone_echoes(rng, scene, band))
    typical = square_echo(scene, band)
    noise = typical / float(10 ** (setup.snr_db / 20))
    others = other_echoes(rng, scene, band, noise)
    gain = _gain(scene, band, others, typical)
    rf = (bone.real + others + _noise(rng, band, setup, count) * np.float32(noise)) * gain
    _add_receiver(rng, scene, band, rf)
    largest = 2 ** (setup.bits - 1)
    statuses = draw_statuses(rng, count)
    tracked = np.array(statuses) == "OK"
    recording = Recording(
        lines=np.clip(np.rint(rf), -largest, largest - 1).astype(np.int16),
        acquisition=setup.acquisition,
        probe_to_reference=np.where(tracked[:, None, None], draw_poses(rng, setup, hand), np.nan),
        statuses=statuses,
        timestamps_s=hand.timestamps_s,
        palpation_points=np.full(count, -1) if setup.sweeps else hand.place,
    )
    snr_db = np.where(hand.bone, _snr_db(scene, band, bone, gain, noise), -np.inf)
    depth = np.where(hand.bone, hand.depth_mm, np.nan)
    truth = Truth(depth, np.degrees(hand.incidence_rad), setup.speed_m_s, snr_db)
    return recording, truth, World(**vars(setup), kind=hand.kind)


def _depth_mm(scene: Scene, band: Band) -> Floats:
    """Depth in the scalp (n, samples) that the samples belong to."""
    time = (np.arange(band.samples) / band.sampling_mhz).astype(np.float32)
    return np.asarray((time - scene.skin_us.astype(np.float32)[:, None]) * np.float32(scene.setup.mm_us / 2))


def _noise(rng: np.random.Generator, band: Band, setup: Setup, count: int) -> Floats:
    """Noise of variance 1 (n, samples), white within the receiver's band."""
    over = band.every_mhz / setup.centre_mhz
    receiver = np.clip((over - 0.3) / 0.2, 0, 1) * np.clip((1.7 - over) / 0.2, 0, 1)
    heard = np.flatnonzero(receiver)
    heard = heard[heard < (band.size + 1) // 2]  # no noise at half the sampling rate, whose part is not told from the mean
    spectra = np.zeros((count, len(over)), dtype=np.complex64)
    drawn = rng.standard_normal((count, 2 * len(heard)), dtype=np.float32).view(np.complex64)
    level = receiver[heard] * (0.5 * band.size / np.linalg.norm(receiver[heard]))
    spectra[:, heard] = drawn * level.astype(np.float32)
    return np.asarray(scipy.fft.irfft(spectra, band.size, axis=1, overwrite_x=True)[:, : band.samples])


def _gain(scene: Scene, band: Band, others: Floats, typical: float) -> Floats:
    """Codes over heights (n, samples), or (1, 1): bone fills part of the converter; what is louder clips only a little."""
    setup, hand = scene.setup, scene.hand
    full = 2 ** (setup.bits - 1)
    with_depth = np.ones((1, 1), dtype=np.float32)
    gain = setup.fill * full / typical
    if setup.depth_gain:
        given_back = np.float32(NEPER * setup.loss_db_mm * setup.depth_gain)
        with_depth = np.exp(given_back * np.clip(_depth_mm(scene, band), 0, np.float32(setup.typical_mm)))
        gain /= float(with_depth[0].max())
    if setup.delay.length_mm and not setup.saturated:
        gain = min(gain, 1.5 * full / abs(setup.face_r * 10 ** (-setup.delay_db / 20)))
    if hand.soft.any():
        seen = _depth_mm(scene, band)[hand.soft] > TEXTURE_FROM_MM
        shown = np.abs(others * with_depth)[hand.soft][seen]
        gain = min(gain, 0.9 * full / float(np.quantile(shown, 0.999)))
    return np.asarray(with_depth * np.float32(gain))


def _add_receiver(rng: np.random.Generator, scene: Scene, band: Band, rf: Floats) -> None:
    """Put in the transmitted pulse, which rings down, longer in air; offset, sag, a switching supply's pickup, and spikes."""
    setup, (count, samples) = scene.setup, rf.shape
    full = 2 ** (setup.bits - 1)
    time = np.arange(samples) / band.sampling_mhz
    rf += _transmitted(rng, scene, time) * (1 + 0.01 * rng.standard_normal((count, 1), dtype=np.float32))
    sag = rng.uniform(-0.01, 0.01) - rng.uniform(0, 0.05) * np.exp(-time / rng.uniform(3, 12))
    rf += (full * sag).astype(np.float32)
    if setup.pickup:
        hum = (0.004 * full * np.exp(2j * np.pi * PICKUP_MHZ * time)).astype(np.complex64)
        started = np.exp(2j * np.pi * rng.random((count, 1))).astype(np.complex64)
        rf += started.real * hum.imag
        rf += started.imag * hum.real
    if setup.spikes:
        for row in np.flatnonzero(rng.random(count) < 0.16):
            rf[row, rng.integers(samples, size=2)] += rng.choice([-1, 1]) * rng.uniform(0.05, 0.5) * full


def _transmitted(rng: np.random.Generator, scene: Scene, time_us: Array) -> Floats:
    """The transmitted pulse and a slower weak mode of the element (n, samples)."""
    setup, hand = scene.setup, scene.hand
    full = 2 ** (setup.bits - 1)
    lasts_us = rng.uniform(0.5, 0.8) / setup.centre_mhz
    slow = np.exp(-time_us * setup.centre_mhz / rng.uniform(1, 1.8)) * np.cos(2 * np.pi * 0.8 * setup.true_mhz * time_us)
    fast = np.cos(2 * np.pi * setup.true_mhz * time_us)
    ringing = np.exp(-time_us / (lasts_us * np.array([[1.0], [1.25]])))  # loaded; into air
    both = full * (8 * ringing * fast + rng.uniform(0.01, 0.06) * slow)
    into_air = np.isin(hand.kind, ["lifted", "air", "gel"]).astype(int)
    return np.asarray(both.astype(np.float32)[into_air])


def _snr_db(scene: Scene, band: Band, bone: Complex, gain: Floats, noise: float) -> Array:
    """The peak of the received echo of bone (n,) over the noise there, and that of rounding."""
    hand, depth = scene.hand, _depth_mm(scene, band)
    near = (depth > (hand.square_mm - ABOUT_BONE_MM)[:, None]) & (depth < (hand.depth_mm + ABOUT_BONE_MM)[:, None])
    peak = (np.abs(bone) * gain * near).max(axis=1)
    arrival = np.rint(scene.arrival_us(hand.square_mm[:, None]) * band.sampling_mhz).astype(int)
    codes = np.take_along_axis(np.broadcast_to(gain, bone.shape), arrival.clip(0, band.samples - 1), axis=1)[:, 0]
    return np.asarray(20 * np.log10(np.maximum(peak, 1e-9) / np.sqrt((noise * codes) ** 2 + 1 / 12)))
