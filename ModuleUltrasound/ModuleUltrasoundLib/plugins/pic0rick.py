"""The pic0rick open-hardware pulser/receiver with its shell firmware, on its USB serial port."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError
from CranioNavLib.parameters import Limits
from CranioNavLib.sequence_metafile import Acquisition

from ModuleUltrasoundLib.devices import pic0rick_shell as shell
from ModuleUltrasoundLib.devices.amode_settings import AModeSettings, Trigger
from ModuleUltrasoundLib.devices.connection import ByteLink, usb_ports, usb_product
from ModuleUltrasoundLib.devices.device import DeviceError, RfLine
from ModuleUltrasoundLib.devices.linked_device import LinkedDevice

OPEN_S = 5.0  # to find the prompt
SETTLE_S = 0.5  # after opening; the firmware waits 0.4 s for the port before it prints
QUIET_S = 0.3  # without a byte: nothing more is coming
WRITE_S, SHOT_S, READ_S = 1.0, 4.0, 5.0  # a shot may take the converter's time-out of 3 s
READ_ATTEMPTS = 4  # of one buffer: reading it again fires nothing
LOUD, QUIET = 0.98, 0.25  # of full scale: gain goes down when an echo clips, up when its peak is below a quarter
GAIN_STEP_DB = 3.0
FLIGHTS = 50  # shots over which the forerun's flight time is averaged: seconds, in which its temperature stays


class TimeZero(str, Enum):
    """How a line's time zero is found."""

    FORERUN = "forerun"  # from the echo of the forerun's face in every line: free of the pulse's jitter
    CONSTANT = "constant"  # a calibrated constant after the onset of the transmit pulse


class Pic0rick(LinkedDevice):
    """A pic0rick with the shell firmware (prompt `run> `)."""

    name = "pic0rick"
    title = "pic0rick open-hardware pulser/receiver (shell firmware)"

    @dataclass(frozen=True)
    class Settings(AModeSettings):
        gain_db: Annotated[float, Limits(shell.GAIN_DB_LOW, shell.GAIN_DB_HIGH), "one gain for the whole line"] = 30.0
        range_us: Annotated[float, Limits(1, 133), "length of a line"] = 60.0
        averaging: Annotated[int, Limits(1, 16), "shots averaged into one line; hold the probe still"] = 1
        trigger: Annotated[Trigger, "the board shoots when the computer asks"] = Trigger.SOFTWARE
        port: Annotated[str, "serial device or socket://host:port; empty: the only board plugged in"] = ""
        pon_ns: Annotated[float, Limits(0, 2000), "positive pulse"] = 88.0
        poff_ns: Annotated[float, Limits(0, 2000), "negative pulse"] = 88.0
        damp_ns: Annotated[float, Limits(0, 20000), "damping after the pulse; its end makes a small false echo"] = 2000.0
        time_zero: Annotated[Optional[TimeZero], "none: from the forerun if there is one"] = None
        zero_after_bang: Annotated[float, Limits(0, 100), "samples from the pulse's onset to time zero"] = shell.ZERO_AFTER_BANG
        blind_us: Annotated[float, Limits(0, 20), "after time zero; clipping there is the transmit pulse's"] = 3.0
        verify: Annotated[bool, "read every line twice and compare; without it a damaged digit goes unseen"] = True
        auto_gain: Annotated[bool, "step the gain down when an echo clips, up when it is faint"] = False

    settings: Settings

    def __init__(self, settings: Optional[AModeSettings] = None) -> None:
        super().__init__(settings)
        if self.settings.trigger is not Trigger.SOFTWARE:
            raise InputError("the pic0rick fires only on request; set trigger=software")
        if self.settings.time_zero is TimeZero.FORERUN and not self._has_forerun:
            raise InputError("time_zero=forerun needs forerun_length_mm and forerun_speed_m_s of the probe")
        self._sampling_hz = float("nan")
        self._code = shell.gain_code(self.settings.gain_db)
        self._sequence = 0
        self._shots: list[tuple[float, shell.AlignedShot]] = []  # of the next line, with their times
        self._flights: deque[float] = deque(maxlen=FLIGHTS)

    @property
    def acquisition(self) -> Acquisition:
        """Sampling rate of the board; transducer and forerun as set."""
        return self.settings.acquisition(self._sampling_hz)

    @property
    def gain_db(self) -> float:
        """The gain in force."""
        return shell.gain_db_of_code(self._code)

    @property
    def _has_forerun(self) -> bool:
        return self.settings.forerun_length_mm > 0 and self.settings.forerun_speed_m_s > 0

    @property
    def _use_forerun(self) -> bool:
        return self._has_forerun and self.settings.time_zero is not TimeZero.CONSTANT

    # -- connection

    def _connect(self) -> ByteLink:
        name = self.settings.port or _only_board()
        self._link = ByteLink.open(name)
        product = usb_product(name)
        default_hz = shell.RP2040_SAMPLING_HZ if product == shell.USB_RP2040 else shell.RP2350_SAMPLING_HZ
        self._sampling_hz = self.settings.sampling_hz or default_hz
        self._find_prompt(name)
        self._write_gain(self._code)  # unknown after a reboot
        return self._link

    def _find_prompt(self, name: str) -> None:
        """Talk to whatever is at the port until it prompts like the shell firmware."""
        end, heard = time.monotonic() + OPEN_S, b""
        heard += self.link.drain(SETTLE_S, SETTLE_S)
        tries = [b"\n", b"\n", b"?\n"]  # one firmware ignores empty lines, none ignores an unknown command
        while time.monotonic() < end:
            self.link.write(tries.pop(0) if len(tries) > 1 else tries[0])
            received = self.link.drain(QUIET_S, 1.0)
            heard += received
            if received.endswith(b"\r\n" + shell.PROMPT):
                return
        raise DeviceError(_not_a_shell(name, heard))

    def _begin(self) -> None:
        self._shots = []  # nothing to switch on: it fires only on request

    def _end(self) -> None:
        return

    # -- transactions

    def _transact(self, command: str, limit_s: float, until: bytes = b"") -> tuple[Optional[bytes], float]:
        """A command's answer, None if it did not come whole; and when `until` was seen in it."""
        stray = self.link.read(0.0)
        if stray:
            self.counters["stray bytes"] += len(stray)
        self.link.write(command.encode("ascii") + b"\n")
        received, seen_s = b"", float("nan")
        end = time.monotonic() + limit_s
        while time.monotonic() < end:
            received += self.link.read()
            if until and np.isnan(seen_s) and until in received:
                seen_s = time.monotonic()
            answer = shell.answer_to(command, received)
            if answer is not None:
                return answer, seen_s
        self._resynchronise()
        return None, seen_s

    def _resynchronise(self) -> None:
        """After any surprise: let the line fall silent, then ask for a fresh prompt."""
        self.counters["resynchronisations"] += 1
        self.link.drain(QUIET_S)
        self.link.write(b"\n")
        self.link.drain(QUIET_S, 1.0)

    def _write_gain(self, code: int) -> None:
        self._shots = []
        for _ in range(3):
            answer, _ = self._transact(f"write dac {code}", WRITE_S)
            if answer is not None and b"DAC writing ended" in answer:
                self._code = code
                return
            self._resynchronise()
        raise DeviceError(f"the pic0rick at {self.link.name} does not take its gain; unplug it and plug it in again")

    def _apply_gain(self, gain_db: float) -> None:
        self._write_gain(shell.gain_code(gain_db))

    # -- lines

    def _next_line(self, timeout_s: float) -> Optional[RfLine]:
        """One line of `averaging` shots of one gain; those of a line that is not done in time wait for the next call."""
        end = time.monotonic() + timeout_s
        while True:
            shot_s, codes = self._shoot()
            shot = None if codes is None else self._aligned(codes)
            if shot is not None:
                self._shots.append((shot_s, shot))
            if len(self._shots) >= self.settings.averaging:
                break
            if time.monotonic() >= end:
                return None
        times, shots = [shot_s for shot_s, _ in self._shots], [shot for _, shot in self._shots]
        self._shots = []
        self._sequence += 1
        line = RfLine(self._averaged(shots), float(np.mean(times)), self._sequence, any(s.clipped for s in shots), self.gain_db)
        if self.settings.auto_gain:
            self._follow_gain(line)
        return line

    def _shoot(self) -> tuple[float, Optional[npt.NDArray[np.int64]]]:
        """One shot: its time and its codes, None if it was lost."""
        wanted = self.settings
        command = shell.start_command(wanted.pon_ns, wanted.poff_ns, wanted.damp_ns)
        answer, shot_s = self._transact(command, SHOT_S, until=b"Acquisition ended")
        self.counters["shots"] += 1
        if answer is None or b"Acquisition ended" not in answer:
            self.counters["lost shots"] += 1
            return shot_s, None
        if b"ADC timeout" in answer:  # half zeros, half the last shot
            self.counters["ADC timeouts"] += 1
            return shot_s, None
        codes = self._read_buffer()
        if codes is None:
            self.counters["lost shots"] += 1
        return shot_s, codes

    def _read_buffer(self) -> Optional[npt.NDArray[np.int64]]:
        """The board's buffer. Its text has no check sum: a lost or changed digit shows only in a second reading."""
        good: list[npt.NDArray[np.int64]] = []
        for _ in range(READ_ATTEMPTS):
            answer, _ = self._transact("read", READ_S)
            try:
                codes = shell.parse_codes(answer if answer is not None else b"")
            except ValueError:
                self.counters["damaged reads"] += 1
                continue
            if not self.settings.verify or any(np.array_equal(codes, earlier) for earlier in good):
                return codes
            if good:
                self.counters["damaged reads"] += 1
            good.append(codes)
        return None

    def _aligned(self, codes: npt.NDArray[np.int64]) -> Optional[shell.AlignedShot]:
        wanted = self.settings
        try:
            flights = self._flights if self._use_forerun else None
            return shell.align_shot(codes, self.acquisition, flights, wanted.zero_after_bang, wanted.blind_us)
        except ValueError as error:
            self.counters[str(error)] += 1
            return None

    def _averaged(self, shots: list[shell.AlignedShot]) -> npt.NDArray[np.int16]:
        """Mean of the shots, from the transmit pulse to the end of the range; flat up to the delay."""
        first = round(self.settings.delay_us * 1e-6 * self._sampling_hz)
        length = min(first + round(self.settings.range_us * 1e-6 * self._sampling_hz), *(len(shot.samples) for shot in shots))
        mean: npt.NDArray[np.float64] = np.mean([shot.samples[:length] for shot in shots], axis=0)
        first = min(first, length - 1)
        mean[:first] = mean[first]
        return np.round(mean).astype(np.int16)

    def _follow_gain(self, line: RfLine) -> None:
        """Between lines: down when an echo clips, up when the largest is faint."""
        blind = int(self.settings.blind_us * 1e-6 * self._sampling_hz)
        peak = float(np.abs(line.samples[blind:].astype(float)).max(initial=0.0)) / (shell.STEPS_A_CODE * shell.CODE_MIDDLE)
        step = -GAIN_STEP_DB if line.saturated or peak > LOUD else GAIN_STEP_DB if peak < QUIET else 0.0
        wanted = shell.gain_code(self.gain_db + step)
        if step and wanted != self._code:
            self._write_gain(wanted)


def _only_board() -> str:
    """The port of the only board plugged in."""
    boards = usb_ports({shell.USB_RP2040, shell.USB_RP2350})
    if len(boards) == 1:
        return boards[0]
    if boards:
        raise InputError(f"several boards may be the pic0rick: {', '.join(boards)}; set its parameter port")
    raise DeviceError("no pic0rick is plugged in (no Raspberry Pi board on USB); plug it in, or set its parameter port")


def _not_a_shell(name: str, heard: bytes) -> str:
    """Why what answered is not the firmware that this driver speaks to."""
    text = heard.decode("ascii", errors="replace")
    if "Enter a number between" in text or "triggering number" in text:
        return f"the board at {name} runs the old menu firmware (v1.0 or VGA); flash the current shell firmware"
    if text.startswith(("OK ", "ERR ")) or "\nOK " in text or "\nERR " in text:
        return f"the board at {name} runs the binary envelope firmware; flash the shell firmware"
    if not heard:
        return f"nothing answers at {name} in {OPEN_S:.0f} s; is it the pic0rick's port, and its firmware running?"
    return f"{name} does not prompt like the pic0rick's shell firmware; it sent {text[-60:]!r}; check the port and the firmware"
