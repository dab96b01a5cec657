"""The virtual patient: a real or synthetic head, its tissue and markers, a simulated tracker and A-mode probe.

What is simulated: bone and skin from a head CT at its own resolution; a planning CT of it at the study's protocol with
partial volume, noise and titanium spheres; the place of the reference base; tracker noise (anisotropic, most of it
standing still), the error of the probe's calibration and of every touch; the hand's aim, tilt, tremor and pressure; RF
lines with forerun, scalp layers, speckle, attenuation, directivity, inner table, repetitions, gain, noise and converter.

What is not, so that simulated results are on the kind side: metal streaks and motion in the CT, hair, air in the gel,
refraction in the scalp, shear waves, a reference base that slips, skin that drags the markers, and users who err.
All constants are in constants.py, each with its source; nothing that estimates may import it.
"""

from CranioNavLib.phantom.case_writer import write_case, write_volume
from CranioNavLib.phantom.palpation import Palpation, palpate, sweep
from CranioNavLib.phantom.patient import VirtualPatient, make_patient
from CranioNavLib.phantom.session_data import MODES, SessionData, draw_session
from CranioNavLib.phantom.sites import LANDMARK_LABELS

__all__ = [
    "LANDMARK_LABELS",
    "MODES",
    "Palpation",
    "SessionData",
    "VirtualPatient",
    "draw_session",
    "make_patient",
    "palpate",
    "sweep",
    "write_case",
    "write_volume",
]
