"""The keys in the browser: they press the open step's buttons, then the page's own, as a click would; "?" lists them."""

from __future__ import annotations

from CranioNavLib.panel import Action
from trame.widgets import client, html
from trame.widgets import vuetify3 as v3

from Workstation.web import words
from Workstation.web.panel_view import PanelView
from Workstation.web.procedure import HAND, ProcedureStep
from Workstation.web.toolbar import KEYS
from Workstation.web.view_controls import SIZES, STEPS_MM, TURNS_DEG

# Another step is seen from its beginning, and Tab goes on from there.
# Text fields keep their keys; a button, list or slider reached by Tab keeps those that work it, one that was clicked does not.
# Enter presses the bright button, whichever it is, unless something else was reached by Tab.
# Once: another layout draws the page anew, and with it this script.
LISTEN = """
if (!window.cranionavKeys) {
window.cranionavKeys = true;
const opened = () => (document.querySelector('[data-panel]') || { dataset: {} }).dataset.panel;
const begin = (before, tries) => {  // the panel of the new step comes a little later
  if (opened() === before) { if (tries) setTimeout(() => begin(before, tries - 1), 50); return; }
  document.querySelectorAll('.v-navigation-drawer__content').forEach((one) => { one.scrollTop = 0; });
  document.querySelector('[data-panel]').focus({ preventScroll: true });
};
window.addEventListener('click', (event) => {
  const button = event.detail && event.target.closest && event.target.closest('button, a');
  if (button) button.blur();
  if (event.target.closest && event.target.closest('[data-step], [data-go], [data-key=N], [data-key=B]')) begin(opened(), 40);
}, true);
const keepInSight = () => {  // below the step's heading, which stays; also when a message has moved what lies below it
  const at = document.activeElement, head = document.querySelector('[data-panel] .in-sight');
  const frame = at && at.closest('.v-navigation-drawer__content');
  if (!frame || !head || !at.closest('.part') || !at.matches(':focus-visible')) return;
  frame.style.scrollPaddingTop = head.offsetHeight + 12 + 'px';
  at.scrollIntoView({ block: 'nearest' });
};
window.addEventListener('keydown', (event) => {
  if (event.key === 'Tab') for (const wait of [0, 300, 1000]) setTimeout(keepInSight, wait);
});
const bright = () => [...document.querySelectorAll('[data-panel] .headline button.v-btn--variant-flat')].find(
  (one) => !one.disabled && one.getClientRects().length && !one.closest('[inert]'));
window.addEventListener('keydown', (event) => {
  const at = event.target;
  if (event.altKey || event.metaKey) return;
  if (at.closest && at.closest('input, textarea, select, [contenteditable], [role=slider], [role=listbox]')) return;
  if (event.key === '?') { document.querySelector('[data-keys]').click(); return; }
  if (document.querySelector('.v-overlay--active .v-card')) return;
  const own = at.matches && at.matches(
    'button:focus-visible, a:focus-visible, .v-list-item:focus-visible, .v-list:focus-visible, [role=button]:focus-visible');
  if (own && ['Enter', ' '].includes(event.key)) {  // what was chosen in a list is worked on next, with the page's keys
    if (at.closest('.v-list')) setTimeout(() => at.blur(), 0);
    return;
  }
  if (own && at.closest('.v-list') && ['ArrowUp', 'ArrowDown', 'Home', 'End'].includes(event.key) && !event.shiftKey) return;
  const named = { ' ': 'Space', ArrowLeft: 'Left', ArrowRight: 'Right', Delete: 'Del' }[event.key] || event.key;
  const name = (event.ctrlKey ? 'Ctrl+' : '') + (named.length === 1 ? named.toUpperCase() : named);
  const typed = event.key.length === 1 ? event.key.toUpperCase() : event.key;
  const page = (event.ctrlKey ? 'Ctrl+' : event.shiftKey && typed.length > 1 ? 'Shift+' : '') + typed;
  const button = [...document.querySelectorAll('[data-shortcut]')].find(
    (one) => one.dataset.shortcut === name && one.getClientRects().length && !one.closest('[inert]'));
  const target = page === 'Enter' ? bright() : button || [...document.querySelectorAll('[data-key]')].find(
    (one) => one.dataset.key === page && !one.closest('[inert]'));
  if (!target) return;
  event.preventDefault();
  if (event.repeat && !target.dataset.repeats) return;
  if (document.activeElement) document.activeElement.blur();
  if (!target.disabled) target.click();
}, true);
}
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
    _draw_hidden(procedure)
    v3.VBtn("?", icon=True, size="small", click="keys = !keys", title=words.KEYS_HINT, raw_attrs=["data-keys"])
    everywhere = [(key, what, words.EVERY_STEP) for key, what in KEYS]
    with v3.VDialog(v_model=("keys", False), max_width=760, scrollable=True), v3.VCard(title=words.KEYS), v3.VCardText():
        for key, what, step in (*everywhere, *shortcuts(procedure, panels)):
            with html.Div(classes="d-flex py-1", style="gap: 16px"):
                html.Div(key, style="width: 130px; flex: none", classes="font-weight-bold")
                html.Div(what, classes="flex-grow-1")
                html.Div(step, classes="text-medium-emphasis text-no-wrap")


def _draw_hidden(procedure: tuple[ProcedureStep, ...]) -> None:
    """Buttons that only keys press."""
    names = repr([step.name for step in procedure])
    for key, way in (("N", 1), ("B", -1)):
        onwards = f"step = {names}[Math.min({len(procedure) - 1}, Math.max(0, {names}.indexOf(step) + {way}))]"
        html.Button(style="display: none", click=onwards, raw_attrs=[f'data-key="{key}"'])
    moves = [
        (f"{shift}{key}", f"view_move', ['{key}', {far}")
        for key in STEPS_MM
        for shift, far in (("", "false"), ("Shift+", "true"))
    ]
    turns = [(key, f"view_turn', ['{key}'") for key in TURNS_DEG] + [(key, f"view_size', ['{key}'") for key in SIZES]
    for key, call in (*moves, *turns):
        html.Button(style="display: none", click=f"trigger('{call}])", raw_attrs=[f'data-key="{key}"', 'data-repeats="yes"'])
