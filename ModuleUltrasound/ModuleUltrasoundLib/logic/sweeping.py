"""Palpation by a sweep: the probe glides, and every good line becomes a point where none is yet."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Optional

from CranioNavLib import scene_data
from CranioNavLib.panel import Level, Reading
from CranioNavLib.rigid import Array

from ModuleUltrasoundLib.live_drawings import PointState
from ModuleUltrasoundLib.logic.asking import AskStep

if TYPE_CHECKING:
    from CranioNavLib.surface import Surface

    from ModuleUltrasoundLib.palpation.palpation import PalpationLine, Sweep

SHOWN_EVERY_S = 1.0
SHARE_OF_TIME = 0.1  # spent on showing points, at most: there may be thousands


class SweepStep(AskStep):
    """SurfacePoints as the probe glides; no point of the protocol is asked for meanwhile."""

    def __init__(self, parent: Any = None) -> None:
        super().__init__(parent)
        self.sweep: Optional[Sweep] = None  # while recording one
        self._why = ""  # the last line was no point
        self._showAt = 0.0

    def currentIndex(self) -> int:
        """Index of the point to palpate now; -1 without a protocol, and while the probe glides."""
        return -1 if self.sweep is not None else super().currentIndex()

    def indexAt(self, host_time_s: float) -> int:
        """Index of the point that was asked for at a moment; -1 for all lines of a recording of a gliding probe."""
        return -1 if self.sweep is not None else super().indexAt(host_time_s)

    def pointStates(self) -> list[PointState]:
        """How far each planned point is; none while the probe glides, for none is asked for."""
        return [] if self.sweep is not None else super().pointStates()

    def aimAt(self, probe_to_ras: Array, surface: Surface) -> Optional[tuple[Array, Array]]:
        """While the probe glides it is where it has to be; it only has to stand upright on the bone."""
        if self.sweep is None:
            return super().aimAt(probe_to_ras, surface)
        near = surface.closest(probe_to_ras[None, :3, 3])
        return near.points_mm[0], near.normals[0]

    def guidance(self) -> Optional[Reading]:
        """What to do with the probe now: a gliding one is not told to hold still."""
        found = super().guidance()
        return Reading("glide on", Level.GOOD) if self.sweep is not None and found and found.level is Level.GOOD else found

    def sweepOver(self, lines: list[PalpationLine]) -> None:
        """Take measured lines; the points are shown about once a second."""
        assert self.sweep is not None
        for line in lines:
            self._why = self.sweep.add(line)
        if len(self.sweep) and time.monotonic() >= self._showAt:
            self.showSweep()

    def showSweep(self) -> None:
        """The sweep so far as SurfacePoints; measuring the whole recording replaces them at the end."""
        from ModuleUltrasoundLib.palpation.palpation import to_bone_points

        assert self.sweep is not None
        began, wanted = time.monotonic(), self.parameters().read()
        scene_data.set_bone_points(
            to_bone_points(self.sweep.lines, None, wanted.speed_of_sound_m_s, wanted.speed_of_sound_sd_m_s)
        )
        now = time.monotonic()
        self._showAt = now + max(SHOWN_EVERY_S, (now - began) / SHARE_OF_TIME)

    def swept(self) -> Optional[Reading]:
        """How many points the sweep has given, and why the last line was none."""
        if self.sweep is None:
            return None
        return Reading("; ".join(filter(None, [f"{len(self.sweep)} points of the sweep", self._why])))
