"""From an echo's time to a bone point with a 3x3 covariance.

What all points of a recording share is left out of the covariance, because registration estimates it with the pose: the speed
of sound in the tissue, and a common offset of depth (what is left of the pulse's delay where no forerun echo gives the zero).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from CranioNavLib.rigid import Array
from CranioNavLib.sequence_metafile import Acquisition

FWHM_TO_SD = 2.3548  # of a Gaussian
# A gel film between probe and skin is a wedge of a few degrees; it bends the beam where its speed differs from the delay
# line's. Judgement, not measured.
INTERFACE_TILT_SD_DEG = 3.0
TRIGGER_SD_S = 8e-9  # converter start against pulse, measured on an open-hardware pulser (up to 11 ns); a forerun echo cancels it


def refracted_angle_deg(incidence_deg: npt.ArrayLike, from_speed_m_s: float, to_speed_m_s: float) -> Array:
    """Angle behind an interface of a beam that meets it at `incidence_deg`, by Snell's law; NaN beyond the critical angle."""
    sine = np.sin(np.radians(np.asarray(incidence_deg, dtype=float))) * to_speed_m_s / from_speed_m_s
    with np.errstate(invalid="ignore"):
        return np.asarray(np.degrees(np.arcsin(sine)))


@lru_cache(maxsize=16)
def bending_sd_deg(acquisition: Acquisition, speed_m_s: float) -> float:
    """SD of the beam's angle in the tissue that an oblique interface in front of it causes; 0 without a forerun."""
    if acquisition.forerun_length_mm <= 0:
        return 0.0
    turned = refracted_angle_deg(INTERFACE_TILT_SD_DEG, acquisition.forerun_speed_m_s, speed_m_s)
    return float(abs(turned - INTERFACE_TILT_SD_DEG))


def bone_positions(probe_to_reference: Array, depth_mm: Array, forerun_mm: float) -> tuple[Array, Array]:
    """Bone points (n, 3) and beams (n, 3) in Reference. The Probe frame starts at the transducer's face, +z along the beam:
    the skin lies one forerun further on, the bone another tissue depth."""
    beams = probe_to_reference[:, :3, 2]
    return probe_to_reference[:, :3, 3] + beams * (forerun_mm + depth_mm)[:, None], beams


def covariances(
    beams: Array,
    depth_mm: Array,
    time_sd_s: Array,
    acquisition: Acquisition,
    speed_m_s: float,
    beam_width_mm: float,
    tilt_sd_deg: float,
    has_zero: npt.NDArray[np.bool_],
) -> Array:
    """Covariance (n, 3, 3) in mm^2 of each bone point: thin along the beam, wide across it.

    Along: the echo's time, the trigger where no forerun echo gives the zero (`has_zero` false), and the first arrival from
    the near side of a tilted bone under the beam. Across: the beam's width, and its bending at an oblique interface.
    """
    trigger = np.where(has_zero, 0.0, TRIGGER_SD_S)
    radius = beam_width_mm / 2
    early = 0.5 * radius * np.tan(np.radians(tilt_sd_deg))
    along = (500 * speed_m_s) ** 2 * (time_sd_s**2 + trigger**2) + early**2
    across = (beam_width_mm / FWHM_TO_SD) ** 2 + (depth_mm * np.tan(np.radians(bending_sd_deg(acquisition, speed_m_s)))) ** 2
    outer = beams[:, :, None] * beams[:, None, :]
    return np.asarray(along[:, None, None] * outer + across[:, None, None] * (np.eye(3) - outer))
