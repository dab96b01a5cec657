"""The protocol step: which points are palpated, and which of them now."""

from __future__ import annotations

import logging
import time
from collections import deque
from dataclasses import dataclass
from typing import Any, Optional

import numpy as np
from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.module_logic import DeviceInScene, done_or
from CranioNavLib.panel import Level, Reading, StepStatus
from CranioNavLib.rigid import Array, transform_points
from CranioNavLib.slicer_files import LabelledPoints

from ModuleUltrasoundLib.devices.device import DeviceError
from ModuleUltrasoundLib.devices.line_stream import LineStream
from ModuleUltrasoundLib.panel_description import UltrasoundParameters

LOG = logging.getLogger(__name__)
CHANGES = 16  # of the point asked for that are remembered: no line waits for longer
MOST_NAMED = 3  # points in a line of the panel
CURRENT_POINT = "current"  # parameter of the Protocol node: index of the point to palpate now
NORMALS = ("Normal_R", "Normal_A", "Normal_S")  # measurements of ProtocolPoints: outward normals of the bone


class ProtocolStep(DeviceInScene[UltrasoundParameters, LineStream]):
    """ProtocolPoints and Protocol; what every other step stands on."""

    parameterClass = UltrasoundParameters
    sessionRole = "UltrasoundSession"
    refusals = (DeviceError,)
    deviceWord = "probe"

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self._changes: deque[tuple[float, int]] = deque(maxlen=CHANGES)  # when another point was asked for, and which was before
        self._around: Optional[_Around] = None  # what the plan was last held to
        self._plannedAnew = False  # by itself, because of it
        self._noFreePlace: tuple[str, ...] = ()  # labels of points that kept their place near clamp or base
        self._leftOut: tuple[str, ...] = ()  # labels of points that have none

    def planProtocol(self) -> str:
        """Place the palpation points on the outer table; writes ProtocolPoints and Protocol. Returns a message."""
        from ModuleUltrasoundLib.palpation.protocol import plan_protocol

        around = self._whatIsAround()
        landmarks = scene_data.get_points("LandmarksCT") if count_of("LandmarksCT") else None
        planned = plan_protocol(
            scene_data.get_surface("OuterTable"),
            landmarks.positions_mm if landmarks else None,
            landmarks.labels if landmarks else None,
            around.places_mm,
            around.clearance_mm,
        )
        node = scene_data.set_points("ProtocolPoints", LabelledPoints(planned.labels, planned.positions_ras_mm))
        for axis, name in enumerate(NORMALS):
            scene_data.add_measurement(node, name, planned.normals[:, axis])
        self.goTo(0)
        self._around, self._plannedAnew = around, False
        self._noFreePlace, self._leftOut = planned.too_near, planned.left_out
        said = [f"{len(planned.labels)} points", *self._lost()]
        if planned.too_near:
            said.append(
                f"no free place within reach of {', '.join(planned.too_near)}: nearer to clamp or base than "
                f"{around.clearance_mm:g} mm, asked for last"
            )
        return "; ".join(said)

    def keepClear(self) -> None:
        """Plan anew once a pin or the reference base is known to be in the way of a point, as long as none was palpated.

        Called again and again by the owner of the event loop. Points that were taken stay where they are; those that are out
        of reach are asked for last. Where another plan is refused, the one that there is stays.
        """
        if not count_of("ProtocolPoints") or self.recordsPoints():
            return
        before, now = self._around, self._whatIsAround()
        if now == before:
            return
        self._around = now
        other_distance = before is not None and before.clearance_mm != now.clearance_mm and now.places_mm is not None
        try:
            if (self._tooNear(now) or other_distance) and not count_of("SurfacePoints"):
                self.planProtocol()
                self._plannedAnew = True
        except InputError as error:
            LOG.warning("the points stay where they are: %s", error)

    def _lost(self) -> list[str]:
        """What is said of points that have no place at all."""
        if not (self._leftOut and count_of("ProtocolPoints")):
            return []
        return [f"no place to stand for {', '.join(self._leftOut)} (no even bone, or a pin in it)"]

    def recordsPoints(self) -> bool:
        """Whether points are being palpated: the plan must stay as it is."""
        return False

    def _whatIsAround(self) -> _Around:
        return _Around(in_the_way(), self.parameters().read().clamp_clearance_mm)

    def _tooNear(self, around: _Around) -> tuple[str, ...]:
        """Labels of the points of the plan that do not keep clear of it."""
        from ModuleUltrasoundLib.palpation.clamp import clear_of_clamp

        if not count_of("ProtocolPoints"):
            return ()
        positions, normals, labels = self.protocolPoints()
        clear = clear_of_clamp(positions, normals, around.places_mm, around.clearance_mm)
        return tuple(label for label, free in zip(labels, clear) if not free)

    def clampPins(self) -> Reading:
        """What is known of clamp and reference base, how far the points keep from them, which do not, and why."""
        count, around = count_of("ClampPins"), self._whatIsAround()
        pins = f"{count} pin{'s' if count > 1 else ''}"
        if around.places_mm is None:
            if not count:
                return Reading("no pins known; touch them with the stylus to keep away from them")
            return Reading(f"{pins}; where they are on the head is known once the landmarks are registered", Level.WARNING)
        keeps = f"the probe keeps {around.clearance_mm:g} mm away"
        said = f"no pins known: touch them with the stylus; {keeps} from the reference base"
        if count:
            said = f"{pins} and the reference base; {keeps}"
        said = "; ".join([said, *self._lost()])
        near = self._tooNear(around)
        if near:
            stands = "1 point stands" if len(near) == 1 else f"{len(near)} points stand"
            named = f" ({', '.join(near)})" if len(near) <= MOST_NAMED else ""
            why = ", as there is no free place within reach," if set(near) <= set(self._noFreePlace) else ""
            return Reading(f"{said}; {stands} nearer{named}{why} and will be asked for last", Level.WARNING)
        anew = "; the points were planned anew" if self._plannedAnew else ""
        return Reading(said + anew, Level.WARNING if self._lost() else Level.GOOD)

    def planProtocolBlocked(self) -> str:
        """Why no points can be placed now."""
        return "" if scene.find("OuterTable") is not None else "find the bone first"

    def protocolPoints(self) -> tuple[Array, Array, tuple[str, ...]]:
        """Positions (N, 3) in RAS, outward normals (N, 3) and labels of the planned points.

        Raises
        ------
        InputError
            Somebody added or removed points by hand, so that normals are lacking.
        """
        points = scene_data.get_points("ProtocolPoints")
        columns = scene_data.read_measurements(scene.find("ProtocolPoints"))
        if not all(name in columns and len(columns[name]) == len(points) for name in NORMALS):
            raise InputError("the palpation points were edited by hand and have no normals any more; plan them again")
        return points.positions_mm, np.stack([columns[name] for name in NORMALS], axis=1), points.labels

    def nextPoint(self) -> None:
        """Go on to the next point of the protocol; the present one may be taken later."""
        self.goTo(min(self.currentIndex() + 1, count_of("ProtocolPoints") - 1))

    def nextPointBlocked(self) -> str:
        """Why there is no next point."""
        return "" if count_of("ProtocolPoints") else "plan the points first"

    def previousPoint(self) -> None:
        """Go back to the point before."""
        self.goTo(max(self.currentIndex() - 1, 0))

    def previousPointBlocked(self) -> str:
        """Why there is no point before."""
        return self.nextPointBlocked()

    def currentIndex(self) -> int:
        """Index of the point to palpate now; -1 without a protocol."""
        node = scene.find("Protocol")
        text = node.GetParameter(CURRENT_POINT) if node is not None else ""
        return int(text) if text and count_of("ProtocolPoints") else -1

    def indexAt(self, host_time_s: float) -> int:
        """Index of the point that was asked for at a moment of the clock of lines; -1 without a protocol."""
        index = self.currentIndex()
        for changed_s, before in reversed(self._changes):
            if host_time_s >= changed_s:
                break
            index = before
        return index

    def goTo(self, index: int) -> None:
        """Ask for a point, from now on: lines on their way still belong to the one before."""
        self._changes.append((time.monotonic(), self.currentIndex()))
        scene.find_or_create("Protocol").SetParameter(CURRENT_POINT, str(index))

    def currentPoint(self) -> Optional[Reading]:
        """The point to palpate now."""
        index, node = self.currentIndex(), scene.find("ProtocolPoints")
        return Reading(f"{index + 1}. {node.GetNthControlPointLabel(index)}") if index >= 0 and node is not None else None

    def protocolStatus(self) -> StepStatus:
        """Whether the points are planned."""
        return done_or(count_of("ProtocolPoints") > 0, self.planProtocolBlocked() or "plan the points")


def count_of(role: str) -> int:
    """How many points a role has."""
    node = scene.find(role)
    return int(node.GetNumberOfControlPoints()) if node is not None else 0


def registered() -> bool:
    """Whether ReferenceToRas is a registration."""
    node = scene.find("ReferenceToRas")
    return node is not None and bool(node.GetAttribute(scene.STATUS_ATTRIBUTE))


@dataclass(frozen=True, eq=False)
class _Around:
    """What a plan has to keep clear of."""

    places_mm: Optional[Array]  # (K, 3) RAS: the pins that are known, and the reference base; None before the registration
    clearance_mm: float

    def __eq__(self, other: object) -> bool:
        """The same places to the digit, and the same distance."""
        if not isinstance(other, _Around) or self.clearance_mm != other.clearance_mm:
            return False
        one, another = self.places_mm, other.places_mm
        return one is another or (one is not None and another is not None and np.array_equal(one, another))


def in_the_way() -> Optional[Array]:
    """(K, 3) RAS: the pins of the head clamp that are known, and the reference base; None while no registration places them."""
    if not registered():
        return None
    base, pins = scene_data.get_transform("ReferenceToRas")[:3, 3][None], clamp_pins()
    return base if pins is None else np.concatenate([pins, base])


def clamp_pins() -> Optional[Array]:
    """(K, 3) the pins of the head clamp in RAS; None where none is known, or no registration says where it is."""
    if not registered() or not count_of("ClampPins"):
        return None
    return transform_points(scene_data.get_transform("ReferenceToRas"), scene_data.get_points("ClampPins").positions_mm)
