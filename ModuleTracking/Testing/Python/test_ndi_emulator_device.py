"""The emulated device command by command, as bytes."""

from __future__ import annotations

import pytest
from ModuleTrackingLib.ndi.emulator.device import EmulatedPolaris, Model
from ModuleTrackingLib.ndi.emulator.station import Station, make_faults
from ModuleTrackingLib.ndi.replies import command_bytes, text_payload
from polaris_rig import CountingMotion


class Desk:
    """A device, and somebody who types commands."""

    def __init__(self, **model) -> None:
        self.device, self.now_s = EmulatedPolaris(CountingMotion(), model=Model(**model)), 10.0

    def __call__(self, command: str) -> str:
        (reply,) = self.device.receive(command_bytes(command), self.now_s)
        assert reply.endswith(b"\r")
        return text_payload(reply[:-1]).decode()

    def all(self, *commands: str) -> list[str]:
        return [self(command) for command in commands]


def test_documented_exchanges_come_out_to_the_byte():
    device = EmulatedPolaris(CountingMotion())
    assert device.receive(b"INIT:E3A5\r", 0.0) == [b"OKAYA896\r"]
    assert device.receive(b"INIT \r", 0.0) == [b"OKAYA896\r"]
    assert device.receive(b"TX:0001031A\r", 0.0) == [b"ERROR0C4E42\r"]
    assert device.receive(b"NONSENSE \r", 0.0) == [b"ERROR016BC2\r"]
    assert device.receive(b"INIT:0000\r", 0.0) == [b"ERROR046802\r"]


def test_commands_may_come_in_pieces():
    device = EmulatedPolaris(CountingMotion())
    assert device.receive(b"INIT", 0.0) == []
    assert device.receive(b":E3A5", 0.0) == []
    assert device.receive(b"\rVER", 0.0) == [b"OKAYA896\r"]


@pytest.mark.parametrize("way", ["break", "command"])
def test_break_and_reset_lose_everything_and_are_announced_after_the_boot(way):
    device = EmulatedPolaris(CountingMotion(), model=Model(boot_s=2.0))
    device.receive(command_bytes("INIT:") + command_bytes("COMM:50000"), 0.0)
    assert device.speed == 115200
    assert device.receive(b"\0" if way == "break" else b"RESET 0\r", 1.0) == []
    assert device.speed == 9600
    assert device.receive(b"INIT:E3A5\r", 2.0) == []  # it boots
    assert device.booted(2.9) == []
    assert device.booted(3.0) == [b"RESETBE6F\r"]
    assert device.booted(3.1) == []


def test_handles_go_through_their_states():
    desk = Desk()
    assert desk.all("INIT:", "PHSR:01", "PHRQ:*********1****", "PHRQ:*********1****") == ["OKAY", "00", "01", "02"]
    assert desk("PHSR:02") == "0201001" + "02001"
    assert desk("PENA:01D") == "ERROR0E"
    assert desk.all("PINIT:01", "PHSR:03", "PENA:01X", "PENA:01D", "PHSR:04") == ["OKAY", "0101011", "ERROR09", "OKAY", "0101031"]
    assert desk.all("PDIS:01", "PHF:01", "PHSR:00", "PHF:01") == ["OKAY", "OKAY", "0102001", "ERROR08"]


def test_a_tool_file_with_a_hole_is_refused():
    desk = Desk()
    desk.all("INIT:", "PHRQ:*********1****")
    for address in range(0, 1024 - 64, 64):
        assert desk(f"PVWR:01{address:04X}" + "00" * 64) == "OKAY"
    assert desk("PINIT:01") == "ERROR13"
    assert desk("PVWR:0103C0" + "00" * 64) == "OKAY"
    assert desk("PINIT:01") == "OKAY"
    assert desk("PVWR:010400" + "00" * 64) == "ERROR1F"
    assert desk("PVWR:010000" + "00" * 63) == "ERROR1F"


def test_while_tracking_only_tracking_commands_are_legal():
    desk = Desk()
    assert desk("PHSR:00") == "ERROR10"
    assert desk.all("INIT:", "TSTOP:", "TSTART:", "INIT:", "PHSR:00", "BEEP:2", "TSTOP:") == [
        "OKAY",
        "ERROR0C",
        "OKAY",
        "ERROR0C",
        "ERROR0C",
        "1",
        "OKAY",
    ]


def test_handles_run_out():
    desk = Desk(handles=2)
    assert desk.all("INIT:", *["PHRQ:*********1****"] * 3) == ["OKAY", "01", "02", "ERROR2D"]


def test_replies_at_another_speed_are_noise_and_commands_are_not_heard():
    station = Station(EmulatedPolaris(CountingMotion(), make_faults([])))
    station.receive(b"INIT:E3A5\r", 115200, 0.0)
    assert station.take_due(0.0, 115200) == b""
    station.receive(b"INIT:E3A5\r", 9600, 1.0)
    assert station.take_due(1.0, 115200) not in (b"", b"OKAYA896\r")
    station.receive(b"COMM:500000048\r", 9600, 2.0)
    assert station.take_due(2.0, 9600) == b"OKAYA896\r"  # still at the old speed
    station.receive(b"INIT:E3A5\r", 115200, 3.0)
    assert station.take_due(3.0, 115200) == b"OKAYA896\r"


def test_paced_replies_take_their_time_on_the_line():
    station = Station(EmulatedPolaris(CountingMotion(), make_faults([])), paced=True)
    station.receive(b"INIT:E3A5\r", 9600, 0.0)
    assert station.take_due(0.009, 9600) == b""
    assert station.wakes_at_s() == pytest.approx(9 * 10 / 9600)
    assert station.take_due(0.0095, 9600) == b"OKAYA896\r"


def test_frame_numbers_go_on_after_tstop_and_start_anew_when_asked():
    desk = Desk()
    desk.all("INIT:", "PHSR:02", "PINIT:01", "PENA:01D", "TSTART:")
    desk.now_s += 1.0
    assert desk("TX:0001")[-13:-5] == f"{61:08X}"
    desk.all("TSTOP:", "TSTART:")
    assert desk("TX:0001")[-13:-5] == f"{62:08X}"
    desk.all("TSTOP:", "TSTART:80")
    assert desk("TX:0001")[-13:-5] == f"{1:08X}"
