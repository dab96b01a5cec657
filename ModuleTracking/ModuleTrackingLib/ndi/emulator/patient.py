"""The virtual patient as what the emulated camera sees: a hand that goes from landmark to bone to target, in a loop."""

from __future__ import annotations

import math
from functools import partial
from typing import Optional

import numpy as np
from CranioNavLib.phantom.session import PROBE, SPHERE, STYLUS, TOOLS, SimulatedSession, SteppedClock
from CranioNavLib.rigid import Array
from scipy.spatial.transform import Rotation

from ModuleTrackingLib.ndi.tracking import RawPose

EACH_S = 4.0  # for one place: the way there and a dwell
ERROR_MM = 0.15  # the fit error that the device reports; simulated, it has no bearing on the true one


class PatientMotion:
    """A simulated session on a patient: the stylus touches the landmarks, the probe stands on the bone at each of the
    titanium spheres, the sphere tool sits in them; every tool is seen as an optical tracker sees it, noise included.

    Parameters
    ----------
    session : SimulatedSession
        With a SteppedClock: its time is that of the emulated device.
    calibrated : bool
        Report tool tips; otherwise the marker frames, whose tips calibration has to find.
    """

    def __init__(self, session: SimulatedSession, clock: SteppedClock, rate_hz: float = 60.0, calibrated: bool = True) -> None:
        self.tools, self.rate_hz = TOOLS, rate_hz
        self._session, self._clock, self._calibrated = session, clock, calibrated
        self._began_s = clock.now()
        self._places = self._round()
        self._place = -1
        self._newest: tuple[int, dict[str, Optional[RawPose]]] = (-1, {})

    def _round(self) -> list[partial[None]]:
        """What the hand does, one thing after the other."""
        session, patient = self._session, self._session.patient
        landmarks = [partial(session.touch_landmark, index) for index in range(len(patient.landmarks_ras_mm))]
        bone = [partial(session.hold_probe, place, self._outward(place)) for place in patient.markers_ras_mm]
        targets = [partial(session.touch_target, index) for index in range(len(patient.markers_ras_mm))]
        away = [[partial(session.put_away, tool)] for tool in (STYLUS, PROBE, SPHERE)]
        return [*landmarks, *away[0], *bone, *away[1], *targets, *away[2]]

    def _outward(self, place: Array) -> Array:
        direction = place - self._session.patient.skin.center_mm
        return np.asarray(direction / np.linalg.norm(direction))

    def sample(self, time_s: float) -> tuple[int, dict[str, Optional[RawPose]]]:
        """See Motion.sample. Time may begin anew (tracking was stopped and started): the hand goes on where it is."""
        frame = max(0, math.floor(time_s * self.rate_hz + 1e-6))
        if frame < self._newest[0]:
            self._began_s = self._clock.now()
        if frame != self._newest[0]:
            now_s = self._began_s + frame / self.rate_hz
            while (self._place + 1) * EACH_S <= now_s:  # also what nobody looked at
                self._place += 1
                self._clock.wait_until(self._place * EACH_S)
                self._places[self._place % len(self._places)]()
            self._clock.wait_until(now_s)
            seen = self._session.reported_poses(now_s, calibrated=self._calibrated)
            self._newest = frame, {tool: _raw(pose) for tool, pose in seen.items()}
        return self._newest


def _raw(pose: Optional[Array]) -> Optional[RawPose]:
    if pose is None:
        return None
    qx, qy, qz, q0 = (float(value) for value in Rotation.from_matrix(pose[:3, :3]).as_quat())
    x, y, z = (float(value) for value in pose[:3, 3])
    return RawPose((q0, qx, qy, qz), (x, y, z), ERROR_MM)


def patient_motion(seed: int = 0, rate_hz: float = 60.0, synthetic: bool = False, calibrated: bool = True) -> PatientMotion:
    """The motion over a patient made for it.

    Parameters
    ----------
    synthetic : bool
        The parametric head instead of the sample head's CT.

    Raises
    ------
    InputError
        The sample head is not there.
    """
    from CranioNavLib.phantom.patient import make_patient
    from CranioNavLib.sample_head import load_sample_head

    clock = SteppedClock()
    session = SimulatedSession(make_patient(None if synthetic else load_sample_head(), seed=seed), seed=seed, clock=clock)
    return PatientMotion(session, clock, rate_hz, calibrated)
