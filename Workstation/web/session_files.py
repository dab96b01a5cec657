"""Files that the page may see: the session's folder and the data folder, by name only; and files sent by the browser."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from CranioNavLib.errors import InputError

SESSION, DATA, UPLOADS = "session", "data", "uploads"  # how the page calls the two folders; where what is sent goes
IMAGES = (".nrrd", ".nii", ".nii.gz", ".mha")
SLICES = (".dcm", ".ima", "")  # of DICOM files, which often have none
LARGEST_BYTES = 2_000_000_000  # of one file: a head CT in 0.3 mm slices has 0.5 GB
MOST_FILES = 5000  # in one folder that is sent
MOST_BYTES = 8_000_000_000  # of all that is sent
PREAMBLE = 128  # bytes before the word DICM


@dataclass(frozen=True)
class Entry:
    """One line of a listing."""

    name: str
    path: str  # as the page calls it
    kind: str  # "folder", "ct" (an image file or a folder of slices)


class Places:
    """Translates between the page's names and this computer's paths, and keeps the page within the two folders.

    Not `confined`, for a page on this computer alone, a path may also be typed in full.
    """

    def __init__(self, session: Any, data: Path | None = None, confined: bool = False) -> None:
        self._session, self._data = session, None if data is None else Path(data).resolve()
        self._confined = confined

    def roots(self) -> dict[str, Path]:
        """The folders that the page may look into."""
        roots = {SESSION: Path(self._session.folder)}
        return roots if self._data is None else {**roots, DATA: self._data}

    def shown(self, text: str) -> str:
        """A text for the page: no path of this computer is told."""
        if os.sep not in text:  # nearly every text, and there are hundreds
            return text
        for name, folder in self.roots().items():
            for spelling in {str(folder), str(folder.resolve())}:
                text = text.replace(spelling, name)
        return text.replace(str(Path.home()), "~")

    def meant(self, text: str) -> str:
        """The path that the page means; of names that lead out of the two folders nothing is left but the name itself."""
        name, _, rest = text.partition("/")
        if name not in self.roots():
            return text
        try:
            return str(self.resolve(text))
        except InputError:
            return f"{name}/{Path(rest).name}"

    def typed(self, text: str) -> str:
        """The path that was typed or pasted into a field for one, without the quotes, blanks or `file://` that came with it;
        a relative one that is not there is meant in the session's folder. Confined, any other than of the two folders is
        looked for in the session's by its name alone."""
        text = text.strip().strip("\"'").strip()
        if text.startswith("file://"):
            text = unquote(text[len("file://") :])
        if not text or text.partition("/")[0] in self.roots():
            return self.meant(text)
        if not self._confined:
            path = Path.home() / text[2:] if text == "~" or text.startswith("~/") else Path(text)
            return str(path if path.is_absolute() or path.exists() else Path(self._session.folder) / path)
        return str(Path(self._session.folder) / (re.split(r"[/\\]", text)[-1].strip(".") or UPLOADS))

    def resolve(self, text: str) -> Path:
        """The path of a name that the page gave.

        Raises
        ------
        InputError
            It is not in the session's or the data folder, links followed.
        """
        name, _, rest = text.partition("/")
        roots = self.roots()
        if name not in roots:
            raise InputError(f"{text}: choose a file of the {' or the '.join(roots)} folder")
        root, path = roots[name].resolve(), (roots[name] / rest).resolve()
        if path != root and root not in path.parents:
            raise InputError(f"{text}: outside the {name} folder; choose another file")
        return path

    def listing(self, where: str) -> dict[str, Any]:
        """What there is to choose in a folder ("": the two folders themselves): `where`, `up` and `entries`."""
        if not where:
            entries = [Entry(name, name, "folder") for name, folder in self.roots().items() if folder.is_dir()]
            return {"where": "", "up": None, "entries": [vars(entry) for entry in entries]}
        folder = self.resolve(where)
        if not folder.is_dir():
            raise InputError(f"{where}: no such folder; choose another")
        found = []
        for path in sorted(folder.iterdir(), key=lambda one: (one.is_file(), one.name.lower())):
            kind = self._kind(path, f"{where}/{path.name}")
            if kind:
                found.append(Entry(path.name, f"{where}/{path.name}", kind))
        if holds_slices(folder):
            found.insert(0, Entry("the DICOM series in this folder", where, "ct"))
        return {"where": where, "up": where.rpartition("/")[0], "entries": [vars(entry) for entry in found]}

    def _kind(self, path: Path, shown: str) -> str:
        if path.name.startswith("."):
            return ""
        try:
            resolved = self.resolve(shown)
        except (InputError, OSError):
            return ""  # a link that leads out
        if resolved.is_dir():
            return "folder"
        return "ct" if path.name.lower().endswith(IMAGES) else ""

    async def receive(self, folder: str, name: str, chunks: AsyncIterator[bytes]) -> str:
        """Keep a file that the browser sends; `folder` is "" or the name of the folder it stood in. Its name for the page.

        Raises
        ------
        InputError
            A name that is none, a kind that is no CT, too large, or too many.
        """
        parts = [UPLOADS, *([_plain_name(folder)] if folder else []), _plain_name(name)]
        if not parts[-1].lower().endswith(IMAGES) and not (folder and Path(parts[-1]).suffix.lower() in (*SLICES, *_NUMBERS)):
            raise InputError(f"{parts[-1]}: no CT; send {', '.join(IMAGES)} or a folder of DICOM files")
        target = Path(self._session.folder).joinpath(*parts)
        self.resolve("/".join([SESSION, *parts[:-1]]))  # the folder itself may be a link
        target.parent.mkdir(parents=True, exist_ok=True)
        present, size = _contents(Path(self._session.folder) / UPLOADS)
        if present >= MOST_FILES or size >= MOST_BYTES:
            raise InputError(f"the session holds {present} files that were sent; remove some before sending more")
        await _write_new(target, chunks)
        return "/".join([SESSION, *parts])


_NUMBERS = tuple(f".{digit}" for digit in range(10))


def holds_slices(folder: Path) -> bool:
    """Whether a folder's first plain file looks like DICOM."""
    for path in sorted(folder.iterdir())[:50]:
        if path.name.startswith(".") or not path.is_file() or path.name.lower().endswith((*IMAGES, ".json")):
            continue
        with path.open("rb") as file:
            return file.read(PREAMBLE + 4)[PREAMBLE:] == b"DICM"
    return False


def _plain_name(name: str) -> str:
    """A file's name without any way to another folder."""
    if not name or name.startswith(".") or len(name) > 200 or re.search(r"[\x00-\x1f/\\:]", name):
        raise InputError(f"{name[:60]!r} is no plain file name; rename the file and send it again")
    return name


def _contents(folder: Path) -> tuple[int, int]:
    sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()] if folder.is_dir() else []
    return len(sizes), sum(sizes)


async def _write_new(target: Path, chunks: AsyncIterator[bytes]) -> None:
    """Write beside the target, then take its name; never through a link, and nothing half-sent is left."""
    partial = target.with_name(f".{target.name}.part")
    partial.unlink(missing_ok=True)
    handle = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0), stat.S_IRUSR | stat.S_IWUSR)
    try:
        with os.fdopen(handle, "wb") as file:
            written = 0
            async for chunk in chunks:
                written += len(chunk)
                if written > LARGEST_BYTES:
                    raise InputError(f"{target.name}: larger than {LARGEST_BYTES / 1e9:.0f} GB; send a smaller file")
                file.write(chunk)
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
