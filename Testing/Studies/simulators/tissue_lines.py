"""A second family of simulated A-lines, which shares neither code nor model with echo_lines.py.

Here a line is the response of a linear system: scatterers and interfaces in layers of skin, fat, galea and muscle, each with
the pulse's spectrum, the attenuation of its own path at every frequency, and its delay, summed over frequencies. The probe
glides, so that neighbouring lines see nearly the same tissue, or jumps. The converter sees this through a receiver that may
amplify with depth, clip, ring after the main bang and hum. What a detector has learnt from one family is judged on the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from CranioNavLib.recording import Acquisition, Recording
from CranioNavLib.rigid import rigid_from_vector
from scipy.special import j1

from Testing.Studies.simulators.line_truth import Truth

Array = npt.NDArray[np.float64]

NEPER = np.log(10) / 20  # a decibel
FINE = 32
BONE = 0.5  # amplitude reflected by bone under soft tissue; all other strengths are relative to it
FORERUN_SPEEDS_M_S = (1500.0, 2700.0)  # gels to acrylic
MISSES = ("speckle", "empty", "air", "eye")  # lines without bone


@dataclass(frozen=True)
class Setup:
    """What all lines of a recording share."""

    acquisition: Acquisition
    samples: int
    pulse: str  # gauss, hann, chirp (origin in the middle); damped, resonator (origin at the onset)
    cycles: float  # -6 dB length
    phase: float
    chirp: float
    speed_m_s: float
    attenuation: float  # dB/cm/MHz
    per_frequency: bool  # attenuation acts on each frequency (and lowers the centre); otherwise on the whole pulse
    snr_db: float  # peak of the bone echo over the RMS of the noise
    snr_of: str  # line: of each line's own echo; square: of a perpendicular echo of its depth; recording: of one at 6 mm
    noise_band: float  # noise up to this many times the transducer's frequency; 0: white
    tilt_law: str  # disc, gauss, flat
    tilt_width_deg: float
    diffuse_db: float  # rough bone's echo under the mirror's
    roughness_mm: float
    speckle_db: float  # under the bone echo; > 80: none
    layer_db: tuple[float, float]  # echoes of the layers' borders under the bone's
    galea_db: float
    inner_db: float
    bone_mm: float
    multiple_db: float  # skin-bone multiple under the bone echo
    forerun_r: float
    forerun_back: float  # of its next bounce, per bounce
    forerun_late: float  # its time over the header's
    forerun_drift: float  # of its time over the recording
    bang_db: float  # main bang over the bone echo; < 0: none
    bang_us: float
    tgc: str  # off, signal (noise stays flat), all (noise rises with it)
    tgc_db_us: float
    tgc_from_us: float
    hum: float  # of the noise
    offset: float
    spikes: float  # a line
    jitter_ns: float
    codes: float  # largest code
    clip: float  # times the largest
    glide_mm: float  # between lines; 0: each line stands elsewhere
    depth_mm: tuple[float, float]  # of this recording
    miss_share: float
    most_tilt_deg: float


def draw_setup(rng: np.random.Generator) -> Setup:
    """A set-up from wide ranges."""
    centre = float(rng.uniform(3, 10))
    sampling = float(np.exp(rng.uniform(np.log(max(25.0, 2.5 * centre)), np.log(125))))
    speed = float(rng.uniform(1450, 1630))
    forerun_speed = float(rng.uniform(*FORERUN_SPEEDS_M_S))
    length = float(rng.uniform(16, 30) * forerun_speed / 2000) if rng.random() < 0.6 else 0.0
    if length and rng.random() < 0.6:
        length = max(length, 15.5 * forerun_speed / speed)
    thick = rng.random()
    low = float(rng.uniform(2, 14)) if thick < 0.6 else 2.0
    high = float(min(low + rng.uniform(0.5, 4), 15)) if thick < 0.6 else 15.0
    needed = (2e3 * length / forerun_speed if length else 0.0) + 2e3 * (high + 1.5) / speed + 2.0
    samples = int(np.clip(needed * sampling * rng.choice([1.0, rng.uniform(1.05, 2.0)]), 600, 8000))
    alpha = float(np.exp(rng.uniform(np.log(0.3), np.log(2.6))))
    strong = float(rng.uniform(9, 26))
    return Setup(
        acquisition=Acquisition(sampling * 1e6, centre * 1e6, length, forerun_speed if length else 0.0),
        samples=samples,
        pulse=str(rng.choice(["gauss", "hann", "chirp", "damped", "resonator"], p=[0.35, 0.1, 0.15, 0.2, 0.2])),
        cycles=float(rng.uniform(0.9, 3.0)),
        phase=float(rng.choice([0.0, np.pi, rng.uniform(0, 2 * np.pi)])),
        chirp=float(rng.uniform(-0.25, 0.25)),
        speed_m_s=speed,
        attenuation=alpha,
        per_frequency=bool(rng.random() < 0.65),
        snr_db=float(rng.uniform(12, 40)),
        snr_of=str(rng.choice(["line", "square", "recording"], p=[0.4, 0.4, 0.2])),
        noise_band=float(rng.choice([0.0, rng.uniform(1.6, 3.0)], p=[0.7, 0.3])),
        tilt_law=str(rng.choice(["disc", "gauss", "flat"], p=[0.25, 0.5, 0.25])),
        tilt_width_deg=float(rng.uniform(2, 9)),
        diffuse_db=float(rng.uniform(13, 32)),
        roughness_mm=float(rng.choice([0.0, rng.uniform(0.005, 0.03)])),
        speckle_db=float(rng.choice([rng.uniform(18, 55), 99.0], p=[0.85, 0.15])),
        layer_db=(strong, strong + float(rng.uniform(2, 14))),
        galea_db=float(rng.choice([rng.uniform(9, 26), 99.0], p=[0.6, 0.4])),
        inner_db=float(rng.choice([rng.uniform(5, 26), 99.0], p=[0.75, 0.25])),
        bone_mm=float(rng.uniform(3, 8)),
        multiple_db=float(rng.choice([rng.uniform(8, 30), 99.0], p=[0.6, 0.4])),
        forerun_r=float(rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(0.03), np.log(0.5)))),
        forerun_back=float(rng.uniform(0.1, 0.6)),
        forerun_late=float(1 + rng.choice([0.0, rng.uniform(-0.02, 0.02)])),
        forerun_drift=float(rng.choice([0.0, rng.uniform(-0.004, 0.004)])),
        bang_db=float(rng.choice([-1.0, rng.uniform(3, 30)], p=[0.4, 0.6])),
        bang_us=float(rng.uniform(0.1, 0.5)),
        tgc=str(rng.choice(["off", "signal", "all"], p=[0.86, 0.06, 0.08])),
        tgc_db_us=float(min(alpha * centre * speed * 2e-4 * rng.uniform(0.5, 1.0) * 0.5, 4.0)),
        tgc_from_us=float(rng.uniform(0, 4)),
        hum=float(rng.choice([0.0, rng.uniform(1, 40)], p=[0.6, 0.4])),
        offset=float(rng.choice([0.0, rng.uniform(-30, 30)], p=[0.6, 0.4])),
        spikes=float(rng.choice([0.0, rng.uniform(0, 1.0)], p=[0.7, 0.3])),
        jitter_ns=float(rng.choice([0.0, rng.uniform(0, 12)])),
        codes=float(np.exp(rng.uniform(np.log(200), np.log(32000)))),
        clip=float(rng.choice([1.0, rng.uniform(0.4, 1.0)], p=[0.75, 0.25])),
        glide_mm=float(rng.choice([0.0, 0.02, rng.uniform(0.1, 0.6)], p=[0.3, 0.3, 0.4])),
        depth_mm=(low, high),
        miss_share=float(rng.choice([0.0, 0.15, 0.4], p=[0.25, 0.5, 0.25])),
        most_tilt_deg=float(rng.choice([2.0, 5.0, 8.0], p=[0.3, 0.5, 0.2])),
    )  # fmt: skip


def tidy(setup: Setup, rng: np.random.Generator) -> Setup:
    """The same without accidents, and with tissue whose layers echo well below bone: a careful bench recording."""
    weak = float(rng.uniform(12, 28))
    return replace(
        setup,
        jitter_ns=0.0,
        hum=0.0,
        offset=0.0,
        spikes=0.0,
        clip=1.0,
        tgc="off",
        forerun_late=1.0,
        forerun_drift=0.0,
        noise_band=0.0,
        pulse=str(rng.choice(["gauss", "hann", "damped"], p=[0.7, 0.1, 0.2])),
        codes=max(setup.codes, 2000.0),
        cycles=min(setup.cycles, 2.2),
        layer_db=(weak, weak + float(rng.uniform(2, 12))),
        galea_db=max(setup.galea_db, float(rng.uniform(12, 20))),
        tilt_law="gauss" if setup.tilt_law == "disc" else setup.tilt_law,
        tilt_width_deg=max(setup.tilt_width_deg, 3.0),
    )


def spectrum_of(setup: Setup, frequency_hz: Array) -> npt.NDArray[np.complex128]:
    """Spectrum of the pulse with its origin at time 0, peak of its envelope about 1."""
    f0 = setup.acquisition.transducer_hz
    rate = 32 * f0
    t = np.arange(-1024, 1024) / rate
    wave = pulse_at(setup, t)
    basis = np.exp(-2j * np.pi * frequency_hz[:, None] * t)
    return np.asarray(basis @ wave / rate)


def pulse_at(setup: Setup, t: Array) -> npt.NDArray[np.complex128]:
    """The (analytic) pulse at times t (s) from its origin."""
    f0 = setup.acquisition.transducer_hz
    u = t * f0  # cycles
    carrier = np.exp(1j * (2 * np.pi * u + setup.phase))
    if setup.pulse == "damped":
        envelope = np.where(u >= 0, np.exp(-np.log(2) * np.clip(u, 0, None) / setup.cycles), 0.0)
    elif setup.pulse == "resonator":
        v = np.clip(u, 0, None) * 3.3 / setup.cycles
        envelope = v**2 * np.exp(-v) / (4 * np.exp(-2))
    elif setup.pulse == "hann":
        envelope = np.where(np.abs(u) < setup.cycles, np.cos(np.pi * u / (2 * setup.cycles)) ** 2, 0.0)
    else:
        envelope = np.exp(-np.log(2) * (2 * u / setup.cycles) ** 2)
        if setup.pulse == "chirp":
            carrier = carrier * np.exp(1j * np.pi * setup.chirp * u**2)
    return np.asarray(envelope * carrier)


@dataclass(frozen=True, eq=False)
class Echoes:
    """What one line sends back: times from the pulse, strengths, and the depth of tissue each echo has passed."""

    times_us: Array
    strengths: Array
    paths_mm: Array


class Collected:
    """Echoes of one line, collected."""

    def __init__(self) -> None:
        self.parts: list[Array] = [np.zeros((3, 0))]

    def add(self, time_us: npt.ArrayLike, strength: npt.ArrayLike, path_mm: npt.ArrayLike) -> None:
        """One echo or several."""
        self.parts.append(np.stack(np.broadcast_arrays(*(np.atleast_1d(x) for x in (time_us, strength, path_mm)))).astype(float))

    def echoes(self, late_us: float) -> Echoes:
        """All of them, later by the trigger's jitter."""
        times, strengths, paths = np.concatenate(self.parts, axis=1)
        return Echoes(times + late_us, strengths, paths)


class Synthesiser:
    """Sums echoes into lines, over frequencies."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        acquisition = setup.acquisition
        self.length = setup.samples + int(6 * acquisition.sampling_hz / acquisition.transducer_hz)
        top = min(acquisition.sampling_hz / 2, 3.2 * acquisition.transducer_hz)
        self.count = int(top / acquisition.sampling_hz * self.length)
        self.frequency = np.arange(1, self.count) * acquisition.sampling_hz / self.length
        self.pulse = spectrum_of(setup, self.frequency) * acquisition.sampling_hz
        per_mm = setup.attenuation * 0.2e-6 * NEPER
        self.loss_bin = per_mm * acquisition.sampling_hz / self.length if setup.per_frequency else 0.0
        self.loss_all = 0.0 if setup.per_frequency else per_mm * acquisition.transducer_hz
        depths = np.linspace(0, 20, 11)
        middle = 0.5 * setup.samples / acquisition.sampling_hz * 1e6
        lines = [self.line(Echoes(np.array([middle]), np.array([BONE]), np.array([depth]))) for depth in depths]
        self.peaks = depths, np.log([np.abs(line).max() for line in lines])

    def line(self, echoes: Echoes) -> Array:
        """RF of one line: the sum over echoes of `strength * base^bin`, the powers split into a coarse and a fine part."""
        base = -2j * np.pi * echoes.times_us * 1e-6 * self.setup.acquisition.sampling_hz / self.length
        base = base - echoes.paths_mm * self.loss_bin
        strength = echoes.strengths * np.exp(-echoes.paths_mm * self.loss_all)
        coarse = np.exp(np.outer(np.arange(0, self.count, FINE), base))
        fine = np.exp(np.outer(base, np.arange(1, FINE + 1)))
        total = (coarse * strength) @ fine
        whole = np.zeros(self.length // 2 + 1, dtype=complex)
        whole[1 : self.count] = total.ravel()[: self.count - 1] * self.pulse
        return np.asarray(np.fft.irfft(whole, self.length)[: self.setup.samples] * 0.5)

    def peak(self, depth_mm: float) -> float:
        """Largest amplitude of the echo of a perpendicular mirror at a depth."""
        return float(np.exp(np.interp(depth_mm, *self.peaks)))


def tilt_response(setup: Setup, tilt_deg: Array) -> Array:
    """Mirror echo of tilted bone over that of bone met squarely."""
    if setup.tilt_law == "flat":
        return np.asarray(np.cos(np.radians(tilt_deg)) ** 8)
    if setup.tilt_law == "gauss":
        return np.asarray(np.exp(-np.log(2) * (tilt_deg / setup.tilt_width_deg) ** 2))
    x = 2 * np.pi * setup.acquisition.transducer_hz / (setup.speed_m_s * 1e3) * 5.0 * np.sin(np.radians(tilt_deg))
    x = np.maximum(x * 5e6 / setup.acquisition.transducer_hz, 1e-6)  # probes of higher frequency are smaller
    return np.asarray(np.abs(2 * j1(x) / x))


class Tissue:
    """Layers and scatterers under the probe, which change slowly as it glides."""

    def __init__(self, setup: Setup, rng: np.random.Generator) -> None:
        self.setup, self.rng = setup, rng
        self.place()

    def place(self) -> None:
        """A new place on the head."""
        rng, setup = self.rng, self.setup
        self.depth = float(rng.uniform(*setup.depth_mm))
        self.slope = float(rng.normal(0, 0.04))  # mm of depth a mm of way
        self.tilt = float(rng.uniform(0, setup.most_tilt_deg))
        self.borders = np.sort(rng.uniform(0.08, 0.95, int(rng.integers(0, 4))))
        sign = rng.choice([-1, 1], len(self.borders))
        self.border_r = BONE * 10 ** (-rng.uniform(*setup.layer_db, len(self.borders)) / 20) * sign
        self.galea = float(rng.uniform(0.4, 2.2)), float(rng.uniform(0.2, 1.0))  # over the bone, thickness: mm
        density = float(rng.uniform(3, 14))  # scatterers a mm
        self.z = rng.uniform(0, 40.0, rng.poisson(density * 40))
        self.a = rng.normal(size=len(self.z)) / np.sqrt(density)
        self.tint = 10 ** (rng.normal(0, 4, 4) / 20)  # speckle of the layers differs
        self.rough = rng.normal(size=12)
        self.thickness = setup.bone_mm * rng.uniform(0.85, 1.15)
        self.miss = str(rng.choice(MISSES, p=[0.4, 0.2, 0.3, 0.1])) if rng.random() < setup.miss_share else ""

    def glide(self, step_mm: float) -> None:
        """The probe moves on; speckle decorrelates over a millimetre, tilt and depth wander."""
        rng = self.rng
        keep = np.exp(-step_mm / 0.8)
        self.a = keep * self.a + np.sqrt(1 - keep**2) * rng.normal(size=len(self.a)) * self.a.std()
        self.rough = keep * self.rough + np.sqrt(1 - keep**2) * rng.normal(size=12)
        self.depth += self.slope * step_mm + rng.normal(0, 0.03)
        self.depth = float(np.clip(self.depth, *self.setup.depth_mm))
        self.tilt = float(abs(self.tilt + rng.normal(0, 0.25)))
        if rng.random() < step_mm / 20:
            self.place()

    def echoes(self, skin_us: float, jitter_us: float) -> tuple[Echoes, float]:
        """The line's echoes and the mirror's response at its tilt."""
        setup, some = self.setup, Collected()
        add = some.add
        per_mm = 2e3 / setup.speed_m_s
        if skin_us:
            number = np.arange(1, 6)
            face = 0.9 if self.miss == "air" else setup.forerun_r
            add(number * skin_us, face**number * (-setup.forerun_back) ** (number - 1), 0.0)
        mirror = float(tilt_response(setup, np.array([self.tilt]))[0]) if not self.miss else 0.0
        reach = {"": self.depth, "speckle": 40.0, "empty": 0.0, "air": 0.0, "eye": 3.0}[self.miss]
        if reach and setup.speckle_db < 80:
            inside = self.z < reach
            z = self.z[inside]
            tint = self.tint[np.minimum(np.searchsorted(self.borders, z / self.depth), 3)]
            add(skin_us + z * per_mm, BONE * 10 ** (-setup.speckle_db / 20) * tint * self.a[inside], z)
        if self.miss in ("", "speckle", "eye"):
            z = self.borders * (3.0 if self.miss == "eye" else self.depth)
            add(skin_us + z * per_mm, self.border_r, z)
        if self.miss == "eye":
            z = np.array([3.0, 6.5, 10.0, 24.0]) + self.rough[:4] * 0.2
            add(skin_us + z * per_mm, BONE * np.array([0.12, 0.06, 0.06, 0.1]) * (1 + 0.3 * self.rough[4:8]), z * 0.3)
        if not self.miss:
            self._bone(some, skin_us, per_mm, mirror)
        return some.echoes(jitter_us), mirror

    def _bone(self, some: Collected, skin_us: float, per_mm: float, mirror: float) -> None:
        """Bone, what lies just before it, and what follows."""
        setup, depth, add = self.setup, self.depth, some.add
        if setup.galea_db < 80 and depth > self.galea[0] + self.galea[1] + 0.8:
            top = depth - self.galea[0] - self.galea[1]
            strength = BONE * 10 ** (-setup.galea_db / 20) * np.array([1, -0.7])
            add(skin_us + np.array([top, top + self.galea[1]]) * per_mm, strength, top)
        arrival = skin_us + depth * per_mm
        if setup.roughness_mm:  # a rough mirror: facets before and behind the mean surface
            add(arrival + self.rough[:6] * setup.roughness_mm * per_mm, BONE * mirror / 6, depth)
        else:
            add(arrival, BONE * mirror, depth)
        spread = 1.2 * np.tan(np.radians(self.tilt))  # a tilted bone under a beam of a millimetre or two
        diffuse = BONE * 10 ** (-setup.diffuse_db / 20) / np.sqrt(6)
        add(arrival + np.linspace(-0.5, 0.5, 6) * spread * per_mm, diffuse * self.rough[6:12], depth)
        if setup.inner_db < 80:
            behind = arrival + 2 * self.thickness / 3.0
            add(behind, -BONE * mirror * 10 ** (-setup.inner_db / 20), depth)
            add(np.linspace(arrival, behind, 5)[1:4], BONE * 0.03 * self.rough[:3], depth)
        if setup.multiple_db < 80:
            add(arrival + depth * per_mm, -BONE * mirror * 10 ** (-setup.multiple_db / 20), 2 * depth)


def simulate(rng: np.random.Generator, frames: int, setup: Setup | None = None) -> tuple[Recording, Truth, Setup]:
    """A recording of `frames` lines, and the truth about it."""
    if setup is None:
        setup = draw_setup(rng)
        setup = tidy(setup, rng) if rng.random() < 0.6 else setup
    acquisition, tissue, synthesiser = setup.acquisition, Tissue(setup, rng), Synthesiser(setup)
    nominal = 2e3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s if acquisition.forerun_length_mm else 0.0
    lines = np.zeros((frames, setup.samples))
    depth, tilt, noise, snr = (np.full(frames, np.nan) for _ in range(4))
    kinds, where = [], np.zeros((frames, 3))
    height = synthesiser.peak(6.0)
    for index in range(frames):
        if index:
            tissue.glide(setup.glide_mm) if setup.glide_mm else tissue.place()
        skin = nominal * setup.forerun_late * (1 + setup.forerun_drift * index / frames)
        echoes, mirror = tissue.echoes(skin, float(rng.normal(0, setup.jitter_ns * 1e-3)))
        lines[index] = synthesiser.line(echoes)
        square = synthesiser.peak(tissue.depth)
        own = square * max(mirror, 10 ** (-setup.diffuse_db / 20))
        wanted = {"line": own if not tissue.miss else square, "square": square, "recording": height}[setup.snr_of]
        noise[index] = wanted * 10 ** (-setup.snr_db / 20)
        tilt[index] = tissue.tilt
        kinds.append(tissue.miss or "bone")
        if not tissue.miss and skin + 2e3 * tissue.depth / setup.speed_m_s < setup.samples / acquisition.sampling_hz * 1e6 - 0.6:
            depth[index] = tissue.depth
            snr[index] = 20 * np.log10(own / noise[index])
        where[index] = where[max(index - 1, 0)] + [setup.glide_mm, 0, 0] if setup.glide_mm else rng.uniform(-80, 80, 3)
    lines = receive(rng, setup, lines, noise, height)
    turns = np.tile(rng.uniform(-2, 2, 3), (frames, 1)) + rng.normal(0, 0.01, (frames, 3))
    poses = rigid_from_vector(turns, where + rng.normal(0, 0.05, where.shape))
    recording = Recording(
        lines=lines, acquisition=acquisition, probe_to_reference=poses, statuses=("OK",) * frames,
        timestamps_s=np.arange(frames) / 40, palpation_points=np.full(frames, -1),
    )  # fmt: skip
    return recording, Truth(depth, tilt, setup.speed_m_s, np.where(np.isfinite(snr), snr, -np.inf)), setup


def receive(rng: np.random.Generator, setup: Setup, lines: Array, noise: Array, height: float) -> npt.NDArray[np.int16]:
    """What the receiver and the converter make of the lines: main bang, noise, gain with depth, hum, spikes, clipping, codes."""
    count, samples = lines.shape
    sampling, centre = setup.acquisition.sampling_hz, setup.acquisition.transducer_hz
    t_us = np.arange(samples) / sampling * 1e6
    if setup.bang_db >= 0:
        ring = height * 10 ** (setup.bang_db / 20) * np.exp(-t_us / setup.bang_us)
        lines = lines + ring * np.sin(2 * np.pi * centre * 1e-6 * t_us + setup.phase)
    ramp = 10 ** (np.clip((t_us - setup.tgc_from_us) * setup.tgc_db_us, 0, 45) / 20)
    white = rng.normal(size=lines.shape)
    if setup.noise_band and setup.noise_band * centre < sampling / 2:
        spectrum = np.fft.rfft(white, axis=1)
        spectrum[:, np.fft.rfftfreq(samples, 1 / sampling) > setup.noise_band * centre] = 0
        white = np.fft.irfft(spectrum, samples, axis=1)
        white /= white.std()
    if setup.tgc == "all":
        lines = (lines + white * noise[:, None]) * ramp
    elif setup.tgc == "signal":
        lines = lines * ramp + white * noise[:, None] * np.median(ramp)
    else:
        lines = lines + white * noise[:, None]
    middle = float(np.median(noise))
    phase = rng.uniform(0, 2 * np.pi, count)[:, None]
    lines = lines + setup.hum * middle * np.sin(2 * np.pi * 50e-6 * t_us * 200 + phase) + setup.offset * middle
    for row in range(count):
        for _ in range(rng.poisson(setup.spikes)):
            lines[row, rng.integers(samples)] += rng.choice([-1, 1]) * rng.uniform(5, 60) * middle
    later = lines[:, min(int(1e-6 * sampling), samples // 4) :]
    largest = np.percentile(np.abs(later).max(axis=1), 95) * setup.clip
    return np.asarray(np.clip(np.round(lines / largest * setup.codes), -setup.codes, setup.codes), dtype=np.int16)
