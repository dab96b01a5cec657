"""The step that plans landmarks: suggested on the skull, placed by clicks, moved, taken back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib import scene, scene_data, slice_views
from CranioNavLib.errors import InputError
from CranioNavLib.module_logic import done_or
from CranioNavLib.panel import Entry, Level, Progress, Reading, StepStatus, Task
from CranioNavLib.point_editor import PointEditor
from CranioNavLib.rigid import transform_points
from CranioNavLib.slicer_files import LabelledPoints

from ModuleRegistrationLib.anatomy.landmark_suggestions import LABELS
from ModuleRegistrationLib.logic.given import OFFSET_SD, POSITION_SD, THRESHOLD, RegistrationStep, lacking, lacking_ct

if TYPE_CHECKING:
    from ModuleRegistrationLib.anatomy.landmark_suggestions import LandmarkSuggestions

LEAST_LANDMARKS = 3
FAR_FROM_TISSUE_MM, AIR_HU = 5.0, -400.0  # a landmark lies on the head, or in a cavity of it that is no wider than twice this


class PlanningStep(RegistrationStep):
    """LandmarksCT, by hand."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.planned = PointEditor("LandmarksCT", LABELS, off_the_head)

    def suggestLandmarks(self) -> Task:
        """Propose the anatomical landmarks on the skull found; they become LandmarksCT, for the user to check and move."""
        from ModuleRegistrationLib.anatomy.landmark_suggestions import suggest_landmarks
        from ModuleRegistrationLib.anatomy.segmentation import BoneSurfaces

        table = scene.find_or_create("OuterTable")
        known = [float(table.GetAttribute(name) or "nan") for name in (THRESHOLD, POSITION_SD, OFFSET_SD)]
        bone = BoneSurfaces(scene_data.get_surface("Bone"), scene_data.get_surface("OuterTable"), *known)

        def suggest(progress: Progress) -> LandmarkSuggestions:
            progress("looking for landmarks", 0.1)
            return suggest_landmarks(bone)

        def take(found: LandmarkSuggestions) -> str:
            self.planned.remember()
            scene_data.set_points("LandmarksCT", LabelledPoints(tuple(found.labels), found.positions_ras_mm))
            return f"{', '.join(found.labels)}: suggested; check each in the views and move it where needed. {found.note}"

        return Task("Suggest landmarks", suggest, take)

    def suggestLandmarksBlocked(self) -> str:
        """Why no landmarks can be suggested now."""
        return lacking("Bone", "OuterTable") and "find the bone first"

    def landmarks(self) -> tuple[Entry, ...]:
        """The landmarks to place, and those that are placed."""
        return self.planned.entries()

    def landmarkChosen(self) -> str:
        """The user chose a landmark: the slices go to it, and the next click places it. Returns a message."""
        name = self.parameters().read().landmark
        reason = lacking_ct()
        if reason:
            raise InputError(f"{name} cannot be placed: {reason}")
        _look_at(name)
        self.planned.place(name)
        return f"{name}: click on it in any view"

    def placing(self) -> Optional[Reading]:
        """Which landmark the next click places."""
        if self.planned.said:
            return Reading(self.planned.said, Level.BAD)
        name = self.planned.active()
        return Reading(f"{name}, in any view", Level.WARNING) if name else None

    def placeHere(self) -> str:
        """Place the chosen landmark where the slices cross. Returns a message."""
        name, place = self._chosenLandmark(), slice_views.crossing()
        if place is None:
            raise InputError("there are no slices that cross; show axial, sagittal and coronal slices")
        self.planned.put(name, place)
        following = self.planned.following(name)
        if following:
            self.parameters().change(landmark=following)
        return f"{name} is placed"

    def placeHereBlocked(self) -> str:
        """Why nothing can be placed now."""
        return lacking_ct()

    def undoLandmark(self) -> None:
        """Take back the last change of the landmarks."""
        self.planned.undo()

    def undoLandmarkBlocked(self) -> str:
        """Why there is nothing to take back."""
        return "" if self.planned.can_undo() else "no landmark has been changed"

    def removeLandmark(self) -> str:
        """Take the chosen landmark out. Returns a message."""
        name = self._chosenLandmark()
        self.planned.remove(name)
        return f"{name} is taken out"

    def removeLandmarkBlocked(self) -> str:
        """Why nothing can be taken out."""
        return lacking("LandmarksCT") and "no landmark is placed"

    def addLandmark(self) -> str:
        """One more landmark, which the next click places. Returns a message."""
        self.parameters().change(landmark=self.planned.add())
        return self.landmarkChosen()

    def addLandmarkBlocked(self) -> str:
        """Why no landmark can be placed now."""
        return lacking_ct()

    def stopPlacing(self) -> None:
        """Clicks place nothing any more."""
        self.planned.stop()

    def stopPlacingBlocked(self) -> str:
        """Why there is nothing to stop."""
        return "" if self.planned.active() else "no landmark is being placed"

    def planStatus(self) -> StepStatus:
        """Whether there are enough landmarks to register by."""
        placed = sum(one.done for one in self.landmarks())
        return done_or(placed >= LEAST_LANDMARKS, lacking_ct() or f"place {LEAST_LANDMARKS - placed} more landmarks")

    def _chosenLandmark(self) -> str:
        entries = self.landmarks()
        chosen = self.planned.active() or self.parameters().read().landmark
        return chosen if any(one.name == chosen for one in entries) else entries[0].name


def off_the_head(position_ras_mm: npt.ArrayLike) -> str:
    """Why a place (3,) is no place for a landmark; "" if it is one."""
    volume = scene_data.get_volume("CT")
    place = np.asarray(position_ras_mm, dtype=float)
    middle = transform_points(np.linalg.inv(volume.ijk_to_ras), place[None])[0]
    reach = FAR_FROM_TISSUE_MM / np.linalg.norm(volume.ijk_to_ras[:3, :3], axis=0)  # voxels
    low, high = (np.maximum(edge, 0).astype(int) for edge in (np.ceil(middle - reach), np.floor(middle + reach) + 1))
    near = volume.hu[low[2] : high[2], low[1] : high[1], low[0] : high[0]]
    on_head = near.size > 0 and near.max() > AIR_HU
    return "" if on_head else "the click missed the head; click on the head or on a slice through it"


def _look_at(name: str) -> None:
    node = scene.find("LandmarksCT")
    if node is None:
        return
    index = node.GetControlPointIndexByLabel(name)
    if index >= 0:
        slice_views.go_to(node.GetNthControlPointPositionWorld(index))
