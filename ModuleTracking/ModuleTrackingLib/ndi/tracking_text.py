"""The text (TX) form of tracking replies, read: the fallback for devices or lines without BX."""

from __future__ import annotations

import re
from typing import Optional

from ModuleTrackingLib.ndi.replies import BadReplyError
from ModuleTrackingLib.ndi.tracking import (
    REPORT_OUT_OF_VOLUME,
    STRAY_ACTIVE,
    STRAY_PASSIVE,
    TOOL_INFO,
    TOOL_MARKERS,
    TRANSFORMS,
    HandleData,
    HandleState,
    Marker,
    RawPose,
    TrackingReply,
    checked,
)

_STATUS_AND_FRAME = re.compile(r"[0-9A-F]{16}")
_POSE = re.compile(r"([+-]\d{5})([+-]\d{5})([+-]\d{5})([+-]\d{5})([+-]\d{6})([+-]\d{6})([+-]\d{6})([+-]\d{5})")
_POINT = re.compile(r"([+-]\d{6})([+-]\d{6})([+-]\d{6})")
_HEX = re.compile(r"[0-9A-F]*")


class _Text:
    """Reads a payload front to back; every piece must look as described."""

    def __init__(self, text: str) -> None:
        self.text, self.at = text, 0

    def skip(self, word: str) -> bool:
        found = self.text.startswith(word, self.at)
        self.at += len(word) if found else 0
        return found

    def match(self, pattern: re.Pattern[str]) -> Optional[re.Match[str]]:
        found = pattern.match(self.text, self.at)
        if found:
            self.at = found.end()
        return found

    def hex(self, digits: int) -> int:
        piece = self.text[self.at : self.at + digits]
        if len(piece) != digits or not _HEX.fullmatch(piece):
            raise BadReplyError(f"expected {digits} hex digits, got {piece!r}")
        self.at += digits
        return int(piece, 16)

    def line_end(self) -> None:
        if not self.skip("\n"):
            raise BadReplyError(f"expected the end of a line, got {self.text[self.at : self.at + 12]!r}")


def parse_tx(payload: bytes, options: int) -> TrackingReply:
    """A TX reply's payload (its CRC already checked and cut off).

    Raises
    ------
    BadReplyError
        Anything that does not have the layout that `options` ask for.
    """
    try:
        text = _Text(payload.decode("ascii"))
    except UnicodeDecodeError:
        raise BadReplyError("a text reply holds bytes that are not text") from None
    handles = tuple(_tx_handle(text, options) for _ in range(text.hex(2)))
    strays = None
    if options & STRAY_PASSIVE:
        outside = _outside(text)
        strays = tuple(_marker(text, out, not out or bool(options & REPORT_OUT_OF_VOLUME)) for out in outside)
    system_status = text.hex(4)
    if text.at != len(text.text):
        raise BadReplyError(f"a text reply has {len(text.text) - text.at} characters too many for options {options:04X}")
    return checked(TrackingReply(handles, system_status, strays))


def _tx_handle(text: _Text, options: int) -> HandleData:
    handle = text.hex(2)
    if text.skip("DISABLED"):
        text.line_end()
        return HandleData(handle, HandleState.DISABLED)
    if text.skip("UNOCCUPIED"):  # with or without status and frame, with or without a line end: makers' clients disagree
        text.match(_STATUS_AND_FRAME)
        text.skip("\n")
        return HandleData(handle, HandleState.UNOCCUPIED)
    state, pose, status, frame = HandleState.VALID, None, None, None
    if options & TRANSFORMS:
        if text.skip("MISSING"):
            state = HandleState.MISSING
        else:
            pose = _pose(text, handle)
        status, frame = text.hex(8), text.hex(8)
    info = digits = stray = markers = None
    if options & TOOL_INFO:
        info = text.hex(2)
        digits = tuple(text.hex(1) for _ in range(20))[::-1]
    if options & STRAY_ACTIVE and not (text.skip("MISSING") or text.skip("DISABLED")):
        stray = _marker(text, False, True)
    if options & TOOL_MARKERS:
        markers = tuple(_marker(text, out, True) for out in _outside(text))
    text.line_end()
    return HandleData(handle, state, pose, status, frame, info, digits, None, stray, markers)


def _pose(text: _Text, handle: int) -> RawPose:
    found = text.match(_POSE)
    if not found:
        raise BadReplyError(f"handle {handle:02X}: expected a pose, got {text.text[text.at : text.at + 12]!r}")
    q0, qx, qy, qz, tx, ty, tz, error = (int(number) for number in found.groups())
    return RawPose((q0 / 1e4, qx / 1e4, qy / 1e4, qz / 1e4), (tx / 100, ty / 100, tz / 100), error / 1e4)


def _outside(text: _Text) -> list[bool]:
    """A marker count and its out-of-volume bits, first marker in the lowest bit."""
    count = text.hex(2)
    bits = text.hex(-(-count // 4)) if count else 0
    return [bool(bits >> index & 1) for index in range(count)]


def _marker(text: _Text, outside: bool, has_coordinates: bool) -> Marker:
    if not has_coordinates:
        return Marker(None, outside)
    found = text.match(_POINT)
    if not found:
        raise BadReplyError(f"expected a marker position, got {text.text[text.at : text.at + 12]!r}")
    x, y, z = (int(number) / 100 for number in found.groups())
    return Marker((x, y, z), outside)
