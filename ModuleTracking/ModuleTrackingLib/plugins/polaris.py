"""NDI Polaris, Vicra, Spectra and Vega by the Combined API, over a serial line or TCP."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Any, Optional

from CranioNavLib.parameters import Limits, Parameters

from ModuleTrackingLib.ndi.conductor import Conductor, SystemClock
from ModuleTrackingLib.ndi.plan import Plan, read_pairs, read_tool_files
from ModuleTrackingLib.ndi.poll import Counts, Poller
from ModuleTrackingLib.ndi.port_search import find_port
from ModuleTrackingLib.ndi.poses import missing_poses, tool_poses
from ModuleTrackingLib.ndi.replies import BadReplyError, DeviceError, parse_parameters
from ModuleTrackingLib.ndi.serial_port import list_ports, open_port, same_device, tcp_address
from ModuleTrackingLib.ndi.session import Session, SetUpError
from ModuleTrackingLib.ndi.steps import Ask, Clock, Connect, Disconnect, LinkError, Pause, Port, PortLostError, Script
from ModuleTrackingLib.ndi.words import DIAGNOSTIC_PENDING
from ModuleTrackingLib.tracker import ToolInfo, ToolPose, Tracker, TrackerError

NO_NEWS_S = 0.2  # after this long without a good reply, tools are shown as missing
HAIR_S = 1e-6  # a wait shorter than this may round to none
LOST_SLICE_S = 0.05  # while the tracker is lost, `read` answers about this often
LEAVE_S = 1.0  # at most this long is spent on saying good-bye
ALERT_EVERY_S = 1.0
ALERT_S = 0.05  # for the answer to what the alert is; tracking waits for it


class Speed(str, Enum):
    """The highest serial speed that the driver may choose."""

    HIGHEST = "highest"
    B1228739 = "1228739"
    B921600 = "921600"
    B230400 = "230400"
    B115200 = "115200"
    B57600 = "57600"
    B38400 = "38400"
    B19200 = "19200"
    B14400 = "14400"
    B9600 = "9600"


class Replies(str, Enum):
    """Form of the tracking replies."""

    AUTO = "auto"
    BINARY = "BX"
    TEXT = "TX"


class PolarisState(str, Enum):
    """Where the driver is, in words."""

    DISCONNECTED = "disconnected"
    CONNECTING = "connecting"
    SETTING_UP = "setting up"
    READY = "ready"
    TRACKING = "tracking"
    LOST = "lost"


class PolarisTracker(Tracker):
    """A Polaris. After a loss it connects and sets up again by itself, inside `read`.

    `state` and `message` say what it does; a callable in `on_state` is told of each change. While the
    tracker is lost `read` returns every tool as missing, flagged "tracker lost". `device_time_s` goes on
    across a loss, by the host's clock; `frame_number` is the device's and may start anew.
    """

    name = "polaris"
    title = "NDI Polaris, Vicra, Spectra, Vega (serial or network)"

    @dataclass(frozen=True)
    class Settings(Parameters):
        """Settings of the driver."""

        port: Annotated[str, "device path, COM name, socket://host:port, or auto to look for it"] = "auto"
        roms: Annotated[str, "tool files: Probe=probe.rom;Stylus=stylus.rom"] = ""
        names: Annotated[str, "wired tools by part or serial number: P6-12345=Probe;..."] = ""
        baud: Annotated[Speed, "highest serial speed to use"] = Speed.HIGHEST
        replies: Annotated[Replies, "BX is exact; TX rounds to 0.01 mm"] = Replies.AUTO
        volume: Annotated[Optional[int], Limits(0, 15), "index of the measuring volume to select"] = None
        frame_counter_hz: Annotated[Optional[float], Limits(1, 1000), "ticks of the frame counter; asked of the device"] = None
        connect_timeout_s: Annotated[float, Limits(1, 120), "how long open() tries"] = 20.0

    def __init__(self, settings: Parameters | None = None) -> None:
        super().__init__(settings)
        self.clock: Clock = SystemClock()
        self.open_port: Callable[[str], Port] = open_port  # replaced where no real port is wanted
        self.on_state: Optional[Callable[[PolarisState, str], None]] = None
        self.state, self.message = PolarisState.DISCONNECTED, ""
        self.losses = 0
        self._plan = _plan_of(self.settings)
        self._conductor: Optional[Conductor] = None
        self._session: Optional[Session] = None
        self._poller: Optional[Poller] = None
        self._url = ""
        self._identity = (0, 0, "")
        self._counts_anew, self._time_offset_s = True, 0.0
        self._last_times: Optional[tuple[float, float]] = None  # device and host time of the newest frame
        self._alert, self._alert_asked_s = "", float("-inf")

    # -- the tracker's life --------------------------------------------------------------------

    def open(self) -> None:
        """See Tracker.open."""
        self.close()
        self._last_times = None
        self._go(PolarisState.CONNECTING, "")
        self._url = self._find_port() if self.settings.port == "auto" else self.settings.port
        self._identity = next((choice.identity for choice in list_ports() if choice.device == self._url), (0, 0, ""))
        conductor = Conductor(lambda: self.open_port(same_device(self._url, self._identity)), self.clock)
        self._conductor = conductor
        self._session = Session(
            self._plan,
            self.clock.now,
            lambda: conductor.port is not None and conductor.port.has_speeds,
            lambda: conductor.port is not None and conductor.port.has_break,
            lambda state, what: self._go(PolarisState(state), what),
        )
        try:
            self._play(_try_port())  # a port that is not there is an error at once
            self._play(self._session.establish(), self.settings.connect_timeout_s)
        except (LinkError, SetUpError) as error:
            self._give_up(str(error))
        self._go(PolarisState.READY, f"{len(self.tools)} tools at {self._url}")

    def start(self) -> None:
        """See Tracker.start."""
        _, session = self._opened
        try:
            self._play(self._begin_tracking(session), self.settings.connect_timeout_s)
        except (LinkError, SetUpError) as error:
            self._give_up(str(error))
        self._track()

    def read(self, timeout_s: float = 1.0) -> list[ToolPose]:
        """See Tracker.read; tools that have no trustworthy pose now are missing, and their flags say why."""
        if self.state not in (PolarisState.TRACKING, *_MENDING):
            raise TrackerError("the tracker is not tracking; start it first")
        deadline_s = self.clock.now() + timeout_s
        if self.state is not PolarisState.TRACKING:
            lost = self._mend(min(deadline_s, self.clock.now() + LOST_SLICE_S))
            if lost or self.clock.now() >= deadline_s:
                return lost
        try:
            return self._next_frame(deadline_s)
        except (LinkError, DeviceError, BadReplyError) as error:
            return self._lose(str(error))

    def stop(self) -> None:
        """See Tracker.stop."""
        if self._session is not None and self.state is PolarisState.TRACKING:
            self._try_to(self._session.stop())
            self._go(PolarisState.READY, "tracking stopped")
        elif self.state in _MENDING and self._conductor is not None:
            self._conductor.drop()
            self._go(PolarisState.LOST, self.message)

    def close(self) -> None:
        """See Tracker.close."""
        self.stop()
        if self._conductor is not None:
            if self._session is not None and self.state is PolarisState.READY:
                self._try_to(self._session.leave())
            self._conductor.drop()
            self._conductor.close_port()
        self._conductor = self._session = None
        if self.state is not PolarisState.DISCONNECTED:
            self._go(PolarisState.DISCONNECTED, "")

    @property
    def _opened(self) -> tuple[Conductor, Session]:
        if self._conductor is None or self._session is None:
            raise TrackerError("the tracker is not open; open it first")
        return self._conductor, self._session

    @property
    def tools(self) -> list[ToolInfo]:
        """See Tracker.tools."""
        known = self._session.tools if self._session is not None else ()
        files = {file.name: hashlib.sha256(file.rom).hexdigest()[:12] for file in self._plan.tool_files}
        return [
            ToolInfo(
                tool.name,
                tool.info.part_number,
                tool.info.serial_number,
                f"handle {tool.handle:02X}, {tool.info.kind}",
                files.get(tool.name, ""),
            )
            for tool in known
        ]

    @property
    def counts(self) -> Counts:
        """Polls, frames, damaged and late replies since tracking began or was resumed."""
        return self._poller.counts if self._poller is not None else Counts()

    # -- tracking and mending ------------------------------------------------------------------

    def _begin_tracking(self, session: Session) -> Script[None]:
        """TSTART, and the whole set-up again if the line fails meanwhile."""
        while True:
            try:
                yield from session.start()
                return
            except (LinkError, DeviceError) as error:
                if isinstance(error, DeviceError) and error.code not in _MODE_ERRORS:
                    raise SetUpError(str(error)) from None
                self._go(PolarisState.CONNECTING, str(error))
                if isinstance(error, PortLostError):
                    yield Disconnect()
                session.forget_port()
                yield from session.establish()

    def _track(self) -> Poller:
        _, session = self._opened
        self._poller, self._counts_anew = Poller(session, self.settings.replies is not Replies.TEXT, self.clock.now), True
        self._go(PolarisState.TRACKING, f"{len(session.tools)} tools at {session.line}")
        return self._poller

    def _next_frame(self, deadline_s: float) -> list[ToolPose]:
        conductor, session = self._opened
        poller = self._poller or self._track()
        now = self.clock.now()
        if not conductor.busy:
            poller.last_good_s = now  # nobody asked until now: no news is no failure
            conductor.begin(poller.next_frame())
        silent_s = now - poller.last_good_s
        patience_s = NO_NEWS_S - silent_s if silent_s < NO_NEWS_S - HAIR_S else LOST_SLICE_S
        if not conductor.advance(min(deadline_s, now + patience_s)):
            if self.clock.now() - poller.last_good_s < NO_NEWS_S - HAIR_S:
                return []
            return missing_poses(session.tools, self.clock.now(), "no answer", *([poller.trouble] if poller.trouble else []))
        reply, at_s = conductor.result
        if reply.system_status & DIAGNOSTIC_PENDING and self.clock.now() - self._alert_asked_s > ALERT_EVERY_S:
            self._alert = self._ask_for_alert()
            return self._next_frame(deadline_s)  # asking took its time: this frame is no longer the newest
        alert = self._alert if reply.system_status & DIAGNOSTIC_PENDING else ""
        count = max(0, poller.clock.count)
        return tool_poses(reply, session.tools, count, self._device_time(count / session.counter_hz, at_s), at_s, alert)

    def _device_time(self, counted_s: float, host_time_s: float) -> float:
        """The frame counter's time, moved on by the host's clock where the counter began anew after a loss."""
        if self._counts_anew:
            last_device_s, last_host_s = self._last_times or (counted_s, host_time_s)
            self._time_offset_s = last_device_s + host_time_s - last_host_s - counted_s
            self._counts_anew = False
        self._last_times = (counted_s + self._time_offset_s, host_time_s)
        return counted_s + self._time_offset_s

    def _lose(self, why: str) -> list[ToolPose]:
        """Note the loss, begin to mend it, and show every tool as missing."""
        conductor, session = self._opened
        self.losses += 1
        self._go(PolarisState.LOST, why)
        conductor.begin(self._mending(session))
        return missing_poses(session.tools, self.clock.now(), "tracker lost", why)

    def _mending(self, session: Session) -> Script[None]:
        session.forget_port()
        while True:
            try:
                yield from session.establish()
                yield from self._begin_tracking(session)
                return
            except SetUpError as error:  # the user must do something; look again now and then
                self._go(PolarisState.LOST, str(error))
                yield Pause(1.0)

    def _mend(self, deadline_s: float) -> list[ToolPose]:
        """Go on mending until the deadline; every tool missing, or nothing once the tracker is back."""
        conductor, session = self._opened
        tools = session.tools
        if not conductor.busy:
            conductor.begin(self._mending(session))
        if not conductor.advance(deadline_s):
            return missing_poses(tools, self.clock.now(), "tracker lost", self.message)
        self._track()
        return []

    def _ask_for_alert(self) -> str:
        """What the tracker's alert is about, in words; asked by GET, which is allowed while tracking."""
        self._alert_asked_s = self.clock.now()
        conductor, _ = self._opened
        bumped, alerts = "Param.Bump Detector.Bumped", "Info.Status.Alerts"
        found: dict[str, str] = {}
        for name in (bumped, alerts):
            with contextlib.suppress(LinkError, DeviceError, BadReplyError):  # asked again later
                conductor.begin(_get(name))
                if conductor.advance(self.clock.now() + 2 * ALERT_S):
                    found.update(conductor.result)
        conductor.drop()
        if found.get(bumped, "0") not in ("", "0"):
            return "the camera was bumped: check its accuracy"
        return f"alert {found[alerts]} of the tracker: see its manual" if alerts in found else ""

    # -- small things --------------------------------------------------------------------------

    def _play(self, script: Script[Any], timeout_s: float = 10.0) -> Any:
        """A script played to its end.

        Raises
        ------
        TrackerError
            It did not end in time.
        """
        conductor, _ = self._opened
        conductor.begin(script)
        if not conductor.advance(self.clock.now() + timeout_s):
            conductor.drop()
            self._give_up(
                f"no working connection to the tracker at {self._url} within {timeout_s:g} s ({self.message}); "
                "check power and cables, and that this is the tracker's port"
            )
        return conductor.result

    def _try_to(self, script: Script[None]) -> None:
        """Play a farewell; a device that is gone need not hear it."""
        conductor, _ = self._opened
        with contextlib.suppress(LinkError, DeviceError, BadReplyError):
            conductor.begin(script)
            conductor.advance(self.clock.now() + LEAVE_S)
        conductor.drop()

    def _give_up(self, message: str) -> None:
        if self._conductor is not None:
            self._conductor.drop()
            self._conductor.close_port()
        self._go(PolarisState.DISCONNECTED, message)
        raise TrackerError(message) from None

    def _go(self, state: PolarisState, message: str) -> None:
        if (state, message) == (self.state, self.message):
            return
        self.state, self.message = state, message
        if self.on_state is not None:
            self.on_state(state, message)

    def _find_port(self) -> str:
        try:
            return find_port(self.open_port, self.clock)
        except TrackerError:
            self._go(PolarisState.DISCONNECTED, "no tracker found")
            raise


_MENDING = (PolarisState.LOST, PolarisState.CONNECTING, PolarisState.SETTING_UP)
_MODE_ERRORS = frozenset({0x0C, 0x10, 0x05, 0x2C})


def _try_port() -> Script[None]:
    yield Connect()


def _get(name: str) -> Script[dict[str, str]]:
    return parse_parameters((yield Ask(f"GET:{name}", ALERT_S)).data)


def _plan_of(settings: Any) -> Plan:
    """The settings checked and read.

    Raises
    ------
    InputError
        A list that cannot be read, a tool file that is missing or none, a port that is no port.
    """
    if settings.port.startswith("socket://"):
        tcp_address(settings.port)
    highest = 1228739 if settings.baud is Speed.HIGHEST else int(settings.baud.value)
    return Plan(
        read_tool_files(settings.roms), read_pairs("names", settings.names), highest, settings.volume, settings.frame_counter_hz
    )
