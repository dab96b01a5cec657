"""What the user wants of the set-up: tool files, names, speed, volume."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Optional

from CranioNavLib.errors import InputError

from ModuleTrackingLib.ndi.replies import ROM_BYTES


@dataclass(frozen=True)
class ToolFile:
    """A tool whose description (.rom file) is uploaded."""

    name: str
    rom: bytes
    source: str  # the file's name, for messages


@dataclass(frozen=True)
class Plan:
    """What the user wants of the set-up."""

    tool_files: tuple[ToolFile, ...] = ()
    names: dict[str, str] = field(default_factory=dict)  # part or serial number -> tool name, for wired tools
    highest_speed: int = 1228739
    volume: Optional[int] = None
    counter_hz: Optional[float] = None  # ticks of the frame counter a second; None: ask the device


def read_tool_files(text: str) -> tuple[ToolFile, ...]:
    """The tool files of `Probe=probe.rom;Stylus=stylus.rom`.

    Raises
    ------
    InputError
        A list that cannot be read, a file that is missing or of an impossible size.
    """
    files = []
    for name, place in read_pairs("roms", text).items():
        try:
            rom = Path(place).expanduser().read_bytes()
        except OSError as error:
            raise InputError(f"roms: cannot read {place} of tool {name}: {error.strerror}; give its .rom file's path") from None
        if not 0 < len(rom) <= ROM_BYTES:
            raise InputError(f"roms: {place} of tool {name} has {len(rom)} bytes; a tool file has 1 to {ROM_BYTES}")
        files.append(ToolFile(name, rom, place))
    return tuple(files)


def read_pairs(what: str, text: str) -> dict[str, str]:
    """`a=b;c=d` as a dictionary."""
    pairs: dict[str, str] = {}
    for part in filter(None, (piece.strip() for piece in text.split(";"))):
        key, sign, value = (piece.strip() for piece in part.partition("="))
        if not (sign and key and value):
            raise InputError(f"{what}: expected name=value;name=value, got {part!r}")
        if key in pairs:
            raise InputError(f"{what}: {key} stands there twice; keep one")
        pairs[key] = value
    return pairs
