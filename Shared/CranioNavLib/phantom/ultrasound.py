"""RF lines of a 5 MHz damped probe with a delay line, on scalp over bone.

A line is the sum of echoes, each a delayed, attenuated copy of the transmitted pulse. It is made in the frequency
domain: an echo after a two-way path 2 d has the spectrum A exp(-kappa f) exp(-2 pi i f t), which is geometric in the
bin number, so that all echoes of all lines come out of one batched matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from CranioNavLib.phantom import constants
from CranioNavLib.phantom.beam import BEAM_WEIGHTS, BeamOnBone, look_at_bone
from CranioNavLib.phantom.conditions import Condition
from CranioNavLib.phantom.fields import SmoothField
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Acquisition
from CranioNavLib.surface import Surface

NEPER_PER_DB = 1.0 / 8.685889638
CHUNK = 256  # lines at a time: keeps the arrays in the processor's cache
BLOCK = 16  # bins handled by one factor of the product
Spectra = npt.NDArray[np.complex64]

BINS = np.fft.rfftfreq(constants.LINE_SAMPLES, 1 / constants.SAMPLING_HZ)
FIRST_BIN = int(np.searchsorted(BINS, constants.BAND_HZ[0]))
BIN_COUNT = int(np.ceil((np.searchsorted(BINS, constants.BAND_HZ[1]) - FIRST_BIN) / BLOCK)) * BLOCK
BAND = BINS[FIRST_BIN : FIRST_BIN + BIN_COUNT]
TIMES_S = np.arange(constants.LINE_SAMPLES) / constants.SAMPLING_HZ


def transmitted_pulse() -> Array:
    """(N,) the pulse at the transducer: a damped 5 MHz oscillation, peak of its envelope 1.

    t^2 exp(-t / tau) has the amplitude spectrum (1 + (2 pi df tau)^2)^-1.5, half of its peak at 0.766 / (2 pi tau).
    """
    tau = 0.766 / (2 * np.pi * constants.FRACTIONAL_BANDWIDTH / 2 * constants.TRANSDUCER_HZ)
    envelope = (TIMES_S / tau) ** 2 * np.exp(-TIMES_S / tau) / (4 * np.exp(-2.0))
    pulse: Array = envelope * np.sin(2 * np.pi * constants.TRANSDUCER_HZ * TIMES_S)
    return pulse


PULSE = transmitted_pulse()
PULSE_SPECTRUM = np.fft.rfft(PULSE)[FIRST_BIN : FIRST_BIN + BIN_COUNT].astype(np.complex64)
PULSE_NORM = float(np.sqrt((PULSE**2).sum()))


@dataclass(frozen=True, eq=False)
class Tissue:
    """One patient's scalp and one session's probe: everything drawn once."""

    speed_of_sound_m_s: float
    attenuation_db_cm_mhz: float
    bone_impedance_mrayl: float
    diffuse_floor_db: float
    full_scale: float
    forerun_speed_m_s: float  # now, warmed; the nominal one is in the acquisition
    speed_field: SmoothField
    coupling_field: SmoothField
    share_fields: tuple[SmoothField, ...]
    amplitude_fields: tuple[SmoothField, ...]

    @classmethod
    def draw(cls, rng: np.random.Generator, condition: Condition) -> Tissue:
        """A patient."""

        def field() -> SmoothField:
            return SmoothField.draw(rng, constants.SITE_CORRELATION_MM)

        return cls(
            speed_of_sound_m_s=float(rng.uniform(*condition.speed_of_sound_range_m_s)),
            attenuation_db_cm_mhz=float(rng.uniform(*condition.attenuation_range_db_cm_mhz)),
            bone_impedance_mrayl=float(rng.uniform(*constants.BONE_IMPEDANCE_RANGE_MRAYL)),
            diffuse_floor_db=float(rng.uniform(*constants.DIFFUSE_FLOOR_DB)),
            full_scale=float(rng.uniform(*constants.FULL_SCALE_RANGE)),
            forerun_speed_m_s=constants.FORERUN_SPEED_M_S
            + constants.FORERUN_SPEED_DRIFT_M_S_K * float(rng.uniform(*constants.FORERUN_WARMING_K)),
            speed_field=field(),
            coupling_field=field(),
            share_fields=tuple(field() for _ in constants.LAYER_SHARES),
            amplitude_fields=tuple(field() for _ in constants.LAYER_AMPLITUDES),
        )

    def speed_at(self, points_ras_mm: npt.ArrayLike) -> Array:
        """(N,) speed of sound in the scalp at places on the head, m/s."""
        speed: Array = self.speed_of_sound_m_s + constants.SPEED_OF_SOUND_SITE_SD_M_S * self.speed_field.at(points_ras_mm)
        return speed


def acquisition() -> Acquisition:
    """What the maker of the probe and the digitiser state; the forerun's speed is that at 20 degrees C."""
    return Acquisition(constants.SAMPLING_HZ, constants.TRANSDUCER_HZ, constants.FORERUN_LENGTH_MM, constants.FORERUN_SPEED_M_S)


class LineSource:
    """The probe on one patient: scatterers stay where they are from call to call."""

    def __init__(self, bone: Surface, skin: Surface, tissue: Tissue, rng: np.random.Generator) -> None:
        self._bone, self._skin, self._tissue, self._rng = bone, skin, tissue, rng
        self._scatter = _Scatter(rng)

    def lines(self, probe_to_ras: npt.ArrayLike, warming_k: npt.ArrayLike = 0.0) -> npt.NDArray[np.int16]:
        """RF lines (F, N) for true probe poses (F, 4, 4): origin on the transducer's face, +z along the beam.

        `warming_k` (F,) is how much the forerun has warmed during use.
        """
        poses = np.asarray(probe_to_ras, dtype=float).reshape(-1, 4, 4)
        warming = np.broadcast_to(np.asarray(warming_k, dtype=float), (len(poses),))
        lines = np.empty((len(poses), constants.LINE_SAMPLES), dtype=np.int16)
        for start in range(0, len(poses), CHUNK):
            part = slice(start, start + CHUNK)
            spectra = _spectra(self._bone, self._skin, self._tissue, poses[part], warming[part], self._scatter, self._rng)
            lines[part] = _digitise(_to_time(spectra), self._tissue.full_scale, self._rng)
        return lines


def simulate_lines(
    bone: Surface, skin: Surface, tissue: Tissue, probe_to_ras: npt.ArrayLike, rng: np.random.Generator
) -> npt.NDArray[np.int16]:
    """RF lines (F, N) of one palpation, in the order in which they were taken; the forerun warms up meanwhile."""
    poses = np.asarray(probe_to_ras, dtype=float).reshape(-1, 4, 4)
    warming = constants.FORERUN_WARMING_DURING_USE_K * np.arange(len(poses)) / max(len(poses), 1)
    return LineSource(bone, skin, tissue, rng).lines(poses, warming)


def _spectra(
    bone: Surface,
    skin: Surface,
    tissue: Tissue,
    poses: Array,
    warming_k: Array,
    scatter: _Scatter,
    rng: np.random.Generator,
) -> Spectra:
    contact = poses.copy()
    contact[:, :3, 3] += poses[:, :3, 2] * constants.FORERUN_LENGTH_MM
    seen = look_at_bone(bone, contact)
    coupling = tissue.coupling_field.uniform_at(contact[:, :3, 3], *constants.COUPLING_RANGE)
    coupling[skin.signed_distance(contact[:, :3, 3]) > constants.LARGEST_GEL_GAP_MM] = 0.0
    speed = tissue.speed_at(contact[:, :3, 3])
    forerun_speed = tissue.forerun_speed_m_s + constants.FORERUN_SPEED_DRIFT_M_S_K * warming_k
    forerun_s = 2e-3 * constants.FORERUN_LENGTH_MM / forerun_speed
    texture = scatter.textures(contact, rng)
    spectra = _forerun(forerun_s, coupling) + _layers(tissue, seen, contact, speed, forerun_s, coupling)
    spectra += _bone(tissue, seen, speed, forerun_s, coupling, texture)
    spectra += _speckle(tissue, seen, speed, forerun_s, coupling, texture)
    return spectra


def _echoes(amplitude: Array, delay_s: Array, loss_s: Array | float = 0.0) -> Spectra:
    """Spectra (F, BIN_COUNT) of echoes (F, E): amplitude * exp(-(2 pi i delay + loss) f), without the pulse."""
    exponent = -(2j * np.pi * delay_s + loss_s)  # per Hz
    step = float(BAND[1] - BAND[0])
    blocks = np.exp(exponent[..., None] * (BAND[::BLOCK])).astype(np.complex64)  # (F, E, A)
    within = np.exp(exponent[..., None] * (np.arange(BLOCK) * step)).astype(np.complex64)  # (F, E, B)
    blocks *= amplitude[..., None].astype(np.float32)
    spectra: Spectra = np.matmul(blocks.transpose(0, 2, 1), within).reshape(len(amplitude), BIN_COUNT)
    return spectra


def _loss_s(tissue: Tissue, depth_mm: Array) -> Array:
    """Two-way loss of `depth_mm` of scalp, neper per Hz."""
    loss: Array = tissue.attenuation_db_cm_mhz * 1e-6 * (2 * depth_mm / 10) * NEPER_PER_DB
    return loss


def _reflection(first_mrayl: float, second_mrayl: float) -> float:
    return (second_mrayl - first_mrayl) / (second_mrayl + first_mrayl)


FORERUN_REFLECTION = _reflection(constants.FORERUN_IMPEDANCE_MRAYL, constants.SCALP_IMPEDANCE_MRAYL)


def _through_forerun(coupling: Array) -> Array:
    """(F,) two-way amplitude through the forerun's end and the gel."""
    passed: Array = coupling * (1 - FORERUN_REFLECTION**2)
    return passed


def _forerun(forerun_s: Array, coupling: Array) -> Spectra:
    """The echo of the forerun's end and its repetitions; at an air gap nearly all sound comes back."""
    end = np.where(coupling > 0, FORERUN_REFLECTION * coupling - (1 - coupling) * 0.3, -1.0)
    back = constants.FORERUN_BACK_REFLECTION
    amplitude = np.column_stack([end, end**2 * back, end**3 * back**2])
    return _echoes(amplitude, forerun_s[:, None] * np.array([1.0, 2.0, 3.0]))


def _directivity(tilt_deg: Array, speed_m_s: Array) -> npt.NDArray[np.float32]:
    """(F, BIN_COUNT) what a disc receives from a plane mirror tilted by an angle: 2 J1(x) / x, x = k D sin(angle)."""
    from scipy.special import j1

    sine = np.sin(np.radians(np.nan_to_num(tilt_deg, nan=90.0)))
    x = np.maximum(2 * np.pi * BAND * (constants.ELEMENT_DIAMETER_MM * 1e-3 * sine / speed_m_s)[:, None], 1e-6)
    return np.asarray(2 * j1(x) / x, dtype=np.float32)


def _bone(tissue: Tissue, seen: BeamOnBone, speed: Array, forerun_s: Array, coupling: Array, texture: _Texture) -> Spectra:
    """Outer table (specular and diffuse), inner table, and the sound that goes twice between bone and forerun."""
    reflection = _reflection(constants.SCALP_IMPEDANCE_MRAYL, tissue.bone_impedance_mrayl)
    passed = _through_forerun(coupling)
    depth = np.nan_to_num(seen.center_mm)
    met = np.isfinite(seen.center_mm)
    wave_number = 2 * np.pi * constants.TRANSDUCER_HZ / speed * 1e-3  # per mm
    shape = np.maximum(np.nan_to_num(seen.roughness_mm) - constants.CT_STAIRCASE_MM, 0.0)
    rough = np.hypot(shape, constants.BONE_ROUGHNESS_MM)
    smoothness = np.exp(-2 * (wave_number * np.minimum(rough, 0.3)) ** 2)  # coherent share of a rough mirror's echo
    mirror = reflection * passed * smoothness * met
    time = forerun_s + 2e-3 * depth / speed
    thickness = np.nan_to_num(seen.thickness_mm)
    bone_loss = constants.BONE_ATTENUATION_DB_CM_MHZ * 1e-6 * (2 * thickness / 10) * NEPER_PER_DB
    inner = constants.INNER_TABLE_REFLECTION * (1 - reflection**2) * passed * smoothness * np.isfinite(seen.thickness_mm)
    twice = -mirror * reflection * FORERUN_REFLECTION
    loss = _loss_s(tissue, depth)
    specular = _echoes(
        np.column_stack([mirror, inner, twice]),
        np.column_stack([time, time + 2e-3 * thickness / constants.BONE_SPEED_M_S, time + 2e-3 * depth / speed]),
        np.column_stack([loss, loss + bone_loss, 2 * loss]),
    )
    specular *= _directivity(seen.tilt_deg, speed)
    ranges = np.nan_to_num(seen.ranges_mm)
    lobe = np.exp(-0.5 * (np.nan_to_num(seen.tilt_deg, nan=60.0) / constants.DIFFUSE_WIDTH_DEG) ** 2)
    level = reflection * passed * 10 ** (tissue.diffuse_floor_db / 20) * lobe
    grain = np.sqrt(BEAM_WEIGHTS) * texture.rays * np.isfinite(seen.ranges_mm)
    diffuse = _echoes(level[:, None] * grain, forerun_s[:, None] + 2e-3 * ranges / speed[:, None], _loss_s(tissue, ranges))
    return np.asarray(specular + diffuse, dtype=np.complex64)


def _layers(tissue: Tissue, seen: BeamOnBone, contact: Array, speed: Array, forerun_s: Array, coupling: Array) -> Spectra:
    """Boundaries inside the scalp; they follow the skin (which lies flat on the probe) above and the bone below."""
    place = contact[:, :3, 3]
    # where no bone is met (a burr hole, a fissure) the layers lie as over 6 mm of scalp
    depth = np.nan_to_num(seen.center_mm, nan=6.0)
    tilt = np.nan_to_num(seen.tilt_deg)
    spectra = np.zeros((len(contact), BIN_COUNT), dtype=np.complex64)
    for index, (share, amplitude) in enumerate(zip(constants.LAYER_SHARES, constants.LAYER_AMPLITUDES)):
        at = np.clip(share + constants.LAYER_SHARE_SD * tissue.share_fields[index].at(place), 0.05, 0.97)
        size = amplitude * np.maximum(1 + constants.LAYER_AMPLITUDE_SPREAD * tissue.amplitude_fields[index].at(place), 0.1)
        echo = _echoes(
            (size * _through_forerun(coupling))[:, None],
            (forerun_s + 2e-3 * at * depth / speed)[:, None],
            _loss_s(tissue, at * depth)[:, None],
        )
        wide = constants.LAYER_DIFFUSE_SHARE
        spectra += echo * (wide + (1 - wide) * _directivity(at * tilt, speed))
    return spectra


@dataclass(frozen=True, eq=False)
class _Texture:
    """Random scatterers as each line sees them: SD 1."""

    samples: npt.NDArray[np.float32]  # (F, N) along the line
    rays: Array  # (F, M) over the beam's footprint on the bone


class _Scatter:
    """Scatterers that stay where they are: a line taken close to the one before it sees nearly the same ones."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._line = rng.standard_normal(constants.LINE_SAMPLES, dtype=np.float32)
        self._rays = rng.standard_normal(len(BEAM_WEIGHTS))
        self._place: Array | None = None

    def textures(self, contact: Array, rng: np.random.Generator) -> _Texture:
        """Textures for contact frames (F, 4, 4) in the order in which they were taken."""
        # the place where the beam meets the bone, about 6 mm below the contact: a tilt moves it as well
        places = contact[:, :3, 3] + 6.0 * contact[:, :3, 2]
        before = places[:1] if self._place is None else self._place[None]
        steps = np.linalg.norm(np.diff(places, axis=0, prepend=before), axis=1)
        keep = np.exp(-0.5 * (steps / constants.SPECKLE_LATERAL_CORRELATION_MM) ** 2)
        samples = rng.standard_normal((len(places), constants.LINE_SAMPLES), dtype=np.float32)
        rays = rng.standard_normal((len(places), len(BEAM_WEIGHTS)))
        for index, share in enumerate(keep):
            fresh = np.sqrt(1 - share**2)
            self._line = samples[index] = np.float32(share) * self._line + np.float32(fresh) * samples[index]
            self._rays = rays[index] = share * self._rays + fresh * rays[index]
        self._place = places[-1]
        return _Texture(samples, rays)


def _speckle(tissue: Tissue, seen: BeamOnBone, speed: Array, forerun_s: Array, coupling: Array, texture: _Texture) -> Spectra:
    """Sound scattered inside the scalp: strongest below the skin, fading with depth, hardly any behind bone."""
    import scipy.fft

    depth = (TIMES_S[None, :] - forerun_s[:, None]) * (speed / 2e-3)[:, None]  # mm
    fading = np.exp(-(2 * tissue.attenuation_db_cm_mhz * constants.TRANSDUCER_HZ * 1e-6 / 10) * NEPER_PER_DB * depth)
    level = np.where(depth > 0, fading, 0.0)
    level[depth > np.nan_to_num(seen.center_mm, nan=np.inf)[:, None]] *= 0.1  # little comes back through bone
    level *= (constants.SPECKLE_AMPLITUDE * _through_forerun(coupling) / PULSE_NORM)[:, None]
    spectra = scipy.fft.rfft(texture.samples * level.astype(np.float32), axis=1)[:, FIRST_BIN : FIRST_BIN + BIN_COUNT]
    return np.asarray(spectra, dtype=np.complex64)


def _to_time(spectra: Spectra) -> npt.NDArray[np.float32]:
    """(F, N) lines: echoes convolved with the pulse."""
    import scipy.fft

    full = np.zeros((len(spectra), constants.LINE_SAMPLES // 2 + 1), dtype=np.complex64)
    full[:, FIRST_BIN : FIRST_BIN + BIN_COUNT] = spectra * PULSE_SPECTRUM
    return np.asarray(scipy.fft.irfft(full, constants.LINE_SAMPLES, axis=1), dtype=np.float32)


def _main_bang() -> Array:
    """(N,) the transmit burst as the receiver sees it: far beyond full scale, then ringing away."""
    decay = constants.TRANSMIT_BURST_US * 1e-6 / 5
    bang: Array = 6.0 * np.exp(-TIMES_S / decay) * np.cos(2 * np.pi * constants.TRANSDUCER_HZ * TIMES_S)
    return bang


MAIN_BANG = _main_bang().astype(np.float32)


def _digitise(lines: npt.NDArray[np.float32], full_scale: float, rng: np.random.Generator) -> npt.NDArray[np.int16]:
    """Receiver noise, gain and converter: the ends of its range are where strong echoes are cut off."""
    top = 2 ** (constants.ADC_BITS - 1)
    noisy = lines + MAIN_BANG
    noisy += np.float32(constants.ELECTRONIC_NOISE) * rng.standard_normal(lines.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(noisy * (top / full_scale)), -top, top - 1), dtype=np.int16)
