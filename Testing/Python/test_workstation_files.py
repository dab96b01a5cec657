"""Files of the workstation as the page sees them: by name, in two folders, and never beyond."""

from __future__ import annotations

import asyncio
import urllib.error
import urllib.request
import uuid
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from CranioNavLib.errors import InputError

from Testing.Python import workstation_user as user_module
from Workstation.web import session_files
from Workstation.web.session_files import Places


@pytest.fixture
def places(tmp_path):
    for name in ("session", "data", "data/patient", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / "data" / "head.nrrd").write_bytes(b"x")
    (tmp_path / "data" / "notes.txt").write_text("x")
    (tmp_path / "data" / ".hidden.nrrd").write_text("x")
    (tmp_path / "data" / "patient" / "slice").write_bytes(bytes(128) + b"DICM")
    (tmp_path / "elsewhere" / "secret.nrrd").write_bytes(b"x")
    (tmp_path / "data" / "way-out").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "data" / "link.nrrd").symlink_to(tmp_path / "elsewhere" / "secret.nrrd")
    return Places(SimpleNamespace(folder=tmp_path / "session"), tmp_path / "data")


def send(places: Places, name: str, content: bytes = b"abc", folder: str = "") -> str:
    async def chunks() -> AsyncIterator[bytes]:
        yield content

    return asyncio.run(places.receive(folder, name, chunks()))


def test_a_listing_names_what_can_be_chosen_and_no_path_of_the_computer(places, tmp_path):
    assert [entry["name"] for entry in places.listing("")["entries"]] == ["session", "data"]
    listing = places.listing("data")
    assert [(entry["name"], entry["kind"]) for entry in listing["entries"]] == [("patient", "folder"), ("head.nrrd", "ct")]
    assert str(tmp_path) not in repr(listing)
    inside = places.listing("data/patient")
    assert (inside["up"], inside["entries"][0]["path"], inside["entries"][0]["kind"]) == ("data", "data/patient", "ct")


@pytest.mark.parametrize("name", ["data/../elsewhere", "data/way-out", "data/link.nrrd", "/etc", "elsewhere", "data/../../.."])
def test_nothing_beyond_the_two_folders_is_reached(places, name):
    with pytest.raises(InputError, match="outside the data folder|choose a file of"):
        places.resolve(name)


def test_texts_for_the_page_tell_no_path_and_come_back_as_they_went(places, tmp_path):
    path = str(tmp_path / "session" / "palpation.igs.mha")
    assert places.shown(f"recording into {path}") == "recording into session/palpation.igs.mha"
    assert places.meant("session/palpation.igs.mha") == path
    assert places.shown(f"no CT at {tmp_path / 'data' / 'x'}") == "no CT at data/x"
    assert places.shown(f"{Path.home()}/x") == "~/x"
    assert places.meant("session/../elsewhere/secret.nrrd") == "session/secret.nrrd"


def test_a_file_that_is_sent_lies_in_the_sessions_folder(places, tmp_path):
    assert send(places, "head.nii.gz") == "session/uploads/head.nii.gz"
    assert (tmp_path / "session" / "uploads" / "head.nii.gz").read_bytes() == b"abc"
    assert send(places, "IM0001", folder="series") == "session/uploads/series/IM0001"
    assert send(places, "1.2.840.5", folder="series") == "session/uploads/series/1.2.840.5"


@pytest.mark.parametrize(
    "name",
    ["../head.nrrd", "/etc/head.nrrd", "a/b.nrrd", "..", ".head.nrrd", "", "a\\b.nrrd", "a\0.nrrd", "C:head.nrrd", "a" * 300],
)
def test_a_name_that_leads_elsewhere_is_refused(places, tmp_path, name):
    with pytest.raises(InputError, match="no plain file name"):
        send(places, name)
    if name:
        with pytest.raises(InputError, match="no plain file name"):
            send(places, "IM1", folder=name)
    assert not list((tmp_path / "session").rglob("*.nrrd"))


@pytest.mark.parametrize("name", ["run.sh", "report.html", "head.nrrd.exe", "session.json"])
def test_only_cts_are_taken(places, name):
    with pytest.raises(InputError, match="no CT; send"):
        send(places, name)


def test_a_file_that_is_too_large_leaves_nothing(places, tmp_path, monkeypatch):
    monkeypatch.setattr(session_files, "LARGEST_BYTES", 10)
    with pytest.raises(InputError, match="larger than"):
        send(places, "head.nrrd", b"12345678901")
    assert list((tmp_path / "session" / "uploads").iterdir()) == []
    monkeypatch.setattr(session_files, "MOST_FILES", 1)
    send(places, "a.nrrd")
    with pytest.raises(InputError, match="holds 1 files"):
        send(places, "b.nrrd")


def test_nothing_is_written_through_a_link(places, tmp_path):
    (tmp_path / "session" / "uploads").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="outside the session folder"):
        send(places, "head.nrrd")
    with pytest.raises(InputError, match="outside the session folder"):
        send(places, "IM1", folder="series")
    assert not (tmp_path / "elsewhere" / "series").exists()
    (tmp_path / "session" / "uploads").unlink()
    (tmp_path / "session" / "uploads").mkdir()
    (tmp_path / "session" / "uploads" / "secret.nrrd").symlink_to(tmp_path / "elsewhere" / "secret.nrrd")
    send(places, "secret.nrrd", b"mine")
    assert (tmp_path / "elsewhere" / "secret.nrrd").read_bytes() == b"x"


def write_series(folder: Path, number: int, head: Any) -> None:
    """A CT as a scanner writes it, one file a slice."""
    import SimpleITK as sitk

    folder.mkdir(parents=True, exist_ok=True)
    image = sitk.GetImageFromArray(head.hu[::4, ::4, ::4])
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for index in range(image.GetDepth()):
        piece = image[:, :, index]
        for tag, value in {
            "0008|0060": "CT",
            "0008|103e": f"head {number}",
            "0020|000e": f"1.2.3.{number}",
            "0020|000d": "1.2.3",
            "0020|0011": str(number),
            "0020|0032": f"0\\0\\{4 * index}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0008|0018": f"1.2.3.{number}.{index + 1}",
        }.items():
            piece.SetMetaData(tag, value)
        piece.SetSpacing((4.0, 4.0))
        writer.SetFileName(str(folder / f"{number}-{index}.dcm"))
        writer.Execute(piece)


@pytest.mark.skipif(not Path(user_module.BROWSER).exists(), reason="no Chromium on this machine")
@pytest.mark.slow
def test_a_ct_is_chosen_by_series_or_sent_and_the_page_tells_no_path(tmp_path):
    from CranioNavLib.phantom.case_writer import write_volume
    from CranioNavLib.phantom.synthetic_head import synthetic_head

    head, _ = synthetic_head()
    (tmp_path / "data").mkdir()
    for number in (1, 2):
        write_series(tmp_path / "data" / "patient", number, head)
    write_volume(tmp_path / "mine.nrrd", head)
    with (
        user_module.served(tmp_path / "session", True, "--data", str(tmp_path / "data")) as (url, _),
        user_module.browsing() as user,
    ):
        with pytest.raises(urllib.error.HTTPError, match="403"):  # nobody has opened the page
            urllib.request.urlopen(urllib.request.Request(f"{url}upload?name=a.nrrd&window=x", data=b"x"))
        user.open(url)
        dialog = user.page.locator("[data-files-dialog]")
        user.page.locator("[data-files]").click()
        for choice in ("data …", "patient …", "the DICOM series in this folder"):
            dialog.get_by_role("button", name=choice, exact=True).click()
        dialog.get_by_text("2 series: choose the CT").wait_for()
        dialog.get_by_role("button", name="head 2").click()
        user.sees("ct", r"series 2 head 2: \d+ × \d+ × \d+ voxels")
        user.page.locator("[data-files]").click()
        dialog.locator("[data-upload=file]").set_input_files({"name": "x.exe", "mimeType": "", "buffer": b"x"})
        dialog.get_by_text("no CT; send").wait_for()
        dialog.locator("[data-upload=file]").set_input_files(tmp_path / "mine.nrrd")
        user.sees("ct", f"{head.hu.shape[2]} × {head.hu.shape[1]} × {head.hu.shape[0]} voxels")
        told = user.page.content() + user.page.evaluate("JSON.stringify(trame.state.state)")
        for secret in (str(tmp_path), str(Path.home()), str(Path.cwd()), str(user_module.ROOT)):
            assert secret not in told
    assert (tmp_path / "session" / "uploads" / "mine.nrrd").is_file()


@pytest.mark.parametrize("pasted", ["{}", " {} ", '"{}"', "'{}'", "file://{}"])
def test_a_pasted_path_is_taken_without_what_came_with_it(places, tmp_path, pasted):
    path = str(tmp_path / "elsewhere")
    assert places.typed(pasted.format(path)) == path
    assert places.typed(pasted.format("~/head")) == str(Path.home() / "head")
    assert places.typed("file:///a%20b") == "/a b"
    assert places.typed("scan.igs.mha") == str(tmp_path / "session" / "scan.igs.mha")
    assert places.typed("  ") == ""


def test_a_folder_without_a_ct_or_that_may_not_be_read_says_so(places, tmp_path, monkeypatch):
    from trame.app import get_server

    from Workstation.web.session_files_view import FilesDialog

    (tmp_path / "data" / "patient" / "slice").unlink()
    server = get_server(f"files-{uuid.uuid4()}", client_type="vue3")
    dialog = FilesDialog(server, places, lambda path, series: None, lambda compute, finished: None)
    dialog.open("data/patient")
    assert "Nothing in data/patient is a CT" in server.state.picker["message"]
    dialog.open("data")
    assert server.state.picker["message"] == ""

    def locked(where: str) -> None:
        raise PermissionError(13, "Permission denied", str(tmp_path))

    monkeypatch.setattr(places, "listing", locked)
    dialog.open("data/patient")
    assert server.state.picker["message"].startswith("! data/patient cannot be read: Permission denied; choose another")


def test_a_typed_path_leads_nowhere_else_once_the_page_is_served_to_others(places, tmp_path):
    elsewhere = str(tmp_path / "elsewhere" / "secret.nrrd")
    assert places.typed(elsewhere) == elsewhere
    confined = Places(SimpleNamespace(folder=tmp_path / "session"), tmp_path / "data", confined=True)
    assert confined.typed("data/head.nrrd") == str(tmp_path / "data" / "head.nrrd")
    for text in (
        elsewhere,
        "../elsewhere/secret.nrrd",
        "data/../elsewhere/secret.nrrd",
        "~/secret.nrrd",
        "c:\\\\secret.nrrd",
        "..",
    ):
        assert Path(confined.typed(text)).parent in (tmp_path / "session", Path("data")), text
    assert confined.typed("") == ""
