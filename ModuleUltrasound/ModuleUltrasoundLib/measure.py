"""From a recording to bone depths, bone points and their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

from ModuleUltrasoundLib.echo_candidates import Candidates, find_candidates
from ModuleUltrasoundLib.forerun import Forerun, find_forerun, nominal_skin_s
from ModuleUltrasoundLib.measure_points import bone_points as bone_points
from ModuleUltrasoundLib.signal_chain import check_acquisition, complex_envelopes, design_band

CHUNK = 256  # lines worked on at once: the working set stays in the processor's cache


@dataclass(frozen=True)
class EchoSettings(Parameters):
    """How lines become points. The speed of sound is a prior, not a constant of nature."""

    # 1450 to 1630 m/s is the range of soft tissue over bone in the chapter; mean and SD of the uniform law over it
    speed_of_sound_m_s: Annotated[float, Limits(1300, 1800), "speed of sound in the tissue: mean of the prior"] = 1540.0
    speed_of_sound_sd_m_s: Annotated[float, Limits(0, 200), "speed of sound in the tissue: SD of the prior"] = 52.0
    least_depth_mm: Annotated[float, Limits(0, 20), "no bone is looked for above this depth"] = 1.0
    most_depth_mm: Annotated[float, Limits(2, 60), "no bone is looked for below this depth"] = 20.0
    quality_gate: Annotated[float, Limits(0, 1), "frames below this quality are not points"] = 0.8
    beam_width_mm: Annotated[float, Limits(0, 10), "-6 dB width of the beam"] = 1.2
    tilt_sd_deg: Annotated[float, Limits(0, 20), "SD of the angle between beam and bone normal"] = 2.0


@dataclass(frozen=True, eq=False)
class LineMeasurements:
    """What each of F frames says about the bone. NaN where it says nothing."""

    depths_mm: Array  # (F,) tissue between skin and bone along the beam
    depth_sds_mm: Array  # (F,) of the echo's time alone; speed of sound and common offset are not in it
    positions_mm: Array  # (F, 3) bone point, Reference
    covariances_mm2: Array  # (F, 3, 3) Reference
    beam_directions: Array  # (F, 3) unit, Reference
    qualities: Array  # (F,) probability that the depth is right to 0.5 mm
    accepted: npt.NDArray[np.bool_]  # (F,)
    reasons: tuple[str, ...]  # why a frame was not accepted; empty when it was
    alternative_depths_mm: Array  # (F, K) other echoes that may have been the bone
    alternative_probabilities: Array  # (F, K)
    skin_times_s: Array  # (F,) start of the tissue in the line
    speed_of_sound_m_s: float
    speed_of_sound_sd_m_s: float

    def __len__(self) -> int:
        return len(self.depths_mm)


def measure_lines(recording: Recording, settings: EchoSettings | None = None) -> LineMeasurements:
    """Depth, bone point, covariance and quality of every frame of a recording.

    Raises
    ------
    InputError
        The recording's header cannot be that of pulse-echo lines.
    """
    settings = settings or EchoSettings()
    check_acquisition(recording.acquisition)
    speed = settings.speed_of_sound_m_s
    skin = nominal_skin_s(recording.acquisition)
    until = skin * 1.06 + 2e-3 * (settings.most_depth_mm * 1.35) / speed + 3e-6
    band = design_band(recording.acquisition, recording.lines.shape[1], until)
    parts: list[tuple[Forerun, Candidates]] = []
    per_s = 500.0 * speed  # mm of depth a second of delay
    gain = 1.0 * recording.acquisition.transducer_hz * 1e-6 * 0.2 * per_s  # dB/cm/MHz, both ways
    for start in range(0, len(recording), CHUNK):
        envelopes = complex_envelopes(recording.lines[start : start + CHUNK], band)
        forerun = find_forerun(envelopes, recording.acquisition)
        least, most = settings.least_depth_mm / per_s, settings.most_depth_mm / per_s
        parts.append((forerun, find_candidates(envelopes, forerun.skin_s, least, most, gain)))
    delays = np.concatenate([found.delays_s for _, found in parts])
    snr = np.concatenate([found.amplitudes / found.noise[:, None] for _, found in parts])
    skins = np.concatenate([forerun.skin_s for forerun, _ in parts])
    quality = np.nan_to_num(1 / (1 + np.exp(-(snr[:, 0] - 9.0))))
    depths = delays * per_s
    return assemble(recording, settings, depths, quality, skins, 0.3 / np.maximum(snr[:, 0], 1))


def assemble(
    recording: Recording, settings: EchoSettings, depths: Array, quality: Array, skins: Array, sds: Array
) -> LineMeasurements:
    """The measurements of lines whose best echo stands first in `depths` (F, K)."""
    depth = depths[:, 0]
    ok = np.array([status == "OK" for status in recording.statuses]) & np.isfinite(recording.probe_to_reference).all(axis=(1, 2))
    reasons = []
    for index in range(len(depth)):
        status = recording.statuses[index]
        if not ok[index]:
            reasons.append("pose missing" if status == "MISSING" else f"pose {status.lower().replace('_', ' ')}")
        elif not np.isfinite(depth[index]):
            reasons.append("no echo")
        else:
            reasons.append("" if quality[index] >= settings.quality_gate else "weak echo")
    beam = np.where(ok[:, None], recording.probe_to_reference[:, :3, 2], np.nan)
    origin = np.where(ok[:, None], recording.probe_to_reference[:, :3, 3], np.nan)
    # the Probe frame starts at the transducer's face: the skin lies one forerun further on
    position = origin + beam * (recording.acquisition.forerun_length_mm + depth)[:, None]
    across = (settings.beam_width_mm / 2.3548) ** 2
    along = sds**2
    outer = beam[:, :, None] * beam[:, None, :]
    covariance = along[:, None, None] * outer + across * (np.eye(3) - outer)
    return LineMeasurements(
        depths_mm=depth,
        depth_sds_mm=sds,
        positions_mm=position,
        covariances_mm2=covariance,
        beam_directions=beam,
        qualities=quality,
        accepted=np.array([reason == "" for reason in reasons], dtype=bool),
        reasons=tuple(reasons),
        alternative_depths_mm=np.empty((len(depth), 0)),
        alternative_probabilities=np.empty((len(depth), 0)),
        skin_times_s=skins,
        speed_of_sound_m_s=settings.speed_of_sound_m_s,
        speed_of_sound_sd_m_s=settings.speed_of_sound_sd_m_s,
    )
