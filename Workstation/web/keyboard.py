"""The panels' shortcuts in the browser: a key presses the open step's button, as a click would; "?" lists them."""

from __future__ import annotations

from CranioNavLib.panel import Action
from trame.widgets import client, html
from trame.widgets import vuetify3 as v3

from Workstation.web.panel_view import PanelView
from Workstation.web.procedure import HAND, ProcedureStep

# Text fields keep their keys; a button or slider reached by Tab keeps those that work it, one that was clicked does not.
LISTEN = """
window.addEventListener('click', (event) => {
  const button = event.detail && event.target.closest && event.target.closest('button, a');
  if (button) button.blur();
}, true);
window.addEventListener('keydown', (event) => {
  const at = event.target;
  if (event.altKey || event.metaKey || event.repeat) return;
  if (at.closest && at.closest('input, textarea, select, [contenteditable], [role=slider], [role=listbox]')) return;
  if (event.key === '?') { document.querySelector('[data-keys]').click(); return; }
  if (document.querySelector('.v-overlay--active .v-card')) return;
  const named = { ' ': 'Space', ArrowLeft: 'Left', ArrowRight: 'Right' }[event.key] || event.key;
  const name = (event.ctrlKey ? 'Ctrl+' : '') + (named.length === 1 ? named.toUpperCase() : named);
  if (named === 'Space' && at.matches && at.matches('button:focus-visible, a:focus-visible, [tabindex]:focus-visible')) return;
  const button = [...document.querySelectorAll('[data-shortcut]')].find(
    (one) => one.dataset.shortcut === name && one.getClientRects().length && !one.closest('[inert]'));
  if (!button) return;
  event.preventDefault();
  if (document.activeElement) document.activeElement.blur();
  if (!button.disabled) button.click();
}, true);
"""


def shortcuts(
    procedure: tuple[ProcedureStep, ...], panels: dict[str, PanelView], skip: tuple[str, ...] = (HAND,)
) -> list[tuple[str, str, str]]:
    """(key, what it does, step of the procedure) of every button that has a key."""
    found = []
    for step in procedure:
        for module, name in step.parts:
            if module in skip:
                continue
            part = next(one for one in panels[module].model.panel.steps if one.name == name)
            found += [(item.shortcut, item.help, step.title) for item in part.items if isinstance(item, Action) and item.shortcut]
    return found


def draw_help(procedure: tuple[ProcedureStep, ...], panels: dict[str, PanelView]) -> None:
    """The button "?" of the title bar with its list, and the listener of the keys."""
    client.Script(LISTEN)
    v3.VBtn("?", icon=True, size="small", click="keys = !keys", title="Keys (?)", raw_attrs=["data-keys"])
    with v3.VDialog(v_model=("keys", False), max_width=560), v3.VCard(title="Keys"), v3.VCardText():
        for key, what, step in (*shortcuts(procedure, panels), ("?", "Show or hide this list", "every step")):
            with html.Div(classes="d-flex py-1", style="gap: 16px"):
                html.Div(key, style="width: 80px", classes="font-weight-bold")
                html.Div(what, classes="flex-grow-1")
                html.Div(step, classes="text-medium-emphasis")
