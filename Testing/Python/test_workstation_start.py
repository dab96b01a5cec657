"""The start: the page is built once, as it comes out when built many times; what it does not need loads later."""

from __future__ import annotations

import subprocess
import sys
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


def test_what_the_first_page_does_not_need_is_not_loaded_with_the_modules():
    later = "scipy.spatial scipy.special scipy.ndimage scipy.optimize scipy.fft SimpleITK open3d matplotlib jinja2".split()
    code = (
        "import sys, ModuleRegistration, ModuleTracking, ModuleUltrasound, Workstation.web.simulated_hand; "
        f"print([name for name in {later!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
