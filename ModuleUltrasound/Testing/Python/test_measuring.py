"""The measuring step of the ultrasound module's logic: a recording becomes bone points, and tells of the speed of sound."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib import host, scene_data
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid
from CranioNavLib.sequence_metafile import Acquisition, Recording, write_recording
from CranioNavLib.slicer_files import LabelledPoints

import ModuleUltrasound as module

RATE_HZ, CARRIER_HZ = 50e6, 5e6
POSE = rigid(np.diag([1.0, -1.0, -1.0]), [5.0, 6.0, 50.0])  # the beam points down


@pytest.fixture
def a_logic():
    host.scene().Clear(False)
    yield module.ModuleUltrasoundLogic()
    host.scene().Clear(False)


def echo_line(way_mm_s_m, rng):
    """Transmit pulse, bone after 2 * way (mm over m/s), noise: no forerun."""
    times = np.arange(1500) / RATE_HZ
    samples = rng.normal(0, 20, len(times))
    for late, amplitude, seconds in ((times, 20000, 2e-7), (times - 2e-3 * way_mm_s_m, 8000, 2.5e-7)):
        samples += amplitude * np.exp(-((late / seconds) ** 2)) * np.cos(2 * np.pi * CARRIER_HZ * late)
    return np.clip(samples, -32768, 32767).astype(np.int16)


def test_a_missing_recording_is_refused_and_changes_nothing(a_logic, tmp_path):
    scene_data.set_points("SurfacePoints", LabelledPoints(("a",), np.zeros((1, 3))))
    a_logic.parameters().change(recording_path=str(tmp_path / "none.igs.mha"))
    with pytest.raises(InputError, match=r"none\.igs\.mha"):
        a_logic.measureRecording().run()
    assert scene_data.get_points("SurfacePoints").labels == ("a",)


def pressing_recording(path, speed_m_s=1480.0):
    """Flat bone under a probe that presses hard and softly: its face moves as far as the tissue gives way."""
    rng, frames = np.random.default_rng(5), 60
    depth = 6.5 - 1.5 * (1 - np.cos(np.linspace(0, 8, frames))) / 2
    poses = np.tile(POSE, (frames, 1, 1))
    poses[:, 2, 3] = depth  # the beam points down
    lines = np.stack([echo_line(mm / speed_m_s, rng) for mm in depth])
    times = np.arange(frames) / 40
    write_recording(
        path, Recording(lines, Acquisition(RATE_HZ, CARRIER_HZ), poses, ("OK",) * frames, times, np.zeros(frames, int))
    )


def test_the_speed_of_sound_told_by_pressing_is_reported_and_taken_over_once(a_logic, tmp_path):
    path = tmp_path / "pressed.igs.mha"
    pressing_recording(path)
    a_logic.parameters().change(recording_path=str(path))
    assert a_logic.useSpeedBlocked() != ""
    a_logic.measureRecording().run()
    assert a_logic.pressed.pressed_m_s == pytest.approx(1480, abs=3 * a_logic.pressed.pressed_sd_m_s)
    assert a_logic.pressed.pressed_sd_m_s < 40
    told = a_logic.pressed.speed_m_s
    assert a_logic.useSpeedBlocked() == ""
    a_logic.useSpeed()
    assert a_logic.parameters().read().speed_of_sound_m_s == pytest.approx(told, abs=0.1)
    assert a_logic.pressedSpeed() is None
    assert a_logic.useSpeedBlocked() != ""
