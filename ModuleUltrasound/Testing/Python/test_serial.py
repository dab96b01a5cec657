"""The serial driver against the emulated pulser: what is recorded is what arrives, whatever the line does to it."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.sequence_metafile import Acquisition, Recording
from ModuleUltrasoundLib.devices.connection import ByteLink, DeviceState
from ModuleUltrasoundLib.devices.device import AMODE_DEVICES, DeviceError
from ModuleUltrasoundLib.emulators.amode_serial import SerialPulser
from ModuleUltrasoundLib.emulators.faults import Faults
from ModuleUltrasoundLib.emulators.line_source import RecordedLines
from ModuleUltrasoundLib.emulators.server import PtyDoor, served


def a_recording(count: int = 12, samples: int = 1500) -> Recording:
    rng = np.random.default_rng(3)
    return Recording(
        lines=rng.integers(-3000, 3000, (count, samples)).astype(np.int16),
        acquisition=Acquisition(50e6, 5e6, 20.0, 2340.0),
        probe_to_reference=np.tile(np.eye(4), (count, 1, 1)),
        statuses=("OK",) * count,
        timestamps_s=np.arange(count) / 20.0,
        palpation_points=np.full(count, -1),
    )


def a_pulser(*faults: str, rate_hz: float = 200.0) -> SerialPulser:
    return SerialPulser(RecordedLines(a_recording()), Faults(faults, seed=5), rate_hz)


def lines_of(device, count: int) -> list:
    taken = []
    while len(taken) < count:
        line = device.read(2.0)
        assert line is not None
        taken.append(line)
    return taken


@pytest.mark.parametrize("door", ["tcp", "pty"])
def test_recorded_lines_arrive_bit_for_bit(door):
    with served(a_pulser(), PtyDoor() if door == "pty" else None) as port:
        device = AMODE_DEVICES.create("serial", port=port, range_us="30")
        with device:
            taken = lines_of(device, 12)
            assert device.acquisition.sampling_hz == 50e6
        assert device.state is DeviceState.CLOSED
    recorded = a_recording().lines
    first = taken[0].sequence_number - 1
    for k, line in enumerate(taken):
        assert np.array_equal(line.samples, recorded[(first + k) % 12])
        assert line.sequence_number == first + k + 1


def test_a_delay_keeps_time_zero_at_the_transmit_pulse():
    with served(a_pulser()) as port, AMODE_DEVICES.create("serial", port=port, delay_us="4", range_us="10") as device:
        line = lines_of(device, 1)[0]
    recorded = a_recording().lines[(line.sequence_number - 1) % 12]
    assert len(line.samples) == 14e-6 * 50e6
    assert np.array_equal(line.samples[200:], recorded[200:700])
    assert np.all(line.samples[:200] == recorded[200])


def test_gain_changes_the_lines_and_is_told():
    with served(a_pulser()) as port, AMODE_DEVICES.create("serial", port=port, range_us="30") as device:
        device.set_gain_db(36.0)
        line = lines_of(device, 1)[0]
        device.close()
        with device:  # as after a pulled cable
            assert lines_of(device, 1)[0].gain_db == 36.0
    recorded = a_recording().lines[(line.sequence_number - 1) % 12].astype(float)
    assert line.gain_db == 36.0
    assert np.allclose(line.samples, recorded * 10 ** (6 / 20), atol=0.51)


def test_a_software_trigger_gives_a_line_a_request():
    with served(a_pulser()) as port, AMODE_DEVICES.create("serial", port=port, trigger="software", range_us="30") as device:
        assert [line.sequence_number for line in lines_of(device, 3)] == [1, 2, 3]


@pytest.mark.parametrize(
    "faults", [("byte-loss=0.3",), ("bit-errors=0.3",), ("byte-loss", "bit-errors", "stall=0.02", "stale-fragment")]
)
def test_a_bad_line_costs_lines_but_never_gives_a_wrong_one(faults):
    pulser = a_pulser(*faults)
    with served(pulser) as port, AMODE_DEVICES.create("serial", port=port, range_us="30") as device:
        taken = lines_of(device, 60)
    recorded = a_recording().lines
    assert all(np.array_equal(line.samples, recorded[(line.sequence_number - 1) % 12]) for line in taken)
    assert device.counters["damaged frames"] > 0
    assert device.counters["missed lines"] > 0


def test_a_pulled_cable_is_told_once_and_lines_come_again():
    pulser = a_pulser("disconnect=0.05")
    with served(pulser) as port, AMODE_DEVICES.create("serial", port=port, range_us="30") as device:
        good, lost = 0, 0
        for _ in range(400):
            try:
                line = device.read(0.3)
            except DeviceError:
                assert device.state is DeviceState.LOST
                lost += 1
                continue
            good += line is not None
            if lost and device.counters["reconnects"] and good > 20:
                break
        assert lost >= 1
        assert device.counters["reconnects"] >= 1
        assert device.state in (DeviceState.RUNNING, DeviceState.LOST)


def test_lost_device_gives_no_lines_and_no_hang_while_it_is_away():
    with served(a_pulser()) as port:
        device = AMODE_DEVICES.create("serial", port=port, range_us="30")
        device.open()
        device.start()
        lines_of(device, 1)
    with pytest.raises(DeviceError, match="was lost"):
        for _ in range(200):
            device.read(0.2)
    assert device.state is DeviceState.LOST
    assert device.read(0.1) is None
    device.stop()
    device.close()
    device.close()


def test_a_setting_that_the_device_lacks_is_refused_in_its_words():
    with served(a_pulser()) as port, pytest.raises(InputError, match=r"refuses .*no trigger input"):
        AMODE_DEVICES.create("serial", port=port, trigger="external").open()


def test_a_port_that_is_not_there_says_what_to_do():
    with pytest.raises(DeviceError, match=r"cannot open /dev/ttyNOWHERE: no such port"):
        AMODE_DEVICES.create("serial", port="/dev/ttyNOWHERE").open()
    with pytest.raises(DeviceError, match="start the device's server or the emulator"):
        AMODE_DEVICES.create("serial", port="socket://127.0.0.1:1").open()
    with pytest.raises(InputError, match="set its parameter port"):
        AMODE_DEVICES.create("serial").open()


def test_no_port_is_ever_opened_at_1200_baud():
    with pytest.raises(InputError, match="bootloader"):
        ByteLink.open("socket://127.0.0.1:1", 1200)


def test_a_line_read_before_start_is_refused():
    with pytest.raises(DeviceError, match="open and start it"):
        AMODE_DEVICES.create("serial", port="socket://127.0.0.1:1").read(0.0)


def test_an_unknown_fault_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match=r"unknown fault 'gremlins'; known: byte-loss"):
        Faults(["gremlins"])
