"""Echoes of a target in a water bath: how far each line's strongest echo is from the transducer's face."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.recording import Acquisition, Recording
from CranioNavLib.rigid import Array
from scipy.signal import hilbert

from ModuleTrackingLib.calibration.probe import FEWEST_ECHOES, PlaneTarget, PointTarget

NEAREST_MM = 5.0  # closer to the face the transmit pulse and the forerun's own echo ring
CLEAR = 8.0  # an echo's envelope over the line's median: noise alone reaches 4 in some thousand samples


def bath_depths(lines: npt.ArrayLike, acquisition: Acquisition, speed_m_s: float) -> Array:
    """Depth (F,) in mm of the strongest echo of each RF line (F, N); NaN where none stands out.

    Parameters
    ----------
    speed_m_s : float
        Of sound in the bath, see `water_speed_m_s`.

    Notes
    -----
    The depth is that of the peak of the echo's envelope, to a fraction of a sample (parabola through three).
    """
    rf = np.asarray(lines, dtype=float)
    forerun_s = 2e-3 * acquisition.forerun_length_mm / acquisition.forerun_speed_m_s if acquisition.forerun_length_mm else 0.0
    first = int(np.ceil((forerun_s + 2e-3 * NEAREST_MM / speed_m_s) * acquisition.sampling_hz))
    if first + 3 > rf.shape[1]:
        raise InputError(f"the lines end before {NEAREST_MM:g} mm depth; record longer lines")
    envelope = np.abs(hilbert(rf - rf.mean(axis=1, keepdims=True), axis=1))
    at = first + 1 + np.argmax(envelope[:, first + 1 : -1], axis=1)
    rows = np.arange(len(rf))
    before, peak, after = (envelope[rows, at + step] for step in (-1, 0, 1))
    bend = before - 2 * peak + after
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.where(bend < 0, 0.5 * (before - after) / bend, 0.0)
    depths = ((at + fraction) / acquisition.sampling_hz - forerun_s) * speed_m_s * 1e3 / 2
    clear = (peak > CLEAR * np.median(envelope[:, first:], axis=1)) & (bend < 0)
    return np.where(clear, depths, np.nan)


def bath_echoes(recording: Recording, speed_m_s: float, name: str) -> tuple[Array, Array]:
    """Poses (M, 4, 4) of the marker and depths (M,) of the lines that have both.

    Raises
    ------
    InputError
        Fewer than 15 of them, or a recording without lines.
    """
    if recording.lines.shape[1] == 0:
        raise InputError(f"{name}: holds no A-lines; record tracker and probe together")
    depths = bath_depths(recording.lines, recording.acquisition, speed_m_s)
    good = np.isfinite(depths) & (np.array(recording.statuses) == "OK")
    if good.sum() < FEWEST_ECHOES:
        raise InputError(f"{name}: only {good.sum()} lines have an echo and a pose, expected {FEWEST_ECHOES}; record longer")
    return recording.probe_to_reference[good], depths[good]


def point_of(recording: Recording, speed_m_s: float, name: str) -> PointTarget:
    """A small target at an unknown place."""
    return PointTarget(*bath_echoes(recording, speed_m_s, name))


def plane_of(recording: Recording, speed_m_s: float, beam_in_marker: Array, face_in_marker_mm: Array, name: str) -> PlaneTarget:
    """A flat plate at an unknown place; where it is roughly follows from the rough beam and face."""
    poses, depths = bath_echoes(recording, speed_m_s, name)
    beams = poses[:, :3, :3] @ beam_in_marker
    normal = -beams.mean(axis=0) / np.linalg.norm(beams.mean(axis=0))
    feet = poses[:, :3, :3] @ face_in_marker_mm + poses[:, :3, 3] + beams * depths[:, None]
    return PlaneTarget(poses, depths, normal, float(np.median(feet @ normal)), known=False)
