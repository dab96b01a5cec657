"""The chapter's three studies as conditions of a simulated session: phantom, cadaver, patient."""

from __future__ import annotations

from dataclasses import dataclass

from CranioNavLib.errors import InputError
from CranioNavLib.phantom import constants


@dataclass(frozen=True)
class Condition:
    """What differs between the studies; everything else is the same virtual patient."""

    name: str
    speed_of_sound_range_m_s: tuple[float, float]
    attenuation_range_db_cm_mhz: tuple[float, float]
    landmark_fle_sd_mm: float  # per axis
    skin_marker_fle_sd_mm: float  # per axis
    missing_share: float  # frames in which the camera loses the probe


CONDITIONS = {
    "phantom": Condition(
        "phantom",
        constants.SPEED_OF_SOUND_RANGE_M_S,
        constants.ATTENUATION_RANGE_DB_CM_MHZ,
        constants.LANDMARK_FLE_SD_MM,
        constants.SKIN_MARKER_FLE_SD_MM,
        constants.MISSING_FRAME_SHARE,
    ),
    "cadaver": Condition(
        "cadaver",
        constants.CADAVER_SPEED_OF_SOUND_RANGE_M_S,
        constants.CADAVER_ATTENUATION_RANGE_DB_CM_MHZ,
        constants.LANDMARK_FLE_SD_MM,
        constants.SKIN_MARKER_FLE_SD_MM,
        constants.MISSING_FRAME_SHARE,
    ),
    "patient": Condition(
        "patient",
        constants.SPEED_OF_SOUND_RANGE_M_S,
        constants.ATTENUATION_RANGE_DB_CM_MHZ,
        constants.PATIENT_LANDMARK_FLE_SD_MM,
        constants.PATIENT_SKIN_MARKER_FLE_SD_MM,
        constants.PATIENT_MISSING_FRAME_SHARE,
    ),
}


def condition_named(name: str) -> Condition:
    """The condition of that name.

    Raises
    ------
    InputError
        There is none.
    """
    if name not in CONDITIONS:
        raise InputError(f"unknown study {name!r}; studies are {', '.join(CONDITIONS)}")
    return CONDITIONS[name]
