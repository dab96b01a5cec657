"""The step that plans landmarks: suggested on the skull, placed by clicks, moved, taken back."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib import scene, scene_data, slice_views
from CranioNavLib.errors import InputError
from CranioNavLib.panel import Entry, Level, Progress, Reading, StepState, StepStatus, Task
from CranioNavLib.point_editor import PointEditor
from CranioNavLib.rigid import Array, transform_points
from CranioNavLib.slicer_files import LabelledPoints
from CranioNavLib.volume import Volume

from ModuleRegistrationLib.anatomy.landmark_suggestions import LABELS
from ModuleRegistrationLib.logic.given import OFFSET_SD, POSITION_SD, THRESHOLD, RegistrationStep, lacking, lacking_ct, of_this_ct

if TYPE_CHECKING:
    from ModuleRegistrationLib.anatomy.landmark_suggestions import LandmarkSuggestions

LEAST_LANDMARKS = 3
FAR_FROM_TISSUE_MM, AIR_HU = 5.0, -400.0  # a landmark lies on the head, or in a cavity of it that is no wider than twice this
SAME_MM = 2.0  # a landmark so close to a target is that target: a titanium sphere, which stands off bone and skin


class PlanningStep(RegistrationStep):
    """LandmarksCT, by hand."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.planned = PointEditor("LandmarksCT", LABELS, off_the_head)
        self._off: dict[tuple[float, ...], float] = {}  # by place in the bone and CT in use: how far off both surfaces; 0: on one
        self._off_of: tuple[Any, ...] = ()  # which bone and CT that was

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
            return f"{', '.join(found.labels)}: suggested. {found.note}"

        return Task("Suggest landmarks", suggest, of_this_ct(take))

    def suggestLandmarksBlocked(self) -> str:
        """Why no landmarks can be suggested now."""
        return lacking("Bone", "OuterTable") and "find the bone first"

    def landmarks(self) -> tuple[Entry, ...]:
        """The landmarks to place, and those that are placed; those that can hardly be meant with how far off they are."""
        doubts = {name: f"{off:.0f} mm off skin and bone" for name, off in self._offSurface().items()}
        doubts.update(dict.fromkeys(self._onWrongSide(), "on the wrong side"))
        entries = self.planned.entries()
        return tuple(
            replace(one, note=one.note or doubts[one.name], doubtful=True) if one.name in doubts else one for one in entries
        )

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

    def moveToSurface(self) -> str:
        """Move the first landmark that lies on no surface to the nearest place on the bone's outside. Returns a message."""
        from ModuleRegistrationLib.anatomy.landmark_places import nearest_outside

        name, off_mm = next(iter(self._offSurface().items()))
        place = nearest_outside(scene_data.get_surface("Bone"), _ct(), _places()[name])
        if place is None:
            raise InputError(f"no outside of the bone is near {name}; place it by a click on the head")
        self.planned.put(name, place)
        _look_at(name)
        return f"{name} is moved by {off_mm:.0f} mm to the bone; check it in the views"

    def moveToSurfaceBlocked(self) -> str:
        """Why there is nothing to move."""
        return "" if self._offSurface() else "every landmark lies on a surface"

    def exchangeSides(self) -> str:
        """Give a landmark and its counterpart of the other side each other's place. Returns a message."""
        first, second = self._exchangeable()
        places = _places()
        places[first], places[second] = places[second], places[first]
        self.planned.remember()
        scene_data.set_points("LandmarksCT", LabelledPoints(tuple(places), np.array(list(places.values()))))
        return f"{first} and {second} are exchanged"

    def exchangeSidesBlocked(self) -> str:
        """Why there is nothing to exchange."""
        return "" if self._exchangeable() else "no left and right landmark are exchanged"

    def planStatus(self) -> StepStatus:
        """Whether there are enough landmarks to register by, and whether each lies where such a landmark can lie."""
        placed = sum(one.done for one in self.planned.entries())
        if placed < LEAST_LANDMARKS:
            missing = lacking_ct() or f"place {LEAST_LANDMARKS - placed} more landmarks"
            return StepStatus(StepState.TODO, missing, "" if placed else "suggestLandmarks")
        if self.planned.said and self.planned.active():
            return StepStatus(StepState.ATTENTION, self.planned.said)
        if self._exchangeable():
            first, second = self._exchangeable()
            said = f"{first} and {second} lie on each other's side: exchange them, or place them again"
            return StepStatus(StepState.ATTENTION, said, "exchangeSides")
        for name in self._onWrongSide():
            return StepStatus(StepState.ATTENTION, f"{name} lies on the other side of the head; choose it and place it again")
        for name, off_mm in self._offSurface().items():
            said = f"{name} lies {off_mm:.0f} mm from skin and bone, where it cannot be touched"
            return StepStatus(StepState.ATTENTION, f"{said}; move it to the bone, or place it again", "moveToSurface")
        return StepStatus(StepState.DONE)

    def _onWrongSide(self) -> tuple[str, ...]:
        from ModuleRegistrationLib.anatomy.landmark_places import on_wrong_side

        places = _places()
        if not places or lacking("Bone"):
            return ()
        return on_wrong_side(tuple(places), list(places.values()), float(scene_data.get_surface("Bone").center_mm[0]))

    def _exchangeable(self) -> tuple[str, ...]:
        """The first two landmarks that lie on each other's side; () if there are none."""
        from ModuleRegistrationLib.anatomy.landmark_places import counterpart

        wrong = self._onWrongSide()
        return next(((name, counterpart(name, wrong)) for name in wrong if counterpart(name, wrong)), ())

    def _offSurface(self) -> dict[str, float]:
        """Landmarks that lie neither on bone nor on skin, and how far off, mm. Markers that the CT shows are none of them."""
        from ModuleRegistrationLib.anatomy.landmark_places import landmark_places

        places, ct = _places(), scene.find("CT")
        if not places or lacking("Bone"):
            return {}
        bone, image = scene_data.get_surface("Bone"), ct.GetImageData() if ct is not None else None
        if self._off_of != (bone, image):
            self._off, self._off_of = {}, (bone, image)
        fresh = {tuple(place): place for place in places.values() if tuple(place) not in self._off}
        if fresh:
            found = landmark_places(bone, _ct(), list(fresh.values()))
            self._off = {**self._off, **dict(zip(fresh, np.where(found.doubtful, found.off_mm, 0.0).tolist()))}
        self._off = {place: self._off[place] for place in map(tuple, places.values())}
        markers = scene_data.get_points("TargetsCT").positions_mm if not lacking("TargetsCT") else np.empty((0, 3))
        return {
            name: self._off[tuple(place)]
            for name, place in places.items()
            if self._off[tuple(place)] and not (np.linalg.norm(markers - place, axis=1) < SAME_MM).any()
        }

    def _chosenLandmark(self) -> str:
        entries = self.landmarks()
        chosen = self.planned.active() or self.parameters().read().landmark
        return chosen if any(one.name == chosen for one in entries) else entries[0].name


def off_the_head(position_ras_mm: npt.ArrayLike) -> str:
    """Why a place (3,) is no place for a landmark; "" if it is one, or there is no CT to tell by."""
    volume = _ct()
    if volume is None:
        return ""
    place = np.asarray(position_ras_mm, dtype=float)
    middle = transform_points(np.linalg.inv(volume.ijk_to_ras), place[None])[0]
    reach = FAR_FROM_TISSUE_MM / np.linalg.norm(volume.ijk_to_ras[:3, :3], axis=0)  # voxels
    low, high = (np.maximum(edge, 0).astype(int) for edge in (np.ceil(middle - reach), np.floor(middle + reach) + 1))
    near = volume.hu[low[2] : high[2], low[1] : high[1], low[0] : high[0]]
    on_head = near.size > 0 and near.max() > AIR_HU
    return "" if on_head else "the click missed the head; click on the head or on a slice through it"


def _places() -> dict[str, Array]:
    """The planned landmarks by name, RAS."""
    if lacking("LandmarksCT"):
        return {}
    points = scene_data.get_points("LandmarksCT")
    return dict(zip(points.labels, points.positions_mm))


def _ct() -> Optional[Volume]:
    return scene_data.get_volume("CT") if scene.find("CT") is not None else None


def _look_at(name: str) -> None:
    node = scene.find("LandmarksCT")
    if node is None:
        return
    index = node.GetControlPointIndexByLabel(name)
    if index >= 0:
        slice_views.go_to(node.GetNthControlPointPositionWorld(index))
