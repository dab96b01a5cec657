"""A simulated A-mode palpation: the recording that a session with the virtual patient leaves behind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt

from CranioNavLib.phantom import constants
from CranioNavLib.phantom.hand import Skill, hold, stand_at
from CranioNavLib.phantom.patient import VirtualPatient
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Recording

PAUSE_S = 6.0  # from one point to the next


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
    share = patient.condition.missing_share if missing_share is None else missing_share
    count = len(np.asarray(positions_ras_mm))
    stand = stand_at(patient, positions_ras_mm, normals, rng, skill)
    poses_ras = hold(stand, lines_per_point, rng, skill).reshape(-1, 4, 4)
    true_poses: Array = patient.ras_to_reference @ poses_ras
    points = np.repeat(np.arange(count), lines_per_point)
    reported = patient.tracker_error.of_poses(true_poses @ patient.probe_calibration_error, rng, points)
    missing = rng.random(len(reported)) < share
    reported[missing] = np.nan
    dwell_s = lines_per_point / constants.LINE_RATE_HZ
    within = np.tile(np.arange(lines_per_point) / constants.LINE_RATE_HZ, count)
    recording = Recording(
        lines=patient.rf_lines(true_poses, rng),
        acquisition=patient.acquisition,
        probe_to_reference=reported,
        statuses=tuple("MISSING" if lost else "OK" for lost in missing),
        timestamps_s=points * (dwell_s + PAUSE_S) + within,
        palpation_points=points.astype(np.int64),
    )
    return Palpation(recording, true_poses)
