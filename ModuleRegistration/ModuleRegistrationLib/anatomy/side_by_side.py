"""Work on large arrays on several cores: NumPy, SciPy and VTK let other threads run while they compute."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

MOST_THREADS = 4  # more gain little: memory is then the limit
LEAST_PART = 20_000  # elements that are worth a thread


def in_parts(work: Callable[[slice], Result], count: int) -> list[Result]:
    """What `work` gives for the parts of `range(count)`, in order, each part on a core of its own."""
    parts = max(1, min(_cores(), MOST_THREADS, count // LEAST_PART))
    ends = [count * number // parts for number in range(parts + 1)]
    slices = [slice(start, end) for start, end in zip(ends, ends[1:])]
    if parts == 1:
        return [work(slices[0])]
    with ThreadPoolExecutor(parts) as threads:
        return list(threads.map(work, slices))


def _cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
