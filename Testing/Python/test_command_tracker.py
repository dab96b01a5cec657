"""`cranionav tracker`: list, probe, record and recover, as a user calls them."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import SimpleITK
from CranioNavLib.rigid import rigid
from CranioNavLib.sequence_metafile import Acquisition, RecordingWriter, pixels_beside, read_recording
from ModuleTrackingLib.calibration import ToolGeometry, load_calibration
from ModuleTrackingLib.pose_csv import PoseCsvWriter, read_pose_csv
from ModuleTrackingLib.tracker import PoseStatus, ToolPose
from scipy.spatial.transform import Rotation

from Workstation.__main__ import run


def base_at(time_s: float) -> np.ndarray:
    return rigid(Rotation.from_rotvec([0, 0.1 * time_s, 0]).as_matrix(), [10 * time_s, 0, -1500])


PROBE_TO_REFERENCE = rigid(Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix(), [40, -20, 90])


@pytest.fixture
def a_table(tmp_path):
    """Two seconds of a probe, a base that moves, and a stylus that is never seen."""
    with PoseCsvWriter(tmp_path / "in.csv") as writer:
        for k in range(120):
            base = base_at(k / 60)
            poses = [
                ToolPose("Probe", base @ PROBE_TO_REFERENCE, PoseStatus.OK, 0, error_mm=0.2),
                ToolPose("Reference", base, PoseStatus.OK, 0, error_mm=0.1),
                ToolPose("Stylus", None, PoseStatus.MISSING, 0),
            ]
            writer.write(k / 60, poses)
    return tmp_path / "in.csv"


def cranionav(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "Workstation", *map(str, arguments)]


def refused(capsys, *arguments: object) -> str:
    assert run([str(argument) for argument in arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def test_list_names_trackers_and_their_parameters(capsys):
    assert run(["tracker", "list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("openigtlink", "polaris", "replay", "simulated"))
    assert "port=18944" in said
    assert run(["tracker", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    replay = next(tracker for tracker in listed["trackers"] if tracker["name"] == "replay")
    assert {parameter["name"] for parameter in replay["parameters"]} == {"path", "speed", "loop"}


def test_probe_tells_what_is_seen(capsys, a_table):
    assert run(["tracker", "probe", "replay", "-s", f"path={a_table}", "--seconds", "1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    tools = {tool["tool"]: tool for tool in report["tools"]}
    assert tools["Probe"]["status"] == "OK"
    assert tools["Probe"]["error_mm"] == pytest.approx(0.2)
    assert tools["Probe"]["seen"] == 1
    assert (tools["Stylus"]["status"], tools["Stylus"]["position_mm"], tools["Stylus"]["seen"]) == ("MISSING", None, 0)
    assert report["dropped_frames"] == 0
    assert report["frames"] > 10
    assert run(["tracker", "probe", "replay", "-s", f"path={a_table}", "--seconds", "0.3"]) == 0
    assert re.search(r"Stylus\W+MISSING", capsys.readouterr().out)


def test_record_writes_recording_and_table(capsys, a_table, tmp_path):
    arguments = ["tracker", "record", "replay", "-s", f"path={a_table}", "--seconds", "1", "--json"]
    assert run([*arguments, "-o", str(tmp_path / "out.igs.mha"), "--csv", str(tmp_path / "out.csv")]) == 0
    report = json.loads(capsys.readouterr().out)
    recording = read_recording(tmp_path / "out.igs.mha")
    assert len(recording) == report["frames"] > 20
    # The base moves all the time; in Reference the probe does not.
    good = np.array([status == "OK" for status in recording.statuses])
    assert good.mean() > 0.9
    expected = np.broadcast_to(PROBE_TO_REFERENCE, recording.probe_to_reference[good].shape)
    np.testing.assert_allclose(recording.probe_to_reference[good], expected, atol=1e-5)
    table = read_pose_csv(tmp_path / "out.csv")
    assert len(table) >= report["frames"] - 2
    assert {row.tool for row in table[0]} == {"Probe", "Reference", "Stylus"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.csv", "out.csv", "out.igs.mha"]


def test_a_replay_that_is_not_looped_ends_the_recording(capsys, a_table, tmp_path):
    settings = ["-s", f"path={a_table}", "-s", "loop=no", "-s", "speed=4"]
    assert run(["tracker", "record", "replay", *settings, "--csv", str(tmp_path / "out.csv"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] > 100


@pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
def test_a_terminal_shows_the_tools_live(a_table):
    import pty

    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
    command = cranionav("tracker", "probe", "replay", "-s", f"path={a_table}", "--seconds", "1.5", "--json")
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=theirs, env=environment)
    os.close(theirs)
    shown = b""
    with contextlib.suppress(OSError):  # the other end was closed
        while data := os.read(ours, 65536):
            shown += data
    os.close(ours)
    assert process.wait() == 0
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.decode("utf-8", "replace"))
    assert re.search(r"tool\W+status\W+x mm\W+y mm\W+z mm\W+error mm\W+rate 1/s\W+age ms", text)
    assert re.search(r"Probe\W+OK", text)
    assert re.search(r"Stylus\W+MISSING\W+–\W+–\W+–\W+–", text)


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT and SIGKILL")
@pytest.mark.parametrize("kill", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL], ids=lambda number: number.name)
@pytest.mark.parametrize("lines", [False, True], ids=["poses", "A-lines"])
def test_an_ended_or_killed_recording_is_read_by_everybody(capsys, a_table, tmp_path, kill, lines):
    target = tmp_path / "out.igs.mha"
    command = cranionav("tracker", "record", "replay", "-s", f"path={a_table}", "-o", target, "--json")
    command += ["--amode", "simulated", "--amode-set", "head=synthetic"] if lines else []
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not target.exists() or target.read_bytes().count(b"_Timestamp") < 40:
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(kill)
    out, err = process.communicate(timeout=30)
    if kill is signal.SIGKILL:
        assert pixels_beside(target).exists() == lines
        assert SimpleITK.ReadImage(str(target)).GetSize()[2] >= 40
        assert len(read_recording(target)) >= 40
        assert run(["tracker", "recover", str(target)]) == 0
    else:
        assert process.returncode == 0, err
        assert json.loads(out)["frames"] >= 40
    assert len(read_recording(target)) >= 40
    assert not pixels_beside(target).exists()
    assert SimpleITK.ReadImage(str(target)).GetSize()[2] >= 40
    assert Path(target).read_bytes().startswith(b"ObjectType = Image\nNDims = 3\n")


def test_a_lines_are_recorded_with_their_poses(capsys, a_table, tmp_path):
    target = tmp_path / "lines.igs.mha"
    arguments = ["tracker", "record", "replay", "-s", f"path={a_table}", "--amode", "simulated", "--amode-set", "head=synthetic"]
    status = run([*arguments, "--seconds", "1.5", "-o", str(target), "--json"])
    captured = capsys.readouterr()
    assert status == 0, captured.err
    recording = read_recording(target)
    assert len(recording) == json.loads(captured.out)["frames"]
    assert recording.lines.shape[1] > 100
    good = np.array([status == "OK" for status in recording.statuses])
    assert good.mean() > 0.5  # not all: on a busy computer the poses have gaps
    expected = np.broadcast_to(PROBE_TO_REFERENCE, recording.probe_to_reference[good].shape)
    np.testing.assert_allclose(recording.probe_to_reference[good], expected, atol=0.01)
    image = SimpleITK.ReadImage(str(target))
    np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(image)[:, 0], recording.lines)


def test_what_a_tracker_sees_is_served_to_a_foreign_client(a_table):
    pyigtl = pytest.importorskip("pyigtl")
    command = cranionav("tracker", "serve", "replay", "-s", f"path={a_table}", "--port", "0", "--amode", "simulated")
    process = subprocess.Popen(
        [*command, "--amode-set", "head=synthetic"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        address = process.stdout.readline().strip()
        assert address, process.stderr.read()
        client = pyigtl.OpenIGTLinkClient("127.0.0.1", int(address.rsplit(":", 1)[1]))
        pose = client.wait_for_message("ProbeToReference", timeout=20)
        line = client.wait_for_message("ALine", timeout=20)
        client.stop()
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    np.testing.assert_allclose(pose.matrix, PROBE_TO_REFERENCE, atol=1e-3)
    assert line.image.shape[:2] == (1, 1)
    assert line.image.dtype == np.int16


def test_recordings_of_a_water_bath_calibrate_the_probe(capsys, tmp_path):
    """A bead seen from many sides: short echoes at the times that its distance from the face asks for."""
    rng = np.random.default_rng(2)
    truth, bead = rigid(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), [3.0, -4, 50]), np.array([100.0, 20, 30])
    speed, sampling_hz, at_s = 1482.36, 50e6, np.arange(5000) / 50e6  # of water at 20 deg C
    with RecordingWriter(tmp_path / "bead.igs.mha", 5000, Acquisition(sampling_hz, 5e6), {"ProbeToolId": "P6 0815"}) as writer:
        for k in range(80):
            turn = Rotation.from_rotvec([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-1, 1)]).as_matrix()
            depth = rng.uniform(15, 60)
            probe = rigid(turn, bead - turn @ [0, 0, depth])
            delay = at_s - 2e-3 * depth / speed
            line = 3000 * np.exp(-((delay / 2e-7) ** 2)) * np.cos(2 * np.pi * 5e6 * delay) + rng.normal(0, 10, 5000)
            writer.append(k / 20, {"ProbeToReference": probe @ np.linalg.inv(truth)}, line=line.astype(np.int16))
    target, bath = tmp_path / "p.json", tmp_path / "bead.igs.mha"
    assert run(["tracker", "calibrate-probe", "--point", str(bath), "--face", "0,0,40", "-o", str(target), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["echoes_used"] == 80
    found = load_calibration(target, "Probe", ToolGeometry.of("P6 0815"))
    np.testing.assert_allclose(found.tool_to_marker[:3, 3], truth[:3, 3], atol=0.1)
    np.testing.assert_allclose(found.tool_to_marker[:3, 2], truth[:3, 2], atol=0.003)
    assert "expected three numbers" in refused(capsys, "tracker", "calibrate-probe", "--point", bath, "--beam", "0,1")
    assert "no recording is given" in refused(capsys, "tracker", "calibrate-probe")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["probe", "nothing"], "nothing"),
        (["probe", "replay"], "no recording given"),
        (["probe", "replay", "-s", "path=none.csv"], "none.csv: cannot be read"),
        (["probe", "replay", "-s", "path"], "expected PARAMETER=VALUE, got 'path'"),
        (["probe", "replay", "-s", "pace=2"], "unknown parameter 'pace'"),
        (
            ["probe", "openigtlink", "-s", "port=1", "-s", "connect_timeout_s=0.3", "--timeout", "1"],
            "openigtlink: OpenIGTLink: 127.0.0.1:1: connection refused",
        ),
        (["probe", "polaris", "-s", "port=/dev/none"], "polaris: there is no port /dev/none; plug the tracker in"),
        (["record", "replay", "-s", "path=none.csv"], "nothing to record to"),
        (["record", "replay", "-s", "path={table}", "--csv", "{tmp}/none/a.csv", "--seconds", "1"], "choose a folder"),
        (["record", "replay", "-s", "path={table}", "-o", "{tmp}/a.nrrd", "--seconds", "1"], "written as .igs.mha"),
        (["record", "replay", "-s", "path={table}", "--csv", "{tmp}/a.csv", "--amode", "simulated"], "give -o FILE.igs.mha"),
        (["recover", "{tmp}/a.igs.mha"], "nothing to recover"),
    ],
)
def test_bad_calls_end_with_one_line_and_status_2(capsys, a_table, tmp_path, arguments, message):
    filled = (argument.replace("{table}", str(a_table)).replace("{tmp}", str(tmp_path)) for argument in arguments)
    assert message in refused(capsys, "tracker", *filled)
