"""A hand that goes round by itself: every tool moves calmly from place to place on the head, for as long as anybody looks."""

from __future__ import annotations

from functools import partial

import numpy as np

from CranioNavLib.phantom.session import SimulatedSession

EACH_S = 4.0  # for one place: the way there and a dwell


def go_round(session: SimulatedSession, number: int = 0) -> None:
    """From now on probe, stylus and sphere tool visit the titanium spheres and the landmarks, one every four seconds."""
    patient = session.patient
    place = patient.markers_ras_mm[number % len(patient.markers_ras_mm)]
    outward = place - patient.skin.center_mm
    session.hold_probe(place, outward / np.linalg.norm(outward))
    session.touch_landmark(number % len(patient.landmarks_ras_mm))
    session.touch_target((number + 1) % len(patient.markers_ras_mm))  # the probe stands on the one before
    session.play([(EACH_S, partial(go_round, session, number + 1))])
