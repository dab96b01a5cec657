"""Lines from a device's thread: in order, bounded, with the probe's pose at their time, and none where there was none."""

from __future__ import annotations

import time

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.rigid import rigid_from_vector
from CranioNavLib.sequence_metafile import Acquisition
from ModuleUltrasoundLib.devices.device import AModeDevice, DeviceError, RfLine
from ModuleUltrasoundLib.devices.line_stream import LinePoser, LineStream, recording_of

ACQUISITION = Acquisition(50e6, 5e6)


class Scripted(AModeDevice):
    """Gives the lines of a list, one at a time; an exception in it is raised, None stands for nothing in time."""

    name = "scripted-lines"

    def __init__(self, script):
        super().__init__()
        self.script, self.opened, self.closed = list(script), 0, 0

    def open(self):
        self.opened += 1

    def start(self):
        pass

    def stop(self):
        pass

    def close(self):
        self.closed += 1

    @property
    def acquisition(self):
        return ACQUISITION

    def read(self, timeout_s=1.0):
        if not self.script:
            time.sleep(0.005)
            return None
        item = self.script.pop(0)
        if isinstance(item, BaseException):
            raise item
        return item


def line(number, time_s=None):
    return RfLine(np.full(8, number, np.int16), float(number) if time_s is None else time_s, number)


def take(stream, count, limit_s=5.0):
    got, end = [], time.monotonic() + limit_s
    while len(got) < count and time.monotonic() < end:
        got += stream.poll()
        time.sleep(0.005)
    return got


def test_lines_arrive_in_order_and_the_device_is_closed():
    device = Scripted([line(k) for k in range(20)])
    with LineStream(device) as stream:
        assert [got.sequence_number for got in take(stream, 20)] == list(range(20))
        assert stream.state.connected
        assert stream.acquisition == ACQUISITION
    assert device.closed == 1
    assert not stream.state.connected


def test_a_device_that_fails_is_opened_again(monkeypatch):
    monkeypatch.setattr("CranioNavLib.device_stream.RETRY_S", 0.01)
    device = Scripted([line(0), DeviceError("the cable fell out; plug it in"), line(1)])
    with LineStream(device) as stream:
        assert [got.sequence_number for got in take(stream, 2)] == [0, 1]
    assert device.opened == 2


@pytest.mark.parametrize("error", [InputError("no such port; give another"), ZeroDivisionError("defect")])
def test_what_the_device_refuses_is_raised_on_the_main_thread_once(error):
    with LineStream(Scripted([error])) as stream:
        with pytest.raises(type(error)):
            take(stream, 1)
        assert stream.poll() == []
        assert str(error) in stream.state.problem


def test_when_nobody_polls_the_newest_lines_are_kept_and_the_loss_is_counted():
    device = Scripted([line(k) for k in range(30)])
    with LineStream(device, queue_lines=10) as stream:
        end = time.monotonic() + 5
        while device.script and time.monotonic() < end:
            time.sleep(0.005)
        time.sleep(0.02)
        assert [got.sequence_number for got in stream.poll()] == list(range(20, 30))
        assert stream.state.dropped_lines == 20


def test_a_line_gets_the_pose_at_its_own_time():
    poser = LinePoser(clock=lambda: 1.0)
    poser.add_pose(rigid_from_vector([0, 0, 0], [0, 0, 0]), "OK", 1.00)
    poser.add_line(line(1, 1.02), palpation_point=7)
    assert poser.ready() == [], "the pose after it is still to come"
    poser.add_pose(rigid_from_vector([0, 0, 0.2], [10, 0, 0]), "OK", 1.04)
    (posed,) = poser.ready()
    np.testing.assert_allclose(posed.pose.tool_to_tracker, rigid_from_vector([0, 0, 0.1], [5, 0, 0]), atol=1e-12)
    assert posed.palpation_point == 7


def test_a_line_waits_no_longer_than_it_must_and_then_has_no_pose():
    now = [1.0]
    poser = LinePoser(clock=lambda: now[0])
    poser.add_pose(np.eye(4), "OK", 0.9)
    poser.add_line(line(1, 1.0))
    assert poser.ready() == []
    now[0] = 1.4
    (posed,) = poser.ready()
    assert not posed.pose.usable


def test_no_pose_is_made_up_between_a_lost_pose_and_the_next():
    poser = LinePoser(clock=lambda: 1.0)
    poser.add_pose(np.eye(4), "OK", 1.00)
    poser.add_pose(None, "OUT_OF_VIEW", 1.04)
    poser.add_line(line(1, 1.02))
    (posed,) = poser.ready()
    recording = recording_of([posed], ACQUISITION)
    assert recording.statuses[0] != "OK"
    assert np.isnan(recording.probe_to_reference).all()


def test_a_recording_in_memory_holds_what_was_taken():
    poser = LinePoser(clock=lambda: 9.0)
    for k in range(3):
        poser.add_pose(rigid_from_vector([0, 0, 0], [k, 0, 0]), "OK", 1.0 + 0.05 * k)
        poser.add_line(line(k, 1.0 + 0.05 * k), palpation_point=k)
    recording = recording_of(poser.ready(), ACQUISITION)
    assert recording.statuses == ("OK",) * 3
    np.testing.assert_allclose(recording.timestamps_s, [0, 0.05, 0.1])
    np.testing.assert_array_equal(recording.lines[:, 0], [0, 1, 2])
    np.testing.assert_array_equal(recording.palpation_points, [0, 1, 2])
    np.testing.assert_allclose(recording.probe_to_reference[:, 0, 3], [0, 1, 2])


def test_no_lines_or_lines_of_different_length_are_no_recording():
    with pytest.raises(InputError, match="no lines"):
        recording_of([], ACQUISITION)
    poser = LinePoser(clock=lambda: 9.0)
    poser.add_line(line(1))
    poser.add_line(RfLine(np.zeros(9, np.int16), 2.0))
    with pytest.raises(InputError, match="length"):
        recording_of(poser.ready(everything=True), ACQUISITION)
