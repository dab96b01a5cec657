"""The port of a tracker, found by asking at every likely one."""

from __future__ import annotations

from collections.abc import Callable

from ModuleTrackingLib.ndi.conductor import Conductor
from ModuleTrackingLib.ndi.replies import BadReplyError, DeviceError
from ModuleTrackingLib.ndi.serial_port import list_ports
from ModuleTrackingLib.ndi.steps import Ask, Clock, Connect, LinkError, Port, Script
from ModuleTrackingLib.ndi.talk import PROBE, PROBE_S
from ModuleTrackingLib.tracker import TrackerError

MOST_S = 2.0  # spent at one port


def find_port(open_port: Callable[[str], Port], clock: Clock) -> str:
    """The first likely port whose device answers; nothing but a harmless question is sent.

    Raises
    ------
    TrackerError
        None answers.
    """
    tried = []
    for choice in list_ports():
        if choice.rank > 1:
            continue
        tried.append(f"{choice.device} ({choice.hint})")
        conductor = Conductor(lambda device=choice.device: open_port(device), clock)  # type: ignore[misc]
        try:
            conductor.begin(_knock())
            if conductor.advance(clock.now() + MOST_S):
                return choice.device
        except (LinkError, BadReplyError):
            continue
        except DeviceError:
            return choice.device
        finally:
            conductor.drop()
            conductor.close_port()
    raise TrackerError(
        f"no tracker answered; asked: {', '.join(tried) or 'no port, for there is none of the likely kind'}. "
        "Switch it on, plug it in, or name its port: a tracker left at another speed is only found by name"
    )


def _knock() -> Script[None]:
    yield Connect()
    yield Ask(PROBE, PROBE_S)
