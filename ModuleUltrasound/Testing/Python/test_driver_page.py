"""The example of docs/write-an-amode-driver.md works as printed."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from CranioNavLib.plugins import load_file
from ModuleUltrasoundLib.devices.connection import DeviceState
from ModuleUltrasoundLib.devices.device import AMODE_DEVICES, DeviceError
from ModuleUltrasoundLib.emulators.faults import Chunk, Faults
from ModuleUltrasoundLib.emulators.server import served

PAGE = Path(__file__).resolve().parents[3] / "docs" / "write-an-amode-driver.md"
LINES = [np.random.default_rng(seed).integers(-500, 500, 800).astype(np.int16) for seed in range(5)]


def blocks() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def the_example(tmp_path_factory):
    path = tmp_path_factory.mktemp("driver") / "echobox.py"
    path.write_text(blocks()[0], encoding="utf-8")
    yield load_file(path)
    AMODE_DEVICES._registered.pop("echobox", None)  # other tests list the plugins


class EchoBoxOnTheBench:
    """The made-up box: gain, shot, answer."""

    def __init__(self, *faults: str) -> None:
        self.faults, self.gains, self.shots, self.input = Faults(faults, seed=1), [], 0, b""

    def greet(self) -> list[Chunk]:
        return []

    def tick(self, now_s: float) -> list[Chunk]:
        return []

    def receive(self, data: bytes, now_s: float) -> list[Chunk]:
        self.input += data
        chunks: list[Chunk] = []
        while b"\n" in self.input:
            command, _, self.input = self.input.partition(b"\n")
            if command.startswith(b"G"):
                self.gains.append(int(command[1:]))
            elif command == b"S":
                samples = LINES[self.shots % len(LINES)]
                self.shots += 1
                chunks += self.faults.spoil(b"L" + struct.pack("<H", len(samples)) + samples.astype("<i2").tobytes())
        return chunks


def test_the_example_is_about_forty_lines():
    code = [line for line in blocks()[0].splitlines() if line.strip() and not line.startswith(("import", "from", '"""'))]
    assert len(code) <= 40


def test_the_example_takes_lines_and_sets_the_gain(the_example):
    box = EchoBoxOnTheBench()
    with served(box) as port, AMODE_DEVICES.create("echobox", port=port, gain_db="36", forerun_length_mm="20") as device:
        taken = [device.read() for _ in range(5)]
        device.set_gain_db(20.0)
        device.read()
        assert device.acquisition.sampling_hz == 50e6
        assert device.acquisition.forerun_length_mm == 20.0
    assert all(np.array_equal(line.samples, samples) for line, samples in zip(taken, LINES))
    assert box.gains == [36, 20]


def test_the_example_drops_what_is_damaged_and_goes_on(the_example):
    with served(EchoBoxOnTheBench("byte-loss=0.5")) as port, AMODE_DEVICES.create("echobox", port=port) as device:
        taken = [line for line in (device.read(0.2) for _ in range(8)) if line is not None]
    assert 0 < len(taken) < 8
    assert device.counters["damaged lines"] == 8 - len(taken)
    assert all(any(np.array_equal(line.samples, samples) for samples in LINES) for line in taken)


def test_the_example_survives_a_pulled_cable(the_example):
    with served(EchoBoxOnTheBench("disconnect=0.3")) as port, AMODE_DEVICES.create("echobox", port=port) as device:
        lost = 0
        while not lost:
            try:
                device.read(0.5)
            except DeviceError:
                lost += 1
        assert device.state is DeviceState.LOST


def test_the_other_snippet_of_the_page_is_python():
    compile(blocks()[1], "page", "exec")
    assert "echobox" in blocks()[1]


def test_the_files_that_the_page_names_exist():
    root = PAGE.parents[1] / "ModuleUltrasound"
    for name in re.findall(r"`(ModuleUltrasoundLib/[\w/]+\.py)`", PAGE.read_text(encoding="utf-8")):
        assert (root / name).is_file(), name
