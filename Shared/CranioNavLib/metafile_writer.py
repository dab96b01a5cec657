"""Writing sequence metafiles: whole at once, or frame by frame so that a killed process loses next to nothing.

A metafile's frame fields stand before its pixels, so a growing recording of lines cannot be one file. RecordingWriter
keeps the fields in `NAME.igs.mha` and the pixels in `NAME.part.raw`, which the former names. After every frame the pair
is a valid metafile that SimpleITK and 3D Slicer read; `close` (or `recover`, after a kill) joins it into one file. A
recording of poses only has no pixels, and is one file all along.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping, Sized
from pathlib import Path
from types import TracebackType
from typing import Optional

import numpy as np
import numpy.typing as npt

from CranioNavLib.errors import InputError
from CranioNavLib.files import written_whole
from CranioNavLib.metafile_reader import is_transform
from CranioNavLib.metafile_recovery import checked_target, dim_size, is_whole, recover, taken_back
from CranioNavLib.recording import Acquisition, Recording, pixels_beside
from CranioNavLib.rigid import Array

LONGEST_VALUE = 900  # IGSIO reads at most 999 characters a line


def write_recording(path: str | Path, recording: Recording) -> None:
    """`recording` as an .igs.mha file, uncompressed, whole or not at all.

    Raises
    ------
    InputError
        The path does not end in .mha, cannot be written, or arrays of the recording disagree in length.
    """
    target = checked_target(path)
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
        self.path, self.samples, self.count = checked_target(path), samples, 0
        self._last_time = -np.inf
        self._raw_path = pixels_beside(self.path)
        if self._raw_path.exists() and self._raw_path.stat().st_size and not is_whole(self.path):
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
        invalid: bool = False,
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
        invalid : bool
            As for `mark_invalid`.
        """
        if self._fields is None:
            raise InputError(f"{self.path}: the recording is closed; start a new one")
        if not np.isfinite(timestamp_s) or timestamp_s < self._last_time:
            raise InputError(f"{self.path}: frame {self.count} is at {timestamp_s} s, the one before at {self._last_time} s")
        size = 0 if line is None else line.size
        if size != self.samples:
            raise InputError(f"{self.path}: frame {self.count} has {size} samples, expected {self.samples}")
        fields = _frame_fields(self.count, timestamp_s, transforms, statuses or {}, palpation_point)
        fields = (taken_back(self.count) if invalid else b"") + fields
        try:
            if self.count == 0:
                os.ftruncate(self._fields, 0)
                _write_at(self._fields, self._header + self._tail, 0)
                self._end = len(self._header)
            # Order matters: pixels, then fields, then the count. A kill in between leaves files that are still right.
            if line is not None and self._raw is not None:
                _write_at(self._raw, np.ascontiguousarray(line, dtype="<i2").tobytes(), self.count * 2 * self.samples)
            self._write_fields(self._fields, fields)
            _write_at(self._fields, dim_size(self.samples, self.count + 1), self._header.index(b"DimSize = "))
        except OSError as error:
            raise self._cannot_go_on(error) from None
        self._end += len(fields)
        self.count += 1
        self._last_time = timestamp_s

    def mark_invalid(self, frames: Collection[int]) -> None:
        """Frames written before get the ImageStatus INVALID, on the disk at once: their lines are kept, and never become points.

        Raises
        ------
        InputError
            The disk takes no more.
        """
        if self._fields is None or not frames:
            return
        marks = b"".join(map(taken_back, sorted(frames)))
        try:
            self._write_fields(self._fields, marks)
        except OSError as error:
            raise self._cannot_go_on(error) from None
        self._end += len(marks)

    def _write_fields(self, handle: int, fields: bytes) -> None:
        """Put fields before the last line: first what comes behind that line, then what takes its place, so that a kill in
        between leaves the file as it was."""
        added, cut = fields + self._tail, len(self._tail)
        _write_at(handle, added[cut:], self._end + cut)
        _write_at(handle, added[:cut], self._end)

    def _cannot_go_on(self, error: OSError) -> InputError:
        return InputError(
            f"cannot go on writing {self.path}: {error.strerror}; {self.count} frames are safe, free space and record anew"
        )

    def close(self) -> None:
        """Join fields and pixels into one file; may be called twice. A recording without frames leaves no file."""
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
            recover(self.path)

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _write_at(handle: int, data: bytes, offset: int) -> None:
    while data:
        written = os.pwrite(handle, data, offset) if hasattr(os, "pwrite") else _seek_write(handle, data, offset)
        data, offset = data[written:], offset + written


def _seek_write(handle: int, data: bytes, offset: int) -> int:
    os.lseek(handle, offset, os.SEEK_SET)
    return os.write(handle, data)


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
        dim_size(samples, count).decode("ascii").rstrip("\n"),
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
