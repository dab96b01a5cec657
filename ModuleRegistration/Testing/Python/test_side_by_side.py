"""Work in parts gives what the work as a whole gives."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from ModuleRegistrationLib.anatomy import side_by_side
from ModuleRegistrationLib.anatomy.side_by_side import LEAST_PART, in_parts


@pytest.mark.parametrize("cores", [1, 2, 3, 64])
@pytest.mark.parametrize("count", [0, 1, LEAST_PART - 1, 5 * LEAST_PART + 7])
def test_parts_cover_the_whole_once_and_in_order(monkeypatch, cores, count):
    monkeypatch.setattr(side_by_side, "_cores", lambda: cores)
    numbers = np.arange(count)
    np.testing.assert_array_equal(np.concatenate(in_parts(lambda part: numbers[part], count)), numbers)


def test_little_work_stays_in_the_callers_thread():
    assert in_parts(lambda part: threading.get_ident(), LEAST_PART) == [threading.get_ident()]


def test_a_failing_part_fails_the_whole(monkeypatch):
    monkeypatch.setattr(side_by_side, "_cores", lambda: 2)

    def work(part: slice) -> None:
        if part.start > 0:
            raise ValueError("second part")

    with pytest.raises(ValueError, match="second part"):
        in_parts(work, 4 * LEAST_PART)
