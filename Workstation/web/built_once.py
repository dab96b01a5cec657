"""Builds the page without doing things several times over: seconds of the start."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def built_once() -> Iterator[None]:
    """Within, trame writes the page's template once, at the end, and trame-rca does not render each view to look at its type.

    An element of trame's writes its whole subtree anew whenever its `with` block ends, so that a page is written as often as it
    is deep; only servers whose names are translated need that, and this one's are not.
    """
    from trame_client.widgets import core
    from trame_rca.schedulers import image_scheduler

    leave, wrap = core.AbstractElement.__exit__, image_scheduler.window_wrapper

    def leave_quietly(self: Any, *_: Any) -> None:
        core.HTML_CTX.exit(self)

    core.AbstractElement.__exit__, image_scheduler.window_wrapper = leave_quietly, lambda window: window
    try:
        yield
    finally:
        core.AbstractElement.__exit__, image_scheduler.window_wrapper = leave, wrap
