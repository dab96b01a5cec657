"""Tracking replies written: the inverse of reading them, for the emulator and for round-trip tests."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from ModuleTrackingLib.ndi.crc import crc_binary
from ModuleTrackingLib.ndi.replies import text_reply_bytes
from ModuleTrackingLib.ndi.tracking import (
    BX_START,
    REPORT_OUT_OF_VOLUME,
    STRAY_ACTIVE,
    STRAY_PASSIVE,
    TOOL_INFO,
    TOOL_MARKERS,
    TRANSFORMS,
    HandleData,
    HandleState,
    Marker,
    TrackingReply,
)

STRAY_VALID, STRAY_OUTSIDE = 0x01, 0x08


def bx_bytes(reply: TrackingReply, options: int) -> bytes:
    """A BX reply as a device sends it."""
    body = bytes([len(reply.handles)])
    body += b"".join(_bx_handle(entry, options) for entry in reply.handles)
    if options & STRAY_PASSIVE:
        body += _bx_markers(reply.strays or (), every=True)
    body += struct.pack("<H", reply.system_status)
    header = BX_START + struct.pack("<H", len(body))
    return header + crc_binary(header) + body + crc_binary(body)


def _bx_handle(entry: HandleData, options: int) -> bytes:
    state = HandleState.DISABLED if entry.state is HandleState.UNOCCUPIED else entry.state
    data = bytes([entry.handle, state])
    if state is HandleState.DISABLED:
        return data
    if options & TRANSFORMS:
        if entry.pose and state is HandleState.VALID:
            data += struct.pack("<8f", *entry.pose.quaternion, *entry.pose.translation_mm, entry.pose.error_mm)
        data += struct.pack("<2I", entry.port_status or 0, entry.frame or 0)
    if options & TOOL_INFO:
        digits = tuple(entry.marker_info or ()) + (0,) * 20
        packed = [digits[at] | digits[at + 1] << 4 for at in range(0, 20, 2)]
        data += bytes([entry.tool_info or 0, *reversed(packed)])
    if options & STRAY_ACTIVE:
        data += _bx_stray(entry, options)
    if options & TOOL_MARKERS:
        data += _bx_markers(entry.markers or (), every=True)
    return data


def _bx_stray(entry: HandleData, options: int) -> bytes:
    status = entry.stray_status if entry.stray_status is not None else (STRAY_VALID if entry.stray else 0)
    sent = status & STRAY_VALID or (status & STRAY_OUTSIDE and options & REPORT_OUT_OF_VOLUME)
    position = entry.stray.position_mm if entry.stray and entry.stray.position_mm else (0.0, 0.0, 0.0)
    return bytes([status]) + (struct.pack("<3f", *position) if sent else b"")


def _bx_markers(markers: Sequence[Marker], every: bool) -> bytes:
    bits = sum(1 << index for index, marker in enumerate(markers) if marker.out_of_volume)
    data = bytes([len(markers)]) + bits.to_bytes(-(-len(markers) // 8), "big")
    sent = [marker.position_mm for marker in markers if every or not marker.out_of_volume]
    return data + b"".join(struct.pack("<3f", *(position or (0.0, 0.0, 0.0))) for position in sent)


def tx_bytes(reply: TrackingReply, options: int) -> bytes:
    """A TX reply as a device sends it; UNOCCUPIED is followed directly by the line end, as DISABLED is."""
    text = f"{len(reply.handles):02X}" + "".join(_tx_handle(entry, options) for entry in reply.handles)
    if options & STRAY_PASSIVE:
        text += _tx_markers(reply.strays or (), every=bool(options & REPORT_OUT_OF_VOLUME))
    return text_reply_bytes(f"{text}{reply.system_status:04X}".encode("ascii"))


def _tx_handle(entry: HandleData, options: int) -> str:
    text = f"{entry.handle:02X}"
    if entry.state in (HandleState.DISABLED, HandleState.UNOCCUPIED):
        return text + entry.state.name + "\n"
    if options & TRANSFORMS:
        if entry.pose and entry.state is HandleState.VALID:
            text += "".join(_signed(value, 1e4, 5) for value in entry.pose.quaternion)
            text += _point(entry.pose.translation_mm) + _signed(entry.pose.error_mm, 1e4, 5)
        else:
            text += "MISSING"
        text += f"{entry.port_status or 0:08X}{entry.frame or 0:08X}"
    if options & TOOL_INFO:
        digits = (tuple(entry.marker_info or ()) + (0,) * 20)[:20]
        text += f"{entry.tool_info or 0:02X}" + "".join(f"{digit:X}" for digit in reversed(digits))
    if options & STRAY_ACTIVE:
        text += _point(entry.stray.position_mm) if entry.stray and entry.stray.position_mm else "MISSING"
    if options & TOOL_MARKERS:
        text += _tx_markers(entry.markers or (), every=True)
    return text + "\n"


def _tx_markers(markers: Sequence[Marker], every: bool) -> str:
    bits = sum(1 << index for index, marker in enumerate(markers) if marker.out_of_volume)
    digits = -(-len(markers) // 4)
    text = f"{len(markers):02X}" + (f"{bits:0{digits}X}" if digits else "")
    sent = [marker.position_mm for marker in markers if every or not marker.out_of_volume]
    return text + "".join(_point(position or (0.0, 0.0, 0.0)) for position in sent)


def _point(position: Sequence[float]) -> str:
    return "".join(_signed(value, 100, 6) for value in position)


def _signed(value: float, scale: float, digits: int) -> str:
    """A number as the device writes it: a sign and a fixed count of digits, clipped to what fits."""
    largest = 10**digits - 1
    number = max(-largest, min(largest, round(value * scale)))
    return f"{number:+0{digits + 1}d}"
