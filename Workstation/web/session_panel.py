"""The session as a panel: go on with one that was interrupted, and write its report."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from CranioNavLib import scene, scene_data
from CranioNavLib.case import NOTE, note_in_case
from CranioNavLib.errors import InputError
from CranioNavLib.module_logic import ParametersInScene
from CranioNavLib.panel import Action, Level, Panel, Progress, Reading, ReadOut, Step, StepState, StepStatus, Task, words_of
from CranioNavLib.parameters import Parameters
from CranioNavLib.scripted_module import ScriptedLoadableModuleLogic
from ModuleUltrasoundLib.measurement.measure import EchoSettings

from Workstation.demo_case import SIMULATED
from Workstation.web.session_folder import SessionFolder, last_session

OFFERED = ("report.html", "report.pdf", "scene.mrb", "ReferenceToRas.tfm", "registration.json")  # what the page lets one open
USUAL_REPORT_S = 15.0  # the bar stands at half then
SAME_MM = 0.05  # between the registration on the screen and the one that the report repeats from the files


@dataclass(frozen=True)
class SessionParameters(Parameters):
    """A session has none of its own."""


PANEL = Panel(
    module="Session",
    title="Session",
    parameters=SessionParameters,
    steps=(
        Step(
            "resume",
            "Go on",
            "",
            (
                Action(
                    "resumeSession", "Go on with the last session", "CT, points, settings and registration as left", primary=True
                ),
            ),
            status="resumeStatus",
        ),
        Step(
            "report",
            "Report",
            "The report is made from the saved files alone and compared with the registration on the screen.",
            (
                Action("writeReport", "Write report and export", "Takes half a minute", primary=True),
                ReadOut("reportFiles", "Written"),
            ),
            status="reportStatus",
        ),
    ),
)


class SessionLogic(ParametersInScene, ScriptedLoadableModuleLogic):
    """Brings a saved session back, and has its report made by a process of its own."""

    parameterClass = SessionParameters
    sessionRole = "WorkstationSession"

    def __init__(self, session: SessionFolder, logics: dict[str, Any], go_to: Any) -> None:
        super().__init__()
        self.session, self._logics, self._go_to = session, logics, go_to
        self._resumable = last_session(session.folder)

    # Going on

    def resumeSession(self) -> Task:
        """Read the session; the bone comes from the cache, the points from the recording."""
        folder = self._resumable
        assert folder is not None  # or it is blocked
        state, lists = self.session.read_state(folder), self.session.read_lists(folder)
        self.session.restore_parameters(state)
        self.session.correct_paths(folder)
        wanted = self._logics["ModuleRegistration"].parameters().read()
        recorded = state["points"] and Path(self._logics["ModuleUltrasound"].parameters().read().recording_path).is_file()
        measuring = self._logics["ModuleUltrasound"].measureRecording() if recorded else None

        def read(progress: Progress) -> Any:
            from ModuleRegistrationLib.anatomy.ct_reader import read_ct
            from ModuleRegistrationLib.anatomy.segmentation import segment_bone
            from ModuleRegistrationLib.logic.bone import prepared

            progress("reading the CT", 0.1)
            volume = read_ct(folder / "ct.nrrd")
            progress("finding the bone", 0.3)
            bone = prepared(segment_bone(volume, method=wanted.segmentation)) if state["bone"] else None
            progress("measuring the recording", 0.6)
            points = measuring.compute(Progress()) if measuring is not None else None
            patient = None
            if state["simulated_seed"] is not None:
                progress("laying the simulated patient on the table", 0.8)
                patient = _simulated_session(state["simulated_seed"])
            return volume, bone, patient, (lambda: measuring.apply(points)) if measuring is not None else None

        return Task("Go on with the last session", read, lambda found: self._bring_back(folder, state, lists, *found))

    def resumeSessionBlocked(self) -> str:
        """Why there is nothing to go on with."""
        if scene.find("CT") is not None:
            return "a session is under way"
        return "" if self._resumable is not None else "no earlier session"

    def resumeStatus(self) -> StepStatus:
        """Whether there is a session to go on with, and of when it is."""
        if self._resumable is None or self.resumeSessionBlocked():
            return StepStatus(StepState.DONE)
        saved = time.strftime("%d %b, %H:%M", time.localtime((self._resumable / "session.json").stat().st_mtime))
        return StepStatus(StepState.TODO, f"go on with the session saved on {saved}, or begin anew")

    def _bring_back(
        self, folder: Path, state: dict[str, Any], lists: Any, volume: Any, bone: Any, patient: Any, take: Any
    ) -> str:
        registration, ultrasound = self._logics["ModuleRegistration"], self._logics["ModuleUltrasound"]
        registration.takeCt(volume)
        self.session.go_on(folder)
        if bone is not None:
            registration.takeBone(bone)
        for role, points in lists.items():
            scene_data.set_points(role, points)
        if patient is not None:
            from CranioNavLib.phantom.session import use_session

            use_session(patient)
            self.session.simulated_seed = state["simulated_seed"]
        if take is not None:
            take()
        self.session.restore_registration(state)
        planned = self.session.restore_plan(state)
        if not planned and state.get("planned") and bone is not None:
            ultrasound.planProtocol()
            planned = True
        if planned:
            ultrasound.goTo(int(state.get("asked_for", 0)))
        self._go_to(state["step"])
        return "the session goes on where it was; connect the devices again"

    # Report

    def writeReport(self) -> Task:
        """Register the saved case anew, in a process of its own, and write everything there is to take along."""
        self.session.save("report")
        wanted = self._logics["ModuleRegistration"].parameters().read()
        recording = Path(self._logics["ModuleUltrasound"].parameters().read().recording_path)
        folder, shown = self.session.folder, scene_data.get_transform("ReferenceToRas")
        if not recording.is_file():
            raise InputError("there is no recording of a palpation; the report is written of an ultrasound registration")

        says = {} if self.session.simulated_seed is None else {NOTE: f"{SIMULATED}, seed {self.session.simulated_seed}"}
        if recording.name != "palpation.igs.mha" or recording.parent != folder:
            says["palpation"] = str(recording)

        def write(progress: Progress) -> float:
            progress("registering the saved session and drawing the report", 0.0)
            note_in_case(folder, says)
            command = [sys.executable, "-m", "Workstation", "register", str(folder), "-o", str(folder), "--mode", "III"]
            command += ["--method", wanted.method, "--segmentation", wanted.segmentation]
            root = Path(__file__).resolve().parents[2]
            _run_until_cancelled(command, root, progress)
            record = json.loads((folder / "registration.json").read_text(encoding="utf-8"))
            corners = np.array([[0, 0, 0, 1], [80, 0, 0, 1], [0, 80, 0, 1], [0, 0, 80, 1]], dtype=float)
            return float(np.abs((np.array(record["reference_to_ras"]) - shown) @ corners.T).max())

        return Task("Write report and export", write, self._report_written)

    def writeReportBlocked(self) -> str:
        """Why there is nothing to report."""
        node = scene.find("ReferenceToRas")
        if node is None or not node.GetAttribute(scene.STATUS_ATTRIBUTE):
            return "register first (steps 5 and 6)"
        return "" if (self.session.folder / "ct.nrrd").is_file() else "the CT is still being saved"

    def _report_written(self, difference_mm: float) -> str | Reading:
        self.session.report_of = json.dumps(scene_data.get_transform("ReferenceToRas").tolist())
        if difference_mm > SAME_MM:
            said = (
                f"written; its registration lies up to {difference_mm:.2f} mm from the one on the screen: {self._why_different()}"
            )
            return Reading(said, Level.WARNING)
        return "written; the registration from the files is the one on the screen"

    def _why_different(self) -> str:
        """What the report was made of and the registration on the screen was not."""
        if scene.find_or_create("ReferenceToRas").GetAttribute(scene.STATUS_ATTRIBUTE) == "landmarks":
            return "that is by landmarks alone, the report's by the bone points; register the surface (step 6)"
        others = self._other_settings()
        if others:
            return f"the report uses the usual settings, here {', '.join(others)}"
        return "no setting explains it; register the surface again (step 6), then write the report again"

    def _other_settings(self) -> list[str]:
        """The settings of measuring and registering that are not the usual ones, which the report is made with."""
        registration, ultrasound = self._logics["ModuleRegistration"], self._logics["ModuleUltrasound"]
        wanted = registration.parameters().read()
        read = [(ultrasound.parameters().read(), set(EchoSettings.__dataclass_fields__))]
        for kind in ("registration", "segmentation"):
            name = wanted.method if kind == "registration" else wanted.segmentation
            settings = registration.pluginSettings(kind, name).read()
            read.append((settings, {info.name for info in settings.describe()}))
        return [
            f"{words_of(info.name).lower()} is {getattr(values, info.name)} {info.unit}".rstrip() + f" (usual {info.default})"
            for values, names in read
            for info in values.describe()
            if info.name in names and getattr(values, info.name) != info.default
        ]

    def reportFiles(self) -> Reading | None:
        """What there is to open."""
        names = self.offered()
        return Reading(", ".join(names), Level.GOOD) if names else None

    def offered(self) -> list[str]:
        """Files of the session that the page may open, once they are of this registration."""
        return [name for name in OFFERED if (self.session.folder / name).is_file()] if self.session.report_of else []

    def reportStatus(self) -> StepStatus:
        """Whether the report is of the registration in force."""
        blocked = self.writeReportBlocked()
        if blocked or not self.session.report_of:
            return StepStatus(StepState.TODO, blocked or "write the report")
        if self.session.report_of != json.dumps(scene_data.get_transform("ReferenceToRas").tolist()):
            return StepStatus(StepState.ATTENTION, "the registration has changed; write the report again")
        return StepStatus(StepState.DONE)


def _run_until_cancelled(command: list[str], folder: Path, progress: Progress) -> None:
    """Run a command of this program to its end; killed when the user cancels."""
    begun = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=folder) as process:
        try:
            while True:
                try:
                    _, said = process.communicate(timeout=0.3)
                    break
                except subprocess.TimeoutExpired:
                    share = 1.0 - 0.5 ** ((time.monotonic() - begun) / USUAL_REPORT_S)
                    progress("registering the saved session and drawing the report", share)
        finally:
            process.kill()
    if process.returncode != 0:
        raise InputError((said.strip().splitlines() or ["the report could not be written"])[-1])


def _simulated_session(seed: int) -> Any:
    from CranioNavLib.phantom.session import SimulatedSession

    from Workstation.web.simulated_hand import simulated_patient_of

    patient, _ = simulated_patient_of(seed, Progress())
    return SimulatedSession(patient, seed)
