"""The emulator against a client that this project did not write: the library ndicapi."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from emulator_process import emulator, write_poses

ndicapy = pytest.importorskip("ndicapy")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")

TOOLS = ("Reference", "Probe", "Stylus")
FRAMES, RATE_HZ = 90, 30.0
TEXT_STEPS = np.array([1e-4] * 4 + [1e-2] * 3 + [1e-4])  # of quaternion, mm and error in a text reply


@pytest.fixture
def a_pose_file(tmp_path):
    path = tmp_path / "poses.csv"
    return path, write_poses(path, TOOLS, FRAMES, RATE_HZ)


def set_up(device, tmp_path, names, speed="5"):
    """INIT to TSTART as the library's own examples do it; handles by tool name."""
    handles = {}
    assert ndicapy.ndiCommand(device, "INIT:") == "OKAY"
    assert ndicapy.ndiCommand(device, f"COMM:{speed}0000") == "OKAY"
    assert "NDI S/N" in ndicapy.ndiCommand(device, "VER:0")
    assert ndicapy.ndiCommand(device, "PHSR:01") == "00"
    for name in names:
        rom = tmp_path / f"{name}.rom"
        rom.write_bytes(b"NDI\0" + name.encode() + bytes(range(200)))
        handle = ndicapy.ndiCommand(device, "PHRQ:*********1****")
        assert ndicapy.ndiPVWRFromFile(device, int(handle, 16), str(rom)) == 0
        handles[name] = handle
    assert ndicapy.ndiCommand(device, "PHSR:02") == f"{len(names):02X}" + "".join(f"{handle}001" for handle in handles.values())
    for handle in handles.values():
        assert ndicapy.ndiCommand(device, f"PINIT:{handle}") == "OKAY"
    assert ndicapy.ndiCommand(device, "PHSR:03").count("011") == len(names)
    for handle in handles.values():
        assert ndicapy.ndiCommand(device, f"PENA:{handle}D") == "OKAY"
        assert len(ndicapy.ndiCommand(device, f"PHINF:{handle}0025")) == 67
    assert ndicapy.ndiCommand(device, "TSTART:") == "OKAY"
    return {name: bytes([int(handle, 16)]) for name, handle in handles.items()}


def ask_binary(device, options="0801"):
    try:
        ndicapy.ndiCommand(device, f"BX:{options}")
    except UnicodeDecodeError:
        return  # the library reads the reply before it fails to show it as text


def compare(pose, truth, tolerance_mm, tolerance_turn):
    if np.isnan(truth).all():
        assert pose == "MISSING"
        return 0
    assert np.abs(np.array(pose[4:7]) - truth[4:7]).max() < tolerance_mm
    assert np.abs(np.array(pose[:4]) - truth[:4]).max() < tolerance_turn
    assert pose[7] == pytest.approx(truth[7], abs=tolerance_turn)
    return 1


@pytest.mark.parametrize("speed", ["0", "A"])
def test_library_tracks_by_binary_replies_to_a_thousandth_of_a_millimetre(a_pose_file, tmp_path, speed):
    path, rows = a_pose_file
    with emulator(replay=path) as running:
        assert ndicapy.ndiProbe(running.url) == 0
        device = ndicapy.ndiOpen(running.url)
        handles = set_up(device, tmp_path, ["Stylus", "Reference", "Probe"], speed)
        seen, compared = set(), 0
        while len(seen) < 25:
            ask_binary(device)
            frame = ndicapy.ndiGetBXFrame(device, handles["Probe"])
            seen.add(frame)
            for name, handle in handles.items():
                pose = ndicapy.ndiGetBXTransform(device, handle)
                compared += compare(pose, rows[name][(frame - 1) % FRAMES], 1e-3, 1e-6)
                assert ndicapy.ndiGetBXPortStatus(device, handle) & 0xFF == 0x31
        assert compared > 60
        assert ndicapy.ndiCommand(device, "TSTOP:") == "OKAY"
        assert ndicapy.ndiCommand(device, "COMM:00000") == "OKAY"
        ndicapy.ndiClose(device)


def test_library_tracks_by_text_replies_to_their_rounding(a_pose_file, tmp_path):
    path, rows = a_pose_file
    with emulator(replay=path) as running:
        device = ndicapy.ndiOpen(running.url)
        handles = set_up(device, tmp_path, TOOLS)
        for _ in range(25):
            reply = ndicapy.ndiCommand(device, "TX:0801")
            frame = ndicapy.ndiGetTXFrame(device, handles["Probe"])
            for name, handle in handles.items():
                truth = rows[name][(frame - 1) % FRAMES]
                rounded = np.round(truth / np.array([1e-4] * 4 + [1e-2] * 3 + [1e-4])) * np.array(
                    [1e-4] * 4 + [1e-2] * 3 + [1e-4]
                )
                compare(ndicapy.ndiGetTXTransform(device, handle), rounded, 1e-3, 1.1e-4)
            assert reply.startswith("03")
        ndicapy.ndiClose(device)


def test_library_is_told_of_mistakes_by_their_codes(tmp_path):
    with emulator() as running:
        device = ndicapy.ndiOpen(running.url)
        for command, code in (
            ("PHSR:00", 0x10),
            ("NONSENSE:", 0x01),
            ("INIT:", 0),
            ("TX:0001", 0x0C),
            ("PINIT:7F", 0x08),
            ("COMM:Z0000", 0x06),
            ("GET:No.Such.Thing", 0x34),
        ):
            if code:
                with pytest.raises(OSError, match=f"0x{code:02x}"):
                    ndicapy.ndiCommand(device, command)
                assert ndicapy.ndiGetError(device) == code
            else:
                assert ndicapy.ndiCommand(device, command) == "OKAY"
        ndicapy.ndiClose(device)


def test_closing_the_port_resets_the_device_for_the_next_client(a_pose_file, tmp_path):
    path, rows = a_pose_file
    with emulator(replay=path) as running:
        for _ in range(2):
            device = ndicapy.ndiOpen(running.url)
            handles = set_up(device, tmp_path, TOOLS)
            ask_binary(device)
            frame = ndicapy.ndiGetBXFrame(device, handles["Probe"])
            assert compare(ndicapy.ndiGetBXTransform(device, handles["Probe"]), rows["Probe"][(frame - 1) % FRAMES], 1e-3, 1e-6)
            ndicapy.ndiClose(device)  # while tracking at 115200
