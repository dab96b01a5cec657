"""A virtual patient with any head: landmarks that nobody has marked are found in the CT."""

from __future__ import annotations

from typing import Optional

from CranioNavLib.phantom import VirtualPatient, make_patient
from CranioNavLib.phantom.patient import knows_landmarks
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.landmark_suggestions import suggest_landmarks
from ModuleRegistrationLib.anatomy.segmentation import segment_bone


def simulated_patient(volume: Optional[Volume], seed: int, condition: str = "phantom") -> VirtualPatient:
    """The virtual patient of a head CT; None: the synthetic head.

    Raises
    ------
    InputError
        No landmarks can be found in the CT, or it holds no head.
    """
    unmarked = volume is not None and not knows_landmarks(volume)
    landmarks = suggest_landmarks(segment_bone(volume)).positions_ras_mm if volume is not None and unmarked else None
    return make_patient(volume, seed, landmarks, condition=condition)
