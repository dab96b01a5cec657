"""A device is closed whatever happens to it."""

from __future__ import annotations

import pytest
from CranioNavLib.device_plugin import DevicePlugin


class Lamp(DevicePlugin):
    """Notes what is asked of it and fails at one of the calls."""

    name = "lamp"

    def __init__(self, fails_at: str = "") -> None:
        super().__init__()
        self.fails_at, self.asked = fails_at, []

    def _note(self, call: str) -> None:
        self.asked.append(call)
        if call == self.fails_at:
            raise RuntimeError(f"{call} failed")

    def open(self) -> None:
        self._note("open")

    def start(self) -> None:
        self._note("start")

    def stop(self) -> None:
        self._note("stop")

    def close(self) -> None:
        self._note("close")


def test_with_opens_starts_stops_and_closes():
    lamp = Lamp()
    with lamp as entered:
        assert entered is lamp
        assert lamp.asked == ["open", "start"]
    assert lamp.asked == ["open", "start", "stop", "close"]


@pytest.mark.parametrize(
    ("fails_at", "asked"),
    [
        ("open", ["open", "close"]),
        ("start", ["open", "start", "close"]),
        ("stop", ["open", "start", "stop", "close"]),
    ],
)
def test_a_device_that_fails_is_closed_and_says_so(fails_at, asked):
    lamp = Lamp(fails_at)
    with pytest.raises(RuntimeError, match=f"{fails_at} failed"), lamp:
        pass
    assert lamp.asked == asked


def test_a_device_is_closed_when_its_user_fails():
    lamp = Lamp()
    with pytest.raises(ZeroDivisionError), lamp:
        raise ZeroDivisionError
    assert lamp.asked == ["open", "start", "stop", "close"]
