"""A-lines from any OpenIGTLink server: IMAGE messages of N x 1 x 1 int16."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import Annotated, Optional

import numpy as np
from CranioNavLib.openigtlink import IgtlClient
from CranioNavLib.openigtlink.messages import Image, Message
from CranioNavLib.parameters import Limits
from CranioNavLib.sequence_metafile import Acquisition

from ModuleUltrasoundLib.devices.amode_settings import AModeSettings
from ModuleUltrasoundLib.devices.connection import DeviceState
from ModuleUltrasoundLib.devices.device import AModeDevice, DeviceError, RfLine

INT16_ENDS = (-32768, 32767)
CLOCKS_AGREE_S = 0.5  # a sender's time stamp that differs more from this computer's clock says nothing here


class OpenIGTLinkDevice(AModeDevice):
    """Client of an OpenIGTLink server that sends A-lines.

    The protocol does not say how a line was sampled: `sampling_hz` must be given. Gain, delay, range, averaging and trigger are
    the sender's own affair. A message whose checksum is wrong, or that is no line, is counted and never a line.
    """

    name = "openigtlink"
    title = "A-lines from an OpenIGTLink server (PlusServer, 3D Slicer)"

    @dataclass(frozen=True)
    class Settings(AModeSettings):
        sampling_hz: Annotated[Optional[float], Limits(1e6, 1e9), "sampling rate of the sender's lines"] = 60e6
        host: Annotated[str, "name or address of the server"] = "127.0.0.1"
        port: Annotated[int, Limits(1, 65535), "TCP port"] = 18944
        device: Annotated[str, "device name of the IMAGE messages; empty: any that is a line"] = ""
        connect_timeout_s: Annotated[float, Limits(0.1, 60), "longest wait for the server when opening"] = 3.0
        silence_s: Annotated[float, Limits(0.1, 60), "a server heard nothing of for so long counts as lost"] = 2.0

    settings: Settings

    def __init__(self, settings: Optional[AModeSettings] = None) -> None:
        super().__init__(settings)
        self.state = DeviceState.CLOSED
        self.counters: Counter[str] = Counter()
        self._client: Optional[IgtlClient] = None
        self._lines: deque[RfLine] = deque()
        self._count = 0

    @property
    def acquisition(self) -> Acquisition:
        """As set: the protocol does not carry it."""
        return self.settings.acquisition(self.settings.sampling_hz or float("nan"))

    def open(self) -> None:
        """Connect to the server.

        Raises
        ------
        DeviceError
            Nobody answers.
        """
        wanted = self.settings
        if wanted.sampling_hz is None:
            raise DeviceError("OpenIGTLink does not tell how lines are sampled; set the parameter sampling_hz")
        client = IgtlClient(wanted.host, wanted.port, wanted.silence_s)
        deadline = time.monotonic() + wanted.connect_timeout_s
        while not client.connected and time.monotonic() < deadline:
            self._take(client.receive(0.1), client)
        if not client.connected:
            client.close()
            raise DeviceError(f"OpenIGTLink: {client.problem}")
        self._client, self.state = client, DeviceState.CONNECTED

    def start(self) -> None:
        """The server sends by itself; lines that came since `open` are kept."""
        if self.state is DeviceState.CONNECTED:
            self.state = DeviceState.RUNNING

    def read(self, timeout_s: float = 1.0) -> Optional[RfLine]:
        """The next line; None if none came in time, or while a lost server is away.

        Raises
        ------
        DeviceError
            The server was lost just now, or the device was never started.
        """
        client = self._client
        if client is None or self.state not in (DeviceState.RUNNING, DeviceState.LOST):
            raise DeviceError(f"the {self.name} device is {self.state.value}; open and start it before reading lines")
        deadline = time.monotonic() + timeout_s
        while not self._lines:
            left = deadline - time.monotonic()
            if left <= 0:
                return None
            self._take(client.receive(min(left, 0.1)), client)
            if client.connected and not client.silent:
                self.state = DeviceState.RUNNING
            elif self.state is DeviceState.RUNNING:
                self.state = DeviceState.LOST
                self.counters["lost"] += 1
                if not self._lines:
                    raise DeviceError(f"OpenIGTLink: {client.problem}")
        return self._lines.popleft()

    def stop(self) -> None:
        """No more lines are read; the server is not asked to stop: others may listen."""
        if self.state in (DeviceState.RUNNING, DeviceState.LOST):
            self.state = DeviceState.CONNECTED

    def close(self) -> None:
        """Disconnect; may be called twice, and after a failure."""
        client, self._client = self._client, None
        if client is not None:
            client.close()
        self._lines.clear()
        self.state = DeviceState.CLOSED

    def _take(self, messages: list[Message], client: IgtlClient) -> None:
        for message in messages:
            if isinstance(message, Image) and (not self.settings.device or message.device == self.settings.device):
                line = self._line_of(message, client.arrival_s)
                if line is not None:
                    self._lines.append(line)
        self.counters["damaged messages"] = client.rejected

    def _line_of(self, message: Image, arrival_s: float) -> Optional[RfLine]:
        voxels = message.voxels
        if voxels.ndim != 3 or voxels.shape[:2] != (1, 1) or voxels.dtype.kind != "i" or voxels.dtype.itemsize != 2:
            self.counters["images that are no line"] += 1
            return None
        samples = np.ascontiguousarray(voxels.reshape(-1), dtype=np.int16)
        saturated = bool(samples.min() == INT16_ENDS[0] or samples.max() == INT16_ENDS[1])
        self._count += 1
        return RfLine(samples, self._host_time(message.time_s, arrival_s), self._count - 1, saturated)

    @staticmethod
    def _host_time(sent_s: float, arrival_s: float) -> float:
        """The sender's time of the line on this computer's monotonic clock; its arrival if the clocks do not agree."""
        age = time.time() - sent_s - (time.monotonic() - arrival_s)
        return arrival_s - age if sent_s > 0 and 0.0 <= age < CLOCKS_AGREE_S else arrival_s
