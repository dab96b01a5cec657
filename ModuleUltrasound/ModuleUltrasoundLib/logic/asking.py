"""Which point is asked for next: the one that shrinks the predicted TRE most, those out of reach last."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib import scene_data
from CranioNavLib.panel import Level, Reading
from CranioNavLib.rigid import Array
from CranioNavLib.scene_guidance import GuidanceRegistration, get_guidance

from ModuleUltrasoundLib.live_drawings import PointState, draw_points
from ModuleUltrasoundLib.logic.planning import count_of, in_the_way
from ModuleUltrasoundLib.logic.probing import ProbeStep
from ModuleUltrasoundLib.panel_description import TOWARDS_TABLE

if TYPE_CHECKING:
    from ModuleUltrasoundLib.palpation.next_point import NextTarget
    from ModuleUltrasoundLib.palpation.palpation import Palpation
    from ModuleUltrasoundLib.palpation.protocol import ProtocolPoints


class AskStep(ProbeStep):
    """The order of the points while they are palpated."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.palpation: Optional[Palpation] = None  # which points have been taken, while recording
        self._passed: set[int] = set()  # left out for now: they come again after the others
        self._brings: Optional[NextTarget] = None  # what the point asked for is expected to bring

    def recordsPoints(self) -> bool:
        """Whether points are being palpated: the plan must stay as it is."""
        return self.palpation is not None

    def planProtocolBlocked(self) -> str:
        """Why no points can be placed now."""
        return "stop the recording first" if self.recordsPoints() else super().planProtocolBlocked()

    def beginAsking(self) -> None:
        """Every point is open again."""
        self._passed.clear()
        self.askNext()

    def askNext(self) -> None:
        """Go to the point that brings most; in the protocol's order while no registration tells which that is."""
        palpation, plan = self.palpation, self._plan()
        if palpation is None:
            return
        is_open = np.array(palpation.open_points)
        if not (is_open & ~self._left_out(len(plan))).any():
            self._passed.clear()
        candidates = is_open & ~self._left_out(len(plan))
        within = candidates & self._within_reach(plan)
        candidates = within if within.any() else candidates
        if not candidates.any():
            return
        self._brings = self._best(plan, candidates)
        if self._brings is not None:
            self.goTo(self._brings.index)
            return
        order = (max(self.currentIndex(), 0) + np.arange(len(plan))) % len(plan)
        self.goTo(int(order[candidates[order]][0]))

    def nextPoint(self) -> None:
        """Leave the present point out for now; while recording it is asked for again after the others."""
        if self.palpation is None:
            super().nextPoint()
            return
        self._passed.add(self.currentIndex())
        self.askNext()

    def brings(self) -> Optional[Reading]:
        """What the point asked for is expected to do to the error at the targets."""
        best, palpation = self._brings, self.palpation
        if best is None or palpation is None or best.index != self.currentIndex() or not any(palpation.open_points):
            return None
        return Reading(f"{best.tre_now_mm:.1f} → {best.tre_then_mm:.1f}")

    def weighAnew(self) -> None:
        """Guidance rests on something else now: the point asked for stays, what it is expected to bring is told anew."""
        index = self.currentIndex()
        if self.palpation is not None and index >= 0 and self.palpation.open_points[index]:
            plan = self._plan()
            self._brings = self._best(plan, np.arange(len(plan)) == index)

    def restsOn(self) -> Optional[Reading]:
        """What guidance rests on, its error at the targets, and why the points taken last have not made it better."""
        from ModuleUltrasoundLib.palpation.next_point import rms_tre_mm

        rests = get_guidance()
        if rests is None:
            return None
        count = len(rests.points)
        said = f"landmarks and {count} points" if count else "landmarks"
        if rests.error is not None and (count_of("TargetsCT") or count_of("ProtocolPoints")):
            said += f"; error to expect {float(rms_tre_mm(*rests.error[:2], _targets())):.1f} mm (RMS at the targets)"
        return Reading("; ".join(filter(None, [said, rests.remark])), Level.WARNING if rests.remark else Level.PLAIN)

    def pointStates(self) -> list[PointState]:
        """How far each planned point is; none once they are palpated and measured."""
        count, palpation = count_of("ProtocolPoints"), self.palpation
        if palpation is None and count_of("SurfacePoints"):
            return []
        is_open = palpation.open_points if palpation is not None else [True] * count
        now = self.currentIndex()
        return [
            PointState.TAKEN if not is_open[index] else PointState.NOW if index == now else PointState.OPEN
            for index in range(min(count, len(is_open)))
        ]

    def pointsDrawn(self) -> Optional[str]:
        """A drawing of how far each point is; None where none is asked for."""
        return draw_points(self.pointStates())

    def _left_out(self, count: int) -> npt.NDArray[np.bool_]:
        return np.isin(np.arange(count), list(self._passed))

    def _plan(self) -> ProtocolPoints:
        from ModuleUltrasoundLib.palpation.protocol import ProtocolPoints

        positions, normals, labels = self.protocolPoints()
        return ProtocolPoints(labels, positions, normals, labels)

    def _within_reach(self, plan: ProtocolPoints) -> npt.NDArray[np.bool_]:
        """A probe that would run into a pin of the head clamp, or into the reference base on it, cannot be held there."""
        from ModuleUltrasoundLib.palpation.next_point import ReachSettings, reachable

        wanted = self.parameters().read()
        distance = ReachSettings(clamp_clearance_mm=wanted.clamp_clearance_mm)
        return reachable(plan, in_the_way(), TOWARDS_TABLE[wanted.patient_lies], distance)

    def _best(self, plan: ProtocolPoints, candidates: npt.NDArray[np.bool_]) -> Optional[NextTarget]:
        """By the error of what guidance rests on, with the points taken since counted in; None where it is not known."""
        from ModuleUltrasoundLib.palpation.next_point import DEFAULTS, choose_next, covariance_with

        rests = get_guidance()
        if rests is None or rests.error is None:
            return None
        covariance, pivot, _ = rests.error
        for index in self._takenSince(rests):
            covariance = covariance_with(
                covariance, plan.positions_ras_mm[index], plan.normals[index], pivot, DEFAULTS.point_sd_mm
            )
        return choose_next(plan, candidates, covariance, pivot, _targets())

    def _takenSince(self, rests: GuidanceRegistration) -> list[int]:
        """Points that are taken and that guidance does not rest on yet."""
        taken = self.palpation.taken if self.palpation is not None else ()
        return [point.target for point in taken if point.label not in rests.points]


def _targets() -> Array:
    """(T, 3) RAS: where the error matters, as far as it is told while points are palpated."""
    return scene_data.get_points("TargetsCT" if count_of("TargetsCT") else "ProtocolPoints").positions_mm
