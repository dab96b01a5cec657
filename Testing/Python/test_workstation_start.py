"""The page is built once, and comes out as it does when it is built many times."""

from __future__ import annotations

import uuid
from contextlib import nullcontext
from typing import Any

from Workstation.web.built_once import built_once


def page_built_in(context: Any) -> tuple[str, int]:
    """The template of a nested page, and how often an element was written."""
    from trame.app import get_server
    from trame.ui.vuetify3 import VAppLayout
    from trame.widgets import html
    from trame.widgets import vuetify3 as v3
    from trame_client.widgets import vue

    server, written = get_server(f"start-{uuid.uuid4()}", client_type="vue3"), []
    renderer = next(kind for kind in vars(vue).values() if isinstance(kind, type) and "render" in vars(kind))
    render = renderer.render

    def counted(self: Any) -> Any:
        written.append(self)
        return render(self)

    renderer.render = counted
    try:
        with context, VAppLayout(server) as layout:
            for _ in range(5):
                with v3.VCard(), html.Div(classes="a"), html.Div(v_if="step === 'x'"):
                    v3.VTextField(v_model=("number", 7), label="n")
    finally:
        renderer.render = render
    assert server.state.number == 7
    return layout.html, len(written)


def test_the_page_is_the_same_but_written_fewer_times():
    often, many = page_built_in(nullcontext())
    once, few = page_built_in(built_once())
    assert once.split("<", 2)[2] == often.split("<", 2)[2]
    assert few < many / 2
