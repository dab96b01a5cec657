"""Files that are either whole or not there: written to a temporary name, then renamed."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from CranioNavLib.errors import InputError


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path`; it becomes `path` when the block ends without an exception.

    The temporary name keeps the full suffix, because writers choose their format by it.

    Raises
    ------
    InputError
        The folder is missing or cannot be written to, or the path is a folder itself.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"cannot write {path}: it is a folder; give the name of a file in it")
    try:
        # "a.igs.mha" -> "a.", ".igs.mha": the suffixes after the first dot stay together
        stem, dot, suffix = path.name.partition(".")
        handle, name = tempfile.mkstemp(prefix=f".{stem}-", suffix=dot + suffix, dir=path.parent)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; choose a folder that exists and is writable") from None
    os.close(handle)
    temporary = Path(name)
    umask = os.umask(0)
    os.umask(umask)
    temporary.chmod(0o666 & ~umask)  # mkstemp makes files private; the result is an ordinary file
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """`text` as a UTF-8 file, whole or not at all."""
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def output_folder(path: str | Path) -> Path:
    """The folder, made if missing and shown to be writable.

    Raises
    ------
    InputError
        It cannot be made or written to.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write into {folder}: {error.strerror}; choose another output folder") from None
    return folder


def set_aside(path: str | Path) -> Path | None:
    """Rename an existing file to the next free number ("a.igs.mha" -> "a-1.igs.mha"); its new path, None if there is no file."""
    path = Path(path)
    if not path.exists():
        return None
    stem, dot, suffix = path.name.partition(".")
    number = 1
    while (aside := path.with_name(f"{stem}-{number}{dot}{suffix}")).exists():
        number += 1
    path.rename(aside)
    return aside
