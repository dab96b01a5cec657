"""What guidance rests on gets better as points arrive: refined in the background, beside the result, which stays the user's.

`registerSurface` makes the registration that is accepted, verified and saved. What is made here by the same method, of the same
nodes, only leads the hand to the next point (scene_guidance.py); no status, table or transform knows of it.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Optional

from CranioNavLib import scene, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.scene_guidance import forget_refinement, get_guidance, registered_points, set_refinement, set_remark

from ModuleRegistrationLib.logic import results
from ModuleRegistrationLib.logic.given import lacking
from ModuleRegistrationLib.logic.registering import RegisteringSteps

if TYPE_CHECKING:
    from ModuleRegistrationLib.registration.problem import RegistrationResult
    from ModuleRegistrationLib.registration.verdict import Verdict

    Refined = tuple[RegistrationResult, Verdict]

LOG = logging.getLogger(__name__)
POLL_MS = 200
LOOK_EVERY_S = 0.5  # for points that have come; it takes a fraction of a millisecond
SHARE_OF_TIME = 0.5  # of one core that refining may take: of a gliding probe points come all the time
NEEDED = ("OuterTable", "LandmarksCT", "LandmarksPatient", "SurfacePoints")


@dataclass(frozen=True)
class _Given:
    """What a refinement is made of, by what tells one state of it from another."""

    basis: tuple[Any, ...]  # the registration in force, the bone, the landmarks
    points: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class _Underway:
    """A refinement that is being computed."""

    given: _Given
    labels: tuple[str, ...]
    begun_s: float
    outcome: Future[Refined]


class RefiningStep(RegisteringSteps):
    """The refinement for guidance, begun by itself."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self._worker: Optional[ThreadPoolExecutor] = None
        self._underway: Optional[_Underway] = None
        self._given: Optional[_Given] = None  # at the last look
        self._lookAt_s = 0.0

    def poll(self) -> None:
        """Take over a refinement that is ready, and begin the next where points have come. Main thread only; returns at once."""
        now_s, run = time.monotonic(), self._underway
        if run is not None and run.outcome.done():
            self._underway = None
            self._lookAt_s = now_s + max(LOOK_EVERY_S, (now_s - run.begun_s) * (1 / SHARE_OF_TIME - 1))
            self._takeRefined(run)
        elif run is None and now_s >= self._lookAt_s:
            self._lookAt_s = now_s + LOOK_EVERY_S
            self._look()

    def _look(self) -> None:
        """Begin a refinement if what it is made of has changed; the one before is forgotten if more than its points have."""
        before, now = self._given, self._whatIsGiven()
        if now == before:
            return
        self._given = now
        if now is None or (before is not None and before.basis != now.basis):
            forget_refinement()
        if now is not None:
            self._begin(now)

    def _whatIsGiven(self) -> Optional[_Given]:
        """None while nobody is guided, or while there is nothing to refine the registration with."""
        from ModuleRegistrationLib.registration.closest_fit import LEAST_POINTS

        tracked = math.isfinite(scene_data.get_pose("ProbeToReference").host_time_s)
        if not tracked or not results.status() or lacking(*NEEDED) or self._isOfOthers():
            return None
        points, table = (scene.find_or_create(role) for role in ("SurfacePoints", "OuterTable"))
        count = points.GetNumberOfControlPoints()
        if count < LEAST_POINTS or self._labels() <= set(registered_points()):
            return None
        landmarks = [scene_data.get_points(role) for role in ("LandmarksCT", "LandmarksPatient")]
        basis = (
            scene_data.get_transform("ReferenceToRas").tobytes(),
            (table.GetID(), table.GetPolyData().GetMTime()),
            *((lists.labels, lists.positions_mm.tobytes()) for lists in landmarks),
        )
        last = tuple(points.GetNthControlPointPosition(count - 1))
        return _Given(basis, (points.GetID(), points.GetMTime(), count, last))

    def _labels(self) -> set[str]:
        """Of the bone points there are now."""
        node = scene.find("SurfacePoints")
        return {node.GetNthControlPointLabel(k) for k in range(node.GetNumberOfControlPoints())} if node is not None else set()

    def _begin(self, given: _Given) -> None:
        try:
            _, problem, find_places = self._problem()
            method = self.createPlugin("registration", self.parameters().read().method)
        except InputError as error:
            self._keepFormer(len(self._labels()), str(error))
            return

        def refine() -> Refined:
            from ModuleRegistrationLib.registration.verdict import FOR_GUIDANCE, judge

            result = method.register(problem)
            return result, judge(problem, result, find_places(), FOR_GUIDANCE)

        if self._worker is None:
            self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="cranionav-refine")
        self._underway = _Underway(given, problem.points.labels, time.monotonic(), self._worker.submit(refine))

    def _takeRefined(self, run: _Underway) -> None:
        """Into the scene, unless landmarks have changed or a point was taken back meanwhile: then the next look begins anew."""
        now = self._whatIsGiven()
        if now is None or now.basis != run.given.basis or not self._labels().issuperset(run.labels):
            return
        result, why = _outcome(run.outcome.result)
        if result is None or result.covariance is None or why:
            self._keepFormer(len(run.labels), why)
            return
        set_refinement(result.reference_to_ras, result.covariance, result.pivot_ras_mm, result.degrees_of_freedom, run.labels)

    def _keepFormer(self, count: int, why: str) -> None:
        """The refinement before stays, unless a point that it was made of has been taken back; what is said tells why."""
        former = get_guidance()
        if former is not None and former.refined and not self._labels().issuperset(former.points):
            forget_refinement()
        set_remark(f"not refined with {count} points: {why}")


def _outcome(result: Callable[[], Refined]) -> tuple[Optional[RegistrationResult], str]:
    """What a worker brought back, or why it is of no use to guidance."""
    from ModuleRegistrationLib.registration.verdict import ACCEPTED

    try:
        found, verdict = result()
    except InputError as error:
        return None, str(error)
    except Exception as error:  # guidance goes on with what it has
        LOG.exception("guidance could not be refined")
        return None, f"{type(error).__name__}: {error}; this is a defect, please report it"
    return found, "" if verdict.status == ACCEPTED else "; ".join(verdict.messages)
