"""The Polaris driver against an emulated device: what it sets up, what it reports, what it refuses."""

from __future__ import annotations

import math

import pytest
from CranioNavLib.errors import InputError
from ModuleTrackingLib.ndi.emulator.device import Model
from ModuleTrackingLib.plugins.polaris import PolarisTracker
from ModuleTrackingLib.tracker import TRACKERS, PoseStatus, TrackerError
from polaris_rig import TOOLS, CountingMotion, Rig


@pytest.fixture
def tool_files(tmp_path):
    """The `roms` setting for three tools whose files name them, out of the device's order."""
    parts = []
    for size, name in ((1024, "Stylus"), (300, "Probe"), (752, "Reference")):
        path = tmp_path / f"{name.lower()}.rom"
        path.write_bytes((b"NDI\0" + name.encode() + bytes(range(256)) * 4)[:size])
        parts.append(f"{name}={path}")
    return ";".join(parts)


def test_plugin_is_found_by_its_name():
    assert TRACKERS.find("polaris") is PolarisTracker


def test_poses_are_those_of_the_device_to_a_thousandth():
    rig = Rig()
    with rig.tracker:
        for _ in range(50):
            poses = rig.tracker.read()
            assert [pose.tool for pose in poses] == list(TOOLS)
            assert rig.check(poses, tolerance_mm=1e-3) == 4
            assert poses[0].error_mm == pytest.approx(0.1, abs=1e-6)


def test_text_replies_take_over_where_the_device_lacks_binary_ones():
    rig = Rig(model=Model(has_bx=False, has_parameters=False))
    with rig.tracker:
        for _ in range(20):
            assert rig.check(rig.tracker.read(), tolerance_mm=0.0051) == 4


def test_frame_numbers_rise_without_repeats_and_give_the_device_time():
    rig = Rig(motion=CountingMotion(rate_hz=20.0))
    with rig.tracker:
        frames = [rig.tracker.read()[0] for _ in range(40)]
    assert [frame.frame_number for frame in frames] == list(range(frames[0].frame_number, frames[0].frame_number + 40))
    assert frames[-1].device_time_s - frames[0].device_time_s == pytest.approx(39 / 20.0)
    assert frames[-1].host_time_s - frames[0].host_time_s == pytest.approx(39 / 20.0, abs=0.02)
    assert rig.tracker.counts.repeats > 0


@pytest.mark.parametrize("rate_hz", [20.0, 60.0, 250.0])
def test_no_frame_is_left_out_and_few_are_asked_for_twice(rate_hz):
    rig = Rig(motion=CountingMotion(rate_hz=rate_hz))
    with rig.tracker:
        frames = [rig.tracker.read()[0].frame_number for _ in range(50)]
        polls = rig.tracker.counts.polls  # by now the driver knows the pace
        frames += [rig.tracker.read()[0].frame_number for _ in range(250)]
    assert frames == list(range(frames[0], frames[0] + 300))
    assert rig.tracker.counts.polls - polls < 1.4 * 250


def test_a_line_too_slow_for_tool_information_goes_without():
    rig = Rig(baud="115200", motion=CountingMotion(tools=TOOLS[:3], rate_hz=60.0))
    with rig.tracker:
        frames = [rig.tracker.read()[0].frame_number for _ in range(200)]
    assert frames == list(range(frames[0], frames[0] + 200))


def test_frame_numbers_go_on_beyond_32_bits():
    rig = Rig(model=Model(first_frame=2**32 - 5))
    with rig.tracker:
        frames = [rig.tracker.read()[0].frame_number for _ in range(20)]
    assert frames == list(range(frames[0], frames[0] + 20))
    assert frames[-1] > 2**32


def test_frame_rate_can_be_given_where_the_device_does_not_tell_it():
    rig = Rig(model=Model(has_parameters=False), motion=CountingMotion(rate_hz=30.0), frame_counter_hz="30")
    with rig.tracker:
        first, *_, last = [rig.tracker.read()[0] for _ in range(31)]
    assert last.device_time_s - first.device_time_s == pytest.approx(1.0)


def test_tool_files_are_uploaded_whole_and_name_the_tools(tool_files):
    rig = Rig(roms=tool_files)
    with rig.tracker:
        poses = rig.tracker.read()
        assert [pose.tool for pose in poses] == ["Stylus", "Probe", "Reference"]
        assert rig.check(poses) == 3
        assert [tool.part_number for tool in rig.tracker.tools] == ["Stylus", "Probe", "Reference"]
        uploaded = rig.device._handles[2].rom
    assert bytes(uploaded) == (b"NDI\0Probe" + bytes(range(256)) * 4)[:300] + bytes(724)


def test_wired_tools_are_named_by_their_part_or_serial_number():
    rig = Rig(names="Probe=A-mode probe;00000003=Pointer")
    with rig.tracker:
        assert [tool.name for tool in rig.tracker.tools] == ["Reference", "A-mode probe", "Pointer", "Sphere"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"roms": "Probe"}, "expected name=value"),
        ({"roms": "Probe=nowhere.rom"}, r"cannot read nowhere\.rom of tool Probe"),
        ({"roms": "A=x;A=y"}, "stands there twice"),
        ({"port": "socket://host"}, "socket://host:port"),
        ({"baud": "12345"}, "expected one of highest"),
        ({"volume": "99"}, "expected 0"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        Rig(**settings)


def test_tool_files_of_an_impossible_size_are_refused(tmp_path):
    path = tmp_path / "picture.rom"
    path.write_bytes(bytes(5000))
    with pytest.raises(InputError, match="5000 bytes"):
        Rig(roms=f"Probe={path}")


@pytest.mark.parametrize(("limit", "speeds", "expected"), [("highest", (9600, 115200), 115200), ("57600", None, 57600)])
def test_highest_speed_that_device_and_user_allow_is_used(limit, speeds, expected):
    rig = Rig(model=Model(speeds=speeds) if speeds else None, baud=limit)
    with rig.tracker:
        rig.tracker.read()
        assert rig.device.speed == expected


def test_device_is_left_at_9600_and_not_tracking():
    rig = Rig()
    with rig.tracker:
        assert rig.device.speed == 1228739
        assert rig.device.tracking
    assert rig.device.speed == 9600
    assert not rig.device.tracking
    rig.tracker.close()


def test_missing_tools_have_no_pose():
    rig = Rig(faults=["missing:1"])
    with rig.tracker:
        for pose in rig.tracker.read():
            assert (pose.status, pose.tool_to_tracker, pose.usable) == (PoseStatus.MISSING, None, False)
            assert math.isnan(pose.error_mm)


@pytest.mark.parametrize(
    ("fault", "status", "words"),
    [
        ("out-of-volume", PoseStatus.OUT_OF_VOLUME, "out of volume"),
        ("partly-out-of-volume", PoseStatus.OUT_OF_VOLUME, "partly out of volume"),
        ("interference", PoseStatus.INVALID, "infrared interference"),
        ("too-few-markers", PoseStatus.MISSING, "too few markers seen"),
        ("disabled", PoseStatus.MISSING, "disabled"),
    ],
)
@pytest.mark.parametrize("replies", ["BX", "TX"])
def test_what_the_device_warns_of_is_flagged_and_not_usable(fault, status, words, replies):
    rig = Rig(faults=[f"{fault}:1"], replies=replies)
    with rig.tracker:
        for pose in rig.tracker.read():
            assert pose.status is status
            assert words in pose.flags
            assert not pose.usable
            assert (pose.tool_to_tracker is not None) == (status is PoseStatus.OUT_OF_VOLUME)


def test_unplugged_tools_are_missing_and_said_to_be_unplugged():
    rig = Rig(faults=["unplugged:1"], replies="TX")
    with rig.tracker:
        assert {(pose.status, pose.flags) for pose in rig.tracker.read()} == {(PoseStatus.MISSING, ("unplugged",))}


def test_tools_come_and_go_one_by_one():
    rig = Rig(faults=["missing:0.5"])
    with rig.tracker:
        seen = [tuple(pose.usable for pose in rig.tracker.read()) for _ in range(300)]
    assert len(set(seen)) > 4


def test_a_bumped_camera_is_said_in_words():
    rig = Rig(faults=["bumped"])
    with rig.tracker:
        flags = rig.tracker.read()[0].flags
    assert flags == ("the tracker has an alert", "the camera was bumped: check its accuracy")


def test_a_tool_file_that_the_device_refuses_is_named(tool_files, monkeypatch):
    from ModuleTrackingLib.ndi.emulator import device

    def refuse(self, parameters, now_s):
        raise device.DeviceError(0x13)

    monkeypatch.setattr(device.EmulatedPolaris, "_do_pinit", refuse)
    rig = Rig(roms=tool_files)
    with pytest.raises(TrackerError, match=r"Stylus \(.*stylus\.rom\).*ERROR13: the tool could not be initialised"):
        rig.tracker.open()
    assert rig.tracker.state.value == "disconnected"


def test_no_tools_at_all_is_said():
    rig = Rig(motion=CountingMotion(tools=()))
    with pytest.raises(TrackerError, match="has no tools; give tool files"):
        rig.tracker.open()


def test_a_silent_port_is_given_up_with_advice():
    rig = Rig(connect_timeout_s="3")
    rig.station.unplug(rig.clock.now(), 1e6)
    with pytest.raises(TrackerError, match="no working connection to the tracker at rig within 3 s.*check power and cables"):
        rig.tracker.open()


def test_a_port_that_does_not_exist_is_an_error_at_once():
    tracker = TRACKERS.create("polaris", port="/dev/no-such-port")
    with pytest.raises(TrackerError, match=r"there is no port /dev/no-such-port; plug .* choose one of"):
        tracker.open()


def test_reading_before_starting_is_refused():
    with pytest.raises(TrackerError, match="start it first"):
        Rig().tracker.read()


def test_states_are_told_in_order():
    rig = Rig()
    with rig.tracker:
        rig.tracker.read()
    names = list(dict.fromkeys(state for _, state, _ in rig.states))
    assert names == ["connecting", "setting up", "ready", "tracking", "disconnected"]


@pytest.mark.parametrize("has_break", [True, False])
def test_a_device_left_tracking_at_another_speed_is_found(has_break):
    rig = Rig()
    rig.tracker.open()
    rig.tracker.start()
    again = Rig(has_break=has_break)
    again.station, again.clock = rig.station, rig.clock  # the host died; the device goes on at its speed
    again.tracker.clock = rig.clock
    with again.tracker:
        assert again.check(again.tracker.read()) == 4


def test_tracking_can_be_stopped_and_started_again():
    rig = Rig()
    rig.tracker.open()
    for _ in range(2):
        rig.tracker.start()
        assert rig.check(rig.tracker.read()) == 4
        rig.tracker.stop()
        rig.tracker.stop()
    rig.tracker.close()


def test_a_device_that_needs_seconds_for_a_command_is_waited_for():
    rig = Rig()
    receive = rig.device.receive

    def slow(data, now_s):
        if data.startswith(b"PINIT"):
            rig.station._line_free_s = now_s + 2.5  # the answer leaves the device so much later
        return receive(data, now_s)

    rig.device.receive = slow
    with rig.tracker:
        assert rig.check(rig.tracker.read()) == 4


def test_slow_readers_get_the_newest_frame():
    rig = Rig()
    with rig.tracker:
        for _ in range(5):
            rig.clock.sleep(0.7)
            assert rig.check(rig.tracker.read()) == 4


def test_short_time_outs_bring_nothing_but_lose_nothing():
    rig = Rig(motion=CountingMotion(rate_hz=20.0))
    frames = []
    with rig.tracker:
        for _ in range(400):
            poses = rig.tracker.read(timeout_s=0.005)
            assert poses == [] or rig.check(poses) == 4
            frames += [poses[0].frame_number] if poses else []
    assert frames == list(range(frames[0], frames[0] + len(frames)))
    assert len(frames) > 30
