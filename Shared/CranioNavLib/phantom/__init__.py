"""The virtual patient: a real or synthetic head, its tissue and markers, a simulated tracker and A-mode probe."""

from CranioNavLib.phantom.case_writer import write_case, write_volume
from CranioNavLib.phantom.palpation import Palpation, palpate
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
    "write_case",
    "write_volume",
]
