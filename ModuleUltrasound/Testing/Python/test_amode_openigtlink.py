"""A-lines over OpenIGTLink, from this project's server and from pyigtl's independent encoding."""

from __future__ import annotations

import socket
import struct
import threading
import time

import numpy as np
import pytest
from CranioNavLib.openigtlink import IgtlServer, encode
from CranioNavLib.openigtlink.messages import Image, String, a_line_image
from ModuleUltrasoundLib.devices.connection import DeviceState
from ModuleUltrasoundLib.devices.device import AMODE_DEVICES, DeviceError


def a_line(seed: int, count: int = 3000) -> np.ndarray:
    return np.random.default_rng(seed).integers(-32000, 32000, count).astype(np.int16)


@pytest.fixture
def a_listener():
    """A bare TCP server that sends given bytes to whoever connects, then waits."""
    listener = socket.create_server(("127.0.0.1", 0))
    peers = []

    def serve(data: bytes, close: bool = False) -> int:
        def run() -> None:
            peer, _ = listener.accept()
            peers.append(peer)
            peer.sendall(data)
            if close:
                time.sleep(0.3)
                peer.close()

        threading.Thread(target=run, daemon=True).start()
        return listener.getsockname()[1]

    yield serve
    for peer in peers:
        peer.close()
    listener.close()


def read_all(device, wait_s: float = 0.5) -> list:
    lines = []
    while (line := device.read(wait_s)) is not None:
        lines.append(line)
    return lines


def opened(port: int, **more: str):
    device = AMODE_DEVICES.create("openigtlink", port=str(port), **more)
    device.open()
    device.start()
    return device


def test_lines_arrive_bit_for_bit_in_order(a_listener):
    sent = [a_line(seed) for seed in range(8)]
    port = a_listener(b"".join(encode(a_line_image("ALine", samples, time.time())) for samples in sent))
    device = opened(port)
    lines = read_all(device)
    device.close()
    assert [line.sequence_number for line in lines] == list(range(8))
    assert all(np.array_equal(line.samples, samples) for line, samples in zip(lines, sent))
    assert device.acquisition.sampling_hz == 60e6


def test_lines_as_pyigtl_packs_them_arrive(a_listener):
    pyigtl = pytest.importorskip("pyigtl")
    samples = a_line(1)
    message = pyigtl.ImageMessage(samples.reshape(1, 1, -1), device_name="ALine")
    device = opened(a_listener(message.pack()))
    line = device.read(2.0)
    device.close()
    assert np.array_equal(line.samples, samples)


def test_the_projects_own_server_can_be_listened_to():
    with IgtlServer(port=0) as server:
        port = server.port
        with AMODE_DEVICES.create("openigtlink", port=str(port), silence_s="5") as device:
            deadline = time.monotonic() + 5.0
            line = None
            while line is None and time.monotonic() < deadline:
                server.publish(a_line_image("ALine", a_line(4), time.time()))
                line = device.read(0.2)
    assert np.array_equal(line.samples, a_line(4))


def test_what_is_no_line_is_passed_over_and_counted(a_listener):
    picture = Image("ALine", time.time(), voxels=np.zeros((1, 4, 5), dtype=np.int16))
    bytes_ = Image("ALine", time.time(), voxels=np.zeros((1, 1, 50), dtype=np.uint8))
    other = a_line_image("Other", a_line(1), time.time())
    mine = a_line_image("ALine", a_line(2), time.time())
    port = a_listener(b"".join(encode(m) for m in (picture, String("ALine", time.time()), bytes_, other, mine)))
    device = opened(port, device="ALine")
    lines = read_all(device)
    device.close()
    assert [np.array_equal(line.samples, a_line(2)) for line in lines] == [True]
    assert device.counters["images that are no line"] == 2


def test_a_damaged_message_is_never_a_line(a_listener):
    good = encode(a_line_image("ALine", a_line(3), time.time()))
    bad = bytearray(encode(a_line_image("ALine", a_line(4), time.time())))
    bad[500] ^= 0x10
    device = opened(a_listener(bytes(bad) + good))
    lines = read_all(device)
    device.close()
    assert [np.array_equal(line.samples, a_line(3)) for line in lines] == [True]
    assert device.counters["damaged messages"] == 1


def test_time_of_a_line_is_the_senders_if_the_clocks_agree_else_its_arrival(a_listener):
    stamps = [time.time() - 0.1, time.time() - 3600.0, 0.0]
    port = a_listener(b"".join(encode(a_line_image("A", a_line(k), stamp)) for k, stamp in enumerate(stamps)))
    before = time.monotonic()
    device = opened(port)
    lines = read_all(device)
    device.close()
    assert lines[0].host_time_s == pytest.approx(before - 0.1, abs=0.05)
    assert lines[1].host_time_s == pytest.approx(lines[2].host_time_s, abs=0.05)
    assert lines[1].host_time_s >= before


def test_a_server_that_goes_is_told_once_then_waited_for(a_listener):
    device = opened(a_listener(encode(a_line_image("A", a_line(0), time.time())), close=True))
    assert device.read(1.0) is not None
    with pytest.raises(DeviceError, match="OpenIGTLink: 127.0.0.1"):
        device.read(3.0)
    assert device.state is DeviceState.LOST
    assert device.read(0.05) is None
    device.stop()
    device.close()
    device.close()
    with pytest.raises(DeviceError, match="open and start it"):
        device.read(0.0)


def test_nobody_there_is_said_at_once():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(DeviceError, match=f"127.0.0.1:{port}"):
        AMODE_DEVICES.create("openigtlink", port=str(port), connect_timeout_s="0.3").open()


def test_a_line_at_the_ends_of_int16_is_saturated(a_listener):
    samples = a_line(0)
    samples[40] = 32767
    assert struct.pack("<h", samples[40]) == b"\xff\x7f"
    device = opened(a_listener(encode(a_line_image("A", samples, time.time()))))
    assert device.read(2.0).saturated
    device.close()
