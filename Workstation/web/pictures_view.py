"""The page's side of the views' pictures: draws them, says so, and says over a view that its picture is old."""

from __future__ import annotations

from trame.widgets import client, html

from Workstation.web import words
from Workstation.web.pictures import HEADER, PICTURES

OLD_S = 0.5  # behind what it should show; a picture that is older says so
STYLE = """
.picture { position: absolute; inset: 0; width: 100%; height: 100%; object-fit: contain; pointer-events: none; }
.picture-old { position: absolute; left: 50%; top: 34px; transform: translateX(-50%); pointer-events: none; white-space: nowrap;
  padding: 4px 14px; font-size: 22px; font-weight: 700; background: #f0b429; color: #16130a; border-radius: 4px; }
"""

# Decoding is the browser's own, off the page's thread; drawing and saying so come once a frame, so that a page that cannot
# keep up is sent less. A view that is not on the page keeps its last picture until it is.
SCRIPT = f"""
(() => {{
  if (window.cranionavPictures) return;
  window.cranionavPictures = true;
  const address = new URL('{PICTURES}', window.location.href), words = {words.PICTURE_OLD!r};
  address.protocol = address.protocol.replace('http', 'ws');
  const decoded = new Map(), latest = new Map(), shown = new Map(), utf8 = new TextDecoder();
  let socket = null, told = {{}}, heard = performance.now(), frame = 0;

  const draw = () => {{
    frame = 0;
    for (const [area, [number, picture]] of decoded) {{
      const canvas = document.querySelector(`canvas[data-picture="${{area}}"]`);
      if (!canvas) continue;
      const width = picture.displayWidth || picture.width, height = picture.displayHeight || picture.height;
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {{ width, height }});
      canvas.getContext('2d', {{ alpha: false }}).drawImage(picture, 0, 0);
      shown.set(area, canvas);
      picture.close();
      decoded.delete(area);
      if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify([area, number]));
    }}
  }};
  const decode = async (content) => {{
    if (!window.ImageDecoder) return createImageBitmap(new Blob([content], {{ type: 'image/jpeg' }}));
    const decoder = new ImageDecoder({{ data: content, type: 'image/jpeg' }});
    const {{ image }} = await decoder.decode();
    decoder.close();
    return image;
  }};
  const show = async (data) => {{
    const head = new DataView(data), number = head.getUint32(0, true), length = head.getUint8(4);
    const area = utf8.decode(new Uint8Array(data, {HEADER.size}, length));
    const picture = await decode(new Uint8Array(data, {HEADER.size} + length));
    if (number <= latest.get(area)) return;
    latest.set(area, number);
    if (decoded.has(area)) decoded.get(area)[1].close();
    decoded.set(area, [number, picture]);
    frame = frame || requestAnimationFrame(draw);
  }};
  const connect = () => {{
    socket = new WebSocket(address);
    socket.binaryType = 'arraybuffer';
    latest.clear();
    socket.onmessage = ({{ data }}) => {{
      heard = performance.now();
      if (typeof data === 'string') told = JSON.parse(data); else show(data);
    }};
    socket.onclose = () => setTimeout(connect, 1000);
  }};
  const keep = () => {{  // another layout makes new canvases: they show the last picture until theirs comes
    for (const canvas of document.querySelectorAll('canvas[data-picture]')) {{
      const area = canvas.dataset.picture, before = shown.get(area);
      if (!before || before === canvas) continue;
      Object.assign(canvas, {{ width: before.width, height: before.height }});
      canvas.getContext('2d', {{ alpha: false }}).drawImage(before, 0, 0);
      shown.set(area, canvas);
    }}
  }};
  const say = () => {{
    keep();
    if (decoded.size && !frame) frame = requestAnimationFrame(draw);
    const quiet = (performance.now() - heard) / 1000;
    for (const sign of document.querySelectorAll('[data-behind]')) {{
      const behind = (told[sign.dataset.behind] || 0) + ((told[sign.dataset.behind] || quiet > {OLD_S}) ? quiet : 0);
      const text = behind > {OLD_S} ? words.replace('{{seconds}}', behind.toFixed(1)) : '';
      if (sign.textContent !== text) {{
        sign.textContent = text;
        sign.style.display = text ? '' : 'none';
      }}
    }}
  }};
  connect();
  setInterval(say, 100);
}})();
"""


def draw_picture(area: str) -> None:
    """The picture of a view, and what says that it is old, within the view's element."""
    html.Canvas(classes="picture", raw_attrs=[f'data-picture="{area}"'])
    html.Div(classes="picture-old", style="display: none", raw_attrs=[f'data-behind="{area}"', 'role="status"', "v-pre"])


def draw_script() -> None:
    """The script of all views."""
    client.Style(STYLE)
    client.Script(SCRIPT)
