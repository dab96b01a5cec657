"""The device's clock expressed in the host's: offset, drift and jitter, estimated while poses arrive."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

BIN_S = 1.0  # the fastest arrival of each bin carries the least transport delay
BINS = 60  # the drift is estimated over the last minute
BINS_FOR_DRIFT = 10  # below, the minima's own scatter (about 0.1 ms over USB) would pass for drift
LARGEST_DRIFT = 1e-3  # quartz is within 1e-4; more means that the device's clock jumped or its rate was set wrongly
JUMP_S = 0.5  # an arrival so far from its expected time before: the device was restarted
JITTER_SAMPLES = 512


@dataclass(frozen=True)
class ClockReport:
    """How well the device's clock is known."""

    offset_s: float  # host minus device time, now
    drift_ppm: float  # how much faster (positive: slower) the device counts, in parts per million of host time
    jitter_ms: float  # SD of the arrivals about the clock
    worst_delay_ms: float  # 99th percentile of the delay beyond the fastest arrivals
    samples: int
    restarts: int  # times that the device's clock jumped


class DeviceClock:
    """Maps device time to host time by the fastest arrivals.

    A pose arrives after its acquisition by a delay that is at least the device's own (constant, unknown) and often more.
    The lower envelope of host minus device time is free of the variable part; a line through it gives offset and drift.
    The constant part stays in the offset: mapped times are late by it, for all poses alike.
    """

    def __init__(self) -> None:
        self.restarts = 0
        self._reset()

    def _reset(self) -> None:
        self._bins: deque[tuple[float, float]] = deque(maxlen=BINS)  # device time and host - device of each bin's minimum
        self._bin = math.nan
        self._least = (math.nan, math.inf)
        self._origin = math.nan
        self._slope = 0.0
        self._offset = math.inf
        self._delays: deque[float] = deque(maxlen=JITTER_SAMPLES)
        self._samples = 0
        self._latest = -math.inf

    def restart(self) -> None:
        """Forget what was learnt; the device was connected anew and its clock may stand anywhere."""
        if self._samples:
            self.restarts += 1
            self._reset()

    def map(self, device_s: float, host_s: float) -> float:
        """Host time at which a pose was taken whose device time is `device_s` and that arrived at `host_s`.

        Never later than its arrival. Without a device time (NaN) the arrival is all there is.
        """
        if not math.isfinite(device_s):
            return host_s
        difference = host_s - device_s
        # Delays are positive and may be long; only an arrival that is too early, or a clock that ran back, is a jump.
        if self._samples and (difference < self._expected(device_s) - JUMP_S or device_s < self._latest - JUMP_S):
            self.restart()
        if not self._samples:
            self._origin = device_s
        self._latest = device_s
        self._samples += 1
        self._add(device_s, difference)
        mapped = device_s + self._expected(device_s)
        self._delays.append(host_s - mapped)
        return min(mapped, host_s)

    def report(self) -> ClockReport:
        """The state of the estimate; NaN before the first sample."""
        if not self._samples:
            return ClockReport(math.nan, math.nan, math.nan, math.nan, 0, self.restarts)
        delays = np.array(self._delays) * 1e3
        return ClockReport(
            offset_s=self._expected(self._latest),
            drift_ppm=self._slope * 1e6,
            jitter_ms=float(delays.std()),
            worst_delay_ms=float(np.percentile(delays, 99)),
            samples=self._samples,
            restarts=self.restarts,
        )

    def _expected(self, device_s: float) -> float:
        return self._offset + self._slope * (device_s - self._origin)

    def _add(self, device_s: float, difference: float) -> None:
        number = math.floor(device_s / BIN_S)
        if number != self._bin:
            if math.isfinite(self._least[0]):
                self._bins.append(self._least)
                self._fit()
            self._bin, self._least = number, (device_s, difference)
        elif difference < self._least[1]:
            self._least = (device_s, difference)
        self._offset = min(self._offset, difference - self._slope * (device_s - self._origin))

    def _fit(self) -> None:
        times, least = np.array(self._bins).T
        if len(times) >= BINS_FOR_DRIFT:
            slope = float(np.polyfit(times - times.mean(), least, 1)[0])
            self._slope = min(max(slope, -LARGEST_DRIFT), LARGEST_DRIFT)
        self._offset = float(np.min(least - self._slope * (times - self._origin)))
