"""The page's dialog for the CT: choose one on the workstation, or send one from this computer; then choose the series."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from CranioNavLib.errors import InputError
from trame.widgets import client, html
from trame.widgets import vuetify3 as v3

from Workstation.web.session_files import Places

CLOSED = {"open": False, "where": "", "up": None, "entries": [], "series": [], "ct": "", "message": ""}
NOTHING_HERE = "Nothing in {where} is a CT (DICOM, NRRD, NIfTI or MetaImage): choose another folder."
SCRIPT = """
(() => {
  if (window.cranionavUpload) return;
  window.cranionavUpload = true;
  let request = null;
  const say = (text) => {
    document.querySelectorAll('[data-sending]').forEach((one) => { one.textContent = text; });
    document.querySelectorAll('[data-cancel-upload]').forEach((one) => { one.style.display = request ? '' : 'none'; });
  };
  const send = (file, folder) => new Promise((done, failed) => {
    const query = new URLSearchParams({ window: sessionStorage.getItem('cranionav-window') || '', folder, name: file.name });
    request = new XMLHttpRequest();
    request.open('POST', 'upload?' + query);
    request.upload.onprogress = ({ loaded, total }) => say(`Sending ${file.name}: ${Math.round(100 * loaded / total)} %`);
    request.onload = () => request.status === 200 ? done(request.responseText) : failed(new Error(request.responseText));
    request.onerror = () => failed(new Error('the connection was lost; send it again'));
    request.onabort = () => failed(new Error('cancelled'));
    request.send(file);
  });
  document.addEventListener('change', async (event) => {
    const input = event.target.closest && event.target.closest('[data-upload]');
    if (!input || !input.files.length) return;
    const files = [...input.files];
    try {
      let path = '';
      for (const file of files) {
        const folder = (file.webkitRelativePath || '').split('/').slice(-2, -1)[0] || '';
        path = await send(file, folder);
        if (folder) path = path.slice(0, path.lastIndexOf('/'));
      }
      request = null;
      say('');
      window.trame.trigger('files_pick', [path]);
    } catch (error) { request = null; say('! ' + error.message); }
    input.value = '';
    request = null;
  });
  document.addEventListener('click', (event) => {
    if (event.target.closest && event.target.closest('[data-cancel-upload]') && request) request.abort();
  });
})();
"""


class FilesDialog:
    """What the dialog shows and does; `load(path, series)` loads a CT, `in_background(compute, finished)` takes long work."""

    def __init__(
        self, server: Any, places: Places, load: Callable[[str, str], object], in_background: Callable[..., None]
    ) -> None:
        self._state, self._places, self._load, self._in_background = server.state, places, load, in_background
        self._state.picker = dict(CLOSED)
        for name, function in {"open": self.open, "pick": self.pick, "series": self.series, "close": self.close}.items():
            server.controller.trigger(f"files_{name}")(function)

    def open(self, where: str = "") -> None:
        """Show what there is in a folder."""
        try:
            listing = self._places.listing(where)
        except OSError as error:
            self._say(InputError(f"{where} cannot be read: {error.strerror}; choose another folder, or have it made readable"))
        except InputError as error:
            self._say(error)
        else:
            nothing = "" if listing["entries"] or not where else NOTHING_HERE.format(where=where)
            self._show(open=True, message=nothing, series=[], **listing)

    def pick(self, path: str) -> None:
        """Load a CT; of a folder with several series, ask which."""
        try:
            resolved = self._places.resolve(path)
        except InputError as error:
            self._say(error)
            return
        if resolved.is_file():
            self._finish(path, "")
            return
        self._show(open=True, ct=path, message="looking for DICOM series …", entries=[], series=[])
        self._in_background(lambda: _series_in(resolved), lambda found: self._choose(path, found))

    def series(self, uid: str) -> None:
        """Load that series of the folder picked."""
        self._finish(self._state.picker["ct"], uid)

    def close(self) -> None:
        """Nothing is chosen."""
        self._show(open=False)

    def _choose(self, path: str, found: Any) -> None:
        if isinstance(found, BaseException):
            self._say(found)
        elif len(found) == 1:
            self._finish(path, found[0]["uid"])
        else:
            self._show(series=found, message=f"{len(found)} series: choose the CT")

    def _finish(self, path: str, series: str) -> None:
        self.close()
        self._load(str(self._places.resolve(path)), series)

    def _say(self, error: BaseException) -> None:
        self._show(open=True, message=f"! {self._places.shown(str(error))}")

    def _show(self, **changes: Any) -> None:
        with self._state as state:
            state.picker = {**state.picker, **changes}


def _series_in(folder: Any) -> list[dict[str, str]]:
    from ModuleRegistrationLib.anatomy.dicom_series import list_series

    return [{"uid": uid, "text": text} for uid, text in list_series(folder)]


def draw_files(shown: str, first: str) -> None:
    """The button of the first step, and its dialog; in JavaScript whether it is `shown`, and the `first` thing to press."""
    client.Script(SCRIPT)
    v3.VBtn(
        "Choose a CT …",
        v_if=shown,
        block=True,
        classes="my-2",
        color="primary",
        variant=(f"{first} ? 'flat' : 'tonal'",),
        click="trigger('files_open', [''])",
        raw_attrs=["data-files"],
    )
    with (
        v3.VDialog(model_value=("picker.open",), update_modelValue="!$event && trigger('files_close')", max_width=640),
        v3.VCard(title="Choose a CT", raw_attrs=["data-files-dialog"]),
        v3.VCardText(),
    ):
        html.Div("{{ picker.message }}", v_if="picker.message", classes="text-body-1 mb-2")
        _draw_lines("one in picker.series", "one.uid", "one.text", "trigger('files_series', [one.uid])")
        with html.Div(v_if="!picker.series.length"):
            v3.VBtn(
                "Up",
                v_if="picker.up !== null",
                size="small",
                variant="tonal",
                click="trigger('files_open', [picker.up])",
                classes="mb-2",
            )
            html.Div(
                "{{ picker.where || 'In the folders that the workstation offers' }}",
                v_if="picker.entries.length",
                classes="text-medium-emphasis",
            )
            chosen = "trigger(one.kind === 'folder' ? 'files_open' : 'files_pick', [one.path])"
            _draw_lines(
                "one in picker.entries", "one.path + one.kind", "one.kind === 'folder' ? one.name + ' …' : one.name", chosen
            )
            html.Div("From the computer in front of you", classes="text-medium-emphasis mt-4")
            _draw_input("A file (NRRD, NIfTI, MetaImage)", "file", 'accept=".nrrd,.nii,.gz,.mha"')
            _draw_input("A folder of DICOM files", "folder", "webkitdirectory multiple")
            with html.Div(classes="d-flex align-center mt-2", style="gap: 12px"):
                html.Div(raw_attrs=["data-sending"])
                v3.VBtn(
                    "Cancel sending",
                    size="small",
                    variant="text",
                    style="display: none",
                    raw_attrs=["data-cancel-upload"],
                )
        v3.VBtn("Close", variant="text", classes="mt-3", click="trigger('files_close')")


def _draw_lines(each: str, key: str, text: str, click: str) -> None:
    v3.VBtn(
        f"{{{{ {text} }}}}",
        v_for=each,
        key=key,
        click=click,
        block=True,
        variant="tonal",
        classes="my-1 justify-start",
        raw_attrs=[f':data-choice="{text}"'],
    )


def _draw_input(label: str, name: str, attributes: str) -> None:
    with html.Label(classes="d-block my-1"):
        html.Div(label, classes="text-body-2")
        html.Input(type="file", raw_attrs=[f'data-upload="{name}"', *attributes.split()])
