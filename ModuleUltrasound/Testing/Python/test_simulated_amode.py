"""The simulated A-mode probe behaves like a device, its faults included."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.phantom import make_patient
from CranioNavLib.phantom.session import SimulatedSession, SteppedClock, use_session
from CranioNavLib.phantom.sites import outer_seats
from ModuleUltrasoundLib.devices.device import AMODE_DEVICES, DeviceError


@pytest.fixture
def a_session():
    patient = make_patient(None, 1)
    session = SimulatedSession(patient, 1, SteppedClock())
    session.set_plan(*(part[:4] for part in outer_seats(patient.bone, patient.skin, np.random.default_rng(0))))
    use_session(session)
    yield session
    use_session(None)


def test_lines_come_at_the_rate_with_time_number_and_acquisition(a_session):
    a_session.hold_probe_at(0)
    with AMODE_DEVICES.create("simulated", rate_hz="50") as device:
        lines = [device.read() for _ in range(20)]
        acquisition = device.acquisition
    assert acquisition.sampling_hz == 60e6
    assert [line.sequence_number for line in lines] == list(range(1, 21))
    assert np.diff([line.host_time_s for line in lines]) == pytest.approx(np.full(19, 0.02))
    assert {line.samples.shape for line in lines} == {(3072,)}
    assert lines[0].samples.dtype == np.int16


def test_a_probe_on_the_head_hears_tissue_and_one_in_the_air_does_not(a_session):
    with AMODE_DEVICES.create("simulated") as device:
        in_air = device.read().samples.astype(float)
        a_session.hold_probe_at(1)
        for _ in range(80):
            line = device.read()
    start, end = int(21.5e-6 * 60e6), int(26e-6 * 60e6)
    assert np.abs(line.samples[start:end].astype(float)).std() > 3 * np.abs(in_air[start:end]).std()


def test_saturation_is_told_of_echoes_not_of_the_main_bang(a_session):
    with AMODE_DEVICES.create("simulated") as device:
        line = device.read()  # total reflection at the end of the forerun
        assert line.saturated
        assert device._saturated(np.where(np.arange(3072) < 100, 511, 0).astype(np.int16)) is False


def test_lost_lines_leave_gaps_in_the_numbers(a_session):
    with AMODE_DEVICES.create("simulated", lost_share="0.3") as device:
        numbers = [device.read().sequence_number for _ in range(60)]
    assert np.diff(numbers).min() == 1
    assert 60 / numbers[-1] == pytest.approx(0.7, abs=0.15)


def test_a_broken_link_is_an_error_that_says_what_to_do(a_session):
    device = AMODE_DEVICES.create("simulated", fail_after_s="0.5")
    with pytest.raises(DeviceError, match="broke; open it again"), device:
        for _ in range(100):
            device.read()


def test_wrong_order_of_calls_is_an_error_and_a_line_not_yet_due_is_none(a_session):
    device = AMODE_DEVICES.create("simulated", rate_hz="1")
    for call in (device.start, lambda: device.acquisition):
        with pytest.raises(DeviceError, match="not open"):
            call()
    with pytest.raises(DeviceError, match="start it first"):
        device.read()
    with device:
        assert device.read(timeout_s=0.2) is None
        assert device.read(timeout_s=1.0).sequence_number == 1
