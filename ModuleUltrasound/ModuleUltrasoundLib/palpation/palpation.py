"""Palpation point by point and by sweep: which of the lines that stream in become bone points, and why others do not."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.bone_points import BonePoints
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.rigid import Array

if TYPE_CHECKING:
    from ModuleUltrasoundLib.measurement.measure import LineMeasurements

NEAR = "near a point already kept"
USUAL_LINES = 6  # that tell how often lines come
MISSED = 2.5  # times the usual way from line to line: one bad line between two good ones is no gap
SLOWEST_S = 2.0  # without a good line, however slow the device
POSE_NOISE_MM = 2.0  # between two poses of a probe at rest: a poor tracker has 0.35 mm an axis, that is 0.86 mm RMS


@dataclass(frozen=True)
class PalpationSettings(Parameters):
    """When a dwell is a point."""

    dwell_s: Annotated[float, Limits(0.1, 5), "stable and good for so long: taken"] = 0.5
    least_quality: Annotated[float, Limits(0, 1), "quality of every line that counts"] = 0.85
    stable_mm: Annotated[float, Limits(0.1, 10), "the bone point stays within this of its middle"] = 1.0
    longest_gap_s: Annotated[
        float, Limits(0.02, 2), "without a good line: the dwell begins anew; a slow device may take longer"
    ] = 0.25
    least_lines: Annotated[int, Limits(1, 100), "good lines in a dwell"] = 4
    target_radius_mm: Annotated[float, Limits(1, 100), "from the target, under the registration in force"] = 15.0
    apart_mm: Annotated[float, Limits(0, 50), "from every point taken before"] = 6.0
    sweep_spacing_mm: Annotated[float, Limits(0.2, 20), "between the points kept of a sweep"] = 2.0
    sweep_speed_mm_s: Annotated[float, Limits(1, 1000), "a faster probe's pose no longer fits its line"] = 120.0


@dataclass(frozen=True, eq=False)
class PalpationLine:
    """One A-line as measured. Reference frame, mm."""

    time_s: float
    accepted: bool  # by the measurement's own gate
    quality: float
    reason: str = ""  # why it was not accepted
    position_mm: Array = field(default_factory=lambda: np.full(3, np.nan))  # (3,) the bone
    covariance_mm2: Array = field(default_factory=lambda: np.full((3, 3), np.nan))  # (3, 3)
    beam: Array = field(default_factory=lambda: np.full(3, np.nan))  # (3,) unit
    depth_mm: float = float("nan")
    frame: int = -1  # in the recording


def _why_doubtful(line: PalpationLine, least_quality: float) -> str:
    """Why a line cannot be a point wherever it is; empty if it can."""
    if not line.accepted:
        return line.reason or "not accepted"
    if not np.isfinite(line.position_mm).all():
        return "pose missing"
    return "echo not sure enough" if line.quality < least_quality else ""


class PalpationState(str, Enum):
    """What palpation is doing."""

    WAITING = "waiting"  # for a good line
    DWELLING = "dwelling"  # good lines are adding up
    DONE = "done"  # every point is taken


@dataclass(frozen=True, eq=False)
class TakenPoint:
    """A palpated point: the best line of its dwell."""

    target: int  # in the protocol
    label: str
    line: PalpationLine
    lines: int  # good lines of the dwell
    spread_mm: float  # RMS of their bone points about their middle


@dataclass(frozen=True, eq=False)
class PalpationStatus:
    """After each line: for the panel's read-outs."""

    state: PalpationState
    dwell: float  # 0..1 of the dwell that is needed
    target: Optional[int]
    taken: int
    total: int
    reason: str  # why the line did not count; empty if it did
    new_point: Optional[TakenPoint] = None


class Palpation:
    """Point by point: a point is taken by itself when the probe rests on it and the echo is good for long enough.

    Parameters
    ----------
    labels : sequence of str
        The protocol's points.
    settings : PalpationSettings, optional
    """

    def __init__(self, labels: Sequence[str], settings: Optional[PalpationSettings] = None) -> None:
        if not labels:
            raise InputError("the protocol has no points to palpate; plan it first")
        self.labels = tuple(labels)
        self.settings = settings or PalpationSettings()
        self.refused: Counter[str] = Counter()  # lines that did not count, by reason
        self._taken: list[TakenPoint] = []
        self._dwell: deque[PalpationLine] = deque()
        self._times: deque[float] = deque(maxlen=USUAL_LINES)  # of the last lines, good or not
        self._target: Optional[int] = 0
        self._target_mm: Optional[Array] = None
        self._asked_s = -np.inf  # since when it is asked for, in the time of the lines

    # -- progress

    @property
    def taken(self) -> tuple[TakenPoint, ...]:
        """The points so far, in the order in which they were taken."""
        return tuple(self._taken)

    @property
    def target(self) -> Optional[int]:
        """The point that the user is on; None when all are taken."""
        return self._target

    @property
    def open_points(self) -> list[bool]:
        """For each point of the protocol whether it is still to be palpated."""
        closed = {point.target for point in self._taken}
        return [index not in closed for index in range(len(self.labels))]

    def aim(self, target: int, position_mm: Optional[Array] = None, asked_s: float = -np.inf) -> None:
        """Make a point the next; lines taken before `asked_s` are not on it, though they come later.

        `position_mm` (3,) in Reference is where it is expected under the registration.

        Raises
        ------
        InputError
            No such point.
        """
        if not 0 <= target < len(self.labels):
            raise InputError(f"no point {target} in a protocol of {len(self.labels)}")
        if target != self._target:
            self._dwell.clear()
        self._target, self._asked_s = target, asked_s
        self._target_mm = None if position_mm is None else np.asarray(position_mm, dtype=float)

    def expect(self, position_mm: Optional[Array]) -> None:
        """The same point is expected elsewhere, (3,) in Reference, as the registration has become better; a dwell goes on."""
        self._target_mm = None if position_mm is None else np.asarray(position_mm, dtype=float)

    def undo(self) -> Optional[TakenPoint]:
        """Take back the last point and return to it; None if there is none."""
        if not self._taken:
            return None
        point = self._taken.pop()
        self._dwell.clear()
        self._target, self._target_mm = point.target, None
        return point

    # -- lines

    def add(self, line: PalpationLine) -> PalpationStatus:
        """Take the next line."""
        if self._target is None:
            return self._status("every point is taken")
        self._times.append(line.time_s)
        if self._dwell and line.time_s - self._dwell[-1].time_s > self._longest_gap_s():
            self._dwell.clear()
        reason = self._why_refused(line)
        if reason:
            self.refused[reason] += 1
            return self._status(reason)
        self._dwell.append(line)
        self._drop_what_moved()
        if self._dwelt_s() < self.settings.dwell_s or len(self._dwell) < self.settings.least_lines:
            return self._status("")
        point = self._take(self._target)
        self._advance()
        return self._status("", point)

    def _longest_gap_s(self) -> float:
        """A board that sends three lines a second has no gaps because of that."""
        usual_s = float(np.median(np.diff(self._times))) if len(self._times) > 1 else 0.0
        return max(self.settings.longest_gap_s, min(MISSED * usual_s, SLOWEST_S))

    def _why_refused(self, line: PalpationLine) -> str:
        if line.time_s < self._asked_s:
            return "taken before the point was asked for"
        doubt = _why_doubtful(line, self.settings.least_quality)
        if doubt:
            return doubt
        if self._target_mm is not None:
            away = float(np.linalg.norm(line.position_mm - self._target_mm))
            if away > self.settings.target_radius_mm:
                return "away from the target"
        for point in self._taken:
            if float(np.linalg.norm(line.position_mm - point.line.position_mm)) < self.settings.apart_mm:
                return f"too near to {point.label}"
        return ""

    def _drop_what_moved(self) -> None:
        """Forget the beginning of the dwell until the rest lies together."""
        while len(self._dwell) > 1:
            positions = np.array([line.position_mm for line in self._dwell])
            if np.linalg.norm(positions - np.median(positions, axis=0), axis=1).max() <= self.settings.stable_mm:
                return
            self._dwell.popleft()

    def _dwelt_s(self) -> float:
        return self._dwell[-1].time_s - self._dwell[0].time_s if self._dwell else 0.0

    def _take(self, target: int) -> TakenPoint:
        positions = np.array([line.position_mm for line in self._dwell])
        middle = np.median(positions, axis=0)
        from_middle = np.linalg.norm(positions - middle, axis=1)
        qualities = np.array([line.quality for line in self._dwell])
        # the best of lines that are equally sure is the one in the middle of the others
        best = int(np.lexsort((from_middle, -np.round(qualities, 2)))[0])
        spread = float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))))
        point = TakenPoint(target, self.labels[target], self._dwell[best], len(self._dwell), spread)
        self._taken.append(point)
        return point

    def _advance(self) -> None:
        """Aim at the next open point, around the protocol from the present one."""
        self._dwell.clear()
        self._target_mm = None
        count, start = len(self.labels), self._target if self._target is not None else 0
        is_open = self.open_points
        self._target = next(((start + k) % count for k in range(1, count + 1) if is_open[(start + k) % count]), None)

    def _status(self, reason: str, new_point: Optional[TakenPoint] = None) -> PalpationStatus:
        state = PalpationState.DWELLING if self._dwell else PalpationState.WAITING
        return PalpationStatus(
            state=PalpationState.DONE if self._target is None else state,
            dwell=min(1.0, self._dwelt_s() / self.settings.dwell_s),
            target=self._target,
            taken=len(self._taken),
            total=len(self.labels),
            reason=reason,
            new_point=new_point,
        )


class Sweep:
    """A gliding probe: every good line is a point, thinned to an even density as they come.

    Of lines nearer to each other than the spacing the surer one stays. `refused` counts the others by reason: with those kept
    they are all the lines that came.
    """

    def __init__(self, settings: Optional[PalpationSettings] = None) -> None:
        self.settings = settings or PalpationSettings()
        self.refused: Counter[str] = Counter()
        self._kept: dict[int, PalpationLine] = {}
        self._cells: dict[tuple[int, ...], set[int]] = {}
        self._way: deque[tuple[float, Array]] = deque()  # when and where the last good lines entered the skin
        self._count = 0

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def lines(self) -> list[PalpationLine]:
        """The lines kept, in the order in which they came."""
        return [self._kept[key] for key in sorted(self._kept)]

    def add(self, line: PalpationLine) -> str:
        """Take the next line; gives why it is not a point, empty if it is one."""
        reason = self._why_refused(line)
        if not reason:
            reason = self._keep(line)
        if reason:
            self.refused[reason] += 1
        return reason

    def _why_refused(self, line: PalpationLine) -> str:
        doubt = _why_doubtful(line, self.settings.least_quality)
        return doubt or ("probe too fast" if self._too_fast(line) else "")

    def _too_fast(self, line: PalpationLine) -> bool:
        """Over the longest gap that good lines are looked back for, less what noise moves a probe at rest."""
        entry = line.position_mm - line.depth_mm * line.beam  # unlike the bone it does not jump with the echo that is chosen
        self._way.append((line.time_s, entry))
        while line.time_s - self._way[0][0] > self.settings.longest_gap_s:
            self._way.popleft()
        since_s, from_mm = self._way[0]
        way_mm = float(np.linalg.norm(entry - from_mm)) - POSE_NOISE_MM
        return way_mm > self.settings.sweep_speed_mm_s * (line.time_s - since_s)

    def _keep(self, line: PalpationLine) -> str:
        cell = tuple(int(index) for index in np.floor(line.position_mm / self.settings.sweep_spacing_mm))
        near = [key for offset in np.ndindex(3, 3, 3) for key in self._cells.get(_shifted(cell, offset), ())]
        close = [
            key for key in near if np.linalg.norm(self._kept[key].position_mm - line.position_mm) < self.settings.sweep_spacing_mm
        ]
        if any(self._kept[key].quality >= line.quality for key in close):
            return NEAR
        for key in close:  # this line is surer than all of them
            self.refused[NEAR] += 1
            old = self._kept.pop(key).position_mm
            self._cells[tuple(int(index) for index in np.floor(old / self.settings.sweep_spacing_mm))].discard(key)
        self._kept[self._count] = line
        self._cells.setdefault(cell, set()).add(self._count)
        self._count += 1
        return ""


def _shifted(cell: tuple[int, ...], offset: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(index + step - 1 for index, step in zip(cell, offset))


def lines_of(measured: LineMeasurements, times_s: npt.ArrayLike, first_frame: int = 0) -> list[PalpationLine]:
    """The measured frames of a recording, or of a piece of a stream, as lines for `Palpation` and `Sweep`.

    Parameters
    ----------
    measured : LineMeasurements
    times_s : array-like, shape (F,)
        When each was taken.
    first_frame : int
        Number of the first of them in its recording.
    """
    times = np.asarray(times_s, dtype=float)
    if len(times) != len(measured):
        raise InputError(f"expected one time for each of {len(measured)} measured lines, got {len(times)}")
    return [
        PalpationLine(
            time_s=float(times[k]),
            accepted=bool(measured.accepted[k]),
            quality=float(measured.qualities[k]),
            reason=measured.reasons[k],
            position_mm=measured.positions_mm[k],
            covariance_mm2=measured.covariances_mm2[k],
            beam=measured.beam_directions[k],
            depth_mm=float(measured.depths_mm[k]),
            frame=first_frame + k,
        )
        for k in range(len(times))
    ]


def to_bone_points(
    lines: Sequence[PalpationLine],
    labels: Optional[Sequence[str]] = None,
    speed_of_sound_m_s: float = 1540.0,
    speed_of_sound_sd_m_s: float = 52.0,
) -> BonePoints:
    """The lines as points for registration, Reference frame.

    Raises
    ------
    InputError
        No lines, or labels of another number.
    """
    if not lines:
        raise InputError("no points were palpated; palpate before registering")
    return BonePoints(
        positions_mm=np.array([line.position_mm for line in lines]),
        covariances_mm2=np.array([line.covariance_mm2 for line in lines]),
        beam_directions=np.array([line.beam for line in lines]),
        depths_mm=np.array([line.depth_mm for line in lines]),
        qualities=np.array([line.quality for line in lines]),
        labels=tuple(labels) if labels is not None else tuple(f"S{index + 1}" for index in range(len(lines))),
        speed_of_sound_m_s=speed_of_sound_m_s,
        speed_of_sound_sd_m_s=speed_of_sound_sd_m_s,
    )
