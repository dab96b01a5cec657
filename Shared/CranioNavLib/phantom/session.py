"""One simulated session: a patient on the table, a tracker, an A-mode probe, and a hand that does as it is told.

The simulated tracker and the simulated probe both look at one session, so that what the one sees fits what the
other hears. Time is the computer's (`RealClock`) or moves only when a device waits (`SteppedClock`, for tests).
All methods may be called from any thread.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from typing import Callable, Optional, Union

import numpy as np
import numpy.typing as npt

from CranioNavLib.errors import InputError
from CranioNavLib.phantom import constants
from CranioNavLib.phantom.hand import Skill, frames_along, slide_over, stand_at
from CranioNavLib.phantom.motion import Path, Slide, Tremor
from CranioNavLib.phantom.palpation import STANDING_ERROR_MM
from CranioNavLib.phantom.patient import VirtualPatient, make_patient
from CranioNavLib.phantom.tracking import STANDING_SHARE, disturb, draw_error
from CranioNavLib.phantom.ultrasound import LineSource
from CranioNavLib.rigid import Array, invert_rigid, rigid, rigid_from_vector, transform_points
from CranioNavLib.sequence_metafile import Acquisition

SLIDE_STEP_MM = 1.0  # between the poses that a slide is made of
REFERENCE, PROBE, STYLUS, SPHERE = "Reference", "Probe", "Stylus", "Sphere"
TOOLS = (REFERENCE, PROBE, STYLUS, SPHERE)
# tip (or face, or centre) in the frame of the tool's markers
TIPS_MM = {PROBE: constants.PROBE_FACE_MM, STYLUS: constants.STYLUS_TIP_MM, SPHERE: constants.SPHERE_TIP_MM}


class RealClock:
    """time.monotonic()."""

    def now(self) -> float:
        """Seconds."""
        return time.monotonic()

    def wait_until(self, moment_s: float) -> None:
        """Sleep until then."""
        time.sleep(max(0.0, moment_s - time.monotonic()))


class SteppedClock:
    """A clock that stands until somebody waits: sessions run as fast as the computer can, and always the same."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now = start_s

    def now(self) -> float:
        """Seconds."""
        return self._now

    def wait_until(self, moment_s: float) -> None:
        """Go to that time; time never goes back."""
        self._now = max(self._now, moment_s)


@dataclass(frozen=True, eq=False)
class _Held:
    """What the hand does with one tool. Poses are of the calibrated tool (tip at the origin), in Reference."""

    path: Union[Path, Slide]
    slide_mm: Tremor
    tilt_rad: Tremor
    number: int
    divot_mm: Optional[Array] = None  # (3,) Reference: the tool pivots here


class SimulatedSession:
    """A patient, his place in the room, and what is held where.

    Parameters
    ----------
    patient : VirtualPatient
    seed : int
        Of the hand, the tracker's noise and the receiver's noise.
    clock : RealClock or SteppedClock
    skill : Skill
        Of the hand.
    """

    CONVERTER_RANGE = (-(2 ** (constants.ADC_BITS - 1)), 2 ** (constants.ADC_BITS - 1) - 1)  # first and last sample value

    def __init__(
        self,
        patient: VirtualPatient,
        seed: int = 0,
        clock: Union[RealClock, SteppedClock, None] = None,
        skill: Optional[Skill] = None,
    ) -> None:
        self.patient, self.clock, self.skill = patient, clock or RealClock(), skill or Skill()
        self._seed = seed
        self._lock = threading.RLock()
        self._rng = np.random.default_rng([seed, 0x5E])
        self._held: dict[str, _Held] = {}
        self._count = 0
        self._plan: tuple[Array, Array] = (np.empty((0, 3)), np.empty((0, 3)))
        self._script: list[tuple[float, Callable[[], None]]] = []
        self.palpation_point = -1  # which point of the plan the probe is at; -1: none
        self._source = LineSource(patient.bone, patient.skin, patient.tissue, np.random.default_rng([seed, 0x11]))
        self._start_s = self.clock.now()
        self._head = Path(*(self._first_head_pose(),) * 2, begin_s=self._start_s, duration_s=0.0, lift=np.zeros(3))

    # --- what the hand is told ------------------------------------------------------------------------------------

    def set_plan(self, positions_ras_mm: npt.ArrayLike, normals: npt.ArrayLike) -> None:
        """The palpation plan: bone points (N, 3) and outward normals (N, 3), RAS."""
        self._plan = (np.asarray(positions_ras_mm, dtype=float), np.asarray(normals, dtype=float))

    def hold_probe_at(self, point: int, tilt_deg: Optional[float] = None) -> None:
        """Set the probe down at a point of the plan.

        Raises
        ------
        InputError
            There is no plan, or it has no such point.
        """
        if not 0 <= point < len(self._plan[0]):
            raise InputError(f"the palpation plan has {len(self._plan[0])} points, there is no number {point}; set a plan first")
        self.hold_probe(self._plan[0][point], self._plan[1][point], tilt_deg)
        self.palpation_point = point

    def hold_probe(self, position_ras_mm: npt.ArrayLike, outward: npt.ArrayLike, tilt_deg: Optional[float] = None) -> None:
        """Set the probe down over a place on the bone; `tilt_deg`: exactly this angle off the normal, no error of aim."""
        skill = (
            self.skill if tilt_deg is None else Skill(0.0, 0.0, self.skill.tremor_tilt_sd_deg, self.skill.tremor_position_sd_mm)
        )
        with self._lock:
            place = np.asarray(position_ras_mm, dtype=float)[None]
            stand = stand_at(self.patient, place, np.asarray(outward, dtype=float)[None], self._rng, skill)
            frames = frames_along(stand.beams, stand.bone_points_mm, self._rng.uniform(0, 2 * np.pi, 1))
            if tilt_deg is not None:
                frames = frames @ rigid_from_vector((np.radians(tilt_deg), 0.0, 0.0), np.zeros(3))
            face = rigid(np.eye(3), (0.0, 0.0, -float(stand.tissue_mm[0]) - constants.FORERUN_LENGTH_MM))
            self._hold(PROBE, self.patient.ras_to_reference @ (frames[0] @ face), self.skill.tremor_tilt_sd_deg)
            self.palpation_point = -1

    def touch_landmark(self, index: int) -> None:
        """Put the stylus tip on an anatomical landmark, as well as a user finds it."""
        self.touch_point(self.patient.landmarks_ras_mm[index], self.patient.condition.landmark_fle_sd_mm)

    def touch_point(self, point_ras_mm: npt.ArrayLike, sd_mm: float = constants.PALPATION_FLE_SD_MM) -> None:
        """Put the stylus tip on a point of the head (RAS)."""
        self._touch(STYLUS, point_ras_mm, sd_mm)

    def touch_target(self, index: int) -> None:
        """Seat the sphere tool on a titanium sphere."""
        self._touch(SPHERE, self.patient.markers_ras_mm[index], constants.SPHERE_TOOL_FLE_SD_MM)

    def pivot(self, tool: str = STYLUS, divot_reference_mm: npt.ArrayLike = (40.0, 25.0, 10.0)) -> None:
        """Pivot a tool about a divot on the head clamp (Reference), as for pivot calibration."""
        with self._lock:
            divot = np.asarray(divot_reference_mm, dtype=float)
            self._hold(tool, rigid(self._upright(), divot), 0.0, divot)

    def put_away(self, tool: str) -> None:
        """Take a tool out of the camera's view."""
        with self._lock:
            self._held.pop(tool, None)
            if tool == PROBE:
                self.palpation_point = -1

    def move_head(self, rotation_vector_rad: npt.ArrayLike, translation_mm: npt.ArrayLike, duration_s: float = 2.0) -> None:
        """Turn and shift the table with the head and the reference base on it (about the head, in Tracker axes)."""
        with self._lock:
            now = self.clock.now()
            start = self._head.at(now)
            middle = transform_points(start @ self.patient.ras_to_reference, self.patient.skin.center_mm[None])[0]
            goal = rigid_from_vector(rotation_vector_rad, translation_mm, middle) @ start
            self._head = Path(start, goal, now, duration_s, np.zeros(3))

    def play(self, steps: list[tuple[float, Callable[[], None]]]) -> None:
        """Do things later by themselves: (seconds from now, what)."""
        now = self.clock.now()
        with self._lock:
            self._script = sorted([*self._script, *((now + delay, what) for delay, what in steps)], key=lambda step: step[0])

    @property
    def playing(self) -> bool:
        """Whether things are still to be done by themselves."""
        with self._lock:
            return bool(self._script)

    def sweep_plan(self) -> float:
        """Slide the probe over the skin through the points of the plan, the nearest next, and back. Returns how long it takes, s.

        Raises
        ------
        InputError
            The plan has fewer than two points.
        """
        places, normals = self._plan
        if len(places) < 2:
            raise InputError(f"the palpation plan has {len(places)} points, a sweep needs two; set a plan first")
        order = _nearest_next(places)
        way = [*order, *order[-2::-1]]
        length_mm = float(np.linalg.norm(np.diff(places[way], axis=0), axis=1).sum())
        steps = max(2, int(length_mm / SLIDE_STEP_MM))
        with self._lock:
            rng = np.random.default_rng(int(self._rng.integers(2**62)))
        # steered as when the probe rests, since the page tells the tilt; outside the lock, for the devices go on
        poses = slide_over(self.patient, places[way], normals[way], steps, rng, self.skill.tilt_sd_deg)
        with self._lock:
            self._hold(PROBE, self.patient.ras_to_reference @ poses[0], 0.0)
            held, self.palpation_point = self._held[PROBE], -1
            approach, duration_s = held.path, length_mm / constants.SWEEP_MM_S
            assert isinstance(approach, Path)
            self._held[PROBE] = replace(held, path=Slide(approach, self.patient.ras_to_reference @ poses, duration_s))
        return approach.duration_s + duration_s

    # --- what the devices see and hear ----------------------------------------------------------------------------

    @property
    def acquisition(self) -> Acquisition:
        """Of the simulated probe."""
        return self.patient.acquisition

    def reference_to_tracker(self, time_s: float) -> Array:
        """(4, 4) true pose of the reference base."""
        return self._head.at(time_s)

    def tool_to_reference(self, tool: str, time_s: float) -> Optional[Array]:
        """(4, 4) true pose of a calibrated tool (tip at the origin) in Reference; None: out of view."""
        with self._lock:
            self._run_script(time_s)
            held = self._held.get(tool)
        if held is None:
            return None
        pose = held.path.at(time_s)
        if held.divot_mm is not None and held.path.arrived(time_s):
            swing = np.radians(constants.PIVOT_CONE_DEG) / np.sqrt(2)
            angles = [swing * np.sin(2 * np.pi * (time_s - held.path.begin_s) / period) for period in constants.PIVOT_PERIODS_S]
            pose = pose @ rigid_from_vector((*angles, 0.0), np.zeros(3))
            pose[:3, 3] = held.divot_mm
        tilt = held.tilt_rad.at(time_s)
        return pose @ rigid_from_vector((*tilt, 0.0), held.slide_mm.at(time_s))

    def reported_poses(self, time_s: float, noise: float = 1.0, calibrated: bool = True) -> dict[str, Optional[Array]]:
        """Tool -> (4, 4) ToolToTracker as the tracker reports it, or None where it sees no tool.

        `noise` scales the tracker's error. Not `calibrated`: poses are of the tools' marker frames, their tips unknown.
        """
        base = self.reference_to_tracker(time_s)
        reported: dict[str, Optional[Array]] = {REFERENCE: self._seen(REFERENCE, base, (self._count,), noise)}
        for tool in TOOLS[1:]:
            pose = self.tool_to_reference(tool, time_s)
            if pose is None:
                reported[tool] = None
                continue
            tip = rigid(np.eye(3), TIPS_MM[tool])
            seen = self._seen(tool, base @ pose @ invert_rigid(tip), self._held_number(tool, time_s), noise)
            if calibrated:
                seen = seen @ tip @ self.patient.probe_calibration_error if tool == PROBE else seen @ tip
            reported[tool] = seen
        return reported

    def rf_line(self, time_s: float) -> npt.NDArray[np.int16]:
        """(N,) the RF line of a pulse sent at that time; a probe out of hand hears only its forerun."""
        pose = self.tool_to_reference(PROBE, time_s)
        if pose is None:
            pose = self.patient.ras_to_reference @ rigid(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 1000.0))
        warming = constants.FORERUN_WARMING_DURING_USE_K * min(1.0, (time_s - self._start_s) / 300.0)
        with self._lock:
            line: npt.NDArray[np.int16] = self._source.lines((self.patient.true_reference_to_ras @ pose)[None], warming)[0]
        return line

    # --- inside -----------------------------------------------------------------------------------------------------

    def _first_head_pose(self) -> Array:
        """The head in the middle of the camera's volume; the camera's axes are those of the patient's tracker error."""
        turn = self.patient.tracker_error.camera_to_reference.T
        middle = transform_points(self.patient.ras_to_reference, self.patient.skin.center_mm[None])[0]
        return rigid(turn, np.array([0.0, 0.0, self._rng.uniform(*constants.CAMERA_DISTANCE_MM)]) - turn @ middle)

    def _upright(self) -> Array:
        """Rotation (3, 3) of a tool whose markers face the camera's side of the reference base."""
        turn = self.patient.tracker_error.camera_to_reference
        return np.asarray(frames_along(turn[:, 1][None], np.zeros((1, 3)))[0, :3, :3])

    def _touch(self, tool: str, point_ras_mm: npt.ArrayLike, sd_mm: float) -> None:
        with self._lock:
            point = np.asarray(point_ras_mm, dtype=float)
            outward = point - self.patient.skin.center_mm
            found = point + self._rng.normal(0.0, sd_mm, 3)
            frame = frames_along(-(outward / np.linalg.norm(outward))[None], found[None], self._rng.uniform(0, 6.28, 1))[0]
            self._hold(tool, self.patient.ras_to_reference @ frame, 2.0)

    def _hold(self, tool: str, goal: Array, tilt_sd_deg: float, divot: Optional[Array] = None) -> None:
        now = self.clock.now()
        before = self._held.get(tool)
        lift = -goal[:3, 2] * constants.LIFT_MM
        start = before.path.at(now) if before is not None else rigid(goal[:3, :3], goal[:3, 3] + lift)
        slip = self.skill.tremor_position_sd_mm if tool == PROBE else constants.TIP_SLIP_SD_MM
        self._count += 1
        self._held[tool] = _Held(
            path=Path(start, goal, now, constants.MOVE_S, lift if before is not None else np.zeros(3)),
            slide_mm=_scaled(Tremor.draw(self._rng, 3), slip),
            tilt_rad=_scaled(Tremor.draw(self._rng, 2), float(np.radians(tilt_sd_deg))),
            number=self._count,
            divot_mm=divot,
        )

    def _held_number(self, tool: str, time_s: float) -> tuple[int, ...]:
        """Of what the hand does with a tool, and of how far it has slid: the standing error changes as a tool gets about."""
        held = self._held.get(tool)
        if held is None:
            return (0,)
        if isinstance(held.path, Slide):
            return (held.number, int(held.path.travelled_mm(time_s) // STANDING_ERROR_MM))
        return (held.number,)

    def _seen(self, tool: str, true_pose: Array, number: tuple[int, ...], noise: float) -> Array:
        """A marker frame's pose with the tracker's error; its standing part is drawn anew with each thing the hand does."""
        standing = draw_error(np.random.default_rng([self._seed, TOOLS.index(tool), *number]), 1)
        with self._lock:
            moving = draw_error(self._rng, 1)
        error = noise * (STANDING_SHARE * standing + constants.TRACKER_JITTER_SHARE * moving)
        seen: Array = disturb(true_pose[None], error, true_pose[None, :3, 3])[0]
        return seen

    def _run_script(self, time_s: float) -> None:
        while self._script and self._script[0][0] <= time_s:
            self._script.pop(0)[1]()


def _nearest_next(places: Array) -> list[int]:
    """An order of points (N, 3) from the first to the nearest that is left, and so on."""
    order, left = [0], set(range(1, len(places)))
    while left:
        order.append(min(left, key=lambda one: float(np.linalg.norm(places[one] - places[order[-1]]))))
        left.remove(order[-1])
    return order


def _scaled(tremor: Tremor, sd: float) -> Tremor:
    return Tremor(tremor.rates_rad_s, tremor.phases, tremor.weights * sd)


# --- the session that the simulated devices share -------------------------------------------------------------------

_CURRENT: list[SimulatedSession] = []
_CURRENT_LOCK = threading.Lock()


def use_session(session: Optional[SimulatedSession]) -> None:
    """The session that simulated devices opened from now on look at; None: they make one of their own."""
    with _CURRENT_LOCK:
        _CURRENT[:] = [] if session is None else [session]


def running_session() -> Optional[SimulatedSession]:
    """The session in use; None when there is none."""
    with _CURRENT_LOCK:
        return _CURRENT[0] if _CURRENT else None


def current_session(head: str = "sample", seed: int = 0) -> SimulatedSession:
    """The session in use; one is made (and kept) when there is none. `head`: "sample" or "synthetic".

    Raises
    ------
    InputError
        The sample head cannot be had.
    """
    with _CURRENT_LOCK:
        if not _CURRENT:
            if head == "sample":
                from CranioNavLib.sample_head import load_sample_head

                _CURRENT.append(SimulatedSession(make_patient(load_sample_head(), seed), seed))
            else:
                _CURRENT.append(SimulatedSession(make_patient(None, seed), seed))
        return _CURRENT[0]
