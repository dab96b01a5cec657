"""The framed protocol: what is sent arrives, and damage never makes a line that was not sent."""

from __future__ import annotations

import numpy as np
import pytest
from CranioNavLib.errors import InputError
from hypothesis import given, settings
from hypothesis import strategies as st
from ModuleUltrasoundLib.devices.framed import (
    KIND_LINE,
    KIND_TEXT,
    Frame,
    FrameDecoder,
    crc16,
    decode_command,
    encode_command,
    encode_frame,
    parse_pairs,
)


def a_line(sequence: int, count: int = 3000) -> Frame:
    samples = np.random.default_rng(sequence).integers(-2000, 2000, count).astype("<i2")
    return Frame(KIND_LINE, samples.tobytes(), sequence, 1_000_000 + sequence, 50_000_000, -12.5, 7, 4, sequence % 2 == 0)


def bitwise_crc16(data: bytes, crc: int = 0xFFFF) -> int:
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def test_crc_is_the_one_of_its_catalogue_entry():
    assert crc16(b"123456789") == 0x29B1  # CRC-16/IBM-3740, "CCITT-FALSE"
    data = bytes(range(256))
    assert crc16(data[100:], crc16(data[:100])) == bitwise_crc16(data)


def test_a_frame_has_the_documented_bytes():
    data = encode_frame(Frame(KIND_LINE, b"\x01\x00\xff\xff", 5, 6, 1000, 1.0, 2, 3, True))
    assert data[:36] == bytes.fromhex("a55ac33c 01 01 0300 05000000 0600000000000000 e8030000 64000000 02000000 04000000")
    assert int.from_bytes(data[36:38], "little") == bitwise_crc16(data[:36])
    assert data[38:42] == b"\x01\x00\xff\xff"
    assert int.from_bytes(data[42:44], "little") == bitwise_crc16(data[:36] + data[38:42])
    assert len(data) == 44


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(1, 400), min_size=1, max_size=30), st.binary(max_size=20))
def test_frames_arrive_whole_however_the_bytes_are_cut(cuts, garbage):
    frames = [a_line(1), Frame(KIND_TEXT, "gain µ".encode()), a_line(2, 1), a_line(3, 1024)]
    stream = garbage + b"".join(encode_frame(frame) for frame in frames)
    decoder, received, at, turn = FrameDecoder(), [], 0, 0
    while at < len(stream):
        step = cuts[turn % len(cuts)]
        received += decoder.feed(stream[at : at + step])
        at, turn = at + step, turn + 1
    assert [frame.payload for frame in received] == [frame.payload for frame in frames]
    got, sent = received[0], frames[0]
    assert (got.sequence, got.device_time_us, got.sampling_hz, got.gain_db) == (1, 1_000_001, 50_000_000, -12.5)
    assert (got.first_sample, got.averaging, got.clipped) == (sent.first_sample, sent.averaging, sent.clipped)
    assert received[1].text == "gain µ"
    assert not decoder.mid_frame


def spoil(rng: np.random.Generator, stream: bytes) -> bytes:
    for _ in range(int(rng.integers(1, 6))):
        at = int(rng.integers(len(stream)))
        kind, count = rng.integers(4), int(rng.integers(1, 40))
        if kind == 0:
            stream = stream[:at] + stream[at + count :]
        elif kind == 1:
            stream = stream[:at] + rng.bytes(count) + stream[at:]
        elif kind == 2:
            stream = stream[:at] + rng.bytes(min(count, len(stream) - at)) + stream[at + count :]
        else:
            stream = stream[:at] + bytes([stream[at] ^ (1 << int(rng.integers(8)))]) + stream[at + 1 :]
    return stream


def test_damage_never_makes_a_wrong_line_and_costs_only_the_frames_it_touches():
    sent = [a_line(k, 300 + 700 * (k % 4)) for k in range(20)]
    known = {(frame.sequence, frame.payload) for frame in sent}
    stream = b"".join(encode_frame(frame) for frame in sent)
    received = 0
    for seed in range(400):
        frames = FrameDecoder().feed(spoil(np.random.default_rng(seed), stream))
        assert {(frame.sequence, frame.payload) for frame in frames} <= known
        received += len(frames)
        assert len(frames) >= len(sent) - 10
    assert received < 400 * len(sent)  # the damage was real


def test_every_flipped_bit_of_a_frame_is_seen():
    data = encode_frame(a_line(1, 40))
    for bit in range(8 * len(data)):
        spoiled = bytearray(data)
        spoiled[bit // 8] ^= 1 << (bit % 8)
        assert FrameDecoder().feed(bytes(spoiled)) == []


def test_a_block_of_another_frame_does_not_fit():
    one, two = encode_frame(a_line(1)), encode_frame(a_line(2))
    swapped = one[: 38 + 2050] + two[38 + 2050 : 38 + 2 * 2050] + one[38 + 2 * 2050 :]
    assert FrameDecoder().feed(swapped) == []


def test_a_frame_that_stops_half_way_is_given_up_and_the_next_one_read():
    decoder = FrameDecoder()
    assert decoder.feed(encode_frame(a_line(1))[:1000]) == []
    assert decoder.mid_frame
    assert decoder.give_up() == []
    assert [frame.sequence for frame in decoder.feed(encode_frame(a_line(2)))] == [2]
    assert decoder.damaged_frames == 1


def test_commands_survive_the_round_trip_and_damage_is_seen():
    line = encode_command("SET gain_db=40 range_us=60")
    assert line.endswith(b"\n")
    assert decode_command(line.rstrip(b"\n")) == "SET gain_db=40 range_us=60"
    assert decode_command(line.replace(b"40", b"41").rstrip(b"\n")) is None
    assert decode_command(b"") is None


def test_settings_that_are_not_pairs_are_refused():
    assert parse_pairs("a=1 b=x") == {"a": "1", "b": "x"}
    with pytest.raises(InputError, match="expected key=value, got 'gain'"):
        parse_pairs("gain")
