"""Commands out, text replies in: framing, checksums, and the replies of the set-up commands."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ModuleTrackingLib.ndi.crc import crc_text
from ModuleTrackingLib.ndi.words import error_in_words

CR = b"\r"
ROM_BYTES, ROM_CHUNK = 1024, 64

# The first character of COMM's parameter, fastest first.
SPEED_CODES: dict[int, str] = {
    1228739: "7",
    921600: "6",
    230400: "A",
    115200: "5",
    57600: "4",
    38400: "3",
    19200: "2",
    14400: "1",
    9600: "0",
}
_ERROR = re.compile(rb"ERROR([0-9A-F]{2})")


class BadReplyError(Exception):
    """A reply that is damaged or does not have the shape that was asked for; no part of it may be used."""


class DeviceError(Exception):
    """The device refused a command with `ERRORxx`."""

    def __init__(self, code: int, command: str = "") -> None:
        self.code, self.command = code, command
        super().__init__((f"{command.split(':')[0]} was answered with " if command else "") + error_in_words(code))


def command_bytes(command: str) -> bytes:
    """A command as sent: `INIT:` -> b"INIT:E3A5\\r"."""
    body = command.encode("ascii")
    return body + crc_text(body) + CR


def text_reply_bytes(payload: bytes) -> bytes:
    """A text reply as a device sends it."""
    return payload + crc_text(payload) + CR


def text_payload(reply: bytes) -> bytes:
    """The payload of a text reply whose CR is already cut off.

    Raises
    ------
    BadReplyError
        Too short, or the CRC does not fit.
    """
    if len(reply) < 4 or crc_text(reply[:-4]) != reply[-4:]:
        raise BadReplyError(f"a text reply of {len(reply)} bytes fails its CRC")
    return reply[:-4]


def raise_if_error(payload: bytes, command: str = "") -> None:
    """Raise DeviceError if the payload is `ERRORxx`."""
    found = _ERROR.fullmatch(payload)
    if found:
        raise DeviceError(int(found.group(1), 16), command)


def check_okay(payload: bytes) -> None:
    """Accept `OKAY` and newer firmware's `WARNING`; anything else belongs to another command."""
    if payload not in (b"OKAY", b"WARNING"):
        raise BadReplyError(f"expected OKAY, got {payload[:40]!r}")


def parse_handle(payload: bytes) -> int:
    """The port handle that PHRQ gives."""
    if not re.fullmatch(rb"[0-9A-F]{2}", payload) or payload == b"00":
        raise BadReplyError(f"expected a port handle, got {payload[:40]!r}")
    return int(payload, 16)


@dataclass(frozen=True)
class HandleStatus:
    """One entry of a PHSR reply; `status` has 12 bits."""

    handle: int
    status: int


def parse_phsr(payload: bytes) -> tuple[HandleStatus, ...]:
    """Handles and their status from PHSR's `nn` + n x (`hh` + 3 hex)."""
    if not re.fullmatch(rb"[0-9A-F]{2}([0-9A-F]{5})*", payload) or len(payload) != 2 + 5 * int(payload[:2], 16):
        raise BadReplyError(f"expected a list of handles, got {payload[:40]!r}")
    entries = (payload[at : at + 5] for at in range(2, len(payload), 5))
    return tuple(HandleStatus(int(entry[:2], 16), int(entry[2:], 16)) for entry in entries)


MAIN_TYPES = {
    0x01: "reference",
    0x02: "probe",
    0x03: "button box",
    0x04: "software-defined",
    0x05: "microscope",
    0x07: "calibration device",
    0x0A: "C-arm",
    0x0B: "catheter",
}
PHINF_WIDTHS = {0x0001: 33, 0x0002: 8, 0x0004: 20, 0x0008: 2, 0x0010: 2, 0x0020: 14, 0x0040: 2}
PHINF_OPTIONS = 0x0025  # description, part number, location


@dataclass(frozen=True)
class PortInfo:
    """What PHINF says about one handle; fields that were not asked for are empty."""

    main_type: int = 0
    maker: str = ""
    revision: str = ""
    serial_number: str = ""
    port_status: int = 0
    part_number: str = ""
    location: str = ""

    @property
    def kind(self) -> str:
        """The tool's main type in words."""
        return MAIN_TYPES.get(self.main_type, f"type {self.main_type:02X}")


def parse_phinf(payload: bytes, options: int = PHINF_OPTIONS) -> PortInfo | None:
    """PHINF's fields, or None for an unoccupied handle."""
    if payload == b"UNOCCUPIED":
        return None
    widths = {option: width for option, width in PHINF_WIDTHS.items() if options & option}
    if len(payload) != sum(widths.values()):
        raise BadReplyError(f"expected {sum(widths.values())} characters of port information, got {len(payload)}")
    fields, at = {}, 0
    for option, width in widths.items():
        fields[option] = payload[at : at + width].decode("ascii", "replace")
        at += width
    described = fields.get(0x0001)
    try:
        return PortInfo(
            main_type=int(described[0:2], 16) if described else 0,
            maker=described[8:20].strip(" \0") if described else "",
            revision=described[20:23].strip(" \0") if described else "",
            serial_number=described[23:31].strip(" \0") if described else "",
            port_status=int(described[31:33], 16) if described else 0,
            part_number=fields.get(0x0004, "").strip(" \0"),
            location=fields.get(0x0020, "").strip(" \0"),
        )
    except ValueError as error:
        raise BadReplyError(f"port information is not as described: {error}") from None


def parse_parameters(payload: bytes) -> dict[str, str]:
    """GET's `name=value` lines."""
    pairs = (line.partition("=") for line in payload.decode("ascii", "replace").split("\n") if line)
    parameters = {name: value for name, sign, value in pairs if sign}
    if not parameters:
        raise BadReplyError(f"expected name=value, got {payload[:40]!r}")
    return parameters


def rom_chunks(rom: bytes) -> list[tuple[int, bytes]]:
    """A tool file as PVWR wants it: 16 chunks of 64 bytes with their addresses, padded with zeros."""
    if not 0 < len(rom) <= ROM_BYTES:
        raise ValueError(f"a tool file has 1 to {ROM_BYTES} bytes, got {len(rom)}")
    padded = rom.ljust(ROM_BYTES, b"\0")
    return [(at, padded[at : at + ROM_CHUNK]) for at in range(0, ROM_BYTES, ROM_CHUNK)]


def pvwr_command(handle: int, address: int, chunk: bytes) -> str:
    """One PVWR command."""
    return f"PVWR:{handle:02X}{address:04X}{chunk.hex().upper()}"
