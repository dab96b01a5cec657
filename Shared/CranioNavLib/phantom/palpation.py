"""A simulated A-mode palpation: the recording that a session with the virtual patient leaves behind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt

from CranioNavLib.phantom import constants
from CranioNavLib.phantom.hand import Skill, hold, slide_over, stand_at
from CranioNavLib.phantom.patient import VirtualPatient
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

PAUSE_S = 6.0  # from one point to the next
STANDING_ERROR_MM = 30.0  # of a sweep, over which the tracker's standing error stays the same


@dataclass(frozen=True, eq=False)
class Palpation:
    """A recording and the truth behind it."""

    recording: Recording
    true_probe_to_reference: Array  # (F, 4, 4)


def palpate(
    patient: VirtualPatient,
    positions_ras_mm: npt.ArrayLike,
    normals: npt.ArrayLike,
    rng: np.random.Generator,
    lines_per_point: int = constants.DWELL_LINES,
    missing_share: Optional[float] = None,
    skill: Optional[Skill] = None,
) -> Palpation:
    """A-mode palpation of planned points (N, 3) whose outward normals (N, 3) are planned, too.

    Some frames have no pose, as the camera loses the probe: their status is MISSING and their matrix NaN. Their share is
    that of the patient's condition unless given.
    """
    count = len(np.asarray(positions_ras_mm))
    stand = stand_at(patient, positions_ras_mm, normals, rng, skill)
    poses_ras = hold(stand, lines_per_point, rng, skill).reshape(-1, 4, 4)
    points = np.repeat(np.arange(count), lines_per_point)
    dwell_s = lines_per_point / constants.LINE_RATE_HZ
    within = np.tile(np.arange(lines_per_point) / constants.LINE_RATE_HZ, count)
    times = points * (dwell_s + PAUSE_S) + within
    return _recorded(patient, poses_ras, points, points, times, missing_share, rng)


def sweep(
    patient: VirtualPatient,
    positions_ras_mm: npt.ArrayLike,
    normals: npt.ArrayLike,
    rng: np.random.Generator,
    lines: int = 2000,
    missing_share: Optional[float] = None,
) -> Palpation:
    """A-mode sweep: the probe slides from each planned place (N, 3) to the next, without guidance; no palpation points."""
    poses_ras = slide_over(patient, positions_ras_mm, normals, lines, rng)
    # the standing part of the tracker's error changes as the probe gets about
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses_ras[:, :3, 3], axis=0), axis=1))])
    stretches = (path // STANDING_ERROR_MM).astype(np.int64)
    none = np.full(lines, -1, dtype=np.int64)
    return _recorded(patient, poses_ras, stretches, none, np.arange(lines) / constants.LINE_RATE_HZ, missing_share, rng)


def _recorded(
    patient: VirtualPatient,
    poses_ras: Array,
    stays: npt.NDArray[np.int64],
    points: npt.NDArray[np.int64],
    times_s: Array,
    missing_share: Optional[float],
    rng: np.random.Generator,
) -> Palpation:
    """The recording of true ProbeToRas poses (F, 4, 4), as tracker and receiver give it."""
    share = patient.condition.missing_share if missing_share is None else missing_share
    true_poses: Array = patient.ras_to_reference @ poses_ras
    reported = patient.tracker_error.of_poses(true_poses @ patient.probe_calibration_error, rng, stays)
    missing = rng.random(len(reported)) < share
    reported[missing] = np.nan
    recording = Recording(
        lines=patient.rf_lines(true_poses, rng),
        acquisition=patient.acquisition,
        probe_to_reference=reported,
        statuses=tuple("MISSING" if lost else "OK" for lost in missing),
        timestamps_s=times_s,
        palpation_points=points.astype(np.int64),
    )
    return Palpation(recording, true_poses)
