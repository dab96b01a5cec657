"""How layered tissue over bone answers to a pulse, frequency by frequency, for layer_lines.py.

Spectra are over lines and frequencies (n, F). Units are mm, microseconds and MHz, so that speeds are in mm/us.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft
from scipy.special import j1

from Testing.Studies.simulators.layer_plan import NEPER, Array, Head, Stack, Stay, Transducer, over_places

Real = npt.NDArray[np.float32]
Spectra = npt.NDArray[np.complex64]

WINDOWS = 1.6  # length of the transform over that of a line: what comes later must not come round
FAINT = 3e-4  # of the pulse's spectrum, over its height: what is less is left out
LOBE_STEP, LOBE_REACH = 0.002, 150.0  # of the table of the beam
LOBE = np.append(1.0, 2 * j1(np.arange(LOBE_STEP, LOBE_REACH, LOBE_STEP)) / np.arange(LOBE_STEP, LOBE_REACH, LOBE_STEP))
LOBE = LOBE.astype(np.float32)
SPOT = 0.12  # width of the beam on the bone (standard deviation) over the disc
FACETS_MM2, FACETS_ACROSS_MM = 7, 4.0  # of the bone's surface; how far to the sides
SPECKLE_MM, SPECKLE_US, SPECKLE_STEP_DB = 0.4, 50.0, 6.0  # a cell along the skin; as long as tissue scatters; between two filters
BRAIN = 10 ** (-8 / 20)  # its speckle over skin's
DURA = 0.5 * (1.68 - 1.52) / 3.2  # its reflection under a hole


def phasor(phase: npt.ArrayLike) -> Spectra:
    """exp(i phase), fast."""
    phase = np.asarray(phase, dtype=np.float32)
    out = np.empty(phase.shape, dtype=np.complex64)
    np.cos(phase, out=out.real)
    np.sin(phase, out=out.imag)
    return out


class Band:
    """Frequencies of a recording, and its pulse on them: the envelope's peak stands at time zero with height 1."""

    def __init__(self, transducer: Transducer, samples: int) -> None:
        self.transducer, self.samples, rate = transducer, samples, transducer.sampling_mhz
        self.size = scipy.fft.next_fast_len(int(WINDOWS * samples), real=True)
        self.step = rate / self.size
        self.top = min(2.3 * transducer.nominal_mhz, 0.49 * rate)
        number = np.arange(self.size // 2 + 1)
        self.heard = number[(number * self.step > 0.12 * transducer.nominal_mhz) & (number * self.step < self.top)]
        self.heard_mhz = self.heard * self.step
        peak_us, height = self._peak()
        pulse = self._raw(self.heard_mhz) * np.exp(2j * np.pi * self.heard_mhz * peak_us) / height
        level, late_us = transducer.backing
        pulse *= 1 + level * np.exp(-2j * np.pi * self.heard_mhz * late_us)
        strong = np.flatnonzero(np.abs(pulse) > FAINT * np.abs(pulse).max())
        self.bins = self.heard[strong[0] : strong[-1] + 1]  # of all echoes; noise is heard a little further
        self.pulse = pulse[strong[0] : strong[-1] + 1].astype(np.complex64)
        self.mhz = (self.bins * self.step).astype(np.float32)
        self.energy = float(np.sqrt(2 / self.size * (np.abs(pulse) ** 2).sum()))  # root of the sum of squared samples

    def receiver(self, mhz: Array) -> Array:
        """Response of the receiver."""
        high = np.cos(np.pi / 2 * np.clip((mhz / self.top - 0.78) / 0.22, 0, 1)) ** 2
        return np.asarray(high * np.clip((mhz / self.transducer.nominal_mhz - 0.12) / 0.18, 0, 1))

    def _raw(self, mhz: Array) -> npt.NDArray[np.complex128]:
        """Spectrum of the pulse before it is put to time zero."""
        one, centre = self.transducer, self.transducer.centre_mhz

        def resonator(tuned: float, quality: float) -> npt.NDArray[np.complex128]:
            damped = 1j * mhz * tuned / quality
            return np.asarray(damped / (tuned**2 - mhz**2 + damped))

        first, last = one.qualities
        pulse = resonator(centre * (1 + one.skew), first) * resonator(centre * (1 - one.skew), first) * resonator(centre, last)
        height, quality, ratio, phase = one.ring
        ring = height * np.exp(1j * phase) * resonator(centre * ratio, quality) * resonator(centre, 1)
        return np.asarray((pulse * np.sinc(mhz * one.pulser_us) + ring) * self.receiver(mhz) * one.sign)

    def _peak(self) -> tuple[float, float]:
        """When the envelope peaks (us), and its height in samples."""
        reach_us, before_us, size = 16.0, 2.0, 8192
        mhz = np.arange(1, int(self.top * reach_us)) / reach_us
        spectrum = np.zeros(size, dtype=complex)
        spectrum[1 : len(mhz) + 1] = self._raw(mhz) * np.exp(-2j * np.pi * mhz * before_us)
        envelope = np.abs(scipy.fft.ifft(spectrum)) * size * 2 / (reach_us * self.transducer.sampling_mhz)
        at = int(envelope.argmax())
        return at * reach_us / size - before_us, float(envelope[at])

    def lines(self, spectra: npt.NDArray[np.complexfloating], bins: npt.NDArray[np.int64]) -> Real:
        """Samples (n, samples) of spectra (n, F) on the given frequencies."""
        full = np.zeros((len(spectra), self.size // 2 + 1), dtype=np.complex64)
        full[:, bins[0] : bins[-1] + 1] = spectra
        return np.asarray(scipy.fft.irfft(full, self.size, axis=1)[:, : self.samples])

    def heights(self, spectra: Spectra) -> Array:
        """Peaks (n,) of the envelopes of echoes (n, F)."""
        size = scipy.fft.next_fast_len(3 * spectra.shape[1])
        largest = np.abs(scipy.fft.ifft(spectra * self.pulse, size, axis=1)).max(axis=1)
        return np.asarray(largest * (2 * size / self.size), dtype=np.float64)

    def delay(self, time_us: Array) -> Spectra:
        """What turns an echo at zero into one at these times: (n, F)."""
        return phasor(np.outer(-2 * np.pi * time_us, self.mhz))

    def lobe(self, tilt_deg: npt.ArrayLike, speed: float) -> Real:
        """Echo of a tilted plane (n, F) over that of one met squarely: a disc listening to its mirror image."""
        one = self.transducer
        off = 2 * np.pi / speed * one.flatness * one.disc_mm * np.sin(np.radians(tilt_deg))
        at = np.outer(np.abs(off) / LOBE_STEP, self.mhz).astype(np.int32)
        return np.asarray(LOBE[np.minimum(at, len(LOBE) - 1)])

    def through(self, layer_mm: npt.ArrayLike, speed: float, attenuation: float) -> Spectra:
        """Through a layer (n,) and back, with its loss and dispersion: (n, F). The speed is the group's at the centre."""
        neper = attenuation * NEPER / 10
        bent = neper / np.pi**2
        slowness = 1 / speed + bent - bent * np.log(self.mhz / self.transducer.centre_mhz)
        passed = phasor(np.outer(layer_mm, -4 * np.pi * self.mhz * slowness))
        passed *= np.exp(np.outer(np.asarray(layer_mm, dtype=np.float32), -2 * neper * self.mhz))
        return passed


@dataclass(frozen=True, eq=False)
class Answer:
    """What comes back from a place to the probe's face, over what goes in."""

    whole: Spectra  # (n, F)
    bone: Spectra  # (n, F) the bone's echo alone
    square: Spectra  # (n, F) what it would be if it were met squarely


def answer_of(rng: np.random.Generator, band: Band, head: Head, stay: Stay, stack: Stack, face_impedance: float) -> Answer:
    """Reflection of a place: from the deepest interface up through the layers, exact with every reverberation."""
    bone, count = stay.kind == "bone", len(stack.share)
    impedance = np.append(face_impedance, stack.impedance)
    steps = np.diff(impedance) / (impedance[1:] + impedance[:-1])
    lean = rng.normal(0, 2, (count, 2))
    part = np.cumsum(stack.share) - stack.share  # an interface follows the bone the more, the deeper it is
    interfaces, ways = [np.full((len(stay), 1), steps[0], dtype=np.float32)], []
    for layer in range(count):
        ways.append(band.through(stack.thickness_mm[:, layer], stack.speed[layer], stack.attenuation[layer]))
        if layer:
            rough = rng.uniform(*((0.35, 1) if bone else (0.1, 0.35))) * (1 + over_places(rng, stay.x_mm, 4, 0.25))
            tilt = np.hypot(*(stay.tilt_deg * part[layer] + lean[layer]).T)
            height = (steps[layer] * np.clip(rough, 0.1, 1.2)).astype(np.float32)
            interfaces.append(height * band.lobe(tilt, stack.speed[layer - 1]))
    if bone:
        below, echo, square = _bone(rng, band, head, stay, impedance[-1])
        for way, interface in zip(ways, interfaces):
            echo, square = [back * (way * (1 - interface**2)) for back in (echo, square)]
    else:
        below = echo = square = np.zeros((len(stay), len(band.mhz)), dtype=np.complex64)
    for way, interface in zip(reversed(ways), reversed(interfaces)):
        below = below * way
        below = (interface + below) / (1 + interface * below)
    return Answer(below + _speckle(rng, band, head, stay, stack), echo, square)


def _bone(rng: np.random.Generator, band: Band, head: Head, stay: Stay, above: float) -> tuple[Spectra, Spectra, Spectra]:
    """Bone, or dura in a hole, as it answers to the lowest soft layer: all of it, its surface alone, the surface met squarely."""
    tables = [rng.uniform(5.4, 7.8), rng.uniform(3.4, 4.8), rng.uniform(5.4, 7.8), 1.6]  # MRayl; the last is the brain
    thick = [rng.uniform(1.5, 3), rng.uniform(1.5, 4), rng.uniform(1, 2)]
    speeds = [rng.uniform(2.8, 3.0), rng.uniform(2.3, 2.6), 2.9]
    losses = [rng.uniform(3, 6), rng.uniform(8, 15), rng.uniform(3, 6)]
    angle, speed = stay.angle_deg, head.speed
    surface = np.float32((tables[0] - above) / (tables[0] + above))
    roughness_mm = rng.uniform(0.003, 0.02)
    rough = np.exp(-0.5 * (4 * np.pi * band.mhz / speed * roughness_mm) ** 2).astype(np.float32)
    specular = band.lobe(angle, speed) * rough
    deep = np.zeros((len(stay), len(band.mhz)), dtype=np.complex64)
    for layer in (2, 1, 0):
        step = (tables[layer + 1] - tables[layer]) / (tables[layer + 1] + tables[layer]) * rng.uniform(0.3, 0.8)
        inner = np.float32(step) * band.lobe(angle + rng.uniform(0, 3), speeds[layer])
        deep = (inner + deep * np.float32(1 - step * step)) * band.through([thick[layer]], speeds[layer], losses[layer])
    diffuse = _facets(rng, band, head, stay) * surface
    open_ = stay.hole[:, None]
    dura = np.float32(DURA) * band.lobe(angle + 1, speed) if stay.hole.any() else np.float32(0)
    whole = np.where(open_, dura, surface * specular + (1 - surface**2) * specular * deep + diffuse)
    echo = np.where(open_, np.float32(0), surface * specular + diffuse)
    square = np.where(open_, np.float32(0), np.broadcast_to(surface * rough, whole.shape)).astype(np.complex64)
    return whole, echo, square


def _facets(rng: np.random.Generator, band: Band, head: Head, stay: Stay) -> Spectra:
    """The diffuse part of the bone's echo (n, F), over its reflection: facets in the beam, about the depth along the beam."""
    spot = SPOT * band.transducer.disc_mm
    low, high = stay.x_mm.min() - 3, stay.x_mm.max() + 3
    count = int(FACETS_MM2 * (high - low) * 2 * FACETS_ACROSS_MM)
    along, across = rng.uniform(low, high, count), rng.uniform(-FACETS_ACROSS_MM, FACETS_ACROSS_MM, count)
    relief, height = rng.normal(0, 0.02, count), rng.normal(size=count)
    far_x, far_y = along - stay.x_mm[:, None], across - stay.y_mm[:, None]
    away = far_x**2 + far_y**2
    row, facet = np.nonzero((away < (2.3 * spot) ** 2) & ~stay.hole[:, None])
    slope = np.tan(np.radians(stay.tilt_deg))[row]
    longer = stay.thickness_mm * (1 / np.cos(np.radians(stay.angle_deg)) - 1)  # along the beam than perpendicular
    deeper = longer[row] + slope[:, 0] * far_x[row, facet] + slope[:, 1] * far_y[row, facet] + relief[facet]
    value = height[facet] * np.exp(-away[row, facet] / (2 * spot**2)) * (head.diffuse / np.sqrt(FACETS_MM2 * np.pi * spot**2))
    # sorted into steps of time, shared between the two next to each facet, they are transformed together
    step_us = 1 / (16 * band.transducer.nominal_mhz)
    at = 2 * deeper / head.speed / step_us
    first = int(np.floor(at.min(initial=0.0)))
    steps = int(np.ceil(at.max(initial=0.0))) - first + 2
    lower = np.floor(at).astype(np.int64)
    cell, upper = row * steps + lower - first, at - lower
    sorted_ = np.bincount(cell, value * (1 - upper), len(stay) * steps)
    sorted_ += np.bincount(cell + 1, value * upper, len(stay) * steps)
    sorted_ = sorted_.reshape(len(stay), steps).astype(np.float32)
    waves = band.delay((first + np.arange(steps)) * step_us)
    spectra = np.empty((len(stay), len(band.mhz)), dtype=np.complex64)
    spectra.real, spectra.imag = sorted_ @ waves.real, sorted_ @ waves.imag
    return spectra


def _speckle(rng: np.random.Generator, band: Band, head: Head, stay: Stay, stack: Stack) -> Spectra:
    """Scatterers (n, F) that stay where they are while the hand moves; none behind bone."""
    edges = np.cumsum(2 * stack.thickness_mm / stack.speed, axis=1)
    goes_on = stay.hole if stay.kind == "bone" else np.ones(len(stay), dtype=bool)
    reach_us = min(band.samples / band.transducer.sampling_mhz, SPECKLE_US)
    if not goes_on.any():
        reach_us = min(reach_us, float(edges[:, -1].max()))
    size = scipy.fft.next_fast_len(int(2.05 * (band.bins[-1] + 1)), real=True)  # a rate as low as the band allows
    rate = size * band.step
    time = np.arange(int(reach_us * rate) + 1) / rate
    level = np.zeros((len(stay), len(time)), dtype=np.float32)
    start = np.zeros((len(stay), 1))
    for layer in range(len(stack.share)):
        end = edges[:, layer : layer + 1]
        level += np.float32(stack.speckle[layer]) * ((time >= start) & (time < end))
        start = end
    level += np.float32(BRAIN) * (goes_on[:, None] & (time >= start))
    per_us = head.attenuation * head.speed / 10  # dB/MHz
    scale = head.speckle * (1.0 if stay.kind == "bone" else 1.6) / band.energy / np.sqrt(rate / band.transducer.sampling_mhz)
    centre = band.transducer.nominal_mhz
    level *= (scale * np.exp(-NEPER * per_us * centre * time)).astype(np.float32)
    cells = np.arange(stay.x_mm.min() - 2, stay.x_mm.max() + 2.01, SPECKLE_MM)
    spot = np.exp(-((stay.x_mm[:, None] - cells) ** 2) / (2 * (SPOT * band.transducer.disc_mm) ** 2))
    spot /= np.sqrt((spot**2).sum(axis=1, keepdims=True))
    level *= spot.astype(np.float32) @ rng.standard_normal((len(cells), len(time)), dtype=np.float32)
    # what the loss does beyond that at the centre changes slowly with depth: a few filters, and what is between them
    count = 2 + int(per_us * centre * reach_us / SPECKLE_STEP_DB)
    knots = np.linspace(0, reach_us, count)
    spectra = np.zeros((len(stay), len(band.mhz)), dtype=np.complex64)
    for knot in knots:
        weight = np.clip(1 - np.abs(time - knot) / knots[1], 0, None).astype(np.float32)
        until = int(np.flatnonzero(weight)[-1]) + 1
        part = scipy.fft.rfft(level[:, :until] * weight[:until], size, axis=1)[:, band.bins[0] : band.bins[-1] + 1]
        spectra += part * np.exp(-NEPER * per_us * knot * (band.mhz - centre)).astype(np.float32)
    return spectra
