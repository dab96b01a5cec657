"""Builds the page without doing things several times over: seconds of the start."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def built_once() -> Iterator[None]:
    """Within, trame writes the page's template once, at the end, and trame-rca does not render each view to look at its type.

    An element of trame's writes its whole subtree anew whenever its `with` block ends, so that a page is written as often as it
    is deep, and takes every expression apart in search of names to be translated; only servers whose names are translated need
    that, and this one's are not.
    """
    from trame_client.widgets.core import HTML_CTX, AbstractElement
    from trame_rca.schedulers import image_scheduler
    from trame_server.utils.namespace import Translator

    quicker: tuple[tuple[Any, str, Any], ...] = (
        (AbstractElement, "__exit__", lambda self, *_: HTML_CTX.exit(self)),
        (Translator, "translate_js_expression", lambda self, state, expression: expression),
        (Translator, "translate_vue_templating", lambda self, state, expression: expression),
        (image_scheduler, "window_wrapper", lambda window: window),
    )
    before = [getattr(place, name) for place, name, _ in quicker]
    for place, name, instead in quicker:
        setattr(place, name, instead)
    try:
        yield
    finally:
        for (place, name, _), was in zip(quicker, before, strict=True):
            setattr(place, name, was)
