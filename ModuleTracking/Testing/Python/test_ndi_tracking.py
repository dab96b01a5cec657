"""BX replies: the documented bytes, round trips of every option, and every damage refused."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleTrackingLib.ndi.crc import crc_binary
from ModuleTrackingLib.ndi.encode import bx_bytes
from ModuleTrackingLib.ndi.replies import BadReplyError
from ModuleTrackingLib.ndi.tracking import BX_HEADER, HandleData, HandleState, Marker, RawPose, TrackingReply, bx_length, parse_bx

EXAMPLE = bytes.fromhex(
    "c4a52d003043 010101 0000003f000000bf0000003f000000bf 66e6f6429ab929c40088bbc4 24b9fc3d 31000000 01100000 0000 ba59"
)

single = st.floats(width=32, allow_nan=False, allow_infinity=False, min_value=-1e6, max_value=1e6)
word32 = st.integers(0, 2**32 - 1)
poses = st.builds(RawPose, st.tuples(single, single, single, single), st.tuples(single, single, single), single)
positions = st.tuples(single, single, single)
markers = st.lists(st.builds(Marker, positions, st.booleans()), max_size=20).map(tuple)


@st.composite
def replies(draw, options):
    """Any reply that a device could send for these options."""
    handles = []
    for handle in draw(st.lists(st.integers(1, 255), max_size=6, unique=True)):
        state = draw(st.sampled_from([HandleState.VALID, HandleState.MISSING, HandleState.DISABLED]))
        if state is HandleState.DISABLED:
            handles.append(HandleData(handle, state))
            continue
        fields = {}
        if options & 1:
            pose = draw(poses) if state is HandleState.VALID else None
            fields.update(pose=pose, port_status=draw(word32), frame=draw(word32))
        if options & 2:
            digits = tuple(draw(st.lists(st.integers(0, 15), min_size=20, max_size=20)))
            fields.update(tool_info=draw(st.integers(0, 255)), marker_info=digits)
        if options & 4:
            status = draw(st.sampled_from([0x00, 0x01, 0x02, 0x08, 0x09]))
            sent = status & 0x01 or (status & 0x08 and options & 0x0800)
            stray = Marker(draw(positions), bool(status & 0x08)) if sent else None
            fields.update(stray_status=status, stray=stray)
        if options & 8:
            fields.update(markers=draw(markers))
        handles.append(HandleData(handle, state, **fields))
    strays = draw(markers) if options & 0x1000 else None
    return TrackingReply(tuple(handles), draw(st.integers(0, 0xFFFF)), strays)


option_words = st.sampled_from([0x0001, 0x0002, 0x0003, 0x0801, 0x0803, 0x0809, 0x0807, 0x1001, 0x1803, 0x180F, 0x100F])


def test_documented_example_is_read():
    reply = parse_bx(EXAMPLE, 0x0001)
    (entry,) = reply.handles
    assert (entry.handle, entry.state, entry.port_status, entry.frame) == (1, HandleState.VALID, 0x31, 0x1001)
    assert entry.pose.quaternion == (0.5, -0.5, 0.5, -0.5)
    assert entry.pose.translation_mm == pytest.approx((123.45, -678.90, -1500.25), abs=1e-4)
    assert entry.pose.error_mm == pytest.approx(0.1234, abs=1e-7)
    assert reply.system_status == 0


def test_documented_example_is_written_to_the_byte():
    assert bx_bytes(parse_bx(EXAMPLE, 0x0001), 0x0001) == EXAMPLE
    assert bx_length(EXAMPLE[:BX_HEADER]) == len(EXAMPLE) == 53


def test_missing_tools_carry_status_and_frame_only_and_disabled_ones_nothing():
    reply = TrackingReply(
        (HandleData(1, HandleState.MISSING, port_status=0x71, frame=9), HandleData(2, HandleState.DISABLED)), 0x00C0
    )
    raw = bx_bytes(reply, 0x0001)
    assert raw[BX_HEADER:-2] == bytes.fromhex("02 0102 71000000 09000000 0204 c000")
    assert parse_bx(raw, 0x0001) == reply


@settings(max_examples=80, deadline=None)
@given(option_words.flatmap(lambda options: st.tuples(st.just(options), replies(options))))
def test_every_reply_survives_the_round_trip(case):
    options, reply = case
    assert parse_bx(bx_bytes(reply, options), options) == reply


def test_stray_markers_out_of_volume_may_come_without_coordinates():
    body = b"\x00" + b"\x03" + b"\x02" + struct.pack("<6f", 1, 2, 3, 7, 8, 9) + b"\x00\x00"
    header = b"\xc4\xa5" + struct.pack("<H", len(body))
    reply = parse_bx(header + crc_binary(header) + body + crc_binary(body), 0x1001)
    assert reply.strays == (Marker((1, 2, 3)), Marker(None, True), Marker((7, 8, 9)))


@pytest.mark.parametrize("at", range(len(EXAMPLE)))
@pytest.mark.parametrize("change", [0x01, 0x80, 0xFF])
def test_any_changed_byte_is_refused(at, change):
    damaged = bytearray(EXAMPLE)
    damaged[at] ^= change
    with pytest.raises(BadReplyError):
        parse_bx(bytes(damaged), 0x0001)


@pytest.mark.parametrize("length", range(len(EXAMPLE)))
def test_any_cut_is_refused(length):
    with pytest.raises(BadReplyError):
        parse_bx(EXAMPLE[:length], 0x0001)


def test_wrong_way_round_start_sequence_is_refused():
    with pytest.raises(BadReplyError, match="C4 A5"):
        bx_length(bytes.fromhex("a5c42d003043"))


@pytest.mark.parametrize("options", [0x0003, 0x0009, 0x1001, 0x0002])
def test_a_reply_to_other_options_is_refused(options):
    with pytest.raises(BadReplyError):
        parse_bx(EXAMPLE, options)


def test_a_handle_twice_and_handle_zero_are_refused():
    entry = HandleData(3, HandleState.MISSING, port_status=1, frame=1)
    with pytest.raises(BadReplyError, match="each once"):
        parse_bx(bx_bytes(TrackingReply((entry, entry), 0), 1), 1)
    with pytest.raises(BadReplyError, match="none zero"):
        parse_bx(bx_bytes(TrackingReply((HandleData(0, HandleState.DISABLED),), 0), 1), 1)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_none_are_refused(bad):
    pose = RawPose((1.0, 0.0, 0.0, 0.0), (0.0, bad, 0.0), 0.1)
    raw = bx_bytes(TrackingReply((HandleData(1, HandleState.VALID, pose, 0x31, 1),), 0), 1)
    with pytest.raises(BadReplyError, match="not finite"):
        parse_bx(raw, 1)


def test_unknown_handle_status_is_refused():
    body = bytes.fromhex("01 0103") + bytes(8) + b"\0\0"
    header = b"\xc4\xa5" + struct.pack("<H", len(body))
    with pytest.raises(BadReplyError, match="unknown status 03"):
        parse_bx(header + crc_binary(header) + body + crc_binary(body), 0x0001)


@given(st.binary(max_size=200), option_words)
def test_bytes_of_any_kind_are_refused_and_nothing_else_happens(data, options):
    body = data
    header = b"\xc4\xa5" + struct.pack("<H", len(body))
    raw = header + crc_binary(header) + body + crc_binary(body)
    try:
        reply = parse_bx(raw, options)
    except BadReplyError:
        return
    assert parse_bx(bx_bytes(reply, options), options) == reply or reply.strays is not None
