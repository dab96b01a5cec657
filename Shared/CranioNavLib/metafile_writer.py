"""Writing sequence metafiles: whole at once, or frame by frame so that a killed process loses next to nothing.

A metafile's frame fields stand before its pixels, so a growing recording of lines cannot be one file. RecordingWriter
keeps the fields in `NAME.igs.mha` and the pixels in `NAME.part.raw`, which the former names. After every frame the pair
is a valid metafile that SimpleITK and 3D Slicer read; `close` (or `recover`, after a kill) joins it into one file. A
recording of poses only has no pixels, and is one file all along.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping, Sized
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Optional

import numpy as np
import numpy.typing as npt

from CranioNavLib.errors import InputError
from CranioNavLib.files import set_aside, written_whole
from CranioNavLib.metafile_reader import is_transform
from CranioNavLib.recording import Acquisition, Recording, pixels_beside
from CranioNavLib.rigid import Array

PAD = 40  # PLUS pads DimSize to this width, so that it can be patched in place
LONGEST_VALUE = 900  # IGSIO reads at most 999 characters a line
FRAME_DONE = re.compile(rb"Seq_Frame(\d+)_Timestamp = .*\n")  # the last field of each frame


def write_recording(path: str | Path, recording: Recording) -> None:
    """`recording` as an .igs.mha file, uncompressed, whole or not at all.

    Raises
    ------
    InputError
        The path does not end in .mha, cannot be written, or arrays of the recording disagree in length.
    """
    target = _checked_target(path)
    count, samples = recording.lines.shape
    _check_lengths(recording)
    with written_whole(target) as temporary, temporary.open("wb") as file:
        file.write(_global_header(samples, count, recording.acquisition, recording.fields))
        for index in range(count):
            transforms = {"ProbeToReference": recording.probe_to_reference[index]}
            transforms.update((name, poses[index]) for name, poses in recording.other_transforms.items())
            statuses = {"ProbeToReference": recording.statuses[index]}
            statuses.update((name, states[index]) for name, states in recording.other_statuses.items())
            time, point = float(recording.timestamps_s[index]), int(recording.palpation_points[index])
            file.write(_frame_fields(index, time, transforms, statuses, point))
        file.write(b"ElementDataFile = LOCAL\n")
        for start in range(0, count, 1024):
            file.write(np.ascontiguousarray(recording.lines[start : start + 1024], dtype="<i2").tobytes())


class RecordingWriter:
    """A recording on disk that grows by one frame at a time; `with` joins the journal into the file.

    Every frame is handed to the operating system before `append` returns, so killing the process loses no finished
    frame. Memory does not grow with the recording.

    Parameters
    ----------
    path : path
        The .igs.mha file, begun with the first frame; pixels stand in a file beside it until `close`.
    samples : int
        Samples a line; 0 for poses only.
    acquisition : Acquisition
        How the lines are taken; not needed for poses only.
    fields : mapping
        Further global fields (name to text), e.g. what time zero is.
    """

    def __init__(
        self,
        path: str | Path,
        samples: int = 0,
        acquisition: Optional[Acquisition] = None,
        fields: Optional[Mapping[str, str]] = None,
    ) -> None:
        if samples and acquisition is None:
            raise InputError("a recording of A-lines needs their acquisition (sampling and transducer frequency)")
        self.path, self.samples, self.count = _checked_target(path), samples, 0
        self._last_time = -np.inf
        self._raw_path = pixels_beside(self.path)
        if self._raw_path.exists() and self._raw_path.stat().st_size and not _is_whole(self.path):
            raise InputError(f"{self.path} holds an interrupted recording; recover or remove it, or record to another name")
        self._header = _global_header(samples, 0, acquisition, fields or {})
        self._tail = f"ElementDataFile = {self._raw_path.name if samples else 'LOCAL'}\n".encode("ascii")
        self._fields: Optional[int] = None
        self._raw: Optional[int] = None
        try:
            # An older recording of that name is safe until the first frame of the new one.
            self._fields = os.open(self.path, os.O_WRONLY | os.O_CREAT, 0o666)
            if samples:
                self._raw = os.open(self._raw_path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        except OSError as error:
            raise InputError(f"cannot write {self.path}: {error.strerror}; choose a folder that exists and is writable") from None

    def append(
        self,
        timestamp_s: float,
        transforms: Mapping[str, Optional[Array]],
        statuses: Optional[Mapping[str, str]] = None,
        line: Optional[npt.NDArray[np.int16]] = None,
        palpation_point: int = -1,
    ) -> None:
        """Add one frame.

        Parameters
        ----------
        timestamp_s : float
            Not before that of the frame before.
        transforms : mapping
            Name (`ProbeToReference`) to 4x4 matrix in mm; None or NaN: no pose, only its status is written.
        statuses : mapping
            Name to status; where absent OK with a pose, MISSING without.
        line : int16 array, shape (samples,)
            The RF line; None only in a recording of poses.
        palpation_point : int
            Point of the protocol, -1 for none.
        """
        if self._fields is None:
            raise InputError(f"{self.path}: the recording is closed; start a new one")
        if not np.isfinite(timestamp_s) or timestamp_s < self._last_time:
            raise InputError(f"{self.path}: frame {self.count} is at {timestamp_s} s, the one before at {self._last_time} s")
        size = 0 if line is None else line.size
        if size != self.samples:
            raise InputError(f"{self.path}: frame {self.count} has {size} samples, expected {self.samples}")
        fields = _frame_fields(self.count, timestamp_s, transforms, statuses or {}, palpation_point)
        try:
            if self.count == 0:
                os.ftruncate(self._fields, 0)
                _write_at(self._fields, self._header + self._tail, 0)
                self._end = len(self._header)
            # Order matters: pixels, then fields, then the count; of the fields first what comes behind the old last line,
            # then what takes its place. A kill in between leaves files that are still right.
            if line is not None and self._raw is not None:
                _write_at(self._raw, np.ascontiguousarray(line, dtype="<i2").tobytes(), self.count * 2 * self.samples)
            added, cut = fields + self._tail, len(self._tail)
            _write_at(self._fields, added[cut:], self._end + cut)
            _write_at(self._fields, added[:cut], self._end)
            _write_at(self._fields, _dim_size(self.samples, self.count + 1), self._header.index(b"DimSize = "))
        except OSError as error:
            raise InputError(
                f"cannot go on writing {self.path}: {error.strerror}; {self.count} frames are safe, free space and record anew"
            ) from None
        self._end += len(fields)
        self.count += 1
        self._last_time = timestamp_s

    def close(self, invalid: Collection[int] = ()) -> None:
        """Join fields and pixels into one file; may be called twice. A recording without frames leaves no file.

        The frames `invalid` get the ImageStatus INVALID: their lines are kept, and never become points.
        """
        if self._fields is None:
            return
        empty = self.count == 0 and os.fstat(self._fields).st_size == 0
        for handle in (self._fields, self._raw):
            if handle is not None:
                os.close(handle)
        joined = self._raw is None
        self._fields = self._raw = None
        if empty:
            self.path.unlink()
        if self.count == 0:
            self._raw_path.unlink(missing_ok=True)
        elif not joined:
            recover(self.path, invalid)

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def recover(path: str | Path, invalid: Collection[int] = ()) -> int:
    """Finish an interrupted recording: join the pixels beside `path` into it. Returns the number of frames.

    The frames `invalid` get the ImageStatus INVALID.

    Raises
    ------
    InputError
        There is no interrupted recording, it holds no whole frame, or the disk cannot take the file.
    """
    target = _checked_target(path)
    raw = pixels_beside(target)
    if not target.is_file():
        raise InputError(f"{target}: no such file; nothing to recover")
    if not raw.is_file() and _is_whole(target):
        return _whole_frames(target, None)[0]  # it was not interrupted, or held poses only
    if not raw.is_file():
        raise InputError(f"{target}: its pixel file {raw.name} is missing; nothing to recover")
    count, samples = _whole_frames(target, raw)
    if count == 0:
        raise InputError(f"{target}: holds no whole frame; remove it and record again")
    try:
        with written_whole(target) as temporary, temporary.open("wb") as file:
            for line in _lines_of_frames(target, count):
                done = FRAME_DONE.fullmatch(line)
                if done and int(done[1]) in invalid:
                    file.write(b"Seq_Frame%s_ImageStatus = INVALID\n" % done[1])
                file.write(_dim_size(samples, count) if line.startswith(b"DimSize") else line)
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
    target = _checked_target(path)
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


def _is_whole(path: Path) -> bool:
    """Whether a file's pixels are its own."""
    if path.is_file():
        with path.open("rb") as file:
            for line in file:
                if line.startswith(b"ElementDataFile"):
                    return line.split()[-1:] == [b"LOCAL"]
    return False


def _checked_target(path: str | Path) -> Path:
    target = Path(path)
    if not target.name.lower().endswith(".mha"):
        raise InputError(f"{target}: recordings are written as .igs.mha; give a name with that ending")
    return target


def _write_at(handle: int, data: bytes, offset: int) -> None:
    while data:
        written = os.pwrite(handle, data, offset) if hasattr(os, "pwrite") else _seek_write(handle, data, offset)
        data, offset = data[written:], offset + written


def _seek_write(handle: int, data: bytes, offset: int) -> int:
    os.lseek(handle, offset, os.SEEK_SET)
    return os.write(handle, data)


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


def _dim_size(samples: int, count: int) -> bytes:
    size = f"{samples} 1 {count}" if samples else f"0 0 {count}"
    return f"DimSize = {size:<{PAD}}\n".encode("ascii")


def _global_header(samples: int, count: int, acquisition: Optional[Acquisition], fields: Mapping[str, str]) -> bytes:
    kind = "MET_SHORT" if samples else "MET_UCHAR"
    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "AnatomicalOrientation = RAI",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CenterOfRotation = 0 0 0",
        "CompressedData = False",
        _dim_size(samples, count).decode("ascii").rstrip("\n"),
        "ElementNumberOfChannels = 1",
        "ElementSpacing = 1 1 1",
        f"ElementType = {kind}",
        "Kinds = domain domain list",
        "Offset = 0 0 0",
        "TransformMatrix = 1 0 0 0 1 0 0 0 1",
    ]
    if samples and acquisition is not None:
        lines += [
            "UltrasoundImageOrientation = FM",
            "UltrasoundImageType = RF_REAL",
            f"SamplingFrequencyHz = {acquisition.sampling_hz!r}",
            f"TransducerFrequencyHz = {acquisition.transducer_hz!r}",
            f"ForerunLengthMm = {acquisition.forerun_length_mm!r}",
            f"ForerunSpeedOfSoundMps = {acquisition.forerun_speed_m_s!r}",
        ]
    for name, value in fields.items():
        if not re.fullmatch(r"[A-Za-z]\w*", name) or "\n" in value or not value.isascii() or len(value) > LONGEST_VALUE:
            raise InputError(f"field {name!r} cannot be stored; names are words, values one line of at most 900 ASCII characters")
        lines.append(f"{name} = {value}")
    return ("\n".join(lines) + "\n").encode("ascii")


def _frame_fields(
    index: int, timestamp_s: float, transforms: Mapping[str, Optional[Array]], statuses: Mapping[str, str], palpation_point: int
) -> bytes:
    start = f"Seq_Frame{index:04d}_"
    lines = []
    for name in [*transforms, *(name for name in statuses if name not in transforms)]:
        if not is_transform(f"{name}Transform"):
            raise InputError(f"transform name {name!r} is not of the form ProbeToReference; rename it")
        matrix = transforms.get(name)
        posed = matrix is not None and bool(np.isfinite(matrix).all())
        status = statuses.get(name, "OK" if posed else "MISSING")
        # A pose that is not OK stays out of the file: several readers load it as valid whatever its status.
        if posed and matrix is not None and status == "OK":
            lines.append(f"{start}{name}Transform = {' '.join(map(repr, np.asarray(matrix, float).ravel().tolist()))} ")
        lines.append(f"{start}{name}TransformStatus = {status if posed or status != 'OK' else 'MISSING'}")
    if palpation_point >= 0:
        lines.append(f"{start}PalpationPoint = {palpation_point}")
    lines.append(f"{start}Timestamp = {float(timestamp_s)!r}")
    return ("\n".join(lines) + "\n").encode("ascii")


def _check_lengths(recording: Recording) -> None:
    count = len(recording.lines)
    arrays: dict[str, Sized] = {
        "probe_to_reference": recording.probe_to_reference,
        "statuses": recording.statuses,
        "timestamps_s": recording.timestamps_s,
        "palpation_points": recording.palpation_points,
        **recording.other_transforms,
    }
    for name, values in arrays.items():
        if len(values) != count:
            raise InputError(f"recording: {len(values)} {name} for {count} lines; they must be as many")
    if np.any(np.diff(recording.timestamps_s) < 0) or not np.isfinite(recording.timestamps_s).all():
        raise InputError("recording: the time stamps must be finite and in order")
