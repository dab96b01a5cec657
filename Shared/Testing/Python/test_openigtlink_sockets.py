"""Client and server over real sockets: several clients, slow ones, dead ones, silent ones, and noise."""

from __future__ import annotations

import socket
import struct
import time
from contextlib import closing

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.openigtlink import IgtlClient, IgtlServer, encode
from CranioNavLib.openigtlink.messages import (
    Capability,
    GetCapability,
    GetStatus,
    Image,
    StartTracking,
    Status,
    StopTracking,
    String,
    TrackedTool,
    TrackingData,
    TrackingReply,
    Transform,
    a_line_image,
)


def wait_until(condition, timeout_s=10.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.002)


def received(client, kind, count=1, timeout_s=10.0):
    """The next `count` messages of a kind; others are passed over."""
    found = []
    deadline = time.monotonic() + timeout_s
    while len(found) < count:
        assert time.monotonic() < deadline, "nothing came"
        found += [message for message in client.receive(0.1) if isinstance(message, kind)]
    return found


def outside() -> str:
    """An address of this computer that is not the one the server listens on."""
    return "127.0.0.2"


@pytest.fixture
def a_server():
    with IgtlServer(port=0, status_interval_s=0.1, stall_s=1.0) as server:
        yield server


@pytest.fixture
def a_client(a_server):
    with closing(IgtlClient(port=a_server.port)) as client:
        client.receive(0.05)
        wait_until(lambda: len(a_server.clients) == 1)
        yield client


def test_it_listens_on_loopback_only():
    with IgtlServer(port=0) as server:
        assert server.host == "127.0.0.1"
        with pytest.raises(ConnectionRefusedError), socket.create_connection((outside(), server.port), timeout=1):
            pass


def test_every_client_gets_every_message_in_order(a_server):
    clients = [IgtlClient(port=a_server.port) for _ in range(3)]
    for client in clients:
        client.receive(0.05)
    wait_until(lambda: len(a_server.clients) == 3)
    for k in range(50):
        a_server.publish(Transform("ProbeToReference", 1.0 + k, matrix=np.eye(4)))
    for client in clients:
        assert [message.time_s for message in received(client, Transform, 50)] == [1.0 + k for k in range(50)]
        client.close()


def test_a_lines_arrive_to_the_bit(a_server, a_client):
    samples = np.random.default_rng(1).integers(-32768, 32768, 3200).astype(np.int16)
    a_server.publish(a_line_image("ALine", samples, time.time()))
    (image,) = received(a_client, Image)
    assert image.voxels.shape == (1, 1, 3200)
    np.testing.assert_array_equal(image.voxels.ravel(), samples)


def test_tracking_data_go_only_to_those_who_ask_and_stop_on_request(a_server, a_client):
    data = TrackingData("Tracker", 1.0, tools=(TrackedTool("Probe", np.eye(4)),))
    a_server.publish_tracking(data)
    assert not [m for m in a_client.receive(0.05) if isinstance(m, TrackingData)]
    a_client.send(StartTracking("X"))
    assert received(a_client, TrackingReply)[0].granted
    a_server.publish_tracking(data)
    assert received(a_client, TrackingData)[0].tools[0].name == "Probe"
    a_client.send(StopTracking("X"))
    received(a_client, TrackingReply)
    a_server.publish_tracking(data)
    assert not [m for m in a_client.receive(0.2) if isinstance(m, TrackingData)]


def test_tracking_data_come_no_faster_than_asked(a_server, a_client):
    a_client.send(StartTracking("X", interval_ms=10_000))
    received(a_client, TrackingReply)
    for _ in range(20):
        a_server.publish_tracking(TrackingData("Tracker", 1.0))
    received(a_client, TrackingData)
    assert not [m for m in a_client.receive(0.2) if isinstance(m, TrackingData)]


def test_questions_are_answered(a_server, a_client):
    a_server.status = Status("CranioNav", code=13, text="warming up")
    a_client.send(GetCapability("X"))
    assert "TRANSFORM" in received(a_client, Capability)[0].types
    a_client.send(GetStatus("X"))
    assert received(a_client, Status)[0].words == "not ready: warming up"


def test_what_clients_send_is_handed_over(a_server, a_client):
    a_client.send(String("X", text="hello"))
    inbox = []
    wait_until(lambda: inbox.extend(a_server.receive()) or inbox)
    assert inbox[0].text == "hello"


def test_an_idle_server_sends_status_so_that_nobody_thinks_it_dead(a_server, a_client):
    assert len(received(a_client, Status, 3)) >= 3
    assert not a_client.silent


def a_slow_client(server):
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.connect(("127.0.0.1", server.port))
    return slow


def test_a_slow_client_loses_the_oldest_and_delays_nobody():
    with IgtlServer(port=0, queue_length=20, stall_s=60) as server, closing(IgtlClient(port=server.port)) as quick:
        quick.receive(0.05)
        with a_slow_client(server):
            wait_until(lambda: len(server.clients) == 2)
            line = np.zeros(32000, dtype=np.int16)
            for k in range(20):
                for _ in range(10):
                    server.publish(a_line_image("ALine", line, 1.0 + k))
                received(quick, Image, 10)
            assert sorted(info.dropped > 50 for info in server.clients) == [False, True]
            assert min(info.dropped for info in server.clients) == 0


def test_a_client_that_takes_nothing_is_closed_in_the_end(a_server):
    with a_slow_client(a_server):
        wait_until(lambda: len(a_server.clients) == 1)
        for _ in range(100):
            a_server.publish(a_line_image("ALine", np.zeros(32000, dtype=np.int16), 1.0))
        wait_until(lambda: len(a_server.clients) == 0)


def test_a_client_that_sends_noise_is_closed_and_counted(a_server, a_client):
    with socket.create_connection(("127.0.0.1", a_server.port)) as noisy:
        noisy.sendall(b"GET / HTTP/1.1\r\nHost: somebody\r\n\r\n" + bytes(64))
        wait_until(lambda: a_server.refused_streams == 1)
    a_server.publish(Transform("T", 5.0))
    assert received(a_client, Transform)


def test_a_damaged_message_of_a_client_is_rejected_and_counted(a_server):
    with socket.create_connection(("127.0.0.1", a_server.port)) as damaged:
        data = bytearray(encode(String("S", text="hello")))
        data[-1] ^= 1
        damaged.sendall(data)
        wait_until(lambda: a_server.clients and a_server.clients[0].rejected == 1)


def test_a_taken_port_is_refused(a_server):
    with pytest.raises(InputError, match="another 3D Slicer or PlusServer may have it"):
        IgtlServer(port=a_server.port).open()


def test_a_closed_server_is_noticed_at_once_and_found_again():
    server = IgtlServer(port=0)
    server.open()
    with closing(IgtlClient(port=server.port)) as client:
        client.receive(0.1)
        assert client.connected
        server.close()
        begin = time.monotonic()
        while client.connected:
            client.receive(1.0)
        assert time.monotonic() - begin < 0.9  # told by the closing, not by a time-out
        assert "closed the connection" in client.problem
        again = IgtlServer(port=server.port)
        again.open()
        begin = time.monotonic()
        wait_until(lambda: client.receive(0.1) is not None and client.connected)
        assert time.monotonic() - begin < 2.0
        assert client.connections == 2
        again.close()


def test_a_silent_server_is_told():
    with socket.create_server(("127.0.0.1", 0)) as mute, closing(IgtlClient(port=mute.getsockname()[1], silence_s=0.1)) as client:
        client.receive(0.3)
        assert client.connected
        assert client.silent
        assert "nothing heard for" in client.problem


def test_nobody_there_is_told():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        with closing(IgtlClient(port=unused.getsockname()[1])) as client:
            assert client.receive(0.2) == []
            assert "connection refused; is the server running?" in client.problem


def test_a_server_that_is_no_openigtlink_server_is_told():
    with socket.create_server(("127.0.0.1", 0)) as web, closing(IgtlClient(port=web.getsockname()[1])) as client:
        client.receive(0.05)
        peer, _ = web.accept()
        peer.sendall(b"HTTP/1.1 400 Bad Request\r\n" + bytes(60))
        client.receive(1.0)
        assert "no OpenIGTLink header" in client.problem
        peer.close()


def test_damaged_messages_are_counted_across_connections():
    with socket.create_server(("127.0.0.1", 0)) as listener, closing(IgtlClient(port=listener.getsockname()[1])) as client:
        for _ in range(2):
            wait_until(lambda: client.receive(0.05) is not None and client.connected)
            peer, _ = listener.accept()
            data = bytearray(encode(Transform("T")))
            data[-1] ^= 1
            peer.sendall(bytes(data) + encode(Transform("U")))
            assert len(received(client, Transform)) == 1
            peer.close()
            client.receive(0.1)
        assert (client.received, client.rejected, client.crc_errors) == (4, 2, 2)


def test_a_message_cut_by_a_dying_peer_is_dropped_and_the_next_connection_is_in_step():
    with socket.create_server(("127.0.0.1", 0)) as listener, closing(IgtlClient(port=listener.getsockname()[1])) as client:
        client.receive(0.05)
        peer, _ = listener.accept()
        peer.sendall(encode(Transform("T"))[:70])
        peer.close()
        wait_until(lambda: client.receive(0.05) is not None and client.connections == 2)
        peer, _ = listener.accept()
        peer.sendall(encode(Transform("U")))
        assert received(client, Transform)[0].device == "U"
        peer.close()


def test_version_1_goes_out_by_default(a_server):
    with socket.create_connection(("127.0.0.1", a_server.port)) as raw:
        wait_until(lambda: a_server.clients)
        a_server.publish(Transform("T"))
        assert struct.unpack(">H", raw.recv(58)[:2]) == (1,)


def test_greetings_are_sent_after_every_connection(a_server):
    with closing(IgtlClient(port=a_server.port, greetings=(StartTracking("X"),))) as client:
        client.receive(0.05)
        wait_until(lambda: a_server.clients and a_server.clients[0].wants_tracking)
