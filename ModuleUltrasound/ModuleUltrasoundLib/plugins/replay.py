"""Plays an A-mode recording (.igs.mha) as if its device were there."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Optional

from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits, Parameters
from CranioNavLib.sequence_metafile import Acquisition, Recording, read_recording

from ModuleUltrasoundLib.devices.device import AModeDevice, DeviceError, RfLine

INT16_ENDS = (-32768, 32767)


class Pace(str, Enum):
    """When the next line comes."""

    TIMED = "timed"  # as recorded, or faster or slower by `speed`
    FAST = "fast"  # as soon as it is asked for: step by step, for a script


class Replay(AModeDevice):
    """The lines of a recording, in real time, faster or slower, or as they are asked for."""

    name = "replay"
    title = "Plays an A-mode recording"

    @dataclass(frozen=True)
    class Settings(Parameters):
        path: Annotated[str, "the recording, .igs.mha"] = ""
        pace: Annotated[Pace, "when the next line comes"] = Pace.TIMED
        speed: Annotated[float, Limits(0.01, 1000), "times as fast as recorded, with pace=timed"] = 1.0
        loop: Annotated[bool, "begin again after the last line"] = False

    settings: Settings

    def __init__(self, settings: Optional[Parameters] = None) -> None:
        super().__init__(settings)
        self._recording: Optional[Recording] = None
        self._running = False
        self._next = 0
        self._round_s = 0.0  # host time at which the recording's first line was due

    @property
    def recording(self) -> Recording:
        """The recording that is played, with its poses.

        Raises
        ------
        DeviceError
            Not open.
        """
        if self._recording is None:
            raise DeviceError("the replay device is not open; open it first")
        return self._recording

    @property
    def acquisition(self) -> Acquisition:
        """As recorded."""
        return self.recording.acquisition

    def open(self) -> None:
        """Read the recording."""
        if not self.settings.path:
            raise InputError("no recording given to replay; set its parameter path to an .igs.mha file")
        recording = read_recording(self.settings.path)
        if len(recording) == 0 or recording.lines.shape[1] == 0:
            raise InputError(f"{self.settings.path} holds no A-lines; give a recording of an A-mode device")
        self._recording = recording

    def start(self) -> None:
        """Begin with the first line."""
        self._next = 0
        self._round_s = time.monotonic()
        self._running = self.recording is not None

    def read(self, timeout_s: float = 1.0) -> Optional[RfLine]:
        """The next line; None if it is not due in time, or the recording is at its end."""
        if not self._running:
            raise DeviceError("the replay device is not started; start it before reading lines")
        if self._next >= len(self.recording):
            if not self.settings.loop:
                return None
            self._round_s += self._due_s(len(self.recording) - 1) + self._mean_step_s()
            self._next = 0
        due_s = time.monotonic()
        if self.settings.pace is Pace.TIMED:
            due_s = self._round_s + self._due_s(self._next)
            wait = due_s - time.monotonic()
            time.sleep(max(0.0, min(wait, timeout_s)))
            if wait > timeout_s:
                return None
        samples = self.recording.lines[self._next]
        saturated = bool(samples.size and (samples.min() == INT16_ENDS[0] or samples.max() == INT16_ENDS[1]))
        self._next += 1
        return RfLine(samples, due_s, self._next - 1, saturated)

    def stop(self) -> None:
        """Stop playing; may be called twice."""
        self._running = False

    def close(self) -> None:
        """Let go of the recording; may be called twice."""
        self._running = False
        self._recording = None

    def _due_s(self, index: int) -> float:
        """When a line is due, counted from the first one."""
        times = self.recording.timestamps_s
        return float(times[index] - times[0]) / float(self.settings.speed)

    def _mean_step_s(self) -> float:
        count = len(self.recording)
        return self._due_s(count - 1) / (count - 1) if count > 1 else 0.0
