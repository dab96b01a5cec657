"""A growing recording finished after a kill, or put out of the way: what RecordingWriter leaves becomes one file."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Optional

from CranioNavLib.errors import InputError
from CranioNavLib.files import set_aside, written_whole
from CranioNavLib.recording import pixels_beside

PAD = 40  # PLUS pads DimSize to this width, so that it can be patched in place
FRAME_DONE = re.compile(rb"Seq_Frame(\d+)_Timestamp = .*\n")  # the last field of each frame
TAKEN_BACK = re.compile(rb"Seq_Frame(\d+)_ImageStatus = INVALID\n")  # in a growing recording also behind later frames


def recover(path: str | Path) -> int:
    """Finish an interrupted recording: join the pixels beside `path` into it. Returns the number of frames.

    Raises
    ------
    InputError
        There is no interrupted recording, it holds no whole frame, or the disk cannot take the file.
    """
    target = checked_target(path)
    raw = pixels_beside(target)
    if not target.is_file():
        raise InputError(f"{target}: no such file; nothing to recover")
    if not raw.is_file() and is_whole(target):
        return _whole_frames(target, None)[0]  # it was not interrupted, or held poses only
    if not raw.is_file():
        raise InputError(f"{target}: its pixel file {raw.name} is missing; nothing to recover")
    count, samples = _whole_frames(target, raw)
    if count == 0:
        raise InputError(f"{target}: holds no whole frame; remove it and record again")
    try:
        with written_whole(target) as temporary, temporary.open("wb") as file:
            invalid = _taken_back_in(target)
            for line in _lines_of_frames(target, count):
                done = FRAME_DONE.fullmatch(line)
                if TAKEN_BACK.fullmatch(line):
                    continue
                if done and int(done[1]) in invalid:
                    file.write(taken_back(int(done[1])))
                file.write(dim_size(samples, count) if line.startswith(b"DimSize") else line)
            file.write(b"ElementDataFile = LOCAL\n")
            with raw.open("rb") as pixels:
                _copy(pixels, file, count * samples * 2)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror}; it still holds the recording, with {raw.name}") from None
    raw.unlink()
    return count


def put_aside(path: str | Path) -> Optional[Path]:
    """Make room for a recording: an earlier one is renamed (see `files.set_aside`), joined first if it was interrupted.

    Returns its new path, None if there is none.

    Raises
    ------
    InputError
        The path is none of a recording, or the folder cannot be written to.
    """
    target = checked_target(path)
    raw = pixels_beside(target)
    try:
        if raw.is_file():
            try:
                recover(target)
            except InputError:  # no whole frame, or pixels without their header: kept as they are
                set_aside(raw)
        return set_aside(target)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror}; choose a folder that exists and is writable") from None


def checked_target(path: str | Path) -> Path:
    """The path of a recording.

    Raises
    ------
    InputError
        It is none.
    """
    target = Path(path)
    if not target.name.lower().endswith(".mha"):
        raise InputError(f"{target}: recordings are written as .igs.mha; give a name with that ending")
    return target


def is_whole(path: Path) -> bool:
    """Whether a file's pixels are its own."""
    if path.is_file():
        with path.open("rb") as file:
            for line in file:
                if line.startswith(b"ElementDataFile"):
                    return line.split()[-1:] == [b"LOCAL"]
    return False


def taken_back(frame: int) -> bytes:
    """The field by which a frame's line never becomes a point."""
    return b"Seq_Frame%04d_ImageStatus = INVALID\n" % frame


def dim_size(samples: int, count: int) -> bytes:
    """The field that tells the number of frames, always as long."""
    size = f"{samples} 1 {count}" if samples else f"0 0 {count}"
    return f"DimSize = {size:<{PAD}}\n".encode("ascii")


def _copy(source: BinaryIO, target: BinaryIO, size: int) -> None:
    while size:
        data = source.read(min(size, 1 << 20))
        if not data:
            raise OSError(5, "the pixel file became shorter")
        target.write(data)
        size -= len(data)


def _whole_frames(path: Path, raw: Optional[Path]) -> tuple[int, int]:
    """Frames whose fields and pixels are both complete, and samples a line."""
    count = samples = 0
    with path.open("rb") as file:
        for line in file:
            if line.startswith(b"ElementDataFile"):
                break
            if line.startswith(b"DimSize"):
                samples = int(line.split()[2])
            count += FRAME_DONE.fullmatch(line) is not None
    return (min(count, raw.stat().st_size // (2 * samples)) if raw is not None and samples else count), samples


def _lines_of_frames(path: Path, count: int) -> Iterator[bytes]:
    """The header up to and with the fields of frame count - 1."""
    with path.open("rb") as file:
        for line in file:
            yield line
            done = FRAME_DONE.fullmatch(line)
            if done and int(done[1]) == count - 1:
                return


def _taken_back_in(path: Path) -> set[int]:
    """Frames that a header says to be invalid, wherever it does."""
    with path.open("rb") as file:
        header = iter(file.readline, b"")
        lines = itertools.takewhile(lambda line: not line.startswith(b"ElementDataFile"), header)
        return {int(found[1]) for found in map(TAKEN_BACK.fullmatch, lines) if found}
