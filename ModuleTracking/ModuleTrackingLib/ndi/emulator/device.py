"""The emulated device without input or output: command bytes in, reply bytes out, time given from outside."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Optional

from ModuleTrackingLib.ndi import words
from ModuleTrackingLib.ndi.crc import crc_text
from ModuleTrackingLib.ndi.emulator.faults import Faults
from ModuleTrackingLib.ndi.emulator.motion import Motion
from ModuleTrackingLib.ndi.encode import bx_bytes, tx_bytes
from ModuleTrackingLib.ndi.replies import PHINF_WIDTHS, ROM_BYTES, SPEED_CODES, DeviceError, text_reply_bytes
from ModuleTrackingLib.ndi.tracking import REPORT_OUT_OF_VOLUME, HandleData, HandleState, RawPose, TrackingReply

POWER_ON_SPEED = 9600
LONGEST_COMMAND = 2048
WHILE_TRACKING = {"TX", "BX", "TSTOP", "BEEP", "LED", "GET", "RESET"}
BEFORE_INIT = {"INIT", "COMM", "VER", "APIREV", "RESET", "BEEP", "SFLIST", "GET", "GETINFO"}


@dataclass(frozen=True)
class Model:
    """What kind of device is emulated."""

    name: str = "Polaris Spectra"
    speeds: tuple[int, ...] = tuple(SPEED_CODES)
    has_bx: bool = True
    has_parameters: bool = True  # GET, SET
    boot_s: float = 0.3  # from power or break to the RESET message
    first_frame: int = 1
    handles: int = 12


@dataclass
class _Handle:
    """A port handle and the tool on it."""

    number: int
    wired: bool
    rom: Optional[bytearray] = None
    chunks: int = 0
    tool: str = ""
    initialised: bool = False
    enabled: bool = False

    @property
    def status(self) -> int:
        bits = words.OCCUPIED
        return bits | (words.INITIALISED if self.initialised else 0) | (words.ENABLED if self.enabled else 0)


class EmulatedPolaris:
    """A Polaris that answers commands. `receive` is given bytes and the time, and returns whole replies."""

    def __init__(self, motion: Motion, faults: Faults | None = None, model: Model | None = None) -> None:
        self.motion, self.faults, self.model = motion, faults or Faults(), model or Model()
        self.speed = POWER_ON_SPEED
        self._boots_until_s: Optional[float] = None
        self._buffer = b""
        self._lose_all()

    def _lose_all(self) -> None:
        self.initialised = self.tracking = False
        self._handles: dict[int, _Handle] = {}
        self._next_frame, self._tracking_since_s = self.model.first_frame, 0.0

    def power_cycle(self, now_s: float) -> None:
        """Break, RESET or power failure: everything is lost, and after the boot time RESET is sent at 9600."""
        self._lose_all()
        self.speed, self._boots_until_s, self._buffer = POWER_ON_SPEED, now_s + self.model.boot_s, b""

    def start_afresh(self) -> None:
        """As after a power cycle whose RESET message nobody heard."""
        self._lose_all()
        self.speed, self._boots_until_s, self._buffer = POWER_ON_SPEED, None, b""

    def booted(self, now_s: float) -> list[bytes]:
        """The RESET message, once, when the boot time is over."""
        if self._boots_until_s is None or now_s < self._boots_until_s:
            return []
        self._boots_until_s = None
        return [text_reply_bytes(b"RESET")]

    @property
    def wakes_at_s(self) -> Optional[float]:
        """When `booted` has something to say, if it will."""
        return self._boots_until_s

    def receive(self, data: bytes, now_s: float) -> list[bytes]:
        """Take bytes from the host; a NUL byte is what a break looks like on a line of bytes."""
        if self._boots_until_s is not None:
            return []
        if b"\0" in data:
            self.power_cycle(now_s)
            return []
        self._buffer = (self._buffer + data)[-2 * LONGEST_COMMAND :]
        replies = []
        while b"\r" in self._buffer and self._boots_until_s is None:
            command, self._buffer = self._buffer.split(b"\r", 1)
            speed = self.speed
            reply = self._answer(command, now_s)
            if reply:
                replies.append(reply)
            if self.speed != speed:
                self._buffer = b""  # what follows was sent at the old speed
        return replies

    def _answer(self, command: bytes, now_s: float) -> bytes:
        try:
            name, parameters = _split(command)
            if name in ("TX", "BX"):
                return self._track(name, parameters, now_s)
            return text_reply_bytes(self._execute(name, parameters, now_s))
        except DeviceError as error:
            return text_reply_bytes(b"ERROR%02X" % error.code)
        except _NoReplyError:
            return b""

    def _execute(self, name: str, parameters: str, now_s: float) -> bytes:
        method = getattr(self, f"_do_{name.lower()}", None)
        if method is None or (name in ("GET", "SET") and not self.model.has_parameters):
            raise DeviceError(0x01)
        if self.tracking and name not in WHILE_TRACKING:
            raise DeviceError(0x0C)
        if not self.initialised and name not in BEFORE_INIT:
            raise DeviceError(0x10)
        reply: bytes = method(parameters, now_s)
        return reply

    # -- commands ------------------------------------------------------------------------------

    def _do_init(self, parameters: str, now_s: float) -> bytes:
        self._lose_all()
        self.initialised = True
        return b"OKAY"

    def _do_reset(self, parameters: str, now_s: float) -> bytes:
        self.power_cycle(now_s)
        raise _NoReplyError

    def _do_comm(self, parameters: str, now_s: float) -> bytes:
        speed = next((speed for speed, code in SPEED_CODES.items() if parameters[:1] == code), None)
        if len(parameters) != 5:
            raise DeviceError(0x07)
        if speed not in self.model.speeds or not re.fullmatch("[01][012][01][01]", parameters[1:]):
            raise DeviceError(0x06)
        self.speed = speed
        return b"OKAY"

    def _do_ver(self, parameters: str, now_s: float) -> bytes:
        text = f"{self.model.name} Control Firmware\nNDI S/N: P0-00000\nFreeze Tag: {self.model.name} Rev 001.000\n(C) emulated"
        return text.encode("ascii")

    def _do_apirev(self, parameters: str, now_s: float) -> bytes:
        return b"G.001.002"

    def _do_beep(self, parameters: str, now_s: float) -> bytes:
        if not re.fullmatch("[1-9]", parameters):
            raise DeviceError(0x23)
        return b"1"

    def _do_sflist(self, parameters: str, now_s: float) -> bytes:
        answers = {"00": b"00000003", "01": b"3", "02": b"9"}
        if parameters not in answers:
            raise DeviceError(0x23)
        return answers[parameters]

    def _do_get(self, parameters: str, now_s: float) -> bytes:
        known = self._parameters()
        if parameters.endswith("*"):
            found = {name: value for name, value in known.items() if name.startswith(parameters[:-1])}
        else:
            found = {name: value for name, value in known.items() if name == parameters}
        if not found:
            raise DeviceError(0x34)
        return "\n".join(f"{name}={value}" for name, value in found.items()).encode("ascii")

    def _do_getinfo(self, parameters: str, now_s: float) -> bytes:
        value = self._parameters().get(parameters)
        if value is None or not self.model.has_parameters:
            raise DeviceError(0x34 if self.model.has_parameters else 0x01)
        return f"{parameters}={value};7;1;0;0;;{parameters.split('.')[-1]}".encode("ascii")

    def _do_set(self, parameters: str, now_s: float) -> bytes:
        name, sign, value = parameters.partition("=")
        if not sign or name not in self._parameters():
            raise DeviceError(0x34)
        if name != "Param.Tracking.Selected Volume":
            raise DeviceError(0x39)
        if value != "0":
            raise DeviceError(0x36)
        return b"OKAY"

    def _parameters(self) -> dict[str, str]:
        bumped = "bumped" in self.faults.active
        return {
            "Features.Firmware.Version": "001.000",
            "Features.Hardware.Serial Number": "P0-00000",
            "Param.Tracking.Available Volumes": "0",
            "Param.Tracking.Selected Volume": "0",
            "Param.Tracking.Frame Frequency": f"{self.motion.rate_hz:.6g}",
            "Param.Bump Detector.Bumped": str(int(bumped)),
            "Info.Status.System Mode": "3" if self.tracking else "1" if self.initialised else "0",
            "Info.Status.Alerts": "8" if bumped else "0",
            "Info.Status.New Alerts": "0",
        }

    # -- handles -------------------------------------------------------------------------------

    def _do_phsr(self, parameters: str, now_s: float) -> bytes:
        if parameters not in ("", "00", "01", "02", "03", "04"):
            raise DeviceError(0x23)
        if not self._handles and parameters != "01":
            self._plug_in()
        listed = [handle for handle in self._handles.values() if _is_asked_for(handle, parameters)]
        return (f"{len(listed):02X}" + "".join(f"{handle.number:02X}{handle.status:03X}" for handle in listed)).encode("ascii")

    def _plug_in(self) -> None:
        """A host that gave no tool files finds the tools plugged in by wire."""
        for number, tool in enumerate(self.motion.tools[: self.model.handles], start=1):
            self._handles[number] = _Handle(number, True, tool=tool)

    def _do_phrq(self, parameters: str, now_s: float) -> bytes:
        if len(parameters) != 14:
            raise DeviceError(0x07)
        number = next((n for n in range(1, self.model.handles + 1) if n not in self._handles), None)
        if number is None:
            raise DeviceError(0x2D)
        self._handles[number] = _Handle(number, False)
        return b"%02X" % number

    def _do_pvwr(self, parameters: str, now_s: float) -> bytes:
        handle = self._handle(parameters)
        found = re.fullmatch("([0-9A-Fa-f]{4})([0-9A-Fa-f]{128})", parameters[2:])
        address = int(found.group(1), 16) if found else 0
        if not found or address % 64 or address >= ROM_BYTES:
            raise DeviceError(0x1F)
        handle.rom = handle.rom or bytearray(ROM_BYTES)
        handle.rom[address : address + 64] = bytes.fromhex(found.group(2))
        handle.chunks |= 1 << address // 64
        return b"OKAY"

    def _do_pinit(self, parameters: str, now_s: float) -> bytes:
        handle = self._handle(parameters)
        if handle.rom is not None and handle.chunks != 0xFFFF:
            raise DeviceError(0x13)  # a tool file with a hole
        handle.tool = handle.tool or self._tool_of(handle)
        handle.initialised = True
        return b"OKAY"

    def _tool_of(self, handle: _Handle) -> str:
        """The tool whose name stands in the uploaded file, or else the next one that no handle has."""
        taken = {other.tool for other in self._handles.values()}
        free = [tool for tool in self.motion.tools if tool not in taken]
        named = [tool for tool in free if handle.rom is not None and tool.encode("utf-8") in bytes(handle.rom)]
        return (named or free or [f"unseen {handle.number:02X}"])[0]

    def _do_pena(self, parameters: str, now_s: float) -> bytes:
        handle = self._handle(parameters)
        if parameters[2:] not in ("S", "D", "B"):
            raise DeviceError(0x09)
        if not handle.initialised:
            raise DeviceError(0x0E)
        handle.enabled = True
        return b"OKAY"

    def _do_pdis(self, parameters: str, now_s: float) -> bytes:
        self._handle(parameters).enabled = False
        return b"OKAY"

    def _do_phf(self, parameters: str, now_s: float) -> bytes:
        del self._handles[self._handle(parameters).number]
        return b"OKAY"

    def _do_phinf(self, parameters: str, now_s: float) -> bytes:
        handle = self._handle(parameters)
        try:
            options = int(parameters[2:] or "0001", 16)
        except ValueError:
            raise DeviceError(0x23) from None
        tool = handle.tool.encode("ascii", "replace").decode()
        kind = {"Reference": "01", "Probe": "02", "Stylus": "02", "Sphere": "02"}.get(handle.tool, "04")
        fields = {
            0x0001: f"{kind}000000{'CranioNav':<12.12}001{handle.number:08d}{handle.status:02X}",
            0x0002: "00000000",
            0x0004: f"{tool:<20.20}",
            0x0008: "00",
            0x0010: "00",
            0x0020: f"{'00000000' if handle.wired else '********'}{0 if handle.wired else 1}{0 if handle.wired else 1}"
            f"{handle.number:02d}00",
            0x0040: "00",
        }
        return "".join(fields[option] for option in PHINF_WIDTHS if options & option).encode("ascii")

    def _handle(self, parameters: str) -> _Handle:
        try:
            return self._handles[int(parameters[:2], 16)]
        except (ValueError, KeyError):
            raise DeviceError(0x08) from None

    # -- tracking ------------------------------------------------------------------------------

    def _do_tstart(self, parameters: str, now_s: float) -> bytes:
        if parameters == "80":
            self._next_frame = self.model.first_frame
        self.tracking, self._tracking_since_s = True, now_s
        return b"OKAY"

    def _do_tstop(self, parameters: str, now_s: float) -> bytes:
        if not self.tracking:
            raise DeviceError(0x0C)
        self._next_frame += self.motion.sample(now_s - self._tracking_since_s)[0] + 1
        self.tracking = False
        return b"OKAY"

    def _track(self, name: str, parameters: str, now_s: float) -> bytes:
        if name == "BX" and not self.model.has_bx:
            raise DeviceError(0x01)
        if not self.tracking or self.faults.strikes("errors"):
            raise DeviceError(0x0C)
        if not re.fullmatch("|[0-9A-Fa-f]{4}", parameters):
            raise DeviceError(0x07)
        options = int(parameters or "0001", 16)
        since_s = now_s - self._tracking_since_s
        number, poses = self.motion.sample(since_s)
        frame = (self._next_frame + number) % 2**32
        enabled = [handle for handle in self._handles.values() if handle.enabled]
        entries = tuple(self._seen(handle, poses.get(handle.tool), frame, options, now_s) for handle in enabled)
        system_status = words.DIAGNOSTIC_PENDING if "bumped" in self.faults.active else 0
        reply = TrackingReply(entries, system_status, strays=())
        return bx_bytes(reply, options) if name == "BX" else tx_bytes(reply, options)

    def _seen(self, handle: _Handle, pose: Optional[RawPose], frame: int, options: int, now_s: float) -> HandleData:
        def has(fault: str) -> bool:
            return self.faults.tool_has(fault, handle.tool, now_s)

        if has("disabled"):
            return HandleData(handle.number, HandleState.DISABLED)
        if has("unplugged"):
            return HandleData(handle.number, HandleState.UNOCCUPIED)
        status, info, state = handle.status, 0, HandleState.VALID
        if has("partly-out-of-volume"):
            status |= words.PARTLY_OUT
        if has("interference"):
            status, info = status | 0x0200, info | 0x04
        if has("out-of-volume"):
            status |= words.OUT_OF_VOLUME
            state = state if options & REPORT_OUT_OF_VOLUME else HandleState.MISSING
        if has("too-few-markers"):
            info, state = info | 0x02, HandleState.MISSING
        if has("missing") or pose is None:
            state = HandleState.MISSING
        seen = pose if state is HandleState.VALID else None
        digits = (3, 3, 3, 3) if seen else (0, 0, 0, 0)
        return HandleData(handle.number, state, seen, status, frame, info, digits, markers=())


def _is_asked_for(handle: _Handle, option: str) -> bool:
    """PHSR's choice of handles; none is ever to be freed (01)."""
    if option == "02":
        return not handle.initialised
    if option == "03":
        return handle.initialised and not handle.enabled
    return option in ("", "00") or (option == "04" and handle.enabled)


class _NoReplyError(Exception):
    """A command that is answered later, or never."""


def _split(command: bytes) -> tuple[str, str]:
    """Name and parameters of `NAME:parameters<CRC>` or `NAME parameters`."""
    if len(command) > LONGEST_COMMAND:
        raise DeviceError(0x02)
    found = re.match(rb"[A-Z0-9]+(?=[: ])", command)
    if not found:
        raise DeviceError(0x01)
    rest = command[found.end() :]
    if rest[:1] == b":":
        if crc_text(command[:-4]) != command[-4:].upper():
            raise DeviceError(0x04)
        rest = rest[:-4]
    return found.group().decode("ascii"), rest[1:].decode("ascii", "replace")
