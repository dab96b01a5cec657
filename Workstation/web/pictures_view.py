"""The page's side of the views' pictures: draws them, says so, and says over a view that its picture is old.

A worker takes the pictures from the wire, decodes and draws them, so that a page that is busy with its panels holds up none.
"""

from __future__ import annotations

import json

from trame.widgets import client, html

from Workstation.web import words
from Workstation.web.pictures import HEADER, PICTURES

OLD_S = 0.5  # behind what it should show; a picture that is older says so
STYLE = """
.picture { position: absolute; inset: 0; width: 100%; height: 100%; object-fit: contain; pointer-events: none; }
.picture-old { position: absolute; left: 50%; top: 34px; transform: translateX(-50%); pointer-events: none; white-space: nowrap;
  padding: 4px 14px; font-size: 22px; font-weight: 700; background: #f0b429; color: #16130a; border-radius: 4px; }
"""

# What it drew it says once a frame, so that a window that cannot keep up is sent less. A view that is not on the page keeps
# its last picture until it is; another layout makes new canvases, which show the last picture until theirs comes.
WORKER = f"""
const canvases = new Map(), aside = new Map();
const decoded = new Map(), latest = new Map(), last = new Map(), utf8 = new TextDecoder();
let address = '', socket = null, frame = 0;

const paint = (canvas, picture) => {{
  const width = picture.displayWidth || picture.width, height = picture.displayHeight || picture.height;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {{ width, height }});
  canvas.getContext('2d', {{ alpha: false }}).drawImage(picture, 0, 0);
}};
const draw = () => {{
  frame = 0;
  for (const [area, [number, picture]] of decoded) {{
    const canvas = canvases.get(area);
    if (!canvas) continue;
    paint(canvas, picture);
    if (last.has(area)) last.get(area).close();
    last.set(area, picture);
    decoded.delete(area);
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify([area, number]));
  }}
}};
const decode = async (content) => {{
  if (!self.ImageDecoder) return createImageBitmap(new Blob([content], {{ type: 'image/jpeg' }}));
  const decoder = new ImageDecoder({{ data: content, type: 'image/jpeg' }});
  const {{ image }} = await decoder.decode();
  decoder.close();
  return image;
}};
const show = async (data) => {{
  const head = new DataView(data), number = head.getUint32(0, true), length = head.getUint8(4);
  const area = utf8.decode(new Uint8Array(data, {HEADER.size}, length));
  const picture = await decode(new Uint8Array(data, {HEADER.size} + length));
  if (number <= latest.get(area)) return picture.close();
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
    if (typeof data === 'string') self.postMessage(JSON.parse(data)); else show(data);
  }};
  socket.onclose = () => setTimeout(connect, 1000);
}};
self.onmessage = ({{ data }}) => {{
  if (data.address) {{
    address = data.address;
    return connect();
  }}
  if (data.away) {{
    aside.set(data.area, canvases.get(data.area));
    return canvases.delete(data.area);
  }}
  const canvas = data.canvas || aside.get(data.area);
  if (!canvas) return;
  canvases.set(data.area, canvas);
  if (last.has(data.area)) paint(canvas, last.get(data.area));
  if (decoded.has(data.area)) frame = frame || requestAnimationFrame(draw);
}};
"""
SCRIPT = f"""
(() => {{
  if (window.cranionavPictures) return;
  const source = new Blob([{json.dumps(WORKER)}], {{ type: 'text/javascript' }});
  const worker = window.cranionavPictures = new Worker(URL.createObjectURL(source));
  const address = new URL('{PICTURES}', window.location.href), words = {words.PICTURE_OLD!r}, given = new Map();
  let told = {{}}, heard = performance.now();
  const transferred = new WeakSet();  // a canvas gives its drawing away once, and may leave the page and come back
  address.protocol = address.protocol.replace('http', 'ws');

  worker.onmessage = ({{ data }}) => {{
    heard = performance.now();
    told = data;
  }};
  worker.postMessage({{ address: address.href }});
  const give = () => {{
    for (const canvas of document.querySelectorAll('canvas[data-picture]')) {{
      const area = canvas.dataset.picture;
      if (given.get(area) === canvas) continue;
      given.set(area, canvas);
      if (transferred.has(canvas)) {{
        worker.postMessage({{ area }});
        continue;
      }}
      transferred.add(canvas);
      const offscreen = canvas.transferControlToOffscreen();
      worker.postMessage({{ area, canvas: offscreen }}, [offscreen]);
    }}
    for (const [area, canvas] of given) {{
      if (canvas.isConnected) continue;
      given.delete(area);
      worker.postMessage({{ area, away: true }});
    }}
  }};
  const say = () => {{
    give();
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
