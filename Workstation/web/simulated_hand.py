"""Without hardware: a patient on a simulated table and a hand that does what the buttons say, as one more panel."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.module_logic import ParametersInScene
from CranioNavLib.panel import Action, Panel, ParameterField, Progress, Step, Task
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.scripted_module import ScriptedLoadableModuleLogic
from CranioNavLib.slicer_files import LabelledPoints

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
            "Let the simulated hand pivot the stylus about a divot on the clamp, then press Pivot below.",
            (Action("pivotStylus", "Hand: pivot the stylus"), Action("putAway", "Hand: put the tools away")),
        ),
        Step(
            "landmarks",
            "Simulated hand",
            "Let the simulated hand put the stylus on the landmark that is asked for, then read the point.",
            (Action("touchNextLandmark", "Hand: touch the next landmark"),),
        ),
        Step(
            "palpation",
            "Simulated hand",
            "While the recording runs, let the simulated hand rest on each point that is asked for.",
            (ParameterField("dwell_s"), Action("palpateAll", "Hand: palpate all points")),
        ),
        Step(
            "targets",
            "Simulated hand",
            "Let the simulated hand seat the sphere tool on every target and read it: the ground truth.",
            (Action("measureTargets", "Hand: measure the targets"),),
        ),
        Step(
            "tour",
            "Simulated hand",
            "Let the simulated hand lead the stylus over the head.",
            (Action("tourTargets", "Hand: visit the targets"),),
        ),
    ),
)


class SimulatedHandLogic(ParametersInScene, ScriptedLoadableModuleLogic):
    """Tells the simulated session what to do; knows the other modules only by their nodes."""

    parameterClass = HandParameters
    sessionRole = "SimulationSession"

    def __init__(self, skip: Callable[[], object], taken: Callable[[], int | None]) -> None:
        super().__init__()
        self.skip, self.taken = skip, taken  # go on to the next point; how many are taken; None: not recording
        self._visit: Visit | None = None

    def layPatient(self) -> Task:
        """Make the patient and put his planning CT and planned points into the scene."""
        seed = self.parameters().read().seed

        def make(progress: Progress) -> Any:
            from CranioNavLib.phantom.session import SimulatedSession

            patient, head = simulated_patient_of(seed, progress)
            progress("simulating his CT", 0.7)
            return SimulatedSession(patient, seed), patient.planning_ct, head

        return Task("Use the simulated patient", make, lambda made: self._take(*made))

    def _take(self, session: Any, volume: Any, head: str) -> str:
        from CranioNavLib.phantom.session import use_session

        use_session(session)
        patient = session.patient
        for role in ("Bone", "OuterTable", "Skin", "LandmarksPatient", "SurfacePoints", "TargetsPatient", "PlausibilityPoints"):
            scene.release(role)
        scene_data.set_volume("CT", volume)
        scene_data.set_points("LandmarksCT", LabelledPoints(patient.landmark_labels, patient.landmarks_ras_mm))
        targets = tuple(f"Target {number + 1}" for number in range(len(patient.markers_ras_mm)))
        scene_data.set_points("TargetsCT", LabelledPoints(targets, patient.markers_ras_mm))
        return f"simulated patient: {head}"

    def pivotStylus(self) -> str:
        """Pivot the stylus until told otherwise."""
        self._session().pivot()
        return "the hand pivots the stylus"

    def putAway(self) -> None:
        """Take the tools out of view."""
        for tool in ("Stylus", "Probe", "Sphere"):
            self._session().put_away(tool)

    def touchNextLandmark(self) -> str:
        """Put the stylus on the first planned landmark that has not been digitised."""
        session = self._session()
        planned = scene_data.get_points("LandmarksCT").labels
        node = scene.find("LandmarksPatient")
        taken = {node.GetNthControlPointLabel(i) for i in range(node.GetNumberOfControlPoints())} if node is not None else set()
        waiting = [label for label in planned if label not in taken]
        if not waiting:
            raise InputError("every landmark has been read; go on, or undo one")
        labels = list(session.patient.landmark_labels)
        if waiting[0] not in labels:
            raise InputError(f"the simulated patient has no landmark {waiting[0]!r}; he has {', '.join(labels)}")
        session.touch_landmark(labels.index(waiting[0]))
        return f"the stylus goes to {waiting[0]}"

    def palpateAll(self) -> str:
        """Palpate the planned points one after another."""
        session = self._session()
        points = scene_data.get_points("ProtocolPoints")
        columns = scene_data.read_measurements(scene.find("ProtocolPoints"))
        normals = np.stack([columns[name] for name in ("Normal_R", "Normal_A", "Normal_S")], axis=1)
        session.set_plan(points.positions_mm, normals)
        if self.taken() is None:
            raise InputError("nothing is recorded yet; press Record first")
        session.put_away("Stylus")
        self._visit = Visit(0, -1, 0.0)
        return f"the hand rests on each of {len(points)} points until it is taken"

    def poll(self) -> None:
        """While palpating: go where the protocol asks. A point that is not taken in time is left out."""
        visit, node = self._visit, scene.find("Protocol")
        session = running_simulation()
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
        session.play([(4.0 * number, lambda point=point: session.touch_point(point)) for number, point in enumerate(targets)])
        return f"the stylus goes to {len(targets)} targets, one after another"

    def _session(self) -> Any:
        session = running_simulation()
        if session is None:
            raise InputError("no simulated patient lies on the table; use one in step 1")
        return session


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
