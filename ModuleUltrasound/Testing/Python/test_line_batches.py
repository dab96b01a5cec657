"""Live lines are measured in batches that do not depend on when somebody looks."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleTrackingLib.tracker import PoseStatus, ToolPose
from ModuleUltrasoundLib.devices.device import RfLine
from ModuleUltrasoundLib.devices.line_batches import BATCH_S, CONTEXT_LINES, LineBatches
from ModuleUltrasoundLib.devices.line_stream import PosedLine

NOWHERE = ToolPose("Probe", None, PoseStatus.MISSING, 0.0)


def lines_at(times):
    return [PosedLine(RfLine(np.zeros(4, np.int16), float(time), number), NOWHERE, -1) for number, time in enumerate(times)]


def batches_of(lines, cuts=()):
    """(numbers of all lines, how many are new) of each batch, the lines coming in portions."""
    batches, ends = LineBatches(), [0, *sorted(cuts), len(lines)]
    done = [batch for start, end in zip(ends, ends[1:]) for batch in batches.add(lines[start:end])]
    return [([item.line.sequence_number for item in batch.lines], batch.new) for batch in done]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0.001, 0.5), min_size=1, max_size=80), st.lists(st.integers(0, 80), max_size=10), st.floats(0, 1e5))
def test_however_the_lines_come_in_each_is_new_once_in_the_same_batch(gaps, cuts, start_s):
    times = np.cumsum(gaps)
    whole = batches_of(lines_at(times))
    assert batches_of(lines_at(times), [min(cut, len(times)) for cut in cuts]) == whole
    new = [number for numbers, count in whole for number in numbers[-count:]]
    assert new == list(range(len(new)))
    assert len(times) == len(new) or times[-1] - times[len(new) - 1] < BATCH_S
    usual = np.arange(200) / 40.0  # a rate whose lines come near a batch's end: rounding of times decides nothing
    assert batches_of(lines_at(usual)) == batches_of(lines_at(usual + start_s))


def test_a_batch_ends_with_the_line_that_is_due_and_brings_what_came_before():
    batches = batches_of(lines_at(np.arange(100) / 40.0))
    assert [count for _, count in batches] == [1, *[8] * 12]
    assert batches[2] == (list(range(17)), 8)
    assert batches[-1][0] == list(range(97 - 8 - CONTEXT_LINES, 97))
    assert [count for _, count in batches_of(lines_at([0.0, 1.0, 2.0]))] == [1, 1, 1]  # a slow device's lines do not wait
