"""`cranionav emulate polaris` as a user runs it: its first line, its clients, its faults, its refusals."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from ModuleTrackingLib.ndi.emulator.faults import FAULTS
from ModuleTrackingLib.tracker import TRACKERS, PoseStatus

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals and signals")
COMMAND = [sys.executable, "-m", "Workstation"]
HEAD = "timestamp_s,tool,status,qw,qx,qy,qz,tx_mm,ty_mm,tz_mm,error_mm"


@contextmanager
def emulate(*arguments: object) -> Iterator[tuple[str, subprocess.Popen]]:
    """The command in a process of its own, and the first line that it prints."""
    command = [*COMMAND, "emulate", "polaris", *(str(argument) for argument in arguments)]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        url = process.stdout.readline().strip()
        assert url, process.stderr.read()
        yield url, process
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def a_pose_file(tmp_path):
    """Ten frames of two tools; the rows as qw..tz and error."""
    rng = np.random.default_rng(4)
    rows, lines = {"Reference": [], "Probe": []}, [HEAD]
    for frame in range(10):
        for tool, kept in rows.items():
            quaternion = rng.normal(size=4)
            kept.append([*(quaternion / np.linalg.norm(quaternion)), *rng.uniform(-300, 300, 2), rng.uniform(-1500, -900), 0.2])
            lines.append(f"{frame / 25:.3f},{tool},OK," + ",".join(f"{value:.8f}" for value in kept[-1]))
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(lines) + "\n")
    return path, {tool: np.array(kept) for tool, kept in rows.items()}


def test_a_foreign_client_gets_the_poses_of_the_file(a_pose_file, tmp_path):
    ndicapy = pytest.importorskip("ndicapy")
    path, rows = a_pose_file
    with emulate("--replay", path) as (url, _):
        assert url.startswith("/dev/")
        device = ndicapy.ndiOpen(url)
        for command in ("INIT:", "COMM:50000"):
            assert ndicapy.ndiCommand(device, command) == "OKAY"
        for handle, tool in (("01", "Probe"), ("02", "Reference")):
            assert ndicapy.ndiCommand(device, "PHRQ:*********1****") == handle
            rom = tmp_path / f"{tool}.rom"
            rom.write_bytes(b"NDI\0" + tool.encode() + bytes(500))
            assert ndicapy.ndiPVWRFromFile(device, int(handle), str(rom)) == 0
            assert ndicapy.ndiCommand(device, f"PINIT:{handle}") == "OKAY"
            assert ndicapy.ndiCommand(device, f"PENA:{handle}D") == "OKAY"
        assert ndicapy.ndiCommand(device, "TSTART:") == "OKAY"
        for _ in range(12):
            with contextlib.suppress(UnicodeDecodeError):  # the library reads the reply, then fails to show it as text
                ndicapy.ndiCommand(device, "BX:0801")
            for handle, tool in ((b"\x01", "Probe"), (b"\x02", "Reference")):
                shown = np.array(ndicapy.ndiGetBXTransform(device, handle))
                truth = rows[tool][(ndicapy.ndiGetBXFrame(device, handle) - 1) % 10]
                assert np.abs(shown - truth).max() < 1e-3
            ndicapy.ndiCommand(device, "TX:0801")
            shown = np.array(ndicapy.ndiGetTXTransform(device, b"\x01"))
            truth = rows["Probe"][(ndicapy.ndiGetTXFrame(device, b"\x01") - 1) % 10]
            assert np.abs(shown - truth).max() < 0.005 + 1e-3
        ndicapy.ndiClose(device)


def test_a_tcp_port_is_served_on_this_computer_until_interrupted():
    with emulate("--tcp") as (url, process):
        assert url.startswith("socket://127.0.0.1:")
        with socket.create_connection(("127.0.0.1", int(url.rsplit(":", 1)[1])), timeout=5) as client:
            client.sendall(b"INIT:E3A5\r")
            assert client.recv(100) == b"OKAYA896\r"
        process.send_signal(signal.SIGINT)
        assert process.wait(5) == 0


def test_faults_reach_the_driver():
    with (
        emulate("--fault", "missing=1", "--fault", "delays=0.1:0.01") as (url, _),
        TRACKERS.create("polaris", port=url) as tracker,
    ):
        poses = tracker.read()
        assert len(poses) == 4
        assert {pose.status for pose in poses} == {PoseStatus.MISSING}


def test_the_help_names_every_fault_and_the_options_are_heard(tmp_path):
    from Workstation.commands.emulate import polaris

    assert [name for name in FAULTS if name not in (polaris.__doc__ or "")] == []
    link = tmp_path / "tracker"
    options = ["--link", link, "--text-only", "--paced", "--seed", "3", "--keep-state", "--rate", "30"]
    with emulate(*options) as (url, _), TRACKERS.create("polaris", port=url) as tracker:
        assert url == str(link)
        assert len(tracker.read()) == 4
        assert tracker._poller.binary is False


def test_the_tracker_command_probes_it():
    with emulate() as (url, _):
        done = subprocess.run(
            [*COMMAND, "tracker", "probe", "polaris", "--set", f"port={url}", "--seconds", "1", "--json"],
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
        report = json.loads(done.stdout)
        assert {tool["tool"] for tool in report["tools"]} == {"Reference", "Probe", "Stylus", "Sphere"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--fault", "gremlins"], "unknown fault 'gremlins'; known: byte-loss"),
        (["--rate", "0"], "1 to 1000 frames a second"),
        (["--replay", "nowhere.csv"], "nowhere.csv: cannot be read"),
    ],
)
def test_what_cannot_be_emulated_is_refused_in_one_line(arguments, message):
    done = subprocess.run([*COMMAND, "emulate", "polaris", *arguments], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.strip().splitlines()) == 1
    assert message in done.stderr
