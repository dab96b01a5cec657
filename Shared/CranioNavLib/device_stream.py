"""A device read in a thread of its own, opened again whenever it fails. What comes from it is queued by derived classes."""

from __future__ import annotations

import sys
import threading
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Optional, TypeVar

from CranioNavLib.device_plugin import DevicePlugin
from CranioNavLib.errors import InputError

READ_S = 0.1
CONNECTING = "connecting"  # the problem of a stream that has just been started
RETRY_S = 0.5  # a device that returns is found again well within 2 s
SWITCH_S = 0.001  # Python lets a busy thread go on for 5 ms otherwise: at 250 Hz a frame is gone after 4

S = TypeVar("S", bound="DeviceStream")


class DeviceStream(ABC):
    """The thread and its life. `with stream:` starts and stops it.

    Parameters
    ----------
    device : DevicePlugin
        It is opened, read and closed in the stream's thread alone.
    failure : type
        What the device raises when it fails or is lost; it is then opened again. All else ends the thread.
    thread_name : str
    """

    def __init__(self, device: DevicePlugin, failure: type[Exception], thread_name: str) -> None:
        self._source, self._failure, self._thread_name = device, failure, thread_name
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread: Optional[threading.Thread] = None
        self._connected, self._problem = False, "not started"

    def start(self) -> None:
        """Begin reading; returns at once, `state` tells when the device is connected."""
        if self._thread is None:
            self._stopping.clear()
            self._problem = CONNECTING
            sys.setswitchinterval(min(sys.getswitchinterval(), SWITCH_S))
            self._thread = threading.Thread(target=self._run, name=self._thread_name, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Stop reading and close the device; may be called twice."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(timeout=10.0)
            self._thread = None
        self._connected, self._problem = False, "stopped"

    def __enter__(self: S) -> S:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    # -- the device thread's side -----------------------------------------------------------------------------------

    @abstractmethod
    def _opened(self, again: bool) -> None:
        """The device is open and started; `again`: not for the first time since `start`."""

    @abstractmethod
    def _read(self) -> None:
        """Read the device once, for at most READ_S, and queue what came."""

    @abstractmethod
    def _lost(self, problem: str, error: Optional[BaseException] = None) -> None:
        """The connection is lost; with an `error` for good: it is for `poll` to raise on the main thread."""

    def _run(self) -> None:
        again = False
        while not self._stopping.is_set():
            try:
                with self._source:
                    self._opened(again)
                    again = True
                    while not self._stopping.is_set():
                        self._read()
            except self._failure as error:
                self._lost(str(error))
                self._stopping.wait(RETRY_S)
            except Exception as error:  # refused settings, or a defect of the plugin: shown on the main thread
                self._lost(str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}", error)
                return
