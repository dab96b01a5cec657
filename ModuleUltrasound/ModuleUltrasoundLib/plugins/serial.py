"""Pulser/receivers that speak the framed protocol of `ModuleUltrasoundLib.devices.framed` on a serial port or socket."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, replace
from typing import Annotated, Optional

import numpy as np
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits
from CranioNavLib.sequence_metafile import Acquisition

from ModuleUltrasoundLib.devices.amode_settings import AModeSettings, Trigger
from ModuleUltrasoundLib.devices.connection import ByteLink
from ModuleUltrasoundLib.devices.device import DeviceError, RfLine
from ModuleUltrasoundLib.devices.framed import KIND_LINE, Frame, FrameDecoder, encode_command, parse_pairs
from ModuleUltrasoundLib.devices.linked_device import LinkedDevice

ANSWER_S = 1.0
ATTEMPTS = 4  # of a command whose answer does not come: bytes were lost on the way
STALLED_FRAME_S = 0.5  # a frame that stops half-way for so long is given up
LATEST_FIRST_SAMPLE = 1_000_000
CLOCK_WINDOW = 200  # lines over which the device's clock is compared with the computer's
BITS_A_BYTE = 10  # on a serial line: start, eight, stop


class SerialDevice(LinkedDevice):
    """A-lines over the framed serial protocol."""

    name = "serial"
    title = "Pulser/receiver with the framed serial protocol"

    @dataclass(frozen=True)
    class Settings(AModeSettings):
        port: Annotated[str, "serial device (/dev/ttyUSB0, COM5) or socket://host:port"] = ""
        baud_rate: Annotated[int, Limits(9600, 20_000_000), "symbols a second; USB devices ignore it"] = 921_600

    settings: Settings

    def __init__(self, settings: Optional[AModeSettings] = None) -> None:
        super().__init__(settings)
        self._decoder = FrameDecoder()
        self._lines: deque[RfLine] = deque()
        self._answers: deque[str] = deque()
        self._in_force: dict[str, str] = {}
        self._last_bytes_s = 0.0
        self._last_sequence = -1
        self._clock_offsets: deque[float] = deque(maxlen=CLOCK_WINDOW)

    @property
    def acquisition(self) -> Acquisition:
        """Sampling rate as the device answered; transducer and forerun as set."""
        return self.settings.acquisition(float(self._in_force.get("sampling_hz", "nan")))

    def _connect(self) -> ByteLink:
        self._decoder = FrameDecoder()
        self._lines.clear()
        self._last_sequence = -1
        self._clock_offsets.clear()
        self._link = ByteLink.open(self.settings.port, self.settings.baud_rate)
        self._ask("STOP")
        wanted = self.settings
        words = {
            "gain_db": f"{wanted.gain_db:g}",
            "delay_us": f"{wanted.delay_us:g}",
            "range_us": f"{wanted.range_us:g}",
            "averaging": str(wanted.averaging),
            "trigger": wanted.trigger.value,
        }
        if wanted.sampling_hz is not None:
            words["sampling_hz"] = f"{wanted.sampling_hz:.0f}"
        answer = self._ask("SET " + " ".join(f"{key}={value}" for key, value in words.items()))
        self._in_force = self._settings_in(answer)
        return self._link

    def _settings_in(self, answer: str) -> dict[str, str]:
        try:
            pairs = parse_pairs(answer)
            float(pairs["sampling_hz"])
        except (InputError, KeyError, ValueError):
            raise DeviceError(f"{self.settings.port} did not say its settings; it answered {answer[:80]!r}") from None
        return pairs

    def _begin(self) -> None:
        self._ask("START")

    def _end(self) -> None:
        self._ask("STOP")

    def _apply_gain(self, gain_db: float) -> None:
        self._in_force = self._settings_in(self._ask(f"SET gain_db={gain_db:g}"))
        self.settings = replace(self.settings, gain_db=gain_db)  # also when the device comes back
        self._lines.clear()  # those still waiting were taken with the old gain

    def _next_line(self, timeout_s: float) -> Optional[RfLine]:
        deadline = time.monotonic() + timeout_s
        if self.settings.trigger is Trigger.SOFTWARE and not self._lines:
            self._ask("SHOT")
        while not self._lines:
            left = deadline - time.monotonic()
            if left <= 0:
                return None
            self._receive(min(left, 0.1))
        return self._lines.popleft()

    def _ask(self, command: str) -> str:
        """What the device answers after OK. A command may arrive twice: each sets a state, none counts."""
        for _ in range(ATTEMPTS):
            self._answers.clear()
            self.link.write(encode_command(command))
            deadline = time.monotonic() + ANSWER_S
            while time.monotonic() < deadline:
                self._receive(0.05)
                while self._answers:
                    verdict, _, rest = self._answers.popleft().partition(" ")
                    if verdict == "OK":
                        return rest
                    if rest.startswith("damaged"):
                        deadline = 0.0  # the command was damaged on the way: say it again
                    else:
                        raise InputError(f"the device at {self.settings.port} refuses {command!r}: {rest}")
            self.counters["repeated commands"] += 1
        raise DeviceError(
            f"no answer from {self.settings.port} to {command.split()[0]} in {ATTEMPTS * ANSWER_S:.0f} s; "
            "check the port, the baud rate and that the device speaks the framed protocol"
        )

    def _receive(self, wait_s: float) -> None:
        data = self.link.read(wait_s)
        now = time.monotonic()
        if data:
            self._last_bytes_s = now
            frames = self._decoder.feed(data)
        elif self._decoder.mid_frame and now - self._last_bytes_s > STALLED_FRAME_S:
            self._last_bytes_s = now
            frames = self._decoder.give_up()
        else:
            frames = []
        self.counters["damaged frames"] = self._decoder.damaged_frames
        for frame in frames:
            if frame.kind == KIND_LINE:
                self._keep(frame, now)
            else:
                self._answers.append(frame.text)

    def _keep(self, frame: Frame, now: float) -> None:
        if frame.first_sample > LATEST_FIRST_SAMPLE or abs(frame.sampling_hz - self.acquisition.sampling_hz) > 0.5:
            self.counters["lines with other settings"] += 1
            return
        if self._last_sequence >= 0:
            self.counters["missed lines"] += max(0, frame.sequence - self._last_sequence - 1)
        self._last_sequence = frame.sequence
        samples = frame.samples
        if frame.first_sample:  # time zero is the transmit pulse: what the device left out is flat
            samples = np.concatenate([np.full(frame.first_sample, samples[0], dtype=np.int16), samples])
        self._lines.append(RfLine(samples, self._pulse_time(frame, now), frame.sequence, frame.clipped, frame.gain_db))

    def _pulse_time(self, frame: Frame, arrival_s: float) -> float:
        """Host time of the transmit pulse: the device's stamp, by the quickest way a recent frame took.

        The time that the bytes need on a serial line is known and taken off; a USB or socket's is not, but short.
        """
        device_s = frame.device_time_us * 1e-6
        on_the_line = 0.0
        if "://" not in self.settings.port:
            on_the_line = len(frame.payload) * BITS_A_BYTE / self.settings.baud_rate
        self._clock_offsets.append(arrival_s - on_the_line - device_s)
        return min(device_s + min(self._clock_offsets), arrival_s)
