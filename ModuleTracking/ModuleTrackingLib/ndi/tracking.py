"""Tracking replies: what a TX or BX reply says, and the binary (BX) form read."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from itertools import chain
from typing import Optional

from ModuleTrackingLib.ndi.crc import crc16
from ModuleTrackingLib.ndi.replies import BadReplyError

TRANSFORMS, TOOL_INFO, STRAY_ACTIVE, TOOL_MARKERS = 0x0001, 0x0002, 0x0004, 0x0008
REPORT_OUT_OF_VOLUME, STRAY_PASSIVE = 0x0800, 0x1000
BX_START = b"\xc4\xa5"
BX_HEADER = 6  # start sequence, length, header CRC


class HandleState(IntEnum):
    """Handle status of BX; UNOCCUPIED exists in TX only."""

    VALID = 1
    MISSING = 2
    DISABLED = 4
    UNOCCUPIED = 8


@dataclass(frozen=True)
class RawPose:
    """A pose as the device sends it: tool to tracker, quaternion scalar first, mm."""

    quaternion: tuple[float, float, float, float]
    translation_mm: tuple[float, float, float]
    error_mm: float


@dataclass(frozen=True)
class Marker:
    """Position of a single marker in tracker coordinates; None where the device gives no coordinates."""

    position_mm: Optional[tuple[float, float, float]]
    out_of_volume: bool = False


@dataclass(frozen=True)
class HandleData:
    """One handle's part of a tracking reply; fields that were not asked for or not sent are None."""

    handle: int
    state: HandleState
    pose: Optional[RawPose] = None
    port_status: Optional[int] = None
    frame: Optional[int] = None
    tool_info: Optional[int] = None
    marker_info: Optional[tuple[int, ...]] = None  # 20 digits, marker A first
    stray_status: Optional[int] = None
    stray: Optional[Marker] = None
    markers: Optional[tuple[Marker, ...]] = None


@dataclass(frozen=True)
class TrackingReply:
    """A whole TX or BX reply."""

    handles: tuple[HandleData, ...]
    system_status: int
    strays: Optional[tuple[Marker, ...]] = None


def bx_length(start: bytes) -> int:
    """Number of bytes of a whole BX reply, from its first six.

    Raises
    ------
    BadReplyError
        Another start sequence, or the header's own CRC fails: then the length means nothing.
    """
    if start[:2] != BX_START:
        raise BadReplyError(f"a binary reply starts with C4 A5, got {start[:2].hex()}")
    if len(start) < BX_HEADER or crc16(start[:BX_HEADER]) != 0:
        raise BadReplyError("the header of a binary reply fails its CRC")
    return int.from_bytes(start[2:4], "little") + 8


class _Cursor:
    """Reads a body front to back and refuses to run past its end."""

    def __init__(self, body: bytes) -> None:
        self.body, self.at = body, 0

    @property
    def left(self) -> int:
        return len(self.body) - self.at

    def take(self, layout: str) -> tuple[float, ...]:
        size = struct.calcsize(layout)
        if size > self.left:
            raise BadReplyError("a binary reply ends inside a field")
        values = struct.unpack_from(layout, self.body, self.at)
        self.at += size
        return values

    def raw(self, size: int) -> bytes:
        if size > self.left:
            raise BadReplyError("a binary reply ends inside a field")
        self.at += size
        return self.body[self.at - size : self.at]

    def byte(self) -> int:
        return int(self.take("<B")[0])

    def bits(self, count: int) -> list[bool]:
        """`count` flags from ceil(count / 8) bytes, first marker in the lowest bit of the last byte."""
        value = int.from_bytes(self.raw(-(-count // 8)), "big")
        return [bool(value >> index & 1) for index in range(count)]


def parse_bx(reply: bytes, options: int) -> TrackingReply:
    """A whole BX reply, header and both CRCs included.

    Raises
    ------
    BadReplyError
        Any CRC, length, count or value is not as it must be.
    """
    if bx_length(reply[:BX_HEADER]) != len(reply):
        raise BadReplyError(f"expected a binary reply of {bx_length(reply[:BX_HEADER])} bytes, got {len(reply)}")
    if crc16(reply[BX_HEADER:]) != 0:
        raise BadReplyError("the body of a binary reply fails its CRC")
    cursor = _Cursor(reply[BX_HEADER:-2])
    handles = tuple(_bx_handle(cursor, options) for _ in range(cursor.byte()))
    strays = _bx_strays(cursor, options) if options & STRAY_PASSIVE else None
    system_status = int(cursor.take("<H")[0])
    if cursor.left:
        raise BadReplyError(f"a binary reply has {cursor.left} bytes too many for options {options:04X}")
    return checked(TrackingReply(handles, system_status, strays))


_HALVES = tuple((byte & 15, byte >> 4) for byte in range(256))


def _bx_handle(cursor: _Cursor, options: int) -> HandleData:
    handle, code = cursor.byte(), cursor.byte()
    try:
        state = HandleState(code)
    except ValueError:
        raise BadReplyError(f"handle {handle:02X} has the unknown status {code:02X}") from None
    if state in (HandleState.DISABLED, HandleState.UNOCCUPIED):
        return HandleData(handle, state)
    pose = status = frame = info = digits = stray_status = stray = markers = None
    if options & TRANSFORMS:
        if state is HandleState.VALID:
            q0, qx, qy, qz, tx, ty, tz, error = cursor.take("<8f")
            pose = RawPose((q0, qx, qy, qz), (tx, ty, tz), error)
        status, frame = (int(value) for value in cursor.take("<2I"))
    if options & TOOL_INFO:
        info = cursor.byte()
        digits = tuple(chain.from_iterable(_HALVES[byte] for byte in reversed(cursor.raw(10))))
    if options & STRAY_ACTIVE:
        stray_status = cursor.byte()
        if stray_status & 0x01 or (stray_status & 0x08 and options & REPORT_OUT_OF_VOLUME):
            stray = _bx_marker(cursor, bool(stray_status & 0x08))
    if options & TOOL_MARKERS:
        outside = cursor.bits(cursor.byte())
        markers = tuple(_bx_marker(cursor, out) for out in outside)
    return HandleData(handle, state, pose, status, frame, info, digits, stray_status, stray, markers)


def _bx_marker(cursor: _Cursor, outside: bool) -> Marker:
    x, y, z = cursor.take("<3f")
    return Marker((x, y, z), outside)


def _bx_strays(cursor: _Cursor, options: int) -> tuple[Marker, ...]:
    """Stray passive markers; some firmware leaves out coordinates of those outside, which the length tells."""
    outside = cursor.bits(cursor.byte())
    for_all = cursor.left == 12 * len(outside) + 2
    return tuple(_bx_marker(cursor, out) if for_all or not out else Marker(None, True) for out in outside)


def checked(reply: TrackingReply) -> TrackingReply:
    """What a CRC cannot see: a handle twice, and numbers that are none."""
    seen = [entry.handle for entry in reply.handles]
    if len(set(seen)) != len(seen) or 0 in seen:
        raise BadReplyError(f"handles in a tracking reply: {seen}; expected each once, none zero")
    for entry in reply.handles:
        pose = entry.pose
        if pose and not all(map(math.isfinite, (*pose.quaternion, *pose.translation_mm, pose.error_mm))):
            raise BadReplyError(f"handle {entry.handle:02X} has a pose that is not finite")
    return reply
