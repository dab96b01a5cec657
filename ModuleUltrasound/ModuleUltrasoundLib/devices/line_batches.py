"""Live lines in batches to be measured, whose bounds follow from the lines' own times and not from when somebody looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ModuleUltrasoundLib.devices.line_stream import PosedLine

# A fifth of a second, which is how often a panel shows the depth. No usual line rate has a line at its very end, where
# rounding of times would decide.
BATCH_S = 0.1995
# Lines before a batch that it is measured with, as far as the detector looks back. Of simulated sweeps it accepts a quarter
# fewer lines with 4 of them, and no more with 96.
CONTEXT_LINES = 24


@dataclass(frozen=True, eq=False)
class LineBatch:
    """Lines to be measured together; those before the last `new` ones were in earlier batches."""

    lines: tuple[PosedLine, ...]
    new: int


class LineBatches:
    """Every line is new in one batch, however many come at a time: the same lines give the same batches.

    A batch ends with the first line that was sent `BATCH_S` after the last one of the batch before, and waits for no later one.
    """

    def __init__(self) -> None:
        self._lines: list[PosedLine] = []  # the context, then those of the batch that is open
        self._new = 0

    def add(self, lines: Sequence[PosedLine]) -> list[LineBatch]:
        """Take the next lines; gives the batches that they complete."""
        done = []
        for item in lines:
            self._lines.append(item)
            self._new += 1
            if self._new < len(self._lines):
                before = self._lines[-self._new - 1].line.host_time_s
                if item.line.host_time_s - before < BATCH_S:
                    continue
            done.append(LineBatch(tuple(self._lines), self._new))
            self._lines, self._new = self._lines[-CONTEXT_LINES:], 0
        return done
