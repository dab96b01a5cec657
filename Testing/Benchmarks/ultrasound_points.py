"""Bone points as an A-mode probe would find them on a skull that is known: beams, depths, wrong echoes and their qualities.

Simulated from the physics of single echoes, not from lines: the speed of sound in the tissue is drawn from the range that
is published for it, the points are computed with the speed that the software assumes, and a wrong echo is that of another
interface on the same beam, with the right one among the alternatives or not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.rigid import Array
from ModuleUltrasoundLib.measurement.measure import EchoSettings
from scipy.spatial.transform import Rotation

SLOWEST_M_S, FASTEST_M_S = 1450.0, 1630.0  # of soft tissue (Heger et al., IEEE TMI 24(2), 2005)
THICKNESS_MM, THICKNESS_SPREAD = 5.5, 0.25  # of the scalp, lognormal
MUSCLE_MM, TEMPLE_DEG, TEMPLE_TOP_DEG = 5.0, 55.0, 30.0  # more over the temple: that far to the side, and no higher
TRACKER_MM = (0.1, 0.35)  # SD per axis of the probe's place, anew for every case
TIME_S = (15e-9, 80e-9)  # SD of an echo's time
STATED_SPREAD = 0.3  # lognormal: how well the SD of the time is known
DIRECTION_DEG, TILT_DEG = 0.4, (1.0, 4.0)  # of the beam as calibrated; of the probe against the bone's normal
BEAM_WIDTH_MM = 1.25
ZERO_MM = (0.05, 0.3)  # SD of the common error of the depth's zero
NEAREST_MM = 1.0
SEEN_SHARE = 0.6  # of wrong echoes, those that have the right one among their alternatives
DOUBTED_SHARE = 0.4  # of right echoes, those that have a wrong one among theirs


@dataclass(frozen=True, eq=False)
class Echoes:
    """Measured points in the skull's frame, and the truth about them."""

    points: BonePoints
    outliers: npt.NDArray[np.bool_]
    sd_mm: float  # along the normal, of the points that are no outliers
    reach_mm: Array  # (N,) how far a relative error of the speed of one moves each along its normal
    speed_sd: float  # relative, as the software assumes it


def draw_echoes(
    rng: np.random.Generator,
    bad: np.random.Generator,
    bone: Array,
    normals: Array,
    azimuth: Array,
    elevation: Array,
    share: float,
) -> Echoes:
    """What a probe finds at places (N, 3) of the bone with outward `normals` (N, 3); a `share` of the echoes is wrong."""
    count, settings = len(bone), EchoSettings()
    speed, assumed = rng.uniform(SLOWEST_M_S, FASTEST_M_S), settings.speed_of_sound_m_s
    tracker, time, tilt = rng.uniform(*TRACKER_MM), rng.uniform(*TIME_S), np.radians(rng.uniform(*TILT_DEG))
    beams = _tilted(rng, -normals, tilt)
    depth = THICKNESS_MM * np.exp(rng.normal(0, THICKNESS_SPREAD, count))
    depth += MUSCLE_MM * ((np.abs(azimuth) > TEMPLE_DEG) & (elevation < TEMPLE_TOP_DEG))
    slope = -(beams * normals).sum(axis=1)
    early = 0.25 * BEAM_WIDTH_MM * np.sqrt(np.maximum(1 - slope**2, 0))  # the near side of the beam arrives first
    noise = 500 * assumed * time * rng.standard_normal(count)
    right = (depth - early) * assumed / speed + noise + rng.normal(0, rng.uniform(*ZERO_MM))
    outliers = bad.random(count) < share
    side = np.where(bad.random(count) < bad.choice([0.5, 0.8, 1.0]), -1.0, 1.0)  # mostly too shallow
    other = np.maximum(right + side * bad.uniform(2, 8, count), NEAREST_MM)
    found = np.where(outliers, other, right)
    entries = bone - beams * depth[:, None] + rng.normal(0, tracker, bone.shape)
    seen = _tilted(rng, beams, np.radians(DIRECTION_DEG))
    along = (500 * assumed * time * np.exp(rng.normal(0, STATED_SPREAD))) ** 2 + 0.1**2
    outer = seen[:, :, None] * seen[:, None, :]
    shown = bad.random(count) < np.where(outliers, SEEN_SHARE, DOUBTED_SHARE)
    points = BonePoints(
        positions_mm=entries + seen * found[:, None],
        covariances_mm2=along * outer + (BEAM_WIDTH_MM / 2.3548) ** 2 * (np.eye(3) - outer),
        beam_directions=seen,
        depths_mm=found,
        qualities=np.where(outliers, bad.uniform(0.4, 1, count), bad.uniform(0.7, 1, count)),
        labels=tuple(f"S{index}" for index in range(count)),
        speed_of_sound_m_s=assumed,
        speed_of_sound_sd_m_s=settings.speed_of_sound_sd_m_s,
        alternative_depths_mm=np.where(shown, np.where(outliers, right, other), np.nan)[:, None],
        alternative_probabilities=np.where(shown, bad.uniform(0.02, 0.4, count), np.nan)[:, None],
    )
    sd = float(np.hypot(tracker, 500 * assumed * time))
    return Echoes(points, outliers, sd, slope * found, settings.speed_of_sound_sd_m_s / assumed)


def _tilted(rng: np.random.Generator, directions: Array, sd_rad: float) -> Array:
    """Unit directions (N, 3) turned about random axes by angles of that SD on each axis."""
    turned: Array = Rotation.from_rotvec(rng.normal(0, sd_rad, directions.shape)).apply(directions)
    return turned
