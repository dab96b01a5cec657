"""Simulated A-lines drawn as for an acceptance test: every quantity over its whole range, and the lines that must be accepted.

It is plain in its echoes, each one a Gaussian pulse with the phase of the recording, which the tissue's loss moves down in
frequency. What the other families lack: its set-up comes from anywhere in the stated ranges, the receiver is blanked or the
element rings on after the transmitted pulse, a short delay line puts multiples among the depths, and of each line the world says
whether an expert would demand it, and what it is.
What a recording is drawn from is in grid_plan.py.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.fft
from CranioNavLib.recording import Recording

from Testing.Studies.simulators.grid_plan import Array, Bools, Hand, Setup, World, draw_hand, draw_poses, draw_setup
from Testing.Studies.simulators.line_truth import Truth

Waves = npt.NDArray[np.float32]

NEPER = np.log(10) / 20  # a decibel
BONE_R = 0.55  # of scalp over bone
BONE_MM_US = 2.9
REACH_MM = 28.0  # of tissue that the lines cover
FAINT = 3e-5  # of a spectrum, over its height: what is less is left out
HALF_PULSE = 1.7  # over the bandwidth in MHz: half the pulse in us; beyond, its envelope is below 1e-4
DEEPEST_MM = 60  # of the table of what the loss leaves
MULTIPLES = 4
AIR_R = -0.95
BURST = 3.0  # the transmitted pulse, when the receiver hears it
RING = 0.3  # of it, when the delay line damps the element
SOFT_LAYER, SOFT_SPECKLE = 0.5, 1.6  # where there is no bone: septa in the deep are faint, the tissue scatters more
LINES_S = 20.0
LARGEST = 32767
TILTED_DEG, NEAR_DEG = 6.0, 3.0
LEAST_SNR_DB, LEAST_SPECKLE_DB = 12.0, 6.0  # of a line that must be accepted: over the noise, over the speckle before bone
SPIKE_US = 1.5  # so near to the bone's echo a spike spoils it


class Band:
    """The frequencies of a recording, its pulse on them, and what tissue leaves of the pulse."""

    def __init__(self, setup: Setup, samples: int) -> None:
        width_mhz = setup.bandwidth * setup.centre_mhz
        self.samples, self.half_us = samples, HALF_PULSE / width_mhz
        # a wide band ends at frequency 0, and its transmitted pulse fades slowly: the far end must not come round into the line
        self.size = scipy.fft.next_fast_len(2 * samples, real=True)
        every = np.arange(self.size // 2 + 1) * (setup.sampling_mhz / self.size)
        pulse = np.exp(-np.log(2) * ((every - setup.centre_mhz) / (width_mhz / 2)) ** 2)
        lost = pulse * np.exp(-0.2 * NEPER * setup.attenuation * 2 * setup.depth_mm * every)
        strong = np.flatnonzero((pulse > FAINT) | (lost > FAINT * lost.max()))
        self.bins = slice(int(strong[0]), int(strong[-1]) + 1)
        self.mhz, self.pulse = every[self.bins], pulse[self.bins].astype(np.float32)
        self.neper_mm = 0.2 * NEPER * setup.attenuation * self.mhz  # there and back
        self.sum = float(pulse.sum())
        self.depths = np.arange(DEEPEST_MM + 1)
        heights = np.exp(-np.outer(self.depths, self.neper_mm)) @ pulse[self.bins] / pulse[self.bins].sum()
        self.log_heights = np.log(heights)

    def loss(self, depth_mm: npt.ArrayLike) -> Array:
        """What is left of the envelope's peak from a depth, where each frequency has lost its share."""
        return np.asarray(np.exp(np.interp(np.asarray(depth_mm, dtype=float), self.depths, self.log_heights)))

    def lines(self, spectra: npt.NDArray[np.complex64]) -> Waves:
        """Samples (n, samples) of spectra (n, K)."""
        full = np.zeros((len(spectra), self.size // 2 + 1), dtype=np.complex64)
        full[:, self.bins] = spectra
        return np.asarray(scipy.fft.irfft(full, self.size, axis=1)[:, : self.samples])


class Scene:
    """The lines of a recording under way, and what their parts need of it."""

    def __init__(self, setup: Setup, hand: Hand, rng: np.random.Generator) -> None:
        self.setup, self.hand, self.rng, self.count = setup, hand, rng, len(hand.place)
        stated = setup.acquisition
        warmth = 1 + rng.uniform(-0.004, 0.004) + rng.uniform(-0.002, 0.002) * np.arange(self.count) / self.count
        self.skin_us = 2e3 * stated.forerun_length_mm / (stated.forerun_speed_m_s or 1.0) * warmth
        self.bone_us = 2 * hand.depth_mm / setup.mm_us
        samples = int(np.ceil((self.skin_us.max() + 2 * REACH_MM / setup.mm_us) * setup.sampling_mhz)) + 16
        self.band = Band(setup, samples)
        self.spectra = np.zeros((self.count, len(self.band.mhz)), dtype=np.complex64)
        through = setup.face_loss * (1 - setup.face_r**2)
        self.square = through * BONE_R * float(self.band.loss(np.median(hand.depth_mm)))  # bone met squarely
        specular = np.exp(-np.log(2) * (hand.angle_deg / setup.half_deg) ** 2)
        seen = np.hypot(specular, setup.floor * np.exp(-((hand.angle_deg / 12) ** 2)))
        varied = np.maximum(1 + 0.08 * rng.normal(size=self.count), 0.7)
        self.bone = np.where(hand.bone, through * BONE_R * seen * varied, 0.0)  # its echo before the tissue's loss (n,)
        self.peak = self.bone * self.band.loss(hand.depth_mm)

    def add(self, height: npt.ArrayLike, time_us: npt.ArrayLike, depth_mm: Array | None = None) -> None:
        """One echo in every line: height before the tissue's loss, time, and how deep it has been; each (n,) or one for all."""
        height, time = np.broadcast_to(height, self.count), np.broadcast_to(time_us, self.count)
        last_us = self.band.samples / self.setup.sampling_mhz + self.band.half_us
        rows = np.flatnonzero((height != 0) & (time < last_us))
        phase = np.outer(-2 * np.pi * time[rows], self.band.mhz).astype(np.float32)
        envelope = height[rows, None].astype(np.float32) * self.band.pulse
        if depth_mm is not None:
            envelope *= np.exp(np.outer(-depth_mm[rows], self.band.neper_mm).astype(np.float32))
        phase += np.float32(self.setup.phase)
        self.spectra.real[rows] += envelope * np.cos(phase)
        self.spectra.imag[rows] += envelope * np.sin(phase)

    def waves(self) -> Waves:
        """All echoes so far as lines (n, samples)."""
        return self.band.lines(self.spectra) * np.float32(self.band.size / self.band.sum)


def _add_bone(scene: Scene) -> None:
    """Bone, the diploe and the inner table behind it, and bone once more by way of the skin."""
    setup, rng, depth = scene.setup, scene.rng, scene.hand.depth_mm
    arrival = scene.skin_us + scene.bone_us
    scene.add(scene.bone, arrival, depth)
    diploe, inner = 10 ** (rng.uniform(-22, -12, 2) / 20)
    scene.add(-scene.bone * diploe, arrival + 2 * rng.uniform(1.5, 2.5) / BONE_MM_US, depth + 1)
    scene.add(scene.bone * inner, arrival + 2 * rng.uniform(4, 7) / BONE_MM_US, depth + 2)
    back = setup.face_r if setup.material else 0.15
    scene.add(-scene.bone * BONE_R * back, arrival + scene.bone_us, 2 * depth)


def _add_layers(scene: Scene) -> None:
    """Skin to fat, fat to muscle, galea; without bone the layers go on into the deep."""
    setup, hand, rng = scene.setup, scene.hand, scene.rng
    either = rng.choice([-1, 1])
    signs = (-1, 1, either, -1, 1)
    least = (0.04, 0.03, 0.03, 0.03, 0.03)
    most = (0.10, 0.08, 0.08, 0.08, 0.08)
    shares = (rng.uniform(0.15, 0.3), rng.uniform(0.35, 0.55), rng.uniform(0.62, 0.85), 1.4, 1.9)
    specular = np.exp(-np.log(2) * (hand.angle_deg / (setup.half_deg + 2)) ** 2)
    seen = np.hypot(specular, 0.1) * setup.face_loss
    for number, share in enumerate(shares):
        depth = share * (1 + rng.normal(0, 0.04, hand.places))[hand.place] * hand.depth_mm
        over_bone = float(number < 3)
        without = 1.0 if number < 2 else SOFT_LAYER
        there = np.where(hand.kind == "soft", without, over_bone * hand.bone)
        height = signs[number] * rng.uniform(least[number], most[number]) * seen * there
        scene.add(height, scene.skin_us + 2 * depth / setup.mm_us, depth)


def _add_probe(scene: Scene) -> None:
    """The transmitted pulse, the delay line's face with its multiples, total in air, and the bone heard through these."""
    setup, hand, rng = scene.setup, scene.hand, scene.rng
    scene.add(0.0 if setup.blanked else BURST, 0.0)
    if not setup.material or setup.without == "cable":
        return
    wet = setup.face_r * (1 + 0.1 * rng.normal(size=scene.count))
    face = np.where(hand.wet, wet, AIR_R) * setup.face_loss
    for number in range(1, MULTIPLES + 1):
        scene.add(face * (0.5 * face) ** (number - 1), number * scene.skin_us)
        if number > 1:
            heard = scene.bone * (0.5 * number * face) ** (number - 1)
            scene.add(heard, number * scene.skin_us + scene.bone_us, hand.depth_mm)


def _ring_down(scene: Scene) -> Waves:
    """The element rings on after the transmitted pulse (samples,)."""
    setup = scene.setup
    if setup.blanked:
        return np.zeros(scene.band.samples, dtype=np.float32)
    cycles = np.arange(scene.band.samples) * (setup.centre_mhz / setup.sampling_mhz)
    height = BURST * (RING if setup.material else 1.0)
    return np.asarray(height * np.exp(-cycles / 1.5) * np.cos(2 * np.pi * 0.8 * cycles + 1), dtype=np.float32)


def _add_speckle(scene: Scene, waves: Waves) -> None:
    """What scatters in the tissue: it changes slowly while the probe moves; there is none in the shadow of bone."""
    setup, hand, band = scene.setup, scene.hand, scene.band
    if not hand.wet.any():
        return
    field = scene.rng.standard_normal((scene.count, 2 * len(band.mhz)), dtype=np.float32)
    keeps = np.float32(0.7 if setup.sweeps else 0.93)
    for row in np.flatnonzero(np.diff(hand.place) == 0) + 1:
        field[row] *= np.sqrt(1 - keeps**2)
        field[row] += keeps * field[row - 1]
    scale = band.size / 2 / np.linalg.norm(band.pulse)  # to a standard deviation of 1
    grains = band.lines(field.view(np.complex64) * (band.pulse * np.float32(scale)))
    # the delay line's warming moves the skin by a hundredth of a millimetre or two: nothing for the loss
    depth = (np.arange(band.samples) / setup.sampling_mhz - scene.skin_us.mean()) * (setup.mm_us / 2)
    level = setup.speckle * BONE_R * setup.face_loss * band.loss(np.maximum(depth, 0)).astype(np.float32)
    first = np.floor(scene.skin_us * setup.sampling_mhz).astype(np.int64) + 1
    bone = np.ceil((scene.skin_us + scene.bone_us) * setup.sampling_mhz).astype(np.int64)
    last = np.where(hand.bone, bone, band.samples)
    for row in np.flatnonzero(hand.wet):
        inside = slice(first[row], last[row])
        more = np.float32(1.0 if hand.bone[row] else SOFT_SPECKLE)
        waves[row, inside] += more * level[inside] * grains[row, inside]


def _add_noise(scene: Scene, waves: Waves, noise: float) -> Bools:
    """White noise and a few sharp spikes; on which lines a spike spoils the bone's echo (n,)."""
    rng, band = scene.rng, scene.band
    waves += np.float32(noise) * rng.standard_normal(waves.shape, dtype=np.float32)
    spoilt = np.zeros(scene.count, dtype=bool)
    for row in np.flatnonzero(rng.random(scene.count) < 0.02):
        at = int(rng.integers(0, band.samples - 3))
        waves[row, at : at + 2] += (np.array([1.0, -0.7]) * noise * rng.uniform(8, 20)).astype(np.float32)
        spoilt[row] = abs(at / scene.setup.sampling_mhz - scene.skin_us[row] - scene.bone_us[row]) < SPIKE_US
    return spoilt


def _digitize(scene: Scene, waves: Waves) -> npt.NDArray[np.int16]:
    """Codes of a converter that the largest wanted echo fits; where the face outshines bone, it is let clip now and then."""
    setup, rng = scene.setup, scene.rng
    face = abs(setup.face_r) * setup.face_loss
    bone = setup.face_loss * BONE_R * float(scene.band.loss(scene.hand.depth_mm.min()))
    gain = rng.uniform(12000, 28000) / (1.3 * max(face, bone))
    if rng.random() < 0.15 and face > 4 * bone:
        gain *= rng.uniform(2, 3)
    waves *= np.float32(gain)
    np.rint(waves, out=waves)
    return np.clip(waves, -LARGEST - 1, LARGEST, out=waves).astype(np.int16)


def _hidden(scene: Scene) -> Bools:
    """Where the bone's echo runs into a strong multiple of the delay line (n,)."""
    setup, hidden = scene.setup, np.zeros(scene.count, dtype=bool)
    if not setup.material:
        return hidden
    face, near_us = abs(setup.face_r) * setup.face_loss, 1.5 / (setup.bandwidth * setup.centre_mhz)
    for number in range(2, MULTIPLES + 1):
        strong = face * (0.5 * face) ** (number - 1) > 0.3 * scene.peak
        hidden |= strong & (np.abs((number - 1) * scene.skin_us - scene.bone_us) < near_us)
    return hidden


def _judge(scene: Scene, snr_db: Array, spoilt: Bools, tracked: Bools) -> World:
    """What an acceptance test asks of each line."""
    setup, hand, bone = scene.setup, scene.hand, scene.hand.bone
    ignore, hidden = hand.turns | spoilt, _hidden(scene)
    clear = scene.peak >= 10 ** (LEAST_SPECKLE_DB / 20) * _speckle_at_bone(scene)
    plain = (hand.angle_deg <= NEAR_DEG) & (snr_db >= LEAST_SNR_DB) & clear
    kind = hand.kind.copy()
    kind[bone & hidden] = "multiple"
    kind[bone & (snr_db < LEAST_SNR_DB)] = "weak"
    kind[bone & (hand.angle_deg > TILTED_DEG)] = "tilted"
    must = bone & tracked & ~ignore & ~hidden & plain
    return World(**vars(setup), kind=kind, ignore=ignore, must=must)


def _speckle_at_bone(scene: Scene) -> Array:
    """RMS of the speckle just before the bone (n,)."""
    setup = scene.setup
    return np.asarray(setup.speckle * BONE_R * setup.face_loss * scene.band.loss(scene.hand.depth_mm))


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, World]:
    """A recording of `frames` lines, at least LEAST_LINES, the truth about it, and what it was drawn from."""
    setup = setup or draw_setup(rng)
    hand = draw_hand(rng, setup, frames)
    scene = Scene(setup, hand, rng)
    _add_bone(scene)
    _add_layers(scene)
    _add_probe(scene)
    waves = scene.waves()
    waves += _ring_down(scene)
    _add_speckle(scene, waves)
    noise = scene.square / 10 ** (setup.snr_db / 20)
    spoilt = _add_noise(scene, waves, noise)
    tracked = rng.random(scene.count) > 0.02
    poses = draw_poses(rng, setup, hand)
    poses[~tracked] = np.nan
    recording = Recording(
        lines=_digitize(scene, waves),
        acquisition=setup.acquisition,
        probe_to_reference=poses,
        statuses=tuple("OK" if seen else "MISSING" for seen in tracked),
        timestamps_s=np.arange(scene.count) / LINES_S,
        palpation_points=hand.place,
    )
    with np.errstate(divide="ignore"):
        snr_db = np.where(hand.bone, 20 * np.log10(scene.peak / noise), -np.inf)
    truth = Truth(np.where(hand.bone, hand.depth_mm, np.nan), hand.angle_deg, setup.speed_m_s, snr_db)
    return recording, truth, _judge(scene, snr_db, spoilt, tracked)
