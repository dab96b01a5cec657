"""The conversation with a Polaris as scripts: find it, set it up, track, and set it up again after a loss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ModuleTrackingLib.ndi import words
from ModuleTrackingLib.ndi.plan import Plan, ToolFile
from ModuleTrackingLib.ndi.replies import (
    PHINF_OPTIONS,
    SPEED_CODES,
    BadReplyError,
    DeviceError,
    PortInfo,
    check_okay,
    parse_handle,
    parse_parameters,
    parse_phinf,
    parse_phsr,
    pvwr_command,
    rom_chunks,
)
from ModuleTrackingLib.ndi.steps import (
    Ask,
    Break,
    Connect,
    DamagedReplyError,
    Disconnect,
    LinkError,
    Pause,
    PortLostError,
    Script,
    SetSpeed,
    SilenceError,
    SpeedError,
)
from ModuleTrackingLib.ndi.talk import POWER_ON_SPEED, Talk

NETWORK_SPEED = 10_000_000  # bits a second, for time-outs only
SETTLE_S = 0.1  # after INIT and after a change of speed
RESET_TAKES_S = 7.0  # from break to the RESET message, at most
LISTEN_FOR_RESET_S = 0.5
BACK_OFF_S = (0.05, 0.1, 0.2, 0.3)  # between attempts to open a port that is gone
ROUNDS_OF_PINIT = 3
NO_SUCH_HANDLE = (0x08, 0x2B)


class SetUpError(Exception):
    """The set-up cannot succeed until the user changes something; the message says what."""


@dataclass(frozen=True)
class Tool:
    """A tool that the device tracks for us."""

    handle: int
    name: str
    info: PortInfo


class Session(Talk):
    """State of one conversation. Its methods are scripts; whoever plays them needs nothing else.

    Parameters
    ----------
    plan : Plan
        What the user wants.
    now, say : callable
        See Talk.
    has_speeds, has_break : callable
        What the present port can do.
    """

    def __init__(
        self,
        plan: Plan,
        now: Callable[[], float],
        has_speeds: Callable[[], bool],
        has_break: Callable[[], bool],
        say: Callable[[str, str], None] = lambda state, what: None,
    ) -> None:
        super().__init__(now, say)
        self.plan, self.has_speeds, self.has_break = plan, has_speeds, has_break
        self.tools: tuple[Tool, ...] = ()
        self.working_speed = 0  # the last speed at which the set-up succeeded
        self.counter_hz = plan.counter_hz or 60.0
        self.firmware = ""
        self._connected = False
        self._speed_failures: dict[int, int] = {}
        self._last_break_s = float("-inf")

    def forget_port(self) -> None:
        """A port that failed while tracking is opened anew."""
        self._connected = False

    # -- the way from nothing to tracking ------------------------------------------------------

    def establish(self) -> Script[None]:
        """Connect and set up, from the start again after each failure of the line, until it succeeds.

        Raises
        ------
        SetUpError
            A refusal by the device that repetition cannot mend.
        """
        failures = 0
        while True:
            try:
                yield from self._open(failures)
                yield from self._reach()
                yield from self._initialise()
                yield from self._raise_speed()
                yield from self._set_up()
                self._slow.settle()
                self._quick.settle()
                self.working_speed = self.speed
                return
            except PortLostError as error:
                self.say("connecting", str(error))
                yield Disconnect()
                yield Pause(BACK_OFF_S[min(failures, len(BACK_OFF_S) - 1)])
                self._connected = False
            except (LinkError, BadReplyError) as error:
                self.say("connecting", f"{error}; starting again")
                self._connected = self._connected and self.has_speeds()  # a socket may be half open: make a new one
            except DeviceError as error:
                if error.code not in words.SET_UP_AGAIN:
                    raise SetUpError(str(error)) from None
                self.say("connecting", f"{error}")
                yield Pause(SETTLE_S)
            failures += 1

    def start(self) -> Script[None]:
        """Begin tracking."""
        yield from self._okay("TSTART:")

    def stop(self) -> Script[None]:
        """End tracking; a device that does not track already is content."""
        try:
            check_okay((yield Ask("TSTOP:", self._time_for(12))).data)
        except (DeviceError, BadReplyError):
            return

    def leave(self) -> Script[None]:
        """Back to 9600 baud, so that the next start finds the device there."""
        if self.has_speeds() and self.speed != POWER_ON_SPEED:
            yield Ask("COMM:00000", self._time_for(12))
            yield Pause(SETTLE_S)
            yield SetSpeed(POWER_ON_SPEED)

    def _open(self, failures: int) -> Script[None]:
        if self._connected:
            return
        self.say("connecting", "opening the port" if not failures else f"opening the port (attempt {failures + 1})")
        yield Connect()
        self._connected, self.speed = True, POWER_ON_SPEED if self.has_speeds() else NETWORK_SPEED

    def _reach(self) -> Script[None]:
        """Return at the speed at which the device answers, in whatever mode it is.

        The last working speed and 9600 are tried in turn, one other speed in between, and now and then a
        break. The device's answer is waited for in small slices, so that it is met soon after its return.
        """
        self.say("connecting", "looking for the tracker")
        rounds = 0
        others = [speed for speed in SPEED_CODES if speed not in (POWER_ON_SPEED, self.working_speed)]
        while True:
            if not self.has_speeds():
                if (yield from self._answers()):
                    return
                continue
            candidates = [self.working_speed or POWER_ON_SPEED, POWER_ON_SPEED]
            if rounds:
                candidates.append(others[rounds % len(others)])
            for speed in dict.fromkeys(candidates):
                try:
                    yield from self._set_speed(speed)
                except SpeedError:
                    continue
                if (yield from self._answers()):
                    self._last_break_s = float("-inf")
                    return
            if self.has_break() and self.now() - self._last_break_s > RESET_TAKES_S:
                yield from self._send_break()
            rounds += 1

    def _send_break(self) -> Script[None]:
        self.say("connecting", "no answer; resetting the tracker by a serial break")
        yield from self._set_speed(POWER_ON_SPEED)
        yield Break()
        self._last_break_s = self.now()
        try:
            yield Ask("", LISTEN_FOR_RESET_S)
        except (SilenceError, DamagedReplyError):
            return  # it may take seconds: the search goes on meanwhile

    def _initialise(self) -> Script[None]:
        self.say("setting up", "initialising")
        try:
            yield from self._okay("INIT:")
        except DeviceError as error:
            if error.code != 0x0C:
                raise
            yield from self.stop()
            yield from self._okay("INIT:")
        yield Pause(SETTLE_S)

    def _raise_speed(self) -> Script[None]:
        """The highest speed that the user allows and device, port and cable take."""
        if not self.has_speeds():
            return
        for speed, code in SPEED_CODES.items():
            if speed > self.plan.highest_speed or self._speed_failures.get(speed, 0) >= 2:
                continue
            if speed == self.speed:
                return
            if not (yield from self._port_takes(speed)):
                continue
            self.say("setting up", f"changing to {speed} baud")
            self.working_speed = speed  # where the search meets the device if the answer is lost
            try:
                check_okay((yield Ask(f"COMM:{code}0000", self._time_for(20))).data)
            except DeviceError as error:
                if error.code != 0x06:
                    raise
                self._speed_failures[speed] = 2
                continue
            except BadReplyError as problem:
                raise DamagedReplyError(str(problem)) from None
            yield Pause(SETTLE_S)
            yield from self._set_speed(speed)
            for _ in range(2):
                if (yield from self._answers()):
                    return
            self._speed_failures[speed] = self._speed_failures.get(speed, 0) + 1
            raise SilenceError(f"no answer at {speed} baud")

    def _port_takes(self, speed: int) -> Script[bool]:
        present = self.speed
        try:
            yield SetSpeed(speed)
        except SpeedError:
            self._speed_failures[speed] = 2
            return False
        yield SetSpeed(present)
        return True

    def _set_speed(self, speed: int) -> Script[None]:
        yield SetSpeed(speed)
        self.speed = speed

    # -- set-up --------------------------------------------------------------------------------

    def _set_up(self) -> Script[None]:
        for entry in parse_phsr((yield from self._tell("PHSR:01"))):
            yield from self._free(entry.handle)
        if self.plan.volume is not None:
            yield from self._okay(f"SET:Param.Tracking.Selected Volume={self.plan.volume}")
        yield from self._ask_parameters()
        ours = yield from self._upload()
        yield from self._initialise_tools(ours)
        enabled = yield from self._enable_tools()
        if not enabled:
            raise SetUpError("the tracker has no tools; give tool files (roms=Probe=probe.rom;...) or plug tools in")
        tools = []
        for handle in enabled:
            info = parse_phinf((yield from self._tell(f"PHINF:{handle:02X}{PHINF_OPTIONS:04X}"))) or PortInfo()
            tools.append(Tool(handle, ours[handle].name if handle in ours else self._wired_name(handle, info), info))
        self.tools = _distinct(tools)

    def _ask_parameters(self) -> Script[None]:
        """Firmware, and the frame counter's rate where the device tells it (older ones do not know GET)."""
        for name in ("Features.Firmware.Version", "Param.Tracking.Frame Frequency"):
            try:
                value = parse_parameters((yield from self._tell(f"GET:{name}"))).get(name, "")
            except DeviceError:
                continue
            if name.startswith("Features"):
                self.firmware = value
            elif self.plan.counter_hz is None and _number(value) > 0:
                self.counter_hz = _number(value)

    def _upload(self) -> Script[dict[int, ToolFile]]:
        """A handle for every tool file, and the file sent to it."""
        ours: dict[int, ToolFile] = {}
        for tool in self.plan.tool_files:
            self.say("setting up", f"sending {tool.source}")
            handle = yield from self._new_handle(set(ours))
            ours[handle] = tool
            for address, chunk in rom_chunks(tool.rom):
                yield from self._okay(pvwr_command(handle, address, chunk))
        return ours

    def _new_handle(self, ours: set[int]) -> Script[int]:
        """A handle for a tool file. If its number is lost on the way, whatever was given out is given back first."""
        while True:
            try:
                return parse_handle((yield from self._tell("PHRQ:*********1****", repeat=False)))
            except (DamagedReplyError, BadReplyError):
                for entry in parse_phsr((yield from self._tell("PHSR:02"))):
                    if entry.handle not in ours:
                        yield from self._free(entry.handle)

    def _free(self, handle: int) -> Script[None]:
        try:
            yield from self._okay(f"PHF:{handle:02X}")
        except DeviceError as error:
            if error.code not in NO_SUCH_HANDLE:
                raise

    def _initialise_tools(self, ours: dict[int, ToolFile]) -> Script[None]:
        for _ in range(ROUNDS_OF_PINIT):
            waiting = parse_phsr((yield from self._tell("PHSR:02")))
            if not waiting:
                return
            for entry in waiting:
                name = ours[entry.handle].name if entry.handle in ours else f"the tool on port {entry.handle:02X}"
                self.say("setting up", f"initialising {name}")
                try:
                    yield from self._okay(f"PINIT:{entry.handle:02X}")
                except DeviceError as error:
                    if error.code in words.SET_UP_AGAIN:
                        raise
                    source = f" ({ours[entry.handle].source})" if entry.handle in ours else ""
                    raise SetUpError(f"{name}{source}: {error}") from None

    def _enable_tools(self) -> Script[list[int]]:
        for entry in parse_phsr((yield from self._tell("PHSR:03"))):
            yield from self._okay(f"PENA:{entry.handle:02X}D")
        return [entry.handle for entry in parse_phsr((yield from self._tell("PHSR:04")))]

    def _wired_name(self, handle: int, info: PortInfo) -> str:
        for key in (info.part_number, info.serial_number):
            if key in self.plan.names:
                return self.plan.names[key]
        return info.part_number or f"Tool {handle:02X}"

    @property
    def line(self) -> str:
        """The line in words."""
        return f"{self.speed} baud" if self.has_speeds() else "the network's speed"


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return 0.0


def _distinct(tools: list[Tool]) -> tuple[Tool, ...]:
    """Two wired tools of one part number get different names."""
    seen: dict[str, int] = {}
    named = []
    for tool in tools:
        seen[tool.name] = seen.get(tool.name, 0) + 1
        name = tool.name if seen[tool.name] == 1 else f"{tool.name} {seen[tool.name]}"
        named.append(Tool(tool.handle, name, tool.info))
    return tuple(named)
