"""Reading sequence metafiles: header, frame fields, pixels, each checked and refused by name."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from CranioNavLib.errors import InputError
from CranioNavLib.recording import Acquisition, Recording, pixels_beside
from CranioNavLib.rigid import LARGEST_COORDINATE_MM, ORTHONORMAL_TOLERANCE, Array

FRAME_FIELD = re.compile(r"seq_frame(\d+)_(\w+)", re.IGNORECASE)
TRANSFORM_NAME = re.compile(r"\w+To[^\Wa-z]\w*Transform")  # IGSIO: one "To", followed by no lower-case letter
PIXEL_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
LONGEST_LINE = 65536  # bytes; a header line beyond this means that the file is something else
SAMPLING_RANGE_HZ = (1e5, 1e10)  # a value outside is in MHz or kHz, or not a rate
PROBE = "probetoreference"
# Global fields that the reader understands or that only describe the image; all others are kept as text.
# fmt: off
IMAGE_FIELDS = frozenset([
    "anatomicalorientation", "binarydata", "binarydatabyteordermsb", "centerofrotation", "compresseddata",
    "compresseddatasize", "dimsize", "elementbyteordermsb", "elementdatafile", "elementnumberofchannels", "elementsize",
    "elementspacing", "elementtype", "forerunlengthmm", "forerunspeedofsoundmps", "headersize", "kinds", "ndims",
    "objectsubtype", "objecttype", "offset", "orientation", "origin", "position", "rotation", "samplingfrequencyhz",
    "transducerfrequencyhz", "transformmatrix", "ultrasoundimageorientation", "ultrasoundimagetype",
])
# fmt: on


@dataclass(frozen=True)
class _Header:
    path: Path
    fields: dict[str, str]  # global fields, names in lower case
    names: dict[str, str]  # their spelling in the file
    frames: dict[str, dict[int, str]]  # field name in lower case -> frame -> text
    frame_names: dict[str, str]
    pixel_offset: int

    def get(self, name: str, default: str = "") -> str:
        return self.fields.get(name.lower(), default)

    def refuse(self, problem: str) -> InputError:
        return InputError(f"{self.path}: {problem}")


def is_transform(name: str) -> bool:
    """Whether a frame field's name is that of a transform, as IGSIO reads it."""
    return bool(TRANSFORM_NAME.fullmatch(name)) and len(re.findall("To[^a-z]", name)) == 1


def read_recording(path: str | Path, allow_truncated: bool = False, require_probe: bool = True) -> Recording:
    """A recording from `.igs.mha` (or `.mha`, or `.mhd` beside its pixel file).

    Parameters
    ----------
    path : path
        The metafile.
    allow_truncated : bool
        Keep the whole frames of a file that was cut, instead of refusing it.
    require_probe : bool
        Refuse a recording without any ProbeToReferenceTransform. Without it, a recording of other tools is
        read, and every `probe_to_reference` is NaN with status MISSING.

    Returns
    -------
    Recording
        F frames; poses NaN and status not OK wherever the file gives no trustworthy pose.

    Raises
    ------
    InputError
        Missing file, not a metafile, wrong image type or layout, pixels that do not fit the header, no poses,
        poses that are not rigid, missing or backward time stamps, no usable sampling frequency.
    """
    header = _read_header(Path(path))
    samples, count = _check_layout(header)
    lines, whole = _read_pixels(header, samples, count)
    # Under way, or its process was killed: what is complete is good (see RecordingWriter).
    unfinished = header.get("ElementDataFile") == pixels_beside(header.path).name
    allow_truncated = allow_truncated or unfinished
    if whole != count:
        if not allow_truncated:
            raise header.refuse(
                f"the pixel data do not fit the header: {count} frames announced, {whole} are whole; "
                "the file was cut or damaged, record again or read it with the whole frames only"
            )
        count = min(whole, count)
    beyond = max((max(values, default=-1) for values in header.frames.values()), default=-1) + 1
    ahead = 0 if samples else 1  # of poses only: a killed process leaves one frame that is not counted yet
    if beyond > count + ahead and not allow_truncated:
        raise header.refuse(f"fields for {beyond} frames but DimSize announces {count}; mend DimSize or record again")
    if count == 0:
        raise header.refuse("holds no whole frame; record again")
    poses, statuses = _read_transforms(header, count)
    if PROBE not in poses:
        if require_probe:
            raise header.refuse("no frame has a ProbeToReferenceTransform; record with the tracker on and the probe defined")
        poses[PROBE], statuses[PROBE] = np.full((count, 4, 4), np.nan), ("MISSING",) * count
    probe, states = _without_invalid_images(header, poses.pop(PROBE), statuses.pop(PROBE), count)
    return Recording(
        lines=lines[:count],
        acquisition=_read_acquisition(header, samples),
        probe_to_reference=probe,
        statuses=states,
        timestamps_s=_read_times(header, count),
        palpation_points=_read_palpation_points(header, count),
        other_transforms={header.frame_names[f"{name}transform"][: -len("Transform")]: pose for name, pose in poses.items()},
        other_statuses={header.frame_names[f"{name}transform"][: -len("Transform")]: statuses[name] for name in poses},
        fields={header.names[name]: text for name, text in header.fields.items() if name not in IMAGE_FIELDS},
    )


def _read_header(path: Path) -> _Header:
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the path of a recording (.igs.mha)")
    header = _Header(path, {}, {}, {}, {}, 0)
    with path.open("rb") as file:
        first = file.readline(LONGEST_LINE).decode("latin-1")
        if [part.strip().lower() for part in first.partition("=")] != ["objecttype", "=", "image"]:
            raise InputError(
                f"{path}: not a sequence metafile (its first line is not 'ObjectType = Image'); give an .igs.mha recording"
            )
        while "elementdatafile" not in header.fields:
            _read_line(header, file)
        return _Header(path, header.fields, header.names, header.frames, header.frame_names, file.tell())


def _read_line(header: _Header, file: BinaryIO) -> None:
    raw = file.readline(LONGEST_LINE)
    if not raw.endswith(b"\n") and b"ElementDataFile" not in raw:
        where = "a line is longer than 64 kB" if len(raw) == LONGEST_LINE else "it ends before the line ElementDataFile"
        raise header.refuse(f"the header is damaged: {where}; record or copy the file again")
    name, equals, value = raw.decode("latin-1").partition("=")
    name, value = name.strip(), value.strip()
    if not equals:
        if name:
            raise header.refuse(f"the header is damaged: no '=' in the line {name[:40]!r}; record or copy the file again")
        return
    match = FRAME_FIELD.fullmatch(name)
    if match:
        key = match[2].lower()
        header.frames.setdefault(key, {})[int(match[1])] = value
        header.frame_names.setdefault(key, match[2])
    else:
        header.fields[name.lower()] = value
        header.names[name.lower()] = name


def _check_layout(header: _Header) -> tuple[int, int]:
    """Samples a line and number of frames."""
    dims, sizes = header.get("NDims"), header.get("DimSize").split()
    if dims not in {"2", "3"}:
        raise header.refuse(f"NDims is {dims or 'missing'}; a recording has NDims = 3 (DimSize = samples 1 frames)")
    if not sizes:
        raise header.refuse("DimSize is missing; expected 'DimSize = samples 1 frames'")
    if len(sizes) != int(dims) or not all(size.isdigit() for size in sizes):
        raise header.refuse(f"DimSize is {' '.join(sizes)!r}; expected {dims} whole numbers (samples 1 frames)")
    samples, rows, count = (int(size) for size in [*sizes, "1"][:3])
    if samples == 0 or rows == 0:
        return 0, count
    if rows != 1:
        raise header.refuse(f"holds {rows} lines a frame; an A-mode recording has one (DimSize = samples 1 frames)")
    kinds = header.get("Kinds").lower().split()
    if kinds and ({"list", "time"} & set(kinds[:-1])):
        raise header.refuse(f"Kinds is {' '.join(kinds)!r}; the frame axis must be the last one")
    kind = header.get("UltrasoundImageType", "BRIGHTNESS").upper()
    if kind != "RF_REAL":
        raise header.refuse(f"UltrasoundImageType is {kind}, expected RF_REAL; record RF lines, not images")
    orientation = header.get("UltrasoundImageOrientation").upper()
    if not re.fullmatch("F[MU][AD]?", orientation):
        raise header.refuse(
            f"UltrasoundImageOrientation is {orientation or 'missing'}, expected FM (samples along x, away from the transducer)"
        )
    if header.get("ElementNumberOfChannels", "1") != "1":
        raise header.refuse(f"ElementNumberOfChannels is {header.get('ElementNumberOfChannels')}; an RF line has one channel")
    return samples, count


def _read_pixels(header: _Header, samples: int, count: int) -> tuple[npt.NDArray[np.int16], int]:
    """Lines (frames, samples) and how many whole frames the file really holds."""
    if samples == 0:
        return np.zeros((count, 0), dtype=np.int16), count
    name = header.get("ElementType").upper()
    if name not in PIXEL_TYPES:
        raise header.refuse(f"ElementType {name or 'is missing'} cannot be read; expected MET_SHORT")
    if header.get("BinaryData", "True").lower() != "true":
        raise header.refuse("BinaryData is not True; text pixels cannot be read, write binary ones")
    msb = header.get("BinaryDataByteOrderMSB", header.get("ElementByteOrderMSB", "False")).lower() == "true"
    kind = np.dtype((">" if msb else "<") + PIXEL_TYPES[name])
    data = _pixel_bytes(header)
    frame_bytes = samples * kind.itemsize
    whole, rest = divmod(len(data), frame_bytes)
    pixels = np.frombuffer(data, dtype=kind, count=min(whole, count) * samples).reshape(-1, samples)
    announced = count * frame_bytes
    if rest and len(data) > announced:
        whole = count + 1  # trailing bytes: not a cut, but not this header's pixels either
    return _as_int16(header, pixels), whole


def _pixel_bytes(header: _Header) -> bytes | bytearray:
    source, offset = header.path, header.pixel_offset
    data_file = header.get("ElementDataFile")
    if data_file.upper() != "LOCAL":
        if "%" in data_file or data_file.upper().startswith("LIST") or Path(data_file).name != data_file:
            raise header.refuse(
                f"ElementDataFile = {data_file!r} cannot be read; pixels are expected in one file in the same folder"
            )
        source, offset = header.path.with_name(data_file), 0
        if not source.is_file():
            raise header.refuse(f"its pixel file {data_file} is missing; copy it into the same folder")
    with source.open("rb") as file:
        file.seek(offset)
        if header.get("CompressedData", "False").lower() != "true":
            data = bytearray(max(source.stat().st_size - offset, 0))  # arrays on it can be written to: no copy is needed
            file.readinto(data)
            return data
        size = header.get("CompressedDataSize")
        if not size.isdigit() or int(size) == 0:
            raise header.refuse("CompressedDataSize is missing; compressed pixels need it, write the file again")
        packed = file.read(int(size))
    if len(packed) != int(size):
        raise header.refuse(f"the compressed pixels are cut: {len(packed)} of {size} bytes; copy or record the file again")
    try:
        return zlib.decompress(packed)
    except zlib.error:
        raise header.refuse("the compressed pixels are damaged; copy or record the file again") from None


def _as_int16(header: _Header, pixels: npt.NDArray[np.generic]) -> npt.NDArray[np.int16]:
    if np.can_cast(pixels.dtype, np.int16, "safe"):
        return pixels.astype(np.int16, copy=False)
    with np.errstate(invalid="ignore"):
        lines = pixels.astype(np.int16)
    if not np.array_equal(lines.astype(pixels.dtype), pixels):
        raise header.refuse(
            f"{header.get('ElementType')} samples do not fit 16-bit whole numbers; scale them and write MET_SHORT"
        )
    return lines


def _read_transforms(header: _Header, count: int) -> tuple[dict[str, Array], dict[str, tuple[str, ...]]]:
    """Poses (F, 4, 4) and statuses by name in lower case without 'transform'; only streams with at least one pose."""
    poses: dict[str, Array] = {}
    statuses: dict[str, tuple[str, ...]] = {}
    for key, texts in header.frames.items():
        if not key.endswith("transform") or not (key == f"{PROBE}transform" or is_transform(header.frame_names[key])):
            continue
        states = header.frames.get(f"{key}status", {})
        wanted = [index for index in sorted(texts) if index < count and states.get(index, "OK").upper() == "OK"]
        matrices = np.full((count, 4, 4), np.nan)
        matrices[wanted] = _parse_matrices(header, header.frame_names[key], [texts[index] for index in wanted], wanted)
        name, good = key[: -len("transform")], set(np.flatnonzero(np.isfinite(matrices).all(axis=(1, 2))).tolist())
        poses[name] = matrices
        statuses[name] = tuple("OK" if index in good else _not_ok(states.get(index, "MISSING").upper()) for index in range(count))
    return poses, statuses


def _not_ok(status: str) -> str:
    return status if status and status != "OK" else "MISSING"  # OK without a pose is a missing pose


def _parse_matrices(header: _Header, name: str, texts: list[str], frames: list[int]) -> Array:
    """(F, 4, 4) NaN where a number is not finite: that frame has no pose. Numbers that are none of a rigid pose are refused."""
    rows = [text.split() for text in texts]
    for row, frame in zip(rows, frames):
        if len(row) != 16:
            raise header.refuse(f"frame {frame}: {name} has {len(row)} numbers, expected 16 (4x4, row by row)")
    try:
        matrices = np.array(rows, dtype=float).reshape(-1, 4, 4)
    except ValueError as error:
        raise header.refuse(f"{name}: {error}; expected 16 numbers a frame with '.' as decimal point") from None
    finite = np.isfinite(matrices).all(axis=(1, 2))
    _refuse_if_not_rigid(header, name, matrices[finite], [frame for frame, good in zip(frames, finite) if good])
    matrices[~finite] = np.nan
    return matrices


def _refuse_if_not_rigid(header: _Header, name: str, matrices: Array, frames: list[int]) -> None:
    last = np.abs(matrices[:, 3] - (0, 0, 0, 1)).max(axis=1) > 1e-6
    _refuse_first(header, name, last, frames, "is not a rigid transform (last row not 0 0 0 1); write it row by row")
    turn = matrices[:, :3, :3]
    off = np.abs(np.swapaxes(turn, 1, 2) @ turn - np.eye(3)).max(axis=(1, 2)) > 2 * ORTHONORMAL_TOLERANCE
    _refuse_first(header, name, off, frames, "is not rigid (it scales or shears); expected a rotation and a translation in mm")
    _refuse_first(header, name, np.linalg.det(turn) < 0, frames, "mirrors; check for swapped or flipped axes")
    far = np.abs(matrices[:, :3, 3]).max(axis=1, initial=0) > LARGEST_COORDINATE_MM
    _refuse_first(header, name, far, frames, "lies more than 100 m away; translations are expected in mm")


def _refuse_first(header: _Header, name: str, bad: npt.NDArray[np.bool_], frames: list[int], problem: str) -> None:
    if bad.any():
        raise header.refuse(f"frame {frames[int(np.argmax(bad))]}: {name} {problem}; set its status to INVALID or record again")


def _without_invalid_images(
    header: _Header, poses: Array, statuses: tuple[str, ...], count: int
) -> tuple[Array, tuple[str, ...]]:
    """A line that the device called invalid never becomes a point: its frame loses pose and OK."""
    images = header.frames.get("imagestatus", {})
    bad = [index for index in range(count) if images.get(index, "OK").upper() != "OK"]
    if not bad:
        return poses, statuses
    poses = poses.copy()
    poses[bad] = np.nan
    blank = set(bad)
    return poses, tuple("INVALID" if index in blank and text == "OK" else text for index, text in enumerate(statuses))


def _read_times(header: _Header, count: int) -> Array:
    texts = header.frames.get("timestamp", {})
    missing = next((index for index in range(count) if index not in texts), None)
    if missing is not None:
        raise header.refuse(f"frame {missing} has no Timestamp; every frame needs one, record again")
    try:
        times = np.array([texts[index] for index in range(count)], dtype=float)
    except ValueError as error:
        raise header.refuse(f"Timestamp: {error}; expected seconds") from None
    if not np.isfinite(times).all():
        raise header.refuse(f"frame {int(np.argmin(np.isfinite(times)))}: Timestamp is not a finite number; record again")
    back = np.diff(times) < 0
    if back.any():
        frame = int(np.argmax(back)) + 1
        raise header.refuse(
            f"frame {frame}: Timestamp goes back from {times[frame - 1]:.6f} s to {times[frame]:.6f} s; record again"
        )
    return times


def _read_palpation_points(header: _Header, count: int) -> npt.NDArray[np.int64]:
    points = np.full(count, -1, dtype=np.int64)
    for index, text in header.frames.get("palpationpoint", {}).items():
        if index < count:
            try:
                points[index] = int(text)
            except ValueError:
                raise header.refuse(f"frame {index}: PalpationPoint is {text!r}, expected a whole number") from None
    return points


def _read_acquisition(header: _Header, samples: int) -> Acquisition:
    if samples == 0 and not header.get("SamplingFrequencyHz"):
        return Acquisition(float("nan"), float("nan"))
    sampling = _number(header, "SamplingFrequencyHz", *SAMPLING_RANGE_HZ)
    transducer = _number(header, "TransducerFrequencyHz", 1e4, sampling / 2)
    length = _number(header, "ForerunLengthMm", 0, 1000, default="0")
    speed = _number(header, "ForerunSpeedOfSoundMps", 100 if length > 0 else 0, 10000, default="0")
    return Acquisition(sampling, transducer, length, speed)


def _number(header: _Header, name: str, low: float, high: float, default: str = "") -> float:
    text = header.get(name, default)
    if not text:
        raise header.refuse(f"{name} is missing; add the line '{name} = ...' to the header")
    try:
        value = float(text)
    except ValueError:
        raise header.refuse(f"{name} is {text!r}, expected a number") from None
    if not low <= value <= high:
        raise header.refuse(f"{name} is {text}; expected {low:g} to {high:g}, check its unit")
    return value
