"""The session on disk: a case folder kept up to date, from which a killed session goes on."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from CranioNavLib import host, scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.files import output_folder, set_aside, write_text
from CranioNavLib.sequence_metafile import put_aside
from CranioNavLib.slicer_files import LabelledPoints, read_points, write_points

STATE_FILE = "session.json"
RECORDING = "palpation.igs.mha"
LISTS = {
    "LandmarksCT": "landmarks-ct.mrk.json",
    "LandmarksPatient": "landmarks-patient.mrk.json",
    "TargetsCT": "targets-ct.mrk.json",
    "TargetsPatient": "targets-patient.mrk.json",
    "PlausibilityPoints": "plausibility.mrk.json",
    "ClampPins": "clamp-pins.mrk.json",
}
PATHS = ("_path", "_folder")  # how parameters that name files end
TABLES = ("Residuals", "TargetErrors")
REGISTRATION_ATTRIBUTES = (scene.STATUS_ATTRIBUTE, scene_data.MOTION_ERROR)


def default_parent() -> Path:
    """Where sessions lie unless a folder is named."""
    return Path.home() / "CranioNav"


def new_folder() -> Path:
    """A folder for a session that begins now; made when something is written."""
    return default_parent() / time.strftime("%Y-%m-%d %H-%M-%S")


def last_session(besides: Path) -> Path | None:
    """The newest session that can go on: in the folder itself, else the newest under the same parent."""
    if (besides / STATE_FILE).is_file():
        return besides
    if besides.parent != default_parent() or not besides.parent.is_dir():
        return None
    folders = sorted(path.parent for path in besides.parent.glob(f"*/{STATE_FILE}"))
    return folders[-1] if folders else None


class SessionFolder:
    """Writes what changed; everything that it writes is whole at any moment."""

    def __init__(self, folder: Path, parameter_nodes: Callable[[], Iterable[Any]]) -> None:
        self.folder, self._parameter_nodes = Path(folder), parameter_nodes
        self.simulated_seed: int | None = None
        self.goes_on = False  # whether what the folder holds is this session's own
        self.report_of = ""  # the registration that the report in the folder is of
        self._written: dict[str, str] = {}
        self._ct_image: Any = None  # of the CT that is, or is being, written
        self._ct_pending: Any = None  # the CT (Volume) that is not in the folder yet: nothing to go on from
        self._ct_lock = threading.Lock()  # one is written at a time
        self._state = ""

    @property
    def is_saved(self) -> bool:
        """Whether what was there at the last `save` is in the folder; a CT that cannot be written leaves it behind."""
        return self._ct_pending is None

    @property
    def recording_path(self) -> str:
        """Where palpation is recorded, and where `cranionav register` reads it: always the latest; earlier ones are set aside."""
        return str(self.folder / RECORDING)

    def ct_to_write(self) -> Any | None:
        """The scene's CT (Volume), if the folder does not have it yet; write it with `write_ct`, in any thread."""
        node = scene.find("CT")
        if node is None or node.GetImageData() is None or node.GetImageData() is self._ct_image:
            return None
        if self._ct_image is None and not self.goes_on:
            self._put_earlier_aside()
        self._ct_image, self._ct_pending, self._state = node.GetImageData(), scene_data.get_volume("CT"), ""
        return self._ct_pending

    def go_on(self, folder: Path) -> None:
        """The scene's CT was read from this folder: it is not written again, which would take the state away meanwhile."""
        self.folder, self.goes_on, self._ct_image = folder, True, scene.find("CT").GetImageData()

    def _put_earlier_aside(self) -> None:
        """What an earlier session left in the folder, where another one is begun there: it is of another patient."""
        if not (self.folder / STATE_FILE).is_file():
            return
        put_aside(self.folder / RECORDING)
        for name in (*LISTS.values(), "case.json", STATE_FILE):
            set_aside(self.folder / name)

    def write_ct(self, volume: Any) -> None:
        """Put the CT into the folder, unless another one has come since. The state of the one before goes first.

        Raises
        ------
        InputError
            The folder cannot be written to; `ct_to_write` offers the CT again.
        """
        from CranioNavLib.phantom.case_writer import write_volume

        with self._ct_lock:
            if volume is not self._ct_pending:
                return
            try:
                folder = output_folder(self.folder)
                (folder / STATE_FILE).unlink(missing_ok=True)
                write_volume(folder / "ct.nrrd", volume)
            except BaseException:
                self._ct_image = None  # to be tried again
                raise
            if volume is self._ct_pending:
                self._ct_pending = None

    def save(self, step: str) -> None:
        """Write the lists and the state, where they changed, once the CT that they are of is written. Main thread only."""
        if scene.find("CT") is None or self._ct_pending is not None:
            return
        for role, name in LISTS.items():
            self._save_list(role, output_folder(self.folder) / name)
        state = json.dumps(self._collect(step), indent=1)
        if state != self._state:
            write_text(self.folder / STATE_FILE, state + "\n")
            self._state = state

    def _save_list(self, role: str, path: Path) -> None:
        node = scene.find(role)
        empty = node is None or not node.GetNumberOfControlPoints()
        points = None if empty else scene_data.get_points(role)
        content = (
            "" if points is None else f"{points.labels}{points.positions_mm.tobytes().hex()}"
        )  # a new point leaves MTime alone
        if self._written.get(role, "") == content:
            return
        self._written[role] = content
        if points is None:
            path.unlink(missing_ok=True)
        else:
            write_points(path, points, role)

    def _collect(self, step: str) -> dict[str, Any]:
        registration = scene.find("ReferenceToRas")
        registered = registration is not None and registration.GetAttribute(scene.STATUS_ATTRIBUTE)
        return {
            "step": step,
            "simulated_seed": self.simulated_seed,
            "bone": scene.find("OuterTable") is not None,
            "plan": self._plan(),
            "points": scene.find("SurfacePoints") is not None,
            "asked_for": self._asked_for(),
            "tables": {role: scene_data.get_table(role) for role in TABLES if scene.find(role) is not None},
            "registered_points": self._registered_points(),
            "report_of": self.report_of,
            "parameters": {
                node.GetName(): {name: node.GetParameter(name) for name in node.GetParameterNames()}
                for node in self._parameter_nodes()
            },
            "registration": None
            if not registered
            else {
                "matrix": scene_data.get_transform("ReferenceToRas").tolist(),
                "attributes": {name: registration.GetAttribute(name) for name in REGISTRATION_ATTRIBUTES},
                "results": scene_data.get_table("Results") if scene.find("Results") is not None else None,
            },
        }

    def _asked_for(self) -> int:
        node = scene.find("Protocol")
        return int(node.GetParameter("current") or 0) if node is not None else 0

    def _plan(self) -> dict[str, Any] | None:
        node = scene.find("ProtocolPoints")
        if node is None or not node.GetNumberOfControlPoints():
            return None
        points, columns = scene_data.get_points("ProtocolPoints"), scene_data.read_measurements(node)
        return {
            "labels": list(points.labels),
            "positions_mm": points.positions_mm.tolist(),
            "measurements": {name: np.asarray(values).tolist() for name, values in columns.items()},
        }

    def _registered_points(self) -> dict[str, Any] | None:
        node = scene.find("RegisteredPoints")
        if node is None or not node.GetNumberOfControlPoints():
            return None
        points = scene_data.get_points("RegisteredPoints")
        return {"labels": list(points.labels), "positions_mm": points.positions_mm.tolist()}

    def read_state(self, folder: Path) -> dict[str, Any]:
        """What `save` wrote into a folder.

        Raises
        ------
        InputError
            There is no such file, or it cannot be read.
        """
        try:
            state: dict[str, Any] = json.loads((folder / STATE_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"the session cannot be read: {error}; begin a new one") from None
        return state

    def read_lists(self, folder: Path) -> dict[str, LabelledPoints]:
        """The point lists in a folder, by role."""
        return {role: read_points(folder / name) for role, name in LISTS.items() if (folder / name).is_file()}

    def restore_parameters(self, state: dict[str, Any]) -> None:
        """Give the modules' parameter nodes what they held. Main thread only."""
        for node in self._parameter_nodes():
            with host.slicer_package().util.NodeModify(node):
                for name, value in state["parameters"].get(node.GetName(), {}).items():
                    node.SetParameter(name, value)

    def correct_paths(self, folder: Path) -> None:
        """Paths into the session's folder hold after it was moved to another place, too."""
        for node in self._parameter_nodes():
            for name in node.GetParameterNames():
                value = node.GetParameter(name)
                if name.endswith(PATHS) and value and not Path(value).exists() and (folder / Path(value).name).exists():
                    node.SetParameter(name, str(folder / Path(value).name))

    def restore_plan(self, state: dict[str, Any]) -> bool:
        """Set the points of the protocol as they were: planned anew under another registration they would lie elsewhere.

        Returns whether there are any; sessions that were saved before the plan was have none. Main thread only.
        """
        kept = state.get("plan")
        if not kept:
            return False
        points = LabelledPoints(tuple(kept["labels"]), np.array(kept["positions_mm"], dtype=float))
        node = scene_data.set_points("ProtocolPoints", points)
        for name, values in kept["measurements"].items():
            scene_data.add_measurement(node, name, np.array(values, dtype=float))
        return True

    def restore_registration(self, state: dict[str, Any]) -> None:
        """Set ReferenceToRas with its status, and the results. Main thread only."""
        kept = state["registration"]
        if kept is None:
            return
        scene_data.set_transform("ReferenceToRas", kept["matrix"])
        node = scene.find_or_create("ReferenceToRas")
        for name, value in kept["attributes"].items():
            if value:
                node.SetAttribute(name, value)
        if kept["results"]:
            scene_data.set_table("Results", kept["results"])
        for role, columns in state.get("tables", {}).items():
            scene_data.set_table(role, columns)
        points = state.get("registered_points")
        if points:
            scene_data.set_points("RegisteredPoints", LabelledPoints(tuple(points["labels"]), np.array(points["positions_mm"])))
        self.report_of = str(state.get("report_of") or "")
