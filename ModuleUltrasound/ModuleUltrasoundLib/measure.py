"""From a recording to bone depths, bone points and their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

from ModuleUltrasoundLib.echo_likelihood import Network, probabilities, shared_features
from ModuleUltrasoundLib.echo_search import Found, search_lines
from ModuleUltrasoundLib.measure_points import bone_points as bone_points

SAME_SPOT_MM = 5.0
GAP_S = 0.5


@dataclass(frozen=True)
class EchoSettings(Parameters):
    """How lines become points. The speed of sound is a prior, not a constant of nature."""

    # 1450 to 1630 m/s is the range of soft tissue over bone in the chapter; mean and SD of the uniform law over it
    speed_of_sound_m_s: Annotated[float, Limits(1300, 1800), "speed of sound in the tissue: mean of the prior"] = 1540.0
    speed_of_sound_sd_m_s: Annotated[float, Limits(0, 200), "speed of sound in the tissue: SD of the prior"] = 52.0
    least_depth_mm: Annotated[float, Limits(0, 20), "no bone is looked for above this depth"] = 1.0
    most_depth_mm: Annotated[float, Limits(2, 60), "no bone is looked for below this depth"] = 20.0
    quality_gate: Annotated[float, Limits(0, 1), "frames below this quality are not points"] = 0.85
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


def runs_and_spots(recording: Recording) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], bool]:
    """Runs of frames that may support each other, spots on the head, and whether there are several spots."""
    count = len(recording)
    origins = recording.probe_to_reference[:, :3, 3]
    jump = np.zeros(count, dtype=bool)
    if count > 1:
        step = np.linalg.norm(np.diff(origins, axis=0), axis=1)
        jump[1:] = (np.nan_to_num(step) > SAME_SPOT_MM) | (np.diff(recording.palpation_points) != 0)
    runs = np.cumsum(jump)
    return runs, runs, bool(len(np.unique(runs)) >= 3)


def measure_lines(recording: Recording, settings: EchoSettings | None = None) -> LineMeasurements:
    """Depth, bone point, covariance and quality of every frame of a recording.

    Raises
    ------
    InputError
        The recording's header cannot be that of pulse-echo lines.
    """
    settings = settings or EchoSettings()
    runs, spots, several = runs_and_spots(recording)
    window = (settings.least_depth_mm, settings.most_depth_mm)
    found = search_lines(recording, settings.speed_of_sound_m_s, window, several)
    chance = bone_probabilities(found, runs, spots)
    return assemble(recording, settings, found, chance)


def bone_probabilities(found: Found, runs: Array, spots: Array) -> Array:
    """Probability (n, K) that each candidate is the bone: first from its line alone, then from the whole recording."""
    from ModuleUltrasoundLib import echo_weights

    single, both = Network.from_table(echo_weights.SINGLE), Network.from_table(echo_weights.SHARED)
    scores = single.scores(found.features)
    shared = shared_features(found.candidates, found.forerun_phases, scores, found.depths_mm, runs, spots)
    scores = both.scores(np.concatenate([found.features, shared], axis=-1))
    return probabilities(scores, np.isfinite(found.depths_mm))[0]


def assemble(recording: Recording, settings: EchoSettings, found: Found, chance: Array) -> LineMeasurements:
    """The measurements of a recording whose echoes have been judged."""
    rows = np.arange(len(chance))
    best = chance.argmax(axis=1)
    depth = found.depths_mm[rows, best]
    same = np.abs(found.depths_mm - depth[:, None]) < 0.5
    quality = np.where(np.isfinite(depth), np.where(same, chance, 0.0).sum(axis=1), 0.0)
    snr = 10 ** (found.candidates.snrs_db[rows, best] / 20)
    sds = np.where(np.isfinite(snr), 0.3 / np.maximum(np.nan_to_num(snr, nan=1.0), 1.0), np.nan)
    ok = np.array([status == "OK" for status in recording.statuses], dtype=bool)
    ok &= np.isfinite(recording.probe_to_reference).all(axis=(1, 2))
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
    outer = beam[:, :, None] * beam[:, None, :]
    covariance = (sds**2)[:, None, None] * outer + across * (np.eye(3) - outer)
    others = np.where(same | (chance < 0.01), np.nan, found.depths_mm)
    return LineMeasurements(
        depths_mm=depth,
        depth_sds_mm=sds,
        positions_mm=position,
        covariances_mm2=covariance,
        beam_directions=beam,
        qualities=quality,
        accepted=np.array([reason == "" for reason in reasons], dtype=bool),
        reasons=tuple(reasons),
        alternative_depths_mm=others,
        alternative_probabilities=np.where(np.isfinite(others), chance, np.nan),
        skin_times_s=found.forerun.skin_s,
        speed_of_sound_m_s=settings.speed_of_sound_m_s,
        speed_of_sound_sd_m_s=settings.speed_of_sound_sd_m_s,
    )
