"""The list of ports to choose from, the search for the tracker among them, and addresses."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from CranioNavLib.errors import InputError
from ModuleTrackingLib.ndi import serial_port
from ModuleTrackingLib.ndi.serial_port import list_ports, open_port, same_device, tcp_address
from ModuleTrackingLib.ndi.steps import PortLostError
from ModuleTrackingLib.plugins import polaris
from ModuleTrackingLib.tracker import TRACKERS, TrackerError
from polaris_rig import Rig


def port(device, description, vid=None, serial_number=None):
    return SimpleNamespace(
        device=device, description=description, manufacturer=None, product=None, vid=vid, pid=vid, serial_number=serial_number
    )


@pytest.fixture
def some_ports(monkeypatch):
    """Four ports, the tracker's last."""
    from serial.tools import list_ports as tools

    found = [
        port("/dev/ttyS0", "ttyS0"),
        port("/dev/rfcomm0", "Bluetooth headset"),
        port("/dev/ttyUSB0", "FT232R USB UART", 0x0403, "A1"),
        port("/dev/ttyUSB1", "NDI Polaris Vega", 0x0403, "B2"),
    ]
    monkeypatch.setattr(tools, "comports", lambda: found)
    monkeypatch.setattr(serial_port.os, "access", lambda path, mode: path != "/dev/ttyS0")
    return found


def test_likely_ports_come_first_and_each_says_why(some_ports):
    choices = list_ports()
    assert [choice.device for choice in choices] == ["/dev/ttyUSB1", "/dev/ttyUSB0", "/dev/rfcomm0", "/dev/ttyS0"]
    assert [choice.rank for choice in choices] == [0, 1, 2, 2]
    assert "tracker" in choices[0].hint
    assert "possible" in choices[1].hint
    assert "Bluetooth" in choices[2].hint
    assert "join the group dialout" in choices[3].hint


def test_words_that_only_contain_the_makers_name_do_not_count(some_ports, monkeypatch):
    some_ports[:] = [port("/dev/ttyUSB9", "Handi-Scan adapter", 1)]
    assert list_ports()[0].rank == 1


def test_an_adapter_is_found_again_under_another_name(some_ports):
    assert same_device("/dev/ttyUSB7", (0x0403, 0x0403, "B2")) == "/dev/ttyUSB1"
    assert same_device("/dev/ttyUSB7", (0x0403, 0x0403, "C3")) == "/dev/ttyUSB7"
    assert same_device("/dev/ttyUSB7", (0, 0, "")) == "/dev/ttyUSB7"


def test_auto_asks_the_likely_ports_and_takes_the_one_that_answers(some_ports):
    rig = Rig(port="auto")
    asked = []

    def open_one(url):
        asked.append(url)
        if url == "/dev/ttyUSB0":
            return rig._open_port(url)
        raise PortLostError("busy")

    rig.tracker.open_port = open_one
    with rig.tracker:
        assert rig.check(rig.tracker.read()) == 4
    assert asked[:2] == ["/dev/ttyUSB1", "/dev/ttyUSB0"]
    assert not {"/dev/ttyS0", "/dev/rfcomm0"} & set(asked)


def test_auto_without_an_answer_says_which_ports_were_asked(some_ports):
    rig = Rig(port="auto")
    rig.station.unplug(rig.clock.now(), 1e6)
    with pytest.raises(TrackerError, match=r"asked: /dev/ttyUSB1 .*, /dev/ttyUSB0 .*Switch it on"):
        rig.tracker.open()
    assert rig.tracker.state is polaris.PolarisState.DISCONNECTED


def test_network_addresses_are_read_and_others_refused():
    assert tcp_address("socket://camera.local:8765") == ("camera.local", 8765)
    for url in ("socket://camera", "socket://:8765", "socket://camera:port", "http://camera:80"):
        with pytest.raises(InputError, match="socket://host:port"):
            tcp_address(url)


def test_a_network_tracker_that_is_not_there_is_said_so():
    with pytest.raises(PortLostError, match=r"no connection to socket://127\.0\.0\.1:9: .*check that the tracker is on"):
        open_port("socket://127.0.0.1:9")
    with pytest.raises(TrackerError, match="no connection"):
        TRACKERS.create("polaris", port="socket://127.0.0.1:9").open()
