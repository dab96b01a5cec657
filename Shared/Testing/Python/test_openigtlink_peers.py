"""Both ways with programs we did not write: the C++ library's examples as Debian ships them, and pyigtl.

`Testing/build_openigtlink_peers.sh` builds the programs. Without them the tests are skipped on a desk and fail in CI.
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
import time
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from CranioNavLib.openigtlink import IgtlClient, IgtlServer
from CranioNavLib.openigtlink.messages import Image, StartTracking, StopTracking, String, TrackedTool, TrackingData, Transform

CHECKOUT = Path(__file__).resolve().parents[3]
PROGRAMS = Path(os.environ.get("CRANIONAV_OPENIGTLINK_PEERS", CHECKOUT / "build" / "openigtlink-peers"))
TURNED = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]], dtype=float)


def program(name: str) -> str:
    path = PROGRAMS / name
    if not path.exists():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(f"{path} is not built; run Testing/build_openigtlink_peers.sh")
    return str(path)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def until(condition, timeout_s=15.0):
    deadline = time.monotonic() + timeout_s
    while not (result := condition()):
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.005)
    return result


def received(client, kind, count=1, timeout_s=15.0):
    found = []
    deadline = time.monotonic() + timeout_s
    while len(found) < count:
        assert time.monotonic() < deadline, f"only {len(found)} came: {client.problem}"
        found += [message for message in client.receive(0.1) if isinstance(message, kind)]
    return found


@contextmanager
def running(*command: str, log: Path):
    """A peer whose output goes to a file; ended on leaving."""
    with log.open("wb") as output:
        process = subprocess.Popen(["stdbuf", "-o0", *command], stdout=output, stderr=subprocess.STDOUT)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def numbers(line: str) -> list[float]:
    return [float(word) for word in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", line)]


def test_a_cpp_tracker_server_is_understood(tmp_path):
    port = free_port()
    with running(program("TrackerServer"), str(port), "50", log=tmp_path / "log"), closing(IgtlClient(port=port)) as client:
        transforms = received(client, Transform, 30)
        assert (client.rejected, client.crc_errors) == (0, 0)
    assert {message.device for message in transforms} == {"Tracker"}
    printed = [numbers(line) for line in (tmp_path / "log").read_text().splitlines() if numbers(line)]
    rows = np.array([row for row in printed if len(row) == 4][:4])
    assert np.abs(transforms[0].matrix[:3] - rows[:3]).max() < 1e-3  # the program prints what it sends


def test_a_cpp_receiver_understands_our_transforms_and_images(tmp_path):
    with IgtlServer(port=0) as server:
        command = [program("ReceiveClient"), "127.0.0.1", str(server.port)]
        with running(*command, log=tmp_path / "log"):
            until(lambda: server.clients)

            def printed():
                server.publish(Transform("ProbeToReference", time.time(), matrix=TURNED))
                server.publish(Image("ALine", time.time(), voxels=np.arange(24, dtype=np.int16).reshape(2, 3, 4)))
                server.publish(String("Note", time.time(), text="probe is lost"))
                time.sleep(0.05)
                text = (tmp_path / "log").read_text(errors="replace")
                return text if text.count("IMAGE") > 1 and "probe is lost" in text else ""

            text = until(printed)
    assert "Receiving TRANSFORM data type." in text
    rows = [numbers(line) for line in text.splitlines() if len(numbers(line)) == 4]
    assert [0, -1, 0, 10] in rows
    assert [1, 0, 0, 20] in rows
    assert re.search(r"Dimensions +: \( ?4, ?3, ?2", text)


def test_a_cpp_tracking_server_streams_on_request_and_ends_on_stop(tmp_path):
    port = free_port()
    client = IgtlClient(port=port, greetings=(StartTracking("CranioNav", interval_ms=50, coordinate_name="Patient"),))
    with running(program("TrackingDataServer"), str(port), log=tmp_path / "log"), closing(client):
        data = received(client, TrackingData, 5)
        assert client.rejected == 0
        client.send(StopTracking("CranioNav"))
    assert [len(message.tools) for message in data] == [3] * 5
    assert len({tool.name for tool in data[0].tools}) == 3
    assert "Interval = 50 (ms)" in (tmp_path / "log").read_text(errors="replace")


def test_a_cpp_tracking_client_gets_what_it_asks_for(tmp_path):
    tools = (TrackedTool("Probe", TURNED), TrackedTool("Stylus", np.eye(4)))
    command = [program("TrackingDataClient"), "127.0.0.1"]
    with IgtlServer(port=0) as server, running(*command, str(server.port), "20", log=tmp_path / "log"):
        until(lambda: server.clients and server.clients[0].wants_tracking)

        def printed():
            server.publish_tracking(TrackingData("Tracker", time.time(), tools=tools))
            time.sleep(0.02)
            text = (tmp_path / "log").read_text(errors="replace")
            return text if text.count("Stylus") > 1 else ""

        text = until(printed)
    assert "Probe" in text
    assert [0, -1, 0, 10] in [numbers(line) for line in text.splitlines() if len(numbers(line)) == 4]


def test_a_cpp_tracker_client_is_understood_by_our_server(tmp_path):
    with IgtlServer(port=0) as server:
        with running(program("TrackerClient"), "127.0.0.1", str(server.port), "50", log=tmp_path / "log"):
            got: list = []
            until(lambda: got.extend(m for m in server.receive() if isinstance(m, Transform)) or len(got) > 10)
        assert server.refused_streams == 0


PYIGTL_SERVER = """
import sys, time, numpy as np, pyigtl
server = pyigtl.OpenIGTLinkServer(port=int(sys.argv[1]), local_server=True)
matrix = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1.0]])
while True:
    if server.is_connected():
        server.send_message(pyigtl.TransformMessage(matrix, device_name="ProbeToReference"), wait=False)
        server.send_message(pyigtl.StringMessage("hello", device_name="Note"), wait=False)
        image = np.arange(2048, dtype=np.int16).reshape(1, 1, 2048)
        server.send_message(pyigtl.ImageMessage(image, world_coordinate_system="ras", device_name="ALine"), wait=False)
    time.sleep(0.03)
"""

PYIGTL_CLIENT = """
import sys, time, numpy as np, pyigtl
client = pyigtl.OpenIGTLinkClient("127.0.0.1", int(sys.argv[1]))
transform = client.wait_for_message("ProbeToReference", timeout=10)
image = client.wait_for_message("ALine", timeout=10)
voxels = image.image
print(transform.matrix.round(4).ravel().tolist(), voxels.shape, voxels.dtype, voxels.ravel()[:3].tolist(), flush=True)
client.send_message(pyigtl.StringMessage("received", device_name="Note"), wait=True)
time.sleep(0.5)
client.stop()
"""


def test_a_pyigtl_server_is_understood(tmp_path):
    port = free_port()
    with running(sys.executable, "-c", PYIGTL_SERVER, str(port), log=tmp_path / "log"), closing(IgtlClient(port=port)) as client:
        found: list = []
        until(lambda: found.extend(client.receive(0.1)) or {type(m) for m in found} >= {Transform, String, Image})
        assert client.rejected == 0
    kinds = {type(message): message for message in found}
    np.testing.assert_allclose(kinds[Transform].matrix, TURNED)
    assert kinds[String].text == "hello"
    np.testing.assert_array_equal(kinds[Image].voxels.ravel(), np.arange(2048))


def test_a_pyigtl_client_understands_us_and_is_understood(tmp_path):
    with IgtlServer(port=0) as server:
        with running(sys.executable, "-c", PYIGTL_CLIENT, str(server.port), log=tmp_path / "log"):
            inbox: list = []

            def answered():
                server.publish(Transform("ProbeToReference", time.time(), matrix=TURNED))
                server.publish(Image("ALine", time.time(), voxels=np.array([5, -6, 7], dtype=np.int16).reshape(1, 1, 3)))
                time.sleep(0.02)
                inbox.extend(server.receive())
                return inbox

            until(answered)
            assert isinstance(inbox[0], String)
            assert inbox[0].text == "received"
        text = (tmp_path / "log").read_text()
    assert str(TURNED.ravel().tolist())[:-1] in text
    assert "(1, 1, 3) int16 [5, -6, 7]" in text
