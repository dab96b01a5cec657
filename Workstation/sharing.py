"""`cranionav tracker serve`: what a tracker sees, and A-lines, for OpenIGTLink clients, until the user interrupts."""

from __future__ import annotations

import contextlib
import time
from typing import Any

from CranioNavLib.errors import InputError
from ModuleTrackingLib.pose_stream import PoseStream
from ModuleTrackingLib.sharing import Sharing
from ModuleTrackingLib.tracker import Tracker
from ModuleUltrasoundLib.devices.device import AModeDevice

from Workstation.tracking import TURN_S, connect, interruption, live_table, open_device, read_device


def serve_session(
    tracker: Tracker, device: AModeDevice | None, host: str, port: int, seconds: float | None, timeout_s: float
) -> dict[str, Any]:
    """Serve poses and lines; the address is printed as the first line on stdout.

    Raises
    ------
    InputError
        The port is taken, or tracker or device do not answer.
    """
    with contextlib.ExitStack() as stack:
        sharing = stack.enter_context(contextlib.closing(Sharing(port, host)))
        stream = stack.enter_context(PoseStream(tracker))
        redraw = stack.enter_context(live_table(stream))
        interrupted = stack.enter_context(interruption())
        connect(stream, timeout_s, interrupted)
        if device is not None:
            open_device(device, stack)
        print(sharing.address, flush=True)
        begin = time.monotonic()
        while not interrupted and (seconds is None or time.monotonic() - begin < seconds):
            line = read_device(device)
            frames = stream.poll()
            sharing.add_frames(frames)
            if line is not None:
                sharing.publisher.publish_line(line.samples, line.host_time_s)
            redraw()
            if not frames and getattr(tracker, "finished", False):  # a replay at its end
                break
            if device is None:
                stream.wait(TURN_S)
        state = stream.state
    if not state.frames:
        raise InputError(f"{tracker.name}: nothing came; {state.problem or 'is it tracking?'}")
    return {"tracker": tracker.name, "frames": state.frames, "dropped_frames": state.dropped_frames}
