"""Replay gives a recording's lines back, in time, faster and step by step."""

from __future__ import annotations

import time

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.sequence_metafile import Acquisition, Recording, write_recording
from ModuleUltrasoundLib.devices.device import AMODE_DEVICES, DeviceError


@pytest.fixture
def a_path(tmp_path):
    rng = np.random.default_rng(1)
    recording = Recording(
        lines=rng.integers(-32768, 32767, (6, 200)).astype(np.int16),
        acquisition=Acquisition(25e6, 4e6, 10.0, 2170.0),
        probe_to_reference=np.tile(np.eye(4), (6, 1, 1)),
        statuses=("OK",) * 6,
        timestamps_s=100.0 + 0.05 * np.arange(6),
        palpation_points=np.arange(6),
    )
    path = tmp_path / "palpation.igs.mha"
    write_recording(path, recording)
    return path, recording


def test_every_line_comes_back_once_as_recorded(a_path):
    path, recording = a_path
    with AMODE_DEVICES.create("replay", path=str(path), pace="fast") as device:
        lines = [device.read() for _ in range(6)]
        assert np.array_equal([line.samples for line in lines], recording.lines)
        assert [line.sequence_number for line in lines] == list(range(6))
        assert device.acquisition == recording.acquisition
        assert device.read(0.0) is None


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_lines_keep_the_distances_in_time_that_they_had_divided_by_the_speed(a_path, speed):
    path, _ = a_path
    with AMODE_DEVICES.create("replay", path=str(path), speed=str(speed)) as device:
        lines = [device.read(1.0) for _ in range(6)]
        arrived = time.monotonic()
    assert np.diff([line.host_time_s for line in lines]) == pytest.approx(0.05 / speed)
    assert arrived >= lines[-1].host_time_s  # none before its time


def test_a_line_that_is_not_due_is_waited_for_only_as_long_as_allowed(a_path):
    path, _ = a_path
    with AMODE_DEVICES.create("replay", path=str(path), speed="0.01") as device:
        assert device.read(0.0) is not None
        assert device.read(0.01) is None


def test_a_loop_begins_again_in_step_with_the_clock(a_path):
    path, recording = a_path
    with AMODE_DEVICES.create("replay", path=str(path), loop="yes", speed="20") as device:
        lines = [device.read(1.0) for _ in range(14)]
    assert np.array_equal(lines[12].samples, recording.lines[0])
    assert np.diff([line.host_time_s for line in lines]) == pytest.approx(0.05 / 20)


def test_nothing_to_play_is_refused(a_path, tmp_path):
    with pytest.raises(InputError, match="set its parameter path"):
        AMODE_DEVICES.create("replay").open()
    with pytest.raises(InputError, match="nowhere"):
        AMODE_DEVICES.create("replay", path=str(tmp_path / "nowhere.igs.mha")).open()
    with pytest.raises(DeviceError, match="start it"):
        AMODE_DEVICES.create("replay", path=str(a_path[0])).read()
