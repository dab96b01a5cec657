"""Long work off the main thread: computed in a worker, brought back into the thread that owns the scene."""

from __future__ import annotations

import asyncio
import importlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

WORKERS = 3
SOON_NEEDED = ("scipy.spatial.transform", "scipy.special", "scipy.ndimage", "scipy.optimize", "scipy.fft", "SimpleITK")


def load_soon_needed() -> None:
    """Load what the first steps need and the first page does not. In a worker, where it holds up nobody."""
    for name in SOON_NEEDED:
        importlib.import_module(name)


def make_later_needed() -> None:
    """Make the tables of the expected error, which a registration needs at once. In a worker, when the page is up."""
    import numpy as np
    from ModuleRegistrationLib.registration.error_theory import length_statistics

    length_statistics(np.eye(3)[None])  # they are made on first use


class BackgroundRunner:
    """Runs `compute` in a worker thread and `finished(result or exception)` in the server's event loop."""

    def __init__(self) -> None:
        # the CT is saved while the user works on, and what he cancels may run for a while yet
        self._workers = ThreadPoolExecutor(max_workers=WORKERS, thread_name_prefix="cranionav-work")
        self._tasks: set[asyncio.Task[None]] = set()

    def start(self, compute: Callable[[], Any], finished: Callable[[Any], None]) -> None:
        """Return at once; called in the event loop's thread."""
        task = asyncio.get_running_loop().create_task(self._run(compute, finished))
        self._tasks.add(task)  # the loop itself keeps only a weak reference
        task.add_done_callback(self._tasks.discard)

    async def _run(self, compute: Callable[[], Any], finished: Callable[[Any], None]) -> None:
        try:
            outcome: Any = await asyncio.get_running_loop().run_in_executor(self._workers, compute)
        except Exception as error:
            outcome = error
        finished(outcome)

    def close(self) -> None:
        """Wait for nothing more."""
        self._workers.shutdown(wait=False, cancel_futures=True)
