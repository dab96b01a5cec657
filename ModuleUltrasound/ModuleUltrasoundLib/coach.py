"""One palpation from first to last point: which is next, where the probe stands to it, which lines become points.

Joins protocol, guidance and palpation for a panel. Without a registration the points come in the protocol's order
and nothing is said of tilt; with one, each next point is the one that shrinks the predicted TRE most.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import Array, check_points, check_rigid, invert_rigid, transform_points
from CranioNavLib.surface import Surface

from ModuleUltrasoundLib.guidance import (
    DEFAULTS,
    GuidanceSettings,
    Guide,
    NextTarget,
    choose_next,
    covariance_with,
    guide,
    reachable,
)
from ModuleUltrasoundLib.palpation import Palpation, PalpationLine, PalpationSettings, PalpationStatus
from ModuleUltrasoundLib.protocol import ProtocolPoints


class Coach:
    """Leads one palpation.

    Parameters
    ----------
    plan : ProtocolPoints
    surface : Surface
        The bone model, RAS.
    guidance, palpation : settings, optional
    clamp_ras_mm, table_direction_ras : optional
        What is in the way of the probe; see `guidance.reachable`. Points out of reach are left out.
    """

    def __init__(
        self,
        plan: ProtocolPoints,
        surface: Surface,
        guidance: Optional[GuidanceSettings] = None,
        palpation: Optional[PalpationSettings] = None,
        clamp_ras_mm: Optional[npt.ArrayLike] = None,
        table_direction_ras: Optional[npt.ArrayLike] = None,
    ) -> None:
        self.plan, self.surface = plan, surface
        self.settings = guidance or DEFAULTS
        self.palpation = Palpation(plan.labels, palpation)
        self.reachable = reachable(plan, clamp_ras_mm, table_direction_ras, self.settings)
        if not self.reachable.any():
            raise InputError("no point of the protocol is within reach; check where the clamp and the table are")
        self.next_target: Optional[NextTarget] = None  # what the present target brings; None without a covariance
        self._reference_to_ras: Optional[Array] = None
        self._covariance: Optional[Array] = None
        self._pivot: Array = np.zeros(3)
        self._targets: Array = np.empty((0, 3))
        self._go_on()

    @property
    def target(self) -> Optional[int]:
        """Index of the point to palpate now; None when all within reach are taken."""
        return self.palpation.target if self._open().any() else None

    def use_registration(
        self,
        reference_to_ras: npt.ArrayLike,
        covariance: Optional[npt.ArrayLike] = None,
        pivot_ras_mm: npt.ArrayLike = (0.0, 0.0, 0.0),
        targets_ras_mm: Optional[npt.ArrayLike] = None,
    ) -> None:
        """Guide by this registration from now on; the landmark registration will do to begin with.

        Parameters
        ----------
        reference_to_ras : array-like, shape (4, 4)
        covariance : array-like, shape (6, 6), optional
            Of a rotation (rad) about the pivot and a translation (mm), RAS axes. Without it the protocol's order holds.
        pivot_ras_mm : array-like, shape (3,)
        targets_ras_mm : array-like, shape (T, 3), optional
            Where accuracy is wanted; the whole head where none are given.
        """
        self._reference_to_ras = check_rigid(reference_to_ras, "ReferenceToRas")
        self._covariance = None if covariance is None else np.asarray(covariance, dtype=float)
        self._pivot = np.asarray(pivot_ras_mm, dtype=float)
        if targets_ras_mm is not None and len(np.asarray(targets_ras_mm)):
            self._targets = check_points(targets_ras_mm, "targets")
        else:
            self._targets = self.plan.positions_ras_mm
        self._go_on()

    def add(self, lines: Sequence[PalpationLine]) -> list[PalpationStatus]:
        """Take measured lines in the order in which they came; a status for each."""
        statuses = []
        for line in lines:
            status = self.palpation.add(line)
            if status.new_point is not None:
                self._learn(status.new_point.target)
                self._go_on()
            statuses.append(status)
        return statuses

    def guide(self, probe_to_reference: npt.ArrayLike) -> Optional[Guide]:
        """How the probe stands to the target; None without a registration or a target."""
        target = self.target
        if self._reference_to_ras is None or target is None:
            return None
        rotation = None if self._covariance is None else self._covariance[:3, :3]
        return guide(
            self._reference_to_ras @ np.asarray(probe_to_reference, dtype=float),
            self.surface,
            self.plan.positions_ras_mm[target],
            self.plan.normals[target],
            rotation,
            self.settings,
        )

    def aim(self, target: int) -> None:
        """Go to a point that the user chose."""
        self.palpation.aim(target, self._expected(target))

    def skip(self) -> None:
        """Leave the present point out."""
        self.palpation.skip()
        self._go_on()

    def undo(self) -> None:
        """Take back the last point and return to it."""
        point = self.palpation.undo()
        if point is not None:
            self.aim(point.target)

    def _open(self) -> npt.NDArray[np.bool_]:
        return np.asarray(self.palpation.open_points) & self.reachable

    def _go_on(self) -> None:
        """Aim at the point that brings most, or at the next in order that is within reach."""
        is_open = self._open()
        self.next_target = None
        if not is_open.any():
            return
        if self._covariance is not None:
            self.next_target = choose_next(
                self.plan, is_open, self._covariance, self._pivot, self._targets, self.settings.point_sd_mm
            )
        if self.next_target is not None:
            self.aim(self.next_target.index)
            return
        start = self.palpation.target or 0
        order = (start + np.arange(len(self.plan))) % len(self.plan)
        self.aim(int(order[is_open[order]][0]))

    def _expected(self, target: int) -> Optional[Array]:
        """Where a target lies in Reference, under the registration in force."""
        if self._reference_to_ras is None:
            return None
        expected: Array = transform_points(invert_rigid(self._reference_to_ras), self.plan.positions_ras_mm[target][None])[0]
        return expected

    def _learn(self, target: int) -> None:
        """Count a taken point in before the registration is computed anew, so that the next choice knows of it."""
        if self._covariance is not None:
            position, normal = self.plan.positions_ras_mm[target], self.plan.normals[target]
            self._covariance = covariance_with(self._covariance, position, normal, self._pivot, self.settings.point_sd_mm)
