"""The content of each OpenIGTLink message type: packed by `pack`, read by the functions in `UNPACK`."""

from __future__ import annotations

import struct
from typing import Any, Callable

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from CranioNavLib.errors import InputError
from CranioNavLib.openigtlink.messages import (
    Capability,
    GetCapability,
    GetStatus,
    Image,
    Message,
    NdArray,
    Position,
    StartTracking,
    Status,
    StopTracking,
    String,
    TrackedTool,
    TrackingData,
    TrackingReply,
    Transform,
)
from CranioNavLib.rigid import Array

SCALARS = {2: "i1", 3: "u1", 4: "i2", 5: "u2", 6: "i4", 7: "u4", 10: "f4", 11: "f8"}
SCALAR_CODES = {kind: code for code, kind in SCALARS.items()}
IMAGE_HEADER = struct.Struct(">HBBBB3H12f6H")
STATUS_HEADER = struct.Struct(">Hq20s")
TOOL = struct.Struct(">20sBB12f")
QUATERNION_TOOL = struct.Struct(">20sBB7f")
LPS = 2
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])  # LPS <-> RAS


def pack(message: Message) -> tuple[str, bytes]:
    """Type name and content of a message.

    Raises
    ------
    InputError
        The message is of no type that can be sent, or too large for its format.
    """
    entry = PACK.get(type(message))
    if entry is None:
        raise InputError(f"a {type(message).__name__} cannot be sent over OpenIGTLink")
    name, packer = entry
    try:
        return name, packer(message)
    except (struct.error, KeyError) as error:
        raise InputError(f"{name} {message.device!r} cannot be packed: {error}") from None


def _matrix_floats(matrix: Array) -> list[float]:
    columns: list[float] = np.asarray(matrix, dtype=float)[:3].T.ravel().tolist()  # column by column, translation last
    return columns


def _matrix(floats: tuple[float, ...]) -> Array:
    matrix = np.eye(4)
    matrix[:3] = np.reshape(floats, (4, 3)).T
    if not np.isfinite(matrix).all():
        raise ValueError("a matrix holds a value that is not a finite number")
    return matrix


def _name(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("utf-8", "replace").strip()


def _pack_transform(message: Transform) -> bytes:
    return struct.pack(">12f", *_matrix_floats(message.matrix))


def _unpack_transform(body: bytes, **common: Any) -> Message:
    return Transform(**common, matrix=_matrix(struct.unpack(">12f", body)))


def _pack_position(message: Position) -> bytes:
    return struct.pack(">7f", *message.position_mm, *message.quaternion_xyzw)


def _unpack_position(body: bytes, **common: Any) -> Message:
    if len(body) not in (12, 24, 28):
        raise ValueError(f"{len(body)} bytes, expected 28, 24 or 12")
    numbers = struct.unpack(f">{len(body) // 4}f", body)
    if not np.isfinite(numbers).all():
        raise ValueError("a value is not a finite number")
    x, y, z, *turn = numbers
    if len(turn) == 3:  # the scalar part is left out and not negative
        rest = 1 - sum(part * part for part in turn)
        if rest < -1e-3:
            raise ValueError("the quaternion is longer than 1")
        turn.append(max(rest, 0.0) ** 0.5)
    qx, qy, qz, qw = turn or (0.0, 0.0, 0.0, 1.0)
    return Position(**common, position_mm=(x, y, z), quaternion_xyzw=(qx, qy, qz, qw))


def _pack_tracking(message: TrackingData) -> bytes:
    parts = []
    for tool in message.tools:
        name = tool.name.encode("utf-8")
        if len(name) > 20:
            raise InputError(f"tool name {tool.name!r} is longer than 20 bytes; shorten it")
        parts.append(TOOL.pack(name, tool.kind, 0, *_matrix_floats(tool.matrix)))
    return b"".join(parts)


def _unpack_tracking(body: bytes, **common: Any) -> Message:
    tools = [TrackedTool(_name(name), _matrix(tuple(rest)), kind) for name, kind, _, *rest in TOOL.iter_unpack(body)]
    return TrackingData(**common, tools=tuple(tools))


def _unpack_quaternion_tracking(body: bytes, **common: Any) -> Message:
    tools = []
    for name, kind, _, *numbers in QUATERNION_TOOL.iter_unpack(body):
        tools.append(TrackedTool(_name(name), pose_matrix(numbers[:3], numbers[3:]), kind))
    return TrackingData(**common, tools=tuple(tools))


def pose_matrix(position_mm: npt.ArrayLike, quaternion_xyzw: npt.ArrayLike) -> Array:
    """4x4 matrix of a position and a quaternion whose length is 1 to 1 %.

    Raises
    ------
    ValueError
        Not finite, or the quaternion's length is not 1.
    """
    turn = np.asarray(quaternion_xyzw, dtype=float)
    matrix = np.eye(4)
    matrix[:3, 3] = position_mm
    if not np.isfinite(matrix).all() or not np.isfinite(turn).all() or abs(float(np.linalg.norm(turn)) - 1) > 0.01:
        raise ValueError("a pose is not finite or its quaternion is not of length 1")
    matrix[:3, :3] = Rotation.from_quat(turn).as_matrix()
    return matrix


def _pack_start(message: StartTracking) -> bytes:
    return struct.pack(">i32s", message.interval_ms, message.coordinate_name.encode("ascii", "replace"))


def _unpack_start(body: bytes, **common: Any) -> Message:
    interval, name = struct.unpack(">i32s", body)
    return StartTracking(**common, interval_ms=max(interval, 0), coordinate_name=_name(name))


def _pack_reply(message: TrackingReply) -> bytes:
    return bytes([0 if message.granted else 1])


def _unpack_reply(body: bytes, **common: Any) -> Message:
    return TrackingReply(**common, granted=body[0] == 0)


def _pack_image(message: Image) -> bytes:
    voxels = np.asarray(message.voxels)
    if voxels.ndim not in (3, 4):
        raise InputError(f"an image has axes (k, j, i) or (k, j, i, components), got shape {voxels.shape}")
    code = SCALAR_CODES[f"{voxels.dtype.kind}{voxels.dtype.itemsize}"]
    size = voxels.shape[2::-1]
    components = voxels.shape[3] if voxels.ndim == 4 else 1
    matrix = np.array(message.ijk_to_ras, dtype=float)
    matrix[:3, 3] += matrix[:3, :3] @ ((np.array(size) - 1) / 2)  # the wire has the image's centre
    head = IMAGE_HEADER.pack(1, components, code, 2, 1, *size, *_matrix_floats(matrix), 0, 0, 0, *size)
    return head + np.ascontiguousarray(voxels, dtype=voxels.dtype.newbyteorder("<")).tobytes()


def _unpack_image(body: bytes, **common: Any) -> Message:
    head = IMAGE_HEADER.unpack_from(body)
    _, components, code, endian, frame, i, j, k, *rest = head
    if code not in SCALARS or components < 1:
        raise ValueError(f"scalar type {code} with {components} components")
    if tuple(rest[12:15]) != (0, 0, 0) or tuple(rest[15:18]) != (i, j, k):
        raise ValueError("a part of an image was sent; only whole images are taken")
    kind = np.dtype(("<" if endian == 2 else ">") + SCALARS[code])
    if len(body) - IMAGE_HEADER.size != i * j * k * components * kind.itemsize:
        raise ValueError(f"{len(body) - IMAGE_HEADER.size} bytes of voxels for size {(i, j, k)}")
    voxels = np.frombuffer(body, dtype=kind, offset=IMAGE_HEADER.size).astype(kind.newbyteorder("="))
    shape = (k, j, i) if components == 1 else (k, j, i, components)
    matrix = _matrix(tuple(rest[:12]))
    matrix[:3, 3] -= matrix[:3, :3] @ ((np.array([i, j, k]) - 1) / 2)
    return Image(**common, voxels=voxels.reshape(shape), ijk_to_ras=FLIP @ matrix if frame == LPS else matrix)


def _pack_array(message: NdArray) -> bytes:
    values = np.asarray(message.values)
    code = SCALAR_CODES[f"{values.dtype.kind}{values.dtype.itemsize}"]
    head = struct.pack(f">BB{values.ndim}H", code, values.ndim, *values.shape)
    return head + np.ascontiguousarray(values, dtype=values.dtype.newbyteorder(">")).tobytes()


def _unpack_array(body: bytes, **common: Any) -> Message:
    code, dimensions = struct.unpack_from(">BB", body)
    shape = struct.unpack_from(f">{dimensions}H", body, 2)
    if code not in SCALARS:
        raise ValueError(f"scalar type {code}")
    kind = np.dtype(">" + SCALARS[code])
    values = np.frombuffer(body, dtype=kind, offset=2 + 2 * dimensions).reshape(shape)
    return NdArray(**common, values=values.astype(kind.newbyteorder("=")))


def _pack_string(message: String) -> bytes:
    text = message.text.encode("utf-8")
    return struct.pack(">HH", 3 if message.text.isascii() else 106, len(text)) + text


def _unpack_string(body: bytes, **common: Any) -> Message:
    _, size = struct.unpack_from(">HH", body)
    if size > len(body) - 4:
        raise ValueError(f"a text of {size} bytes in a body of {len(body)}")
    return String(**common, text=body[4 : 4 + size].decode("utf-8", "replace"))


def _pack_status(message: Status) -> bytes:
    return STATUS_HEADER.pack(message.code, message.sub_code, message.error_name.encode("utf-8")) + message.text.encode() + b"\0"


def _unpack_status(body: bytes, **common: Any) -> Message:
    code, sub_code, name = STATUS_HEADER.unpack_from(body)
    return Status(**common, code=code, sub_code=sub_code, error_name=_name(name), text=_name(body[STATUS_HEADER.size :]))


def _pack_capability(message: Capability) -> bytes:
    return b"".join(struct.pack("12s", name.encode("ascii")) for name in message.types)


def _unpack_capability(body: bytes, **common: Any) -> Message:
    return Capability(**common, types=tuple(_name(name) for (name,) in struct.iter_unpack("12s", body)))


def _nothing(_: Message) -> bytes:
    return b""


# What is said of a type: its name, how it is packed, how it is read.
PACK: dict[type[Message], tuple[str, Callable[[Any], bytes]]] = {
    Transform: ("TRANSFORM", _pack_transform),
    Position: ("POSITION", _pack_position),
    TrackingData: ("TDATA", _pack_tracking),
    StartTracking: ("STT_TDATA", _pack_start),
    StopTracking: ("STP_TDATA", _nothing),
    TrackingReply: ("RTS_TDATA", _pack_reply),
    Image: ("IMAGE", _pack_image),
    NdArray: ("NDARRAY", _pack_array),
    String: ("STRING", _pack_string),
    Status: ("STATUS", _pack_status),
    GetStatus: ("GET_STATUS", _nothing),
    GetCapability: ("GET_CAPABIL", _nothing),
    Capability: ("CAPABILITY", _pack_capability),
}
UNPACK: dict[str, Callable[..., Message]] = {
    "TRANSFORM": _unpack_transform,
    "POSITION": _unpack_position,
    "TDATA": _unpack_tracking,
    "QTDATA": _unpack_quaternion_tracking,
    "STT_TDATA": _unpack_start,
    "STP_TDATA": lambda _, **common: StopTracking(**common),
    "RTS_TDATA": _unpack_reply,
    "IMAGE": _unpack_image,
    "NDARRAY": _unpack_array,
    "STRING": _unpack_string,
    "STATUS": _unpack_status,
    "GET_STATUS": lambda _, **common: GetStatus(**common),
    "GET_CAPABIL": lambda _, **common: GetCapability(**common),
    "CAPABILITY": _unpack_capability,
}
