"""The Polaris driver on a bad line: damaged replies, late ones, pulled cables and power failures."""

from __future__ import annotations

import numpy as np
import pytest
from ModuleTrackingLib.ndi.emulator.faults import flip_bits, garble, lose_bytes
from ModuleTrackingLib.ndi.encode import bx_bytes, tx_bytes
from ModuleTrackingLib.ndi.poll import OPTIONS
from ModuleTrackingLib.ndi.replies import BadReplyError, text_payload
from ModuleTrackingLib.ndi.tracking import HandleData, HandleState, TrackingReply, parse_bx
from ModuleTrackingLib.ndi.tracking_text import parse_tx
from ModuleTrackingLib.tracker import PoseStatus
from polaris_rig import CountingMotion, Rig

RETURN_S = 2.0  # the tracker is back this soon after the device is


def corrupt(reply: bytes, rng: np.random.Generator) -> bytes:
    """One of the things that happen on a line."""
    kind = rng.integers(0, 7)
    at, other = (int(value) for value in rng.integers(0, len(reply), size=2))
    if kind == 0:
        return lose_bytes(reply, rng)
    if kind == 1:
        return flip_bits(reply, rng)
    if kind == 2:
        return reply[:at]
    if kind == 3:
        return reply[:at] + rng.bytes(int(rng.integers(1, 9))) + reply[at:]
    if kind == 4:
        return garble(reply, rng)
    if kind == 5:
        low, high = sorted((at, other))
        return reply[:low] + rng.bytes(high - low) + reply[high:]
    return rng.bytes(int(rng.integers(1, 6))) + reply[:at]


def some_reply(number: int) -> TrackingReply:
    entries = [
        HandleData(index + 1, HandleState.VALID, CountingMotion.pose(number, index), 0x31, number, 0, (3,) * 20)
        for index in range(number % 5)
    ]
    return TrackingReply((*entries, HandleData(9, HandleState.MISSING, None, 0x31, number, 2, (0,) * 20)), 0)


def test_ten_thousand_damaged_replies_are_each_refused_or_unchanged():
    rng = np.random.default_rng(7)
    replies = [some_reply(17 * number) for number in range(10)]
    binary = [(bx_bytes(reply, OPTIONS), lambda raw: parse_bx(raw, OPTIONS)) for reply in replies]
    text = [(tx_bytes(reply, OPTIONS)[:-1], lambda raw: parse_tx(text_payload(raw), OPTIONS)) for reply in replies]
    for _ in range(500):
        for raw, read in (*binary, *text):
            damaged = corrupt(raw, rng)
            if damaged == raw:
                continue
            with pytest.raises(BadReplyError):
                read(damaged)


def track_under_corruption(replies: str, corruptions: int, seed: int, share: float = 0.5) -> tuple[int, int]:
    """Track while replies are damaged at random; every pose that comes is checked against the truth."""
    rig = Rig(replies=replies, connect_timeout_s="120")
    rng = np.random.default_rng(seed)
    done = good = 0
    original = rig.station.faults.spoil

    def spoil(reply: bytes) -> tuple[float, bytes]:
        nonlocal done
        if done >= corruptions or rng.random() > share:
            return original(reply)
        done += 1
        return 0.0, corrupt(reply, rng)

    rig.tracker.open()
    rig.tracker.start()
    rig.station.faults.spoil = spoil
    while done < corruptions:
        good += rig.check(rig.tracker.read()) == 4
    for _ in range(100):
        poses = rig.tracker.read()
        if rig.check(poses) == 4:
            break
    assert rig.check(rig.tracker.read()) == 4
    rig.tracker.close()
    return done, good


@pytest.mark.parametrize("replies", ["BX", "TX"])
def test_tracking_goes_on_while_half_of_the_replies_are_damaged(replies):
    done, good = track_under_corruption(replies, corruptions=300, seed=3)
    assert done >= 300
    assert good > 150


def test_a_wait_too_short_for_the_clock_to_tell_ends_all_the_same():
    rig = Rig()
    with rig.tracker:
        rig.clock.time_s = 2.0**20 + 0.3  # steps of 1e-10 s
        port = rig.tracker._conductor.port
        for timeout_s in (1e-12, 1e-9):
            before = rig.clock.now()
            assert port.read(timeout_s) == b""
            assert rig.clock.now() > before


def test_silence_a_hair_shorter_than_the_limit_is_not_waited_for_in_vain():
    rig = Rig()
    with rig.tracker:
        rig.tracker.read()
        rig.clock.time_s = 1024.0306918619308  # where the last bit of time is coarser than what is left to wait
        rig.tracker._conductor.begin(rig.tracker._poller.next_frame())
        rig.tracker._poller.last_good_s = rig.clock.time_s - 0.1999999999999318
        rig.station.unplug(rig.clock.now(), 1.0)
        before = rig.clock.now()
        assert not any(pose.usable for pose in rig.tracker.read())
        assert rig.clock.now() > before


@pytest.mark.slow
@pytest.mark.parametrize("replies", ["BX", "TX"])
def test_ten_thousand_corruptions_while_tracking(replies):
    done, good = track_under_corruption(replies, corruptions=10_000, seed=11)
    assert done >= 10_000
    assert good > 5_000


def test_set_up_succeeds_on_a_line_that_damages_every_tenth_reply():
    for seed in range(4):
        rig = Rig(faults=["bit-errors:0.05", "byte-loss:0.03", "silence:0.02"], seed=seed)
        with rig.tracker:
            rig.station.faults.switch_off()
            for _ in range(60):
                poses = rig.tracker.read()
                rig.check(poses)
            assert rig.check(rig.tracker.read()) == 4


def test_late_replies_are_never_taken_for_the_present():
    rig = Rig(faults=["delays:0.05:0.35"])
    good = 0
    with rig.tracker:
        for _ in range(300):
            good += rig.check(rig.tracker.read(), frames_old=2) == 4
    assert good > 150


def test_errors_of_the_device_lead_to_a_new_set_up():
    rig = Rig()
    with rig.tracker:
        rig.tracker.read()
        rig.device.start_afresh()
        rig.device.speed = rig.tracker._session.speed  # a device that forgot all but its speed
        poses = rig.tracker.read()
        assert {pose.status for pose in poses} == {PoseStatus.MISSING}
        assert any("tracker lost" in pose.flags for pose in poses)
        back = [rig.tracker.read() for _ in range(40)]
        assert rig.check(back[-1]) == 4


def until_tracking(rig: Rig, limit_s: float) -> float:
    """Read until all tools have poses again; the time at which they have. Poses meanwhile are checked."""
    until_s = rig.clock.now() + limit_s
    while rig.clock.now() < until_s:
        if rig.check(rig.tracker.read(timeout_s=0.1)) == len(rig.tracker.tools):
            return rig.clock.now()
    raise AssertionError(f"not back after {limit_s} s: {rig.states[-5:]}")


def pull(rig: Rig, how: str, at_s: float, out_s: float) -> None:
    """Arrange for the cable (or adapter, or power and cable) to be out for a while, by the rig's clock."""
    station, receive, tick = rig.station, rig.station.receive, rig.station.tick
    struck = []

    def strike(now_s: float) -> None:
        if at_s <= now_s and not struck:
            struck.append(now_s)
            station.unplug(at_s, out_s)
            if how == "power":
                rig.device.power_cycle(at_s + out_s - rig.device.model.boot_s)
        if how == "adapter":
            rig.adapter_present = not at_s <= now_s < at_s + out_s

    def struck_receive(data: bytes, speed: int | None, now_s: float) -> None:
        strike(now_s)
        receive(data, speed, now_s)

    def struck_tick(now_s: float) -> None:
        strike(now_s)
        tick(now_s)

    station.receive, station.tick = struck_receive, struck_tick
    sleep = rig.clock.sleep

    def struck_sleep(seconds: float) -> None:
        sleep(seconds)
        strike(rig.clock.now())

    rig.clock.sleep = struck_sleep


HOW = ["cable", "adapter", "power"]


def set_up_time(tmp_path) -> float:
    rig = Rig(roms=rom_setting(tmp_path))
    start_s = rig.clock.now()
    rig.tracker.open()
    return rig.clock.now() - start_s


def rom_setting(tmp_path) -> str:
    path = tmp_path / "probe.rom"
    path.write_bytes(b"NDI\0Probe" + bytes(700))
    return f"Probe={path}"


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("out_s", [0.5, 3.0])
@pytest.mark.parametrize("moments", [11, pytest.param(120, marks=pytest.mark.slow)])
def test_cable_pulled_at_any_moment_of_set_up_is_set_up_soon_after_its_return(tmp_path, how, out_s, moments):
    took_s = set_up_time(tmp_path)
    for at_s in np.linspace(0.0, took_s * 0.999, moments):
        rig = Rig(roms=rom_setting(tmp_path))
        start_s = rig.clock.now()
        pull(rig, how, start_s + at_s, out_s)
        if how == "adapter" and at_s == 0.0:
            continue  # no port at all when opening is an error at once
        rig.tracker.open()
        rig.tracker.start()
        back_s = until_tracking(rig, 10.0)
        assert back_s - (start_s + at_s + out_s) < RETURN_S, f"pulled after {at_s:.3f} s: {rig.states}"
        rig.tracker.close()


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("has_break", [True, False])
def test_cable_pulled_while_tracking_is_shown_at_once_and_tracked_soon_after_its_return(how, has_break):
    rng = np.random.default_rng(5)
    for _ in range(5):
        rig = Rig(has_break=has_break)
        with rig.tracker:
            for _ in range(10):
                rig.tracker.read()
            at_s, out_s = rig.clock.now() + float(rng.uniform(0.0, 0.05)), float(rng.choice([0.9, 2.5, 7.0, 20.0]))
            pull(rig, how, at_s, out_s)
            while rig.check(rig.tracker.read()) == 4:
                assert rig.clock.now() < at_s + 0.1
            assert rig.clock.now() - at_s < 0.25  # shown as missing
            while rig.clock.now() < at_s + out_s - 0.11:
                poses = rig.tracker.read(timeout_s=0.1)
                assert len(poses) == 4
                assert not any(pose.usable for pose in poses)
                assert any("lost" in flag or "answer" in flag for flag in poses[0].flags)
            assert until_tracking(rig, 10.0) - (at_s + out_s) < RETURN_S, rig.states[-12:]
            assert rig.tracker.losses == 1


def test_device_time_goes_on_across_a_power_failure():
    rig = Rig()
    times = []
    with rig.tracker:
        for moment in range(400):
            if moment == 150:
                rig.device.power_cycle(rig.clock.now())
            times += [(pose.host_time_s, pose.device_time_s) for pose in rig.tracker.read()[:1] if pose.usable]
    assert rig.tracker.losses == 1
    differences = [host - device for host, device in times]
    assert max(differences) - min(differences) < 0.02
    assert max(b[0] - a[0] for a, b in zip(times, times[1:])) > 0.5


def test_an_alert_whose_reason_is_lost_on_the_line_does_no_harm():
    rig = Rig(faults=["bumped", "silence=0.03", "bit-errors=0.1"], seed=2)
    good = 0
    with rig.tracker:
        for _ in range(300):
            good += rig.check(rig.tracker.read()) == 4
    assert good > 150


def test_brown_outs_end_in_tracking_again():
    rig = Rig(faults=["brown-out:4"])
    with rig.tracker:
        for _ in range(2):
            until_tracking(rig, 5.0)
            while rig.tracker.state.value == "tracking":
                rig.check(rig.tracker.read())
        assert rig.tracker.losses >= 2


def test_a_cable_that_cannot_carry_the_highest_speed_is_used_at_a_lower_one():
    rig = Rig()
    receive = rig.station.receive

    def worn(data: bytes, speed: int | None, now_s: float) -> None:
        receive(data if speed <= 115200 else garble(data, rig.station.faults.rng).replace(b"\0", b"x"), speed, now_s)

    rig.station.receive = worn
    with rig.tracker:
        assert rig.check(rig.tracker.read()) == 4
        assert rig.device.speed == 115200
