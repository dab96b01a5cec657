"""TX replies: the documented bytes, both habits about UNOCCUPIED, round trips, and every damage refused."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleTrackingLib.ndi.encode import tx_bytes
from ModuleTrackingLib.ndi.replies import BadReplyError, text_payload
from ModuleTrackingLib.ndi.tracking import HandleData, HandleState, Marker, RawPose, TrackingReply
from ModuleTrackingLib.ndi.tracking_text import parse_tx

EXAMPLE = b"0101+05000-05000+05000-05000+012345-067890-150025+012340000003100001001\n0000997C\r"
POSE = "+05000-05000+05000-05000+012345-067890-150025+012340000003100001001"

word32 = st.integers(0, 2**32 - 1)
unit = st.integers(-99999, 99999).map(lambda number: number / 1e4)
place = st.integers(-999999, 999999).map(lambda number: number / 100)
poses = st.builds(RawPose, st.tuples(unit, unit, unit, unit), st.tuples(place, place, place), unit)
inside = st.tuples(place, place, place).map(Marker)
outside = st.tuples(place, place, place).map(lambda position: Marker(position, True))
markers = st.lists(st.one_of(inside, outside), max_size=9).map(tuple)


@st.composite
def replies(draw, options):
    handles = []
    for handle in draw(st.lists(st.integers(1, 255), max_size=6, unique=True)):
        state = draw(st.sampled_from(list(HandleState)))
        if state in (HandleState.DISABLED, HandleState.UNOCCUPIED):
            handles.append(HandleData(handle, state))
            continue
        pose = draw(poses) if state is HandleState.VALID else None
        fields = {"pose": pose, "port_status": draw(word32), "frame": draw(word32)}
        if options & 2:
            digits = tuple(draw(st.lists(st.integers(0, 15), min_size=20, max_size=20)))
            fields.update(tool_info=draw(st.integers(0, 255)), marker_info=digits)
        if options & 4:
            fields.update(stray=draw(st.one_of(st.none(), inside)))
        if options & 8:
            fields.update(markers=draw(markers))
        handles.append(HandleData(handle, state, **fields))
    strays = None
    if options & 0x1000:
        strays = draw(markers)
        if not options & 0x0800:
            strays = tuple(Marker(None, True) if marker.out_of_volume else marker for marker in strays)
    return TrackingReply(tuple(handles), draw(st.integers(0, 0xFFFF)), strays)


option_words = st.sampled_from([0x0001, 0x0003, 0x0801, 0x0803, 0x0809, 0x0807, 0x1001, 0x1803, 0x180F, 0x100F])


def test_documented_example_is_read_and_written_to_the_byte():
    reply = parse_tx(text_payload(EXAMPLE[:-1]), 0x0001)
    (entry,) = reply.handles
    assert (entry.handle, entry.state, entry.port_status, entry.frame) == (1, HandleState.VALID, 0x31, 0x1001)
    assert entry.pose == RawPose((0.5, -0.5, 0.5, -0.5), (123.45, -678.90, -1500.25), 0.1234)
    assert tx_bytes(reply, 0x0001) == EXAMPLE


@settings(max_examples=80, deadline=None)
@given(option_words.flatmap(lambda options: st.tuples(st.just(options), replies(options))))
def test_every_reply_survives_the_round_trip(case):
    options, reply = case
    assert parse_tx(text_payload(tx_bytes(reply, options)[:-1]), options) == reply


@pytest.mark.parametrize("after", ["", "\n", "0000000000000004\n", "0000000000000004"])
def test_unoccupied_is_understood_whichever_way_it_goes_on(after):
    states = {}
    for payload in (f"0201UNOCCUPIED{after}02{POSE}\n00C0", f"0202{POSE}\n01UNOCCUPIED{after}00C0"):
        reply = parse_tx(payload.encode(), 0x0001)
        assert reply.system_status == 0x00C0
        states = {entry.handle: entry.state for entry in reply.handles}
        assert states == {1: HandleState.UNOCCUPIED, 2: HandleState.VALID}


def test_unoccupied_before_disabled_and_missing_is_not_confused_with_hex_digits():
    reply = parse_tx(b"0301UNOCCUPIED02DISABLED\n03MISSING0000000100000002\n0000", 0x0001)
    assert [entry.state for entry in reply.handles] == [HandleState.UNOCCUPIED, HandleState.DISABLED, HandleState.MISSING]


def test_missing_keeps_status_and_frame_and_has_no_pose():
    (entry,) = parse_tx(b"0104MISSING0000007100001001\n0000", 0x0801).handles
    assert (entry.state, entry.pose, entry.port_status, entry.frame) == (HandleState.MISSING, None, 0x71, 0x1001)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"01",
        b"0000",
        b"02" + POSE.encode() + b"\n0000",
        b"0101" + POSE.encode() + b"0000",  # no line end
        b"0101" + POSE.replace("+", " ", 1).encode() + b"\n0000",  # a number without a sign
        b"0101" + POSE.replace("+", "", 1).encode() + b"\n0000",
        b"0101" + POSE.lower().replace("1001", "100f").encode() + b"\n0000",
        b"0101" + POSE.encode() + b"\n00000",
        b"0101" + POSE.encode() + b"\n000",
        b"0101MISSING\n0000",
        b"0101\xff\xfe\n0000",
        b"ERROR0C",
    ],
)
def test_anything_else_is_refused(payload):
    with pytest.raises(BadReplyError):
        parse_tx(payload, 0x0001)


@pytest.mark.parametrize("at", range(len(EXAMPLE) - 1))
def test_a_lost_character_is_noticed(at):
    with pytest.raises(BadReplyError):
        parse_tx(text_payload(EXAMPLE[:at] + EXAMPLE[at + 1 : -1]), 0x0001)


@given(st.text(alphabet="0123456789ABCDEF+-\nMISNGDLEUOCP", max_size=120), option_words)
def test_text_of_any_kind_is_refused_and_nothing_else_happens(text, options):
    try:
        parse_tx(text.encode(), options)
    except BadReplyError:
        return


@pytest.mark.parametrize(("value", "text"), [(1e9, "+999999"), (-1e9, "-999999"), (0.005, "+000000"), (-0.014, "-000001")])
def test_numbers_are_written_with_a_sign_and_clipped_to_their_width(value, text):
    reply = TrackingReply((HandleData(1, HandleState.VALID, RawPose((1.0, 0.0, 0.0, 0.0), (value, 0.0, 0.0), 0.0), 0x31, 1),), 0)
    assert tx_bytes(reply, 0x0001)[4 + 24 : 4 + 24 + 7].decode() == text
