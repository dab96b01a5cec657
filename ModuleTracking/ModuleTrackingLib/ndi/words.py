"""Numbers of the Combined API in words: error codes, port status, tool information, system status."""

from __future__ import annotations

from dataclasses import dataclass

AGAIN = "it is set up again by itself; if this comes back, switch the tracker off and on"
SERVICE = "switch the tracker off and on; if it comes back, call the maker's service"
TOOL_FILE = "check that the tool's .rom file is whole and made for this tracker"
DRIVER = "this is a fault of the driver or of the line; report it with the model of the tracker"
CABLE = "check the cable and its plugs, or choose a lower speed"
FEATURE = "this model cannot do it; leave the option out"


@dataclass(frozen=True)
class ErrorWords:
    """What an error code means and what the user can do about it."""

    meaning: str
    advice: str


ERRORS: dict[int, ErrorWords] = {
    0x01: ErrorWords("invalid command", FEATURE),
    0x02: ErrorWords("command too long", DRIVER),
    0x03: ErrorWords("command too short", DRIVER),
    0x04: ErrorWords("the command arrived damaged (CRC)", CABLE),
    0x05: ErrorWords("time-out inside the device", AGAIN),
    0x06: ErrorWords("the serial speed was refused", "choose a lower speed"),
    0x07: ErrorWords("wrong number of parameters", DRIVER),
    0x08: ErrorWords("invalid port handle", AGAIN),
    0x09: ErrorWords("invalid tracking priority", DRIVER),
    0x0A: ErrorWords("invalid LED", DRIVER),
    0x0B: ErrorWords("invalid LED state", DRIVER),
    0x0C: ErrorWords("not possible in the device's present mode", AGAIN),
    0x0D: ErrorWords("no tool on the handle", "plug the tool in, or give its .rom file"),
    0x0E: ErrorWords("the handle is not initialised", AGAIN),
    0x0F: ErrorWords("the handle is not enabled", AGAIN),
    0x10: ErrorWords("the system is not initialised", AGAIN),
    0x11: ErrorWords("tracking could not be stopped", AGAIN),
    0x12: ErrorWords("tracking could not be started", SERVICE),
    0x13: ErrorWords("the tool could not be initialised", TOOL_FILE),
    0x14: ErrorWords("bad camera parameters", SERVICE),
    0x15: ErrorWords("the camera could not be initialised", SERVICE),
    0x16: ErrorWords("the diagnostic could not be started", AGAIN),
    0x17: ErrorWords("the diagnostic could not be stopped", AGAIN),
    0x19: ErrorWords("the firmware version cannot be read", SERVICE),
    0x1A: ErrorWords("internal error", SERVICE),
    0x1C: ErrorWords("the marker firing cannot be set", TOOL_FILE),
    0x1E: ErrorWords("the tool's memory cannot be read", "unplug the tool and plug it in again"),
    0x1F: ErrorWords("the tool's memory cannot be written", TOOL_FILE),
    0x21: ErrorWords("the tool failed its current test", "unplug the tool; if it comes back, have the tool repaired"),
    0x22: ErrorWords("the tool's wavelength does not fit the selected volume", "select another volume, or use another tool"),
    0x23: ErrorWords("parameter out of range", "check the volume that was chosen"),
    0x24: ErrorWords("the list of volumes is not available", FEATURE),
    0x25: ErrorWords("the list of features is not available", FEATURE),
    0x28: ErrorWords("too many tools enabled", "give fewer tools at once"),
    0x29: ErrorWords("the firmware is corrupt", SERVICE),
    0x2A: ErrorWords("the device's memory is full", "give fewer tools at once, or switch the tracker off and on"),
    0x2B: ErrorWords("the handle is not allocated", AGAIN),
    0x2C: ErrorWords("the handle became unoccupied", AGAIN),
    0x2D: ErrorWords("all handles are in use", "give fewer tools at once, or switch the tracker off and on"),
    0x2E: ErrorWords("firmware parts do not match", SERVICE),
    0x2F: ErrorWords("bad port description", DRIVER),
    0x30: ErrorWords("the port already has a handle", AGAIN),
    0x32: ErrorWords("invalid operation", DRIVER),
    0x33: ErrorWords("the device lacks this feature", FEATURE),
    0x34: ErrorWords("no such user parameter", FEATURE),
    0x35: ErrorWords("user parameter of another type", DRIVER),
    0x36: ErrorWords("user parameter out of range", "check the volume that was chosen"),
    0x37: ErrorWords("user parameter index out of range", "check the volume that was chosen"),
    0x38: ErrorWords("user parameter of wrong size", DRIVER),
    0x39: ErrorWords("no permission for this user parameter", FEATURE),
    0x3B: ErrorWords("file not found in the device", SERVICE),
    0x3C: ErrorWords("a file in the device cannot be written", SERVICE),
    0x3D: ErrorWords("a file in the device cannot be read", SERVICE),
    0x40: ErrorWords("the tool file is bad", TOOL_FILE),
    0x41: ErrorWords("the tool is not supported", "use a tool made for this tracker"),
    0x42: ErrorWords("no camera is connected", "check the cable between the control unit and the camera"),
    0xF1: ErrorWords("too much infrared light", "remove other infrared sources, reflections and sunlight from the view"),
    0xF4: ErrorWords("flash memory cannot be erased", SERVICE),
    0xF5: ErrorWords("flash memory cannot be written", SERVICE),
    0xF6: ErrorWords("flash memory cannot be read", SERVICE),
}

# Codes that say "not in this mode or not any more": the set-up is repeated.
SET_UP_AGAIN = frozenset({0x05, 0x08, 0x0C, 0x0E, 0x0F, 0x10, 0x11, 0x2B, 0x2C, 0x30})

OCCUPIED, INITIALISED, ENABLED = 0x0001, 0x0010, 0x0020
OUT_OF_VOLUME, PARTLY_OUT = 0x0040, 0x0080
PORT_FLAGS: dict[int, str] = {
    0x0002: "switch 1",
    0x0004: "switch 2",
    0x0008: "switch 3",
    OUT_OF_VOLUME: "out of volume",
    PARTLY_OUT: "partly out of volume",
    0x0100: "algorithm limit",
    0x0200: "infrared interference",
    0x1000: "processing exception",
    0x4000: "processing fell behind",
    0x8000: "data buffer limit",
}
PORT_BARS_USE = 0x0100 | 0x0200 | 0x1000 | 0x4000 | 0x8000

TOOL_FLAGS: dict[int, str] = {
    0x01: "bad fit of the markers",
    0x02: "too few markers seen",
    0x04: "infrared interference",
    0x08: "processing fell behind",
    0x80: "processing exception",
}
TOOL_BARS_USE = 0x01 | 0x02 | 0x04 | 0x08 | 0x80

HARDWARE_FAILURE, DIAGNOSTIC_PENDING = 0x0010, 0x0100
SYSTEM_FLAGS: dict[int, str] = {
    0x0001: "communication out of step",
    0x0002: "too much infrared light",
    0x0004: "device reports a CRC error",
    0x0008: "recoverable exception in the device",
    HARDWARE_FAILURE: "hardware failure",
    0x0020: "hardware changed",
    0x0040: "a tool was plugged in",
    0x0080: "a tool was unplugged",
    DIAGNOSTIC_PENDING: "the tracker has an alert",
    0x0200: "temperature out of range",
    0x0400: "configuration changed",
}
SYSTEM_BARS_USE = 0x0004 | HARDWARE_FAILURE


def flags_in_words(value: int, table: dict[int, str]) -> tuple[str, ...]:
    """The words of every bit that is set in `value`."""
    return tuple(words for bit, words in table.items() if value & bit)


def error_in_words(code: int) -> str:
    """`ERROR0C: not possible in the device's present mode; <what to do>`."""
    words = ERRORS.get(code, ErrorWords("an error that this program does not know", SERVICE))
    return f"ERROR{code:02X}: {words.meaning}; {words.advice}"
