"""The page's link to the session: says who controls, comes back by itself when the connection is lost, says so meanwhile."""

from __future__ import annotations

from trame.widgets import client, html
from trame.widgets import vuetify3 as v3

from Workstation.web.pictures_view import draw_script
from Workstation.web.session_windows import OPEN, TAKE

ALIVE = "alive"  # address that the page asks whether the server is there
LOST_TITLE = "Connection lost"
LOST_TEXT = (
    "What was measured is saved. This window comes back by itself. If it does not within a minute, "
    "start the workstation again and choose: Go on with the last session."
)
# in the element itself: when the server is gone the page's own styles are gone, too
LOST_STYLE = (
    "position: fixed; inset: 0; z-index: 9999; display: flex; flex-direction: column; align-items: center; "
    "justify-content: center; gap: 16px; background: rgba(10, 14, 18, 0.94); color: #fff; text-align: center; "
    "padding: 32px; font: 22px/1.5 Roboto, sans-serif;"
)
SHUT_OUT = "The workstation was started anew. Open the address that it printed."
WATCHING = "control.window !== my_window && my_window > 0"
STYLE = """
.link-watching { position: fixed; bottom: 0; right: 0; left: 580px; z-index: 900; display: flex; align-items: center;
  justify-content: center; gap: 16px; padding: 8px; background: #3a2f12; color: #f0b429; border-top: 2px solid #f0b429; }
[inert] .v-btn, [inert] .v-field, [inert] .v-list-item { opacity: 0.6; }
"""

# A window keeps its name over reloads; a copy of the tab, which the browser gives the same storage, takes another one.
SCRIPT = f"""
(() => {{
  if (window.cranionavLink) return;
  window.cranionavLink = true;
  const store = window.sessionStorage, title = {LOST_TITLE!r}, lostText = {LOST_TEXT!r}, shutOut = {SHUT_OUT!r};
  const lostStyle = {LOST_STYLE!r};
  if (store.getItem('cranionav-open') || !store.getItem('cranionav-window'))
    store.setItem('cranionav-window', String(Math.random()).slice(2) + Date.now());
  store.setItem('cranionav-open', '1');
  window.addEventListener('pagehide', () => store.removeItem('cranionav-open'));
  const name = store.getItem('cranionav-window'), trame = window.trame;
  const call = (method, values) => trame.client.getConnection().getSession().call(method, values);
  let closed = false, boot = null, overlay = null;

  const show = (text) => {{
    if (!overlay) {{
      overlay = document.createElement('div');
      overlay.className = 'link-lost';
      overlay.style.cssText = lostStyle;
      overlay.setAttribute('role', 'alert');
      overlay.append(document.createElement('b'), document.createElement('span'));
      overlay.children[0].style.fontSize = '40px';
      overlay.children[1].style.maxWidth = '30em';
      document.body.append(overlay);
    }}
    overlay.children[0].textContent = title;
    overlay.children[1].textContent = text;
  }};
  const hide = () => {{ if (overlay) overlay.remove(); overlay = null; }};
  const look = async () => {{
    try {{
      const answer = await fetch('{ALIVE}?window=' + name, {{ cache: 'no-store', signal: AbortSignal.timeout(5000) }});
      if (answer.status === 403) {{ show(shutOut); return; }}
      const said = await answer.json();
      boot = boot || said.boot;
      if (closed || boot !== said.boot || !said.open) {{ window.location.reload(); return; }}
      hide();
    }} catch (error) {{ show(lostText); }}
  }};
  const lost = () => {{ closed = true; show(lostText); }};
  trame.client.onConnectionClose(lost);
  trame.client.onConnectionError(lost);

  const follow = () => {{
    const control = trame.state.get('control'), mine = trame.state.get('my_window');
    const watching = control.window !== mine;
    if (mine > 0) store.setItem('cranionav-held', watching ? '' : '1');
    document.querySelectorAll('.v-navigation-drawer__content > *, .views').forEach((part) => {{ part.inert = watching; }});
    document.documentElement.dataset.window = mine > 0 ? (watching ? 'watches' : 'controls') : '';
  }};
  trame.state.addListener(({{ type, keys }}) => {{
    if (type === 'dirty-state' && (keys.includes('control') || keys.includes('my_window'))) follow();
  }});
  document.addEventListener('click', (event) => {{
    if (event.target.closest && event.target.closest('[data-take-control]')) call('{TAKE}', []);
  }});
  follow();
  call('{OPEN}', [name, store.getItem('cranionav-held') === '1']).then(() => {{
    look();
    setInterval(look, 2000);
  }});
}})();
"""


def draw_link() -> None:
    """A line below the views that says who controls, where this window does not, with a button; and the script of the link."""
    client.Style(STYLE)
    with html.Div(v_if=(WATCHING,), classes="link-watching", raw_attrs=["data-control"]):
        html.Div("! {{ control.text }}; this window watches", classes="text-body-1")
        v3.VBtn("Take control", variant="flat", color="primary", size="small", raw_attrs=["data-take-control"])
    client.Script(SCRIPT)
    draw_script()
