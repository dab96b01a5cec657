"""While a session is brought back the page shows that and nothing else: panels and views are not what they will be."""

from __future__ import annotations

from typing import Any

from trame.widgets import client, html
from trame.widgets import vuetify3 as v3

from Workstation.web import words

AT_MOST_S = 8.0  # after the session is back its pictures are waited for, but no longer
STYLE = """
.resuming { position: fixed; inset: 48px 0 0 0; z-index: 1900; display: flex; flex-direction: column; align-items: center;
  justify-content: center; gap: 20px; background: #121212; color: #e8eef2; text-align: center; padding: 32px; }
.resuming b { font-size: 36px; }
.resuming .v-progress-linear { flex: none; max-width: 480px; }
"""


class Resuming:
    """Keeps the state variable `resuming`: None, or the text and the share of what is done."""

    def __init__(self, state: Any) -> None:
        self._state, self._busy, self._until_s = state, False, 0.0
        state.resuming = None

    def refresh(self, model: Any, drawn: bool, now_s: float) -> bool:
        """Look at the session's panel `model`; `drawn`: the views show what the scene holds. True: the session is back now."""
        before, self._busy = self._busy, model.busy is not None and model.busy.name == "resumeSession"
        if self._busy:
            self._until_s = now_s + AT_MOST_S
            wanted = {"text": model.progress.text, "share": model.progress.share}
        else:
            wanted = None if (drawn and not before) or now_s > self._until_s else self._state.resuming
        if self._state.resuming != wanted:
            self._state.resuming = wanted
        return before and not self._busy


def draw_resuming(key: str) -> None:
    """What covers the page meanwhile; `key` names the session panel's events."""
    client.Style(STYLE)
    with html.Div(v_if="resuming", classes="resuming", raw_attrs=["data-resuming", 'role="status"']):
        html.B(words.RESUMING)
        v3.VProgressLinear(model_value=("100 * resuming.share",), indeterminate=("!resuming.share",), height=10, color="primary")
        html.Div("{{ resuming.text }}", classes="text-h6")
        v3.VBtn(words.CANCEL, variant="tonal", click=f"trigger('{key}_cancel')")
