"""Without hardware: a patient on a simulated table and a hand that does what the buttons say, as one more panel."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.module_logic import ParametersInScene, done_or
from CranioNavLib.panel import Action, Panel, ParameterField, Progress, Step, StepState, StepStatus, Task
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.phantom.constants import MOVE_S
from CranioNavLib.scripted_module import ScriptedLoadableModuleLogic
from CranioNavLib.slicer_files import LabelledPoints
from CranioNavLib.volume import Volume

PATIENCE = 4.0  # dwell times on one point before it is left out


@dataclass(frozen=True)
class Visit:
    """Where the palpating hand is."""

    skipped: int  # points left out so far
    point: int  # of the plan; -1: on its way
    since_s: float


@dataclass(frozen=True)
class HandParameters(Parameters):
    """What the simulation keeps in the scene."""

    seed: Annotated[int, Limits(0, 2**31), "of the simulated patient and of every error"] = 0
    dwell_s: Annotated[float, Limits(0.5, 20), "a point that is not taken in four times this is left out"] = 2.5


PANEL = Panel(
    module="SimulatedHand",
    title="Simulated hand",
    parameters=HandParameters,
    steps=(
        Step(
            "patient",
            "Simulated patient",
            "No CT or hardware at hand: lay a simulated patient with the sample head on the table, with tracker and probe.",
            (
                ParameterField("seed"),
                Action("layPatient", "Use the simulated patient", "Loads his CT and planned landmarks", primary=True),
            ),
        ),
        Step(
            "pivot",
            "Simulated hand",
            "The simulated hand pivots the stylus about a small hollow (divot) on the head clamp.",
            (
                Action("pivotStylus", "Simulated hand: pivot the stylus", primary=True),
                Action("putAway", "Simulated hand: put the tools away"),
            ),
            status="pivotHandStatus",
        ),
        Step(
            "landmarks",
            "Simulated hand",
            "The simulated hand puts the stylus on the landmark that is asked for. When it rests there, read the point.",
            (Action("touchNextLandmark", "Simulated hand: touch the next landmark", primary=True),),
            status="landmarkHandStatus",
        ),
        Step(
            "palpation",
            "Simulated hand",
            "While the recording runs, the simulated hand rests on each point that is asked for, and those left out come again; "
            "or it glides over the skull, when you palpate by a sweep.",
            (ParameterField("dwell_s"), Action("palpateAll", "Simulated hand: palpate", primary=True)),
            status="palpationHandStatus",
        ),
        Step(
            "targets",
            "Simulated hand",
            "The simulated hand reads every marker (target) with the sphere tool: where they truly are, to compare with.",
            (Action("measureTargets", "Simulated hand: measure the targets", primary=True),),
            status="targetHandStatus",
        ),
        Step(
            "tour",
            "Simulated hand",
            "The simulated hand leads the stylus from target to target.",
            (Action("tourTargets", "Simulated hand: visit the targets", primary=True),),
            status="tourHandStatus",
        ),
    ),
)


class SimulatedHandLogic(ParametersInScene, ScriptedLoadableModuleLogic):
    """Tells the simulated session what to do; knows the other modules only by their nodes."""

    parameterClass = HandParameters
    sessionRole = "SimulationSession"

    def __init__(
        self,
        skip: Callable[[], object],
        taken: Callable[[], int | None],
        sweeping: Callable[[], bool],
        take_patient: Callable[[Volume], object],
    ) -> None:
        super().__init__()
        self.skip, self.taken = skip, taken  # go on to the next point; how many are taken; None: not recording
        self.take_patient = take_patient  # make the CT of another patient the scene's; nothing of the one before stays
        self.sweeping = sweeping  # whether what is recorded is a sweep
        self._visit: Visit | None = None
        self._glides_until_s = 0.0
        self._does = ("", "", 0.0)  # what was asked last, of what, and until when the hand is on its way

    def layPatient(self) -> Task:
        """Make the patient and put his planning CT and planned points into the scene."""
        seed = self.parameters().read().seed

        def make(progress: Progress) -> Any:
            from CranioNavLib.phantom.session import SimulatedSession

            patient, head = simulated_patient_of(seed, progress)
            progress("simulating his CT", 0.7)
            return SimulatedSession(patient, seed), patient.planning_ct, head

        return Task("Use the simulated patient", make, lambda made: self._take(*made))

    def layPatientBlocked(self) -> str:
        """Why no other patient can be laid on the table now."""
        return "stop the recording first" if self.taken() is not None or self.sweeping() else ""

    def _take(self, session: Any, volume: Any, head: str) -> str:
        from CranioNavLib.phantom.session import use_session

        self.take_patient(volume)
        self._visit, self._glides_until_s, self._does = None, 0.0, ("", "", 0.0)
        use_session(session)
        patient = session.patient
        scene_data.set_points("LandmarksCT", LabelledPoints(patient.landmark_labels, patient.landmarks_ras_mm))
        targets = tuple(f"Target {number + 1}" for number in range(len(patient.markers_ras_mm)))
        scene_data.set_points("TargetsCT", LabelledPoints(targets, patient.markers_ras_mm))
        return f"simulated patient: {head}; his landmarks are planned already"

    def pivotStylus(self) -> str:
        """Pivot the stylus until told otherwise."""
        self._session().pivot()
        self._does = ("pivot", "", 0.0)
        return "the hand pivots the stylus"

    def putAway(self) -> None:
        """Take the tools out of view."""
        for tool in ("Stylus", "Probe", "Sphere"):
            self._session().put_away(tool)
        self._does = ("", "", 0.0)

    def touchNextLandmark(self) -> str:
        """Put the stylus on the first planned landmark that has not been digitised."""
        session, waiting = self._session(), _waiting_landmarks()
        if not waiting:
            raise InputError("every landmark has been read; go on, or undo one")
        labels = list(session.patient.landmark_labels)
        if waiting[0] not in labels:
            raise InputError(f"the simulated patient has no landmark {waiting[0]!r}; he has {', '.join(labels)}")
        session.touch_landmark(labels.index(waiting[0]))
        self._does = ("touch", waiting[0], time.monotonic() + MOVE_S)
        return f"the stylus goes to {waiting[0]}"

    def palpateAll(self) -> str | Task:
        """Palpate the planned points one after another, or glide over them."""
        session = self._session()
        points = scene_data.get_points("ProtocolPoints")
        columns = scene_data.read_measurements(scene.find("ProtocolPoints"))
        normals = np.stack([columns[name] for name in ("Normal_R", "Normal_A", "Normal_S")], axis=1)
        session.set_plan(points.positions_mm, normals)
        if self.taken() is None:
            raise InputError("nothing is recorded yet; press Record first")
        session.put_away("Stylus")
        if self.sweeping():
            return Task("Simulated hand: palpate", lambda progress: session.sweep_plan(), self._glide)
        self._visit = Visit(0, -1, 0.0)
        return f"the hand rests on each of {len(points)} points until it is taken"

    def _glide(self, duration_s: float) -> str:
        self._glides_until_s = time.monotonic() + duration_s
        return "the hand glides over the skull to and fro until the recording is stopped"

    def poll(self) -> None:
        """While palpating: go where the protocol asks. A point that is not taken in time is left out."""
        visit, node = self._visit, scene.find("Protocol")
        session = running_simulation()
        if self._glides_until_s and session is not None:
            if not self.sweeping():
                session.put_away("Probe")
                self._glides_until_s = 0.0
            elif time.monotonic() > self._glides_until_s:
                self._glide(session.sweep_plan())
        if visit is None or session is None or node is None:
            return
        now, asked, count = time.monotonic(), int(node.GetParameter("current") or 0), len(scene_data.get_points("ProtocolPoints"))
        taken = self.taken()
        if taken is None or taken >= count or visit.skipped > count:
            session.put_away("Probe")
            self._visit = None
        elif asked != visit.point:
            session.hold_probe_at(asked)
            self._visit = Visit(visit.skipped, asked, now)
        elif now > visit.since_s + PATIENCE * self.parameters().read().dwell_s:
            self.skip()
            self._visit = Visit(visit.skipped + 1, -1, now)

    def measureTargets(self) -> str:
        """Digitise the targets as the sphere tool would, all at once."""
        session = self._session()
        positions = session.patient.digitise(
            session.patient.markers_ras_mm, np.random.default_rng([self.parameters().read().seed, 0x7A]), 0.25
        )
        labels = scene_data.get_points("TargetsCT").labels
        scene_data.set_points("TargetsPatient", LabelledPoints(labels, positions))
        return f"{len(labels)} targets measured"

    def tourTargets(self) -> str:
        """Lead the stylus from target to target."""
        session = self._session()
        targets = session.patient.markers_ras_mm
        self._does = ("tour", "", time.monotonic() + 4.0 * len(targets))
        session.play([(4.0 * number, lambda point=point: session.touch_point(point)) for number, point in enumerate(targets)])
        return f"the stylus goes to {len(targets)} targets, one after another"

    # What is to be asked of the hand; without a simulation nothing is

    def pivotHandStatus(self) -> StepStatus:
        """Whether the stylus is being pivoted."""
        return done_or(running_simulation() is None or self._does[0] == "pivot", "let the simulated hand pivot the stylus")

    def landmarkHandStatus(self) -> StepStatus:
        """Whether the stylus rests on the landmark that is asked for."""
        waiting = _waiting_landmarks()
        if running_simulation() is None or not waiting:
            return StepStatus(StepState.DONE)
        if self._does[:2] != ("touch", waiting[0]):
            return StepStatus(StepState.TODO, f"let the simulated hand touch {waiting[0]}")
        if self._is_on_its_way():
            return StepStatus(StepState.ATTENTION, f"the stylus goes to {waiting[0]}")
        return StepStatus(StepState.DONE)

    def _is_on_its_way(self) -> bool:
        return self._does[0] == "touch" and time.monotonic() < self._does[2]

    def touchNextLandmarkBlocked(self) -> str:
        """Why no landmark can be touched now."""
        if self._is_on_its_way():
            return "the hand is on its way"
        return "" if _waiting_landmarks() else "every landmark has been read"

    def palpationHandStatus(self) -> StepStatus:
        """Whether the hand palpates while points are wanted."""
        taken, node = self.taken(), scene.find("ProtocolPoints")
        if self.sweeping():
            moves = running_simulation() is None or self._glides_until_s > 0
            return done_or(moves, "let the simulated hand glide over the skull")
        idle = taken is not None and node is not None and taken < node.GetNumberOfControlPoints() and self._visit is None
        return done_or(running_simulation() is None or not idle, "let the simulated hand palpate the points")

    def targetHandStatus(self) -> StepStatus:
        """Whether the targets are measured."""
        node = scene.find("TargetsPatient")
        measured = node is not None and node.GetNumberOfControlPoints() > 0
        return done_or(
            running_simulation() is None or measured or not _registered(), "let the simulated hand measure the targets"
        )

    def tourHandStatus(self) -> StepStatus:
        """Whether the stylus is being led about."""
        touring = self._does[0] == "tour" and time.monotonic() < self._does[2]
        return done_or(running_simulation() is None or touring or not _registered(), "let the simulated hand visit the targets")

    def _session(self) -> Any:
        session = running_simulation()
        if session is None:
            raise InputError("no simulated patient lies on the table; use one in step 1")
        return session


def _waiting_landmarks() -> list[str]:
    """The planned landmarks that have not been read."""
    labels = []
    for role in ("LandmarksCT", "LandmarksPatient"):
        node = scene.find(role)
        labels.append(
            [node.GetNthControlPointLabel(i) for i in range(node.GetNumberOfControlPoints())] if node is not None else []
        )
    return [label for label in labels[0] if label not in labels[1]]


def _registered() -> bool:
    """Whether there is a registration: without one there is nothing to verify or to navigate by."""
    node = scene.find("ReferenceToRas")
    return node is not None and bool(node.GetAttribute(scene.STATUS_ATTRIBUTE))


def running_simulation() -> Any:
    """The simulated session; None when there is none."""
    from CranioNavLib.phantom.session import running_session

    return running_session()


def simulated_patient_of(seed: int, progress: Progress) -> tuple[Any, str]:
    """The patient of a seed, always the same, and whose head he has."""
    import os

    from CranioNavLib.phantom import make_patient

    from Workstation.demo_case import choose_head

    progress("loading the head", 0.1)
    synthetic = os.environ.get("CRANIONAV_SIMULATED_HEAD") == "synthetic"
    volume, head = (None, "synthetic head") if synthetic else choose_head(None)
    progress("simulating the patient", 0.3)
    return make_patient(volume, seed), head
