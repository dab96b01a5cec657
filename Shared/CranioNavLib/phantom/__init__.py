"""The virtual patient: a real or synthetic head, its tissue and markers, a simulated tracker and A-mode probe."""

from CranioNavLib.phantom.patient import VirtualPatient, make_patient
from CranioNavLib.phantom.sites import LANDMARK_LABELS

__all__ = ["LANDMARK_LABELS", "VirtualPatient", "make_patient"]
