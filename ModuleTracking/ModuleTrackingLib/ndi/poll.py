"""The tracking loop as a script: poll at the device's own pace, survive damaged replies, notice a loss."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ModuleTrackingLib.ndi.replies import BadReplyError, DeviceError
from ModuleTrackingLib.ndi.session import Session
from ModuleTrackingLib.ndi.steps import (
    FENCE_COMMAND,
    Answer,
    Ask,
    DamagedReplyError,
    Hush,
    Pause,
    ReplyKind,
    Script,
    SilenceError,
)
from ModuleTrackingLib.ndi.tracking import REPORT_OUT_OF_VOLUME, TOOL_INFO, TRANSFORMS, TrackingReply, parse_bx
from ModuleTrackingLib.ndi.tracking_text import parse_tx

OPTIONS = TRANSFORMS | TOOL_INFO | REPORT_OUT_OF_VOLUME
FAILURES_FOR_LOSS = 3
LOST_AFTER_S = 0.5  # nothing but failures for this long, and at least three of them
LONGEST_SILENCE_S = 2.0  # without a frame from a device that otherwise answers
WRAP = 2**32
FRAMES_TO_LEARN, KEPT_FRAMES = 16, 300  # for the pace of frames
LATER, MUCH_SOONER = 0.03, 0.1  # of the period: how the time of the next poll is moved, see FrameClock
FENCE_S = 0.2
LINE_SHARE = 0.75  # of a frame's time that replies may fill
NO_TOOL_S = 0.02  # pace of polling while every handle is disabled or unplugged
BYTES_A_TOOL = {True: 53, False: 94}  # BX, TX, with tool information


class FrameClock:
    """Frame numbers as a count that never wraps, and the time at which the next frame can be had.

    A device keeps only its newest frame: asked too early it repeats the last one, asked too late one is lost. So polls keep
    to the device's own pace, as soon after each frame as can be: a little sooner every time, and later when it was too soon.
    """

    def __init__(self) -> None:
        self.count = -1  # of the newest frame, unwrapped
        self._recent: deque[tuple[int, float]] = deque(maxlen=KEPT_FRAMES)  # frames: count, host time of asking
        self._steps: deque[int] = deque(maxlen=FRAMES_TO_LEARN)  # differences of frame numbers
        self._met_s = math.nan  # when the newest frame was there, as far as polls can tell

    def unwrap(self, frame: int) -> int:
        """The count of a 32-bit frame number, the one nearest to the newest frame."""
        if self.count < 0:
            return frame
        return self.count + (frame - self.count + WRAP // 2) % WRAP - WRAP // 2

    def note(self, count: int, asked_s: float, polls: int) -> None:
        """A new frame was there when the device was asked at `asked_s`, after so many polls."""
        period_s = self.period_s
        steps = (count - self.count) / min(self._steps, default=count - self.count)
        met_s = self._met_s + steps * period_s
        if not period_s or polls > 2 or not abs(asked_s - met_s) < period_s:
            met_s = asked_s
        elif polls == 2:
            met_s += LATER * period_s
        elif steps > 1 and asked_s < self._met_s + 1.5 * period_s:  # one was lost although it was asked for in time
            met_s -= MUCH_SOONER * period_s
        else:
            met_s -= period_s / len(self._recent)  # the fewer frames, the less sure the period
        self._met_s = min(met_s, asked_s)
        if self._recent:
            self._steps.append(count - self.count)
        self.count = count
        self._recent.append((count, asked_s))

    @property
    def period_s(self) -> float:
        """Time from frame to frame as seen on this host; 0 while it is not known."""
        if len(self._recent) < FRAMES_TO_LEARN:
            return 0.0
        (first, since_s), (last, until_s) = self._recent[0], self._recent[-1]
        return min(self._steps) * (until_s - since_s) / (last - first)

    def wait_s(self, now_s: float) -> float:
        """How long to wait before the next poll after a new frame."""
        period_s = self.period_s
        return max(0.0, self._met_s + period_s - now_s) if period_s else 0.0

    def retry_s(self) -> float:
        """How long to wait after a poll that brought nothing new."""
        return max(0.0003, self.period_s / 25.0) if self.period_s else 0.0005


@dataclass
class Counts:
    """What happened on the line since tracking began."""

    polls: int = 0
    frames: int = 0
    repeats: int = 0
    damaged: int = 0
    silent: int = 0


class Poller:
    """Scripts that bring one new frame at a time.

    Parameters
    ----------
    session : Session
        Set up and tracking.
    binary : bool
        Ask for BX; where the device does not know it, TX takes over by itself.
    now : callable
        Monotonic seconds.
    """

    def __init__(self, session: Session, binary: bool, now: Callable[[], float]) -> None:
        self.session, self.binary, self.now = session, binary, now
        self.clock, self.counts = FrameClock(), Counts()
        self.last_good_s = now()
        self.trouble = ""  # what the line did since the last good reply, in words

    def next_frame(self) -> Script[tuple[TrackingReply, float]]:
        """The next new frame, and when its last byte was read.

        Raises
        ------
        LinkError
            Nothing trustworthy for too long, or the port is gone.
        DeviceError
            The device is not tracking any more.
        """
        polls = failures = 0
        yield Pause(self.clock.wait_s(self.now()))
        while True:
            try:
                asked_s = self.now()
                reply, at_s = yield from self._poll()
                self.last_good_s, self.trouble, failures = self.now(), "", 0
                polls += 1
                if self._has_no_frame(reply):
                    yield Pause(NO_TOOL_S)
                    return reply, at_s
                if self._is_new(reply):
                    self.clock.note(self._newest(reply), asked_s, polls)
                    self.counts.frames += 1
                    return reply, at_s
                self.counts.repeats += 1
                yield Pause(self.clock.retry_s())
            except (SilenceError, DamagedReplyError, BadReplyError) as error:
                self.trouble = str(error)
                heard = yield from self._clear_line(isinstance(error, SilenceError))
                failures = 0 if heard else failures + (2 if isinstance(error, SilenceError) else 1)
                silent_s = self.now() - self.last_good_s
                if (failures >= FAILURES_FOR_LOSS and silent_s > LOST_AFTER_S) or silent_s > LONGEST_SILENCE_S:
                    raise DamagedReplyError(self.trouble) from None

    def _poll(self) -> Script[tuple[TrackingReply, float]]:
        self.counts.polls += 1
        options = self._options()
        command = f"{'BX' if self.binary else 'TX'}:{options:04X}"
        kind = ReplyKind.BINARY if self.binary else ReplyKind.TEXT
        timeout_s = max(0.2, 4.0 * self._reply_s())
        try:
            answer: Answer = yield Ask(command, timeout_s, kind)
        except DeviceError as error:
            if error.code != 0x01 or not self.binary or self.counts.frames:
                raise
            self.binary = False  # a device without BX
            return (yield from self._poll())
        reply = parse_bx(answer.data, options) if self.binary else parse_tx(answer.data, options)
        return reply, answer.at_s

    def _reply_s(self) -> float:
        """How long the line needs for a whole reply."""
        return 10.0 * (20 + BYTES_A_TOOL[self.binary] * len(self.session.tools)) / self.session.speed

    def _options(self) -> int:
        """Everything, but on a line too slow for that at the device's rate no tool information."""
        return OPTIONS if self._reply_s() < LINE_SHARE / self.session.counter_hz else OPTIONS & ~TOOL_INFO

    def _newest(self, reply: TrackingReply) -> int:
        counts = [self.clock.unwrap(entry.frame) for entry in reply.handles if entry.frame is not None]
        return max(counts, default=self.clock.count)

    def _is_new(self, reply: TrackingReply) -> bool:
        """Whether a frame was not seen before.

        Raises
        ------
        BadReplyError
            The frame numbers run backwards: an old reply, or a device that began anew.
        """
        newest = self._newest(reply)
        if newest < self.clock.count:
            raise BadReplyError(f"frame {newest} after frame {self.clock.count}")
        return newest > self.clock.count

    def _has_no_frame(self, reply: TrackingReply) -> bool:
        """Whether no handle is there that could have a frame number."""
        return all(entry.frame is None for entry in reply.handles)

    def _clear_line(self, silent: bool) -> Script[bool]:
        """Make sure that the next reply is the next command's; whether the device was heard meanwhile.

        After silence a late reply may still come and would be taken for the next one's. The fence's
        answer cannot be mistaken for it, and a device answers in order.
        """
        if not silent:
            self.counts.damaged += 1
            yield Hush(0.005)
            return False
        self.counts.silent += 1
        yield Hush(0.005)
        try:
            yield Ask(FENCE_COMMAND, FENCE_S, ReplyKind.FENCE)
        except SilenceError:
            return False
        except DeviceError:
            return True  # an error reply marks the place just as well
        return True
