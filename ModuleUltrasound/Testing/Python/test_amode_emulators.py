"""The emulated devices from the command line, and a patient's bone through both of them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.sequence_metafile import Acquisition, Recording, write_recording
from ModuleUltrasoundLib.devices.device import AMODE_DEVICES
from ModuleUltrasoundLib.emulators.faults import DEFAULT_RATES, Chunk, Faults
from ModuleUltrasoundLib.emulators.server import TcpDoor, serve


def recorded(lines: np.ndarray, acquisition: Acquisition) -> Recording:
    count = len(lines)
    return Recording(
        lines=lines,
        acquisition=acquisition,
        probe_to_reference=np.tile(np.eye(4), (count, 1, 1)),
        statuses=("OK",) * count,
        timestamps_s=0.05 * np.arange(count),
        palpation_points=np.zeros(count, dtype=np.int64),
    )


def start(*words: str) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-m", "ModuleUltrasoundLib.emulators", *words], stdout=subprocess.PIPE, text=True)


def stop(process: subprocess.Popen) -> None:
    process.terminate()
    process.wait(timeout=20)


def test_a_recording_is_served_on_a_pty_until_the_process_is_ended(tmp_path):
    lines = np.random.default_rng(0).integers(-900, 900, (3, 600)).astype(np.int16)
    path = tmp_path / "a.igs.mha"
    write_recording(path, recorded(lines, Acquisition(50e6, 5e6)))
    process = start("--replay", str(path), "--pty", "--rate-hz", "100", "--fault", "stale-fragment")
    try:
        port = process.stdout.readline().strip()
        with AMODE_DEVICES.create("serial", port=port, range_us="12") as device:
            taken = [device.read(5.0) for _ in range(3)]
        assert all(np.array_equal(line.samples, lines[(line.sequence_number - 1) % 3]) for line in taken)
    finally:
        stop(process)
    assert process.returncode == 0


def test_an_unknown_fault_ends_it_with_status_2_and_says_which_there_are():
    words = [sys.executable, "-m", "ModuleUltrasoundLib.emulators", "--fault", "gremlins"]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert all(name in ended.stderr for name in DEFAULT_RATES)
    assert "Traceback" not in ended.stderr


def test_faults_strike_at_the_rate_that_is_asked_for():
    faults = Faults(["stall=0.25", "byte-loss"], seed=1)
    struck = sum(faults.strikes("stall") for _ in range(4000))
    assert struck / 4000 == pytest.approx(0.25, abs=0.03)
    assert faults.struck == {"stall": struck}
    assert not any(faults.strikes("disconnect") for _ in range(100))


@pytest.mark.parametrize("rate", ["1.5", "-0.1", "nan", "often"])
def test_a_rate_that_is_no_share_is_refused(rate):
    with pytest.raises(InputError, match="fault stall: expected a rate from 0 to 1"):
        Faults([f"stall={rate}"])


def test_an_emulator_that_is_told_to_end_does_not_send_its_answer_to_the_end():
    class Talker:
        def greet(self):
            return [Chunk(b"x")] * 1000

    class Listener(TcpDoor):
        heard = 0

        def wait_for_peer(self, timeout_s):
            return True

        def send(self, data):
            self.heard += 1

    door = Listener()
    serve(Talker(), door, lambda: door.heard >= 3)
    door.close()
    assert door.heard == 3


@pytest.mark.slow
def test_the_same_patient_is_seen_through_both_devices():
    """The virtual patient's lines, over the framed protocol and through the pic0rick's shell, are the same lines."""
    lines = {}
    for protocol in ("serial", "pic0rick"):
        process = start("--protocol", protocol, "--rate-hz", "50")
        try:
            port = process.stdout.readline().strip()
            with AMODE_DEVICES.create(protocol, port=port, forerun_length_mm="23", forerun_speed_m_s="2340") as device:
                taken = [device.read(10.0) for _ in range(20)]
        finally:
            stop(process)
        after_the_pulse = slice(round(3e-6 * 60e6), round(45e-6 * 60e6))
        lines[protocol] = {line.sequence_number: line.samples[after_the_pulse].astype(float) for line in taken}
    both = sorted(set(lines["serial"]) & set(lines["pic0rick"]))
    assert len(both) >= 15
    for number in both:
        one, other = lines["serial"][number], lines["pic0rick"][number]
        shifts = [np.corrcoef(one[2:-2], np.roll(other, shift)[2:-2])[0, 1] for shift in (-2, -1, 0, 1, 2)]
        assert max(shifts) > 0.98  # whole samples from the pulse's onset to time zero
