"""From a recording to bone depths, bone points and their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

from ModuleUltrasoundLib.echo.features import NAMES
from ModuleUltrasoundLib.echo.lean import median, without_nan
from ModuleUltrasoundLib.echo.likelihood import SHARED_NAMES, judge_echoes
from ModuleUltrasoundLib.echo.network import Calibration, Likelihood, learnt
from ModuleUltrasoundLib.echo.onset import pulse_delay
from ModuleUltrasoundLib.echo.search import Found, search_lines
from ModuleUltrasoundLib.echo.timing import time_echoes
from ModuleUltrasoundLib.measurement.depth import bone_positions, covariances
from ModuleUltrasoundLib.measurement.points import bone_points as bone_points
from ModuleUltrasoundLib.measurement.quality import (
    CLIPPED_SHARE,
    TOLERANCE_MM,
    choose,
    clipped_share,
    lost_contact,
    quality_of,
    reasons_of,
    unstable,
)

LEAST_ALTERNATIVE = 0.01  # less probable echoes are not handed on
SAME_SPOT_MM = 5.0


@dataclass(frozen=True)
class EchoSettings(Parameters):
    """How lines become points. The speed of sound is a prior, not a constant of nature."""

    # 1450 to 1630 m/s is the range of soft tissue over bone in the chapter; mean and SD of the uniform law over it
    speed_of_sound_m_s: Annotated[float, Limits(1300, 1800), "speed of sound in the tissue: mean of the prior"] = 1540.0
    speed_of_sound_sd_m_s: Annotated[float, Limits(0, 200), "speed of sound in the tissue: SD of the prior"] = 52.0
    # soft tissue over bone is 2 to 15 mm thick in the chapter, a little less where the probe presses
    least_depth_mm: Annotated[float, Limits(0, 20), "no bone is looked for above this depth"] = 1.8
    most_depth_mm: Annotated[float, Limits(2, 60), "no bone is looked for below this depth"] = 16.0
    # chosen on simulators by other hands that nothing was fitted to: a higher one costs points and makes few of them righter
    quality_gate: Annotated[float, Limits(0, 1), "frames below this quality are not points"] = 0.91
    beam_width_mm: Annotated[float, Limits(0, 10), "-6 dB width of the beam"] = 1.2
    tilt_sd_deg: Annotated[float, Limits(0, 20), "SD of the angle between beam and bone normal"] = 2.0


DEFAULT_SETTINGS = EchoSettings()


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


def stays(recording: Recording) -> npt.NDArray[np.int64]:
    """A number (F,) that is the same for consecutive frames from one place on the head."""
    count = len(recording)
    jump = np.zeros(count, dtype=bool)
    if count > 1:
        step = np.linalg.norm(np.diff(recording.probe_to_reference[:, :3, 3], axis=0), axis=1)
        jump[1:] = (np.nan_to_num(step) > SAME_SPOT_MM) | (np.diff(recording.palpation_points) != 0)
    return np.cumsum(jump)


def several_spots(recording: Recording, runs: npt.NDArray[np.int64]) -> bool:
    """Whether the lines come from several places on the head: after a jump, or along a glide."""
    if len(recording) < 2:
        return False
    origin = recording.probe_to_reference[:, :3, 3]
    known = origin[np.isfinite(origin).all(axis=1)]
    if len(known) < 2 or runs.max() >= 2:
        return bool(runs.max() >= 2)
    middle = np.array([median(along) for along in known.T])
    return bool(np.linalg.norm(known - middle, axis=1).max() > SAME_SPOT_MM)


def places_of(recording: Recording, runs: npt.NDArray[np.int64]) -> npt.NDArray[np.int64] | None:
    """A number (F,) for each place on the head, along a glide for each few millimetres of it; None if all lines are of one."""
    if not several_spots(recording, runs):
        return None
    if runs.max() >= 2:
        return runs
    steps = np.linalg.norm(np.diff(recording.probe_to_reference[:, :3, 3], axis=0, prepend=np.nan), axis=1)
    return np.asarray(np.cumsum(np.nan_to_num(steps)) // SAME_SPOT_MM, dtype=np.int64)


def measure_lines(
    recording: Recording, settings: EchoSettings | None = None, likelihood: Likelihood | None = None
) -> LineMeasurements:
    """Depth, bone point, covariance and quality of every frame of a recording.

    Raises
    ------
    InputError
        The recording's header cannot be that of pulse-echo lines.
    """
    settings = settings or DEFAULT_SETTINGS
    likelihood = likelihood or learnt()
    runs = stays(recording)
    found = search_lines(
        recording,
        settings.speed_of_sound_m_s,
        (settings.least_depth_mm, settings.most_depth_mm),
        places=places_of(recording, runs),
        rank=likelihood.turns[0].scores,
    )
    chance, shared = judge_echoes(found, likelihood, runs)
    best = choose(found.depths_mm, chance)
    shift_s, sd_s = time_of(found, best, chance, recording.acquisition.transducer_hz)
    return assemble(recording, settings, found, chance, best, shift_s, sd_s, runs, shared, likelihood.quality)


def time_of(found: Found, best: npt.NDArray[np.int64], chance: Array, transducer_hz: float) -> tuple[Array, Array]:
    """Correction of each chosen echo's time and its deviation, in seconds; where no forerun echo gives the zero, the pulse's own
    delay is part of the correction.

    An echo that was not among the first of its line has no window kept: its deviation is the bound for a Gaussian pulse.
    """
    rows = np.arange(len(best))
    kept = best < found.windows.shape[1]
    peaks = np.where(kept, found.candidates.delays_s[rows, best] + found.forerun.skin_s, np.nan)
    windows = found.windows[rows, np.minimum(best, found.windows.shape[1] - 1)]
    timing, pulse = time_echoes(
        windows, peaks, found.forerun_phases, chance[rows, best], found.rate_hz, found.carrier_hz, transducer_hz
    )
    snr = found.candidates.amplitudes[rows, best] / found.candidates.noise
    bound = found.candidates.widths_s[rows, best] / np.maximum(snr, 1.0)
    measured = found.forerun.measured
    late = np.where(measured, 0.0, 0.0 if measured.all() else pulse_delay(found.bang, pulse, transducer_hz))
    return np.where(kept, without_nan(timing.shift_s), 0.0) - late, np.hypot(
        np.where(kept, np.maximum(timing.sd_s, bound / 2), bound), found.forerun.sd_s
    )


def assemble(
    recording: Recording,
    settings: EchoSettings,
    found: Found,
    chance: Array,
    best: npt.NDArray[np.int64],
    shift_s: Array,
    sd_s: Array,
    runs: npt.NDArray[np.int64],
    shared: Array,
    calibration: Calibration,
) -> LineMeasurements:
    """The measurements of a recording whose echoes have been judged and timed."""
    rows, speed = np.arange(len(chance)), settings.speed_of_sound_m_s
    depth = np.where(found.possible[rows, best], found.depths_mm[rows, best] + shift_s * 500 * speed, np.nan)
    sd_mm = sd_s * 500 * speed
    quality = calibration.probability(quality_of(found.depths_mm, best, chance, sd_mm))
    ok = np.array([status == "OK" for status in recording.statuses], dtype=bool)
    poses = np.where(ok[:, None, None], recording.probe_to_reference, np.nan)
    positions, beams = bone_positions(poses, depth, recording.acquisition.forerun_length_mm)
    found_zero = found.forerun.measured
    covariance = covariances(
        beams, depth, sd_s, recording.acquisition, speed, settings.beam_width_mm, settings.tilt_sd_deg, found_zero
    )
    times = found.candidates.delays_s[rows, best] + found.forerun.skin_s
    clipped = clipped_share(recording, times) > CLIPPED_SHARE
    multiple = found.features[rows, best, NAMES.index("multiple")]
    lifted = lost_contact(found.forerun.face, multiple, quality >= settings.quality_gate)
    quality = np.where(lifted, 0.0, quality)
    good = quality >= settings.quality_gate
    reasons = reasons_of(
        recording,
        quality,
        settings.quality_gate,
        clipped,
        unstable(recording, depth, good, runs),
        depth,
        np.fmax.reduce(found.candidates.snrs_db, axis=1, initial=-np.inf),
        15 * shared[rows, best, SHARED_NAMES.index("strength")],
        10 * shared[:, 0, SHARED_NAMES.index("contact")],
        chance[rows, best],
        lifted,
    )
    other = (np.abs(found.depths_mm - depth[:, None]) >= TOLERANCE_MM) & (chance >= LEAST_ALTERNATIVE)
    return LineMeasurements(
        depths_mm=depth,
        depth_sds_mm=sd_mm,
        positions_mm=positions,
        covariances_mm2=covariance,
        beam_directions=beams,
        qualities=quality,
        accepted=np.array([reason == "" for reason in reasons], dtype=bool),
        reasons=reasons,
        alternative_depths_mm=np.where(other, found.depths_mm, np.nan),
        alternative_probabilities=np.where(other, chance, np.nan),
        skin_times_s=found.forerun.skin_s,
        speed_of_sound_m_s=speed,
        speed_of_sound_sd_m_s=settings.speed_of_sound_sd_m_s,
    )
