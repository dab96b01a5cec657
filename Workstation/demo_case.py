"""The demonstration's patient: which head, and the case folder that a simulated session leaves."""

from __future__ import annotations

from pathlib import Path
from typing import Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.volume import Volume

SIMULATED = "Simulated patient, tracker and probe"  # a report says it first


def choose_head(ct: Optional[Path]) -> tuple[Optional[Volume], str]:
    """The head CT to simulate a patient from, and its name for people; None stands for the synthetic head.

    Raises
    ------
    InputError
        The CT given by the user cannot be read.
    """
    if ct is not None:
        from ModuleRegistrationLib.anatomy.ct_reader import read_ct

        return read_ct(ct), str(ct)
    from CranioNavLib.sample_head import load_sample_head

    try:
        return load_sample_head(), "sample head CT (Debian's invesalius-examples)"
    except InputError as error:
        return None, f"synthetic head, because the sample head is missing ({error})"


def make_case(volume: Optional[Volume], seed: int, folder: Path, mode: str = "III") -> Path:
    """A case folder of a simulated session: every draw follows from `seed`."""
    from CranioNavLib.phantom.case_writer import write_case
    from ModuleRegistrationLib.anatomy.segmentation import segment_bone
    from ModuleRegistrationLib.verification.simulated_patient import simulated_patient
    from ModuleUltrasoundLib.palpation.protocol import plan_protocol

    patient = simulated_patient(volume, seed)
    bone = segment_bone(patient.planning_ct)
    plan = plan_protocol(bone.outer_table, patient.landmarks_ras_mm, patient.landmark_labels)
    rng = np.random.default_rng([seed, 1])  # the session's own stream, apart from the patient's
    return write_case(patient, folder, plan.positions_ras_mm, plan.normals, rng, mode, plan.labels)
