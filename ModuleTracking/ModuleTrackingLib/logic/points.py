"""The points step: the resting tip of a tool becomes the next point of a list."""

from __future__ import annotations

from typing import Any, Optional

import numpy as np
from CranioNavLib import scene
from CranioNavLib.errors import InputError
from CranioNavLib.module_logic import done_or, todo
from CranioNavLib.panel import Level, Reading, StepStatus
from CranioNavLib.rigid import Array
from CranioNavLib.slicer_files import LabelledPoints, add_points

from ModuleTrackingLib.digitise import rest_of_tip
from ModuleTrackingLib.logic.calibrating import CalibrationStep
from ModuleTrackingLib.panel_description import PointList

APART_MM = 2.0  # a point so near to the one read before is the same one again
PLANNED = {PointList.LANDMARKS: "LandmarksCT", PointList.TARGETS: "TargetsCT"}  # where the names of the points come from
CHECKS = (PointList.TARGETS, PointList.PLAUSIBILITY)  # what a registration is verified with
LETTERS = {
    PointList.LANDMARKS: "L",
    PointList.BONE: "B",
    PointList.TARGETS: "T",
    PointList.PLAUSIBILITY: "P",
    PointList.CLAMP: "C",
}


class PointsStep(CalibrationStep):
    """Points touched on the patient."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self._checks: list[PointList] = []  # into which list each was read, in order

    def digitise(self) -> str:
        """Add the resting tip of the chosen tool to the chosen list. Returns a message."""
        return self._read(self.parameters().read().points)

    def _read(self, points: PointList) -> str:
        rest = rest_of_tip(self.restingTips(self.parameters().read().tool.value))
        label = next_label(points)
        node = scene.find_or_create(points.value)
        _refuse_twice(node, rest.position_mm, label)
        add_points(node, LabelledPoints((label,), rest.position_mm[None]))
        return f"{label}: {rest.samples} samples, spread {rest.spread_mm:.2f} mm (RMS)"

    def digitiseBlocked(self) -> str:
        """Why no point can be read now."""
        if _all_read(self.parameters().read().points):
            return "every planned point is read; undo the last to read it again"
        return self.notConnected() or self.calibrating()

    def undoPoint(self) -> str:
        """Remove the last point of the chosen list. Returns a message."""
        return _remove_last(self.parameters().read().points)

    def undoPointBlocked(self) -> str:
        """Why there is no point to remove."""
        return "" if _labels(self.parameters().read().points.value) else "the list has no points"

    # What a registration is verified with

    def readMarker(self) -> str:
        """Add the resting tip of the chosen tool to the measured targets. Returns a message."""
        said = self._read(PointList.TARGETS)
        self._checks.append(PointList.TARGETS)
        return said

    def readMarkerBlocked(self) -> str:
        """Why no marker can be read now."""
        if not _planned(PointList.TARGETS):
            return "the CT shows no targets: find its spheres, or load a case that has them"
        if _all_read(PointList.TARGETS):
            return "every marker is read; undo the last to read it again"
        return self.notConnected() or self.calibrating()

    def readPlausibility(self) -> str:
        """Add the resting tip of the chosen tool to the plausibility points. Returns a message."""
        said = self._read(PointList.PLAUSIBILITY)
        self._checks.append(PointList.PLAUSIBILITY)
        return said

    def readPlausibilityBlocked(self) -> str:
        """Why no place on the bone can be read now."""
        return self.notConnected() or self.calibrating()

    def undoCheck(self) -> str:
        """Remove the marker or plausibility point that was read last. Returns a message."""
        return _remove_last(self._last_check())

    def undoCheckBlocked(self) -> str:
        """Why there is nothing to remove."""
        return "" if any(_labels(points.value) for points in CHECKS) else "nothing has been read"

    def _last_check(self) -> PointList:
        """The list that was read into last, as far as it is known, else one that has points."""
        while self._checks:
            points = self._checks.pop()
            if _labels(points.value):
                return points
        return next(points for points in CHECKS if _labels(points.value))

    def nextMarker(self) -> Optional[Reading]:
        """The marker that is read next; None where the CT shows none."""
        if not _planned(PointList.TARGETS):
            return None
        return Reading("all are read", Level.GOOD) if _all_read(PointList.TARGETS) else Reading(next_label(PointList.TARGETS))

    def checksRead(self) -> Optional[Reading]:
        """How many have been read."""
        markers, touched = (len(_labels(points.value)) for points in CHECKS)
        planned = len(_planned(PointList.TARGETS))
        said = [f"{markers} of {planned} markers"] if markers else []
        said += [f"{touched} {'places' if touched > 1 else 'place'} on the bone"] if touched else []
        return Reading(", ".join(said)) if said else None

    def nextPoint(self) -> Reading:
        """The label that the next point gets."""
        points = self.parameters().read().points
        return Reading("all are read", Level.GOOD) if _all_read(points) else Reading(next_label(points))

    def pointsStatus(self) -> StepStatus:
        """Whether every planned landmark is digitised."""
        touched = _labels("LandmarksPatient")
        missing = [label for label in _labels("LandmarksCT") if label not in touched]
        left = f" ({len(missing) - 1} more to come)" if len(missing) > 1 else ""
        waiting = f"rest the tip on {missing[0]} and read the point{left}" if missing else ""
        return todo(waiting) if missing else done_or(bool(touched), "touch the landmarks")


def next_label(points: PointList) -> str:
    """The first planned label that is not taken yet; a number where nothing is planned."""
    taken = _labels(points.value)
    free = [label for label in _planned(points) if label not in taken]
    return free[0] if free else f"{LETTERS[points]}{len(taken) + 1}"


def _refuse_twice(node: Any, position: Array, label: str) -> None:
    """A key pressed twice must not make the next point of the place of the last."""
    last = node.GetNumberOfControlPoints() - 1
    if last >= 0 and np.linalg.norm(np.array(node.GetNthControlPointPosition(last)) - position) < APART_MM:
        raise InputError(f"the tip still rests on {node.GetNthControlPointLabel(last)}; move it to {label} and read the point")


def _remove_last(points: PointList) -> str:
    node = scene.find_or_create(points.value)
    last = node.GetNumberOfControlPoints() - 1
    label = node.GetNthControlPointLabel(last)
    node.RemoveNthControlPoint(last)
    return f"{label} removed"


def _planned(points: PointList) -> list[str]:
    return _labels(PLANNED[points]) if points in PLANNED else []


def _all_read(points: PointList) -> bool:
    return bool(_planned(points)) and set(_planned(points)) <= set(_labels(points.value))


def _labels(role: str) -> list[str]:
    node = scene.find(role)
    return [node.GetNthControlPointLabel(i) for i in range(node.GetNumberOfControlPoints())] if node is not None else []
