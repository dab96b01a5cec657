"""The codec against bytes of the protocol's own documents, against itself, and against pyigtl's packing."""

from __future__ import annotations

import contextlib
import struct

import numpy as np
import pyigtl
import pytest
from CranioNavLib.errors import InputError
from CranioNavLib.openigtlink import Decoder, StreamError, encode
from CranioNavLib.openigtlink.crc64 import crc64
from CranioNavLib.openigtlink.messages import (
    Capability,
    GetCapability,
    GetStatus,
    Image,
    Message,
    NdArray,
    Position,
    Rejected,
    StartTracking,
    Status,
    StopTracking,
    String,
    TrackedTool,
    TrackingData,
    TrackingReply,
    Transform,
    Unknown,
    a_line_image,
)
from hypothesis import given, settings
from hypothesis import strategies as st

HEADER = 58
A_MATRIX = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]], dtype=float)


def crc_by_definition(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte << 56
        for _ in range(8):
            crc = ((crc << 1) ^ 0x42F0E1EBA9EA3693 if crc >> 63 else crc << 1) & (2**64 - 1)
    return crc


def only(data: bytes) -> Message:
    (message,) = Decoder().feed(data)
    return message


def test_crc_of_the_check_string():
    assert crc64(b"123456789") == 0x6C40DF5F0B497347


def test_crc_of_an_identity_transform():
    assert crc64(encode(Transform("T"))[HEADER:]) == 0xB5A225F8F462B3D7


@given(st.binary(max_size=3000))
@settings(max_examples=60, deadline=None)
def test_crc_equals_its_definition(data):
    assert crc64(data) == crc_by_definition(data)


@pytest.mark.parametrize("size", [255, 256, 257, 511, 512, 6472, 70001])
def test_crc_equals_its_definition_across_blocks(size):
    data = np.random.default_rng(size).bytes(size)
    assert crc64(data) == crc_by_definition(data)


def test_header_bytes_are_those_of_the_protocol():
    data = encode(Transform("ProbeToReference", 1700000000.25))
    version, kind, name, seconds, fraction, size, _ = struct.unpack(">H12s20sIIQQ", data[:HEADER])
    assert (version, kind, name) == (1, b"TRANSFORM".ljust(12, b"\0"), b"ProbeToReference".ljust(20, b"\0"))
    assert (seconds, fraction, size) == (0x6553F100, 0x40000000, 48)


def test_transform_goes_column_by_column():
    words = encode(Transform("T", matrix=A_MATRIX))[HEADER:].hex(" ", -4)
    assert words == (
        "00000000 3f800000 00000000 bf800000 00000000 00000000 00000000 00000000 3f800000 41200000 41a00000 41f00000"
    )


def test_ndarray_bytes_are_those_of_the_protocol():
    values = np.array([[1, 2, 3], [4, 5, -2]], dtype=np.int16)
    assert encode(NdArray("A", values=values))[HEADER:].hex() == "04020002000300010002000300040005fffe"


def test_status_bytes_are_those_of_the_protocol():
    body = encode(Status("S", code=13, sub_code=5, error_name="NotReady", text="warming up"))[HEADER:]
    assert body == bytes.fromhex("000d0000000000000005") + b"NotReady".ljust(20, b"\0") + b"warming up\0"


MESSAGES = [
    Transform("ProbeToReference", 12.5, matrix=A_MATRIX),
    Position("P", 1.0, position_mm=(1, 2, 3), quaternion_xyzw=(0, 0, 1, 0)),
    TrackingData("T", 1.0, tools=(TrackedTool("Probe", A_MATRIX), TrackedTool("Stylus", np.eye(4), 1))),
    StartTracking("T", 1.0, interval_ms=50, coordinate_name="Patient"),
    StopTracking("T", 1.0),
    TrackingReply("T", 1.0, granted=False),
    Image("I", 1.0, voxels=np.arange(24, dtype=np.int16).reshape(2, 3, 4) - 9, ijk_to_ras=A_MATRIX),
    Image("I", 1.0, voxels=np.arange(12, dtype=np.uint8).reshape(1, 2, 2, 3)),
    NdArray("A", 1.0, values=np.linspace(0, 1, 7)),
    String("S", 1.0, text="Grüße"),
    Status("S", 1.0, code=7, error_name="lost", text="cable"),
    GetStatus("S", 1.0),
    GetCapability("S", 1.0),
    Capability("S", 1.0, types=("TRANSFORM", "STATUS")),
]


def assert_same(a: Message, b: Message) -> None:
    assert type(a) is type(b)
    for name, value in vars(a).items():
        other = vars(b)[name]
        if name == "tools":
            for x, y in zip(value, other, strict=True):
                assert (x.name, x.kind) == (y.name, y.kind)
                np.testing.assert_allclose(x.matrix, y.matrix, rtol=1e-6)
        elif isinstance(value, np.ndarray):
            assert name != "voxels" or value.dtype == other.dtype
            np.testing.assert_allclose(value, other, rtol=1e-6, atol=1e-6)
        else:
            assert value == other


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("message", MESSAGES, ids=lambda m: type(m).__name__)
def test_every_message_survives_the_wire(message, version):
    assert_same(only(encode(message, header_version=version)), message)


def test_metadata_travel_in_version_2():
    message = Transform("ProbeToReference", metadata={"TransformStatus": "OUT_OF_VIEW", "Ort": "Köln"}, matrix=A_MATRIX)
    received = only(encode(message, header_version=2))
    assert received.metadata == message.metadata
    np.testing.assert_allclose(received.matrix, A_MATRIX)


@given(st.lists(st.integers(1, 200), min_size=1, max_size=40))
@settings(max_examples=50, deadline=None)
def test_messages_arrive_whole_in_any_cut(cuts):
    stream = b"".join(encode(message) for message in MESSAGES)
    decoder, received, place = Decoder(), [], 0
    for cut in cuts:
        received += decoder.feed(stream[place : place + cut])
        place += cut
    received += decoder.feed(stream[place:])
    assert [type(m) for m in received] == [type(m) for m in MESSAGES]
    assert decoder.rejected == 0


@given(st.integers(0, 47), st.integers(1, 255))
@settings(max_examples=100, deadline=None)
def test_a_damaged_body_is_rejected_and_the_stream_goes_on(place, flip):
    data = bytearray(encode(Transform("A", matrix=A_MATRIX)))
    data[HEADER + place] ^= flip
    decoder = Decoder()
    first, second = decoder.feed(bytes(data) + encode(Transform("B")))
    assert isinstance(first, Rejected)
    assert first.crc_error
    assert isinstance(second, Transform)
    assert second.device == "B"
    assert (decoder.received, decoder.rejected, decoder.crc_errors) == (2, 1, 1)


@given(st.sampled_from(MESSAGES), st.binary(max_size=200), st.integers(1, 2))
@settings(max_examples=300, deadline=None)
def test_a_body_of_the_wrong_shape_never_crashes(message, body, version):
    head = struct.unpack(">H12s20sIIQQ", encode(message)[:HEADER])
    data = struct.pack(">H12s20sIIQQ", version, *head[1:5], len(body), crc64(body)) + body
    (received,) = Decoder().feed(data)
    assert isinstance(received, Message)


@given(st.binary(min_size=HEADER, max_size=300))
@settings(max_examples=200, deadline=None)
def test_noise_is_refused_or_waits(noise):
    decoder = Decoder()
    with contextlib.suppress(StreamError):
        decoder.feed(noise)
    assert decoder.received == decoder.rejected  # random bytes may look like a header, but no checksum is right by chance


def test_an_absurd_size_is_refused_instead_of_awaited():
    head = struct.pack(">H12s20sIIQQ", 1, b"TRANSFORM", b"T", 0, 0, 1 << 40, 0)
    with pytest.raises(StreamError, match="out of step"):
        Decoder().feed(head)


def test_an_unknown_type_is_skipped():
    body = b"whatever"
    data = struct.pack(">H12s20sIIQQ", 1, b"VIDEO", b"V", 0, 0, len(body), crc64(body)) + body
    first, second = Decoder().feed(data + encode(Transform("T")))
    assert isinstance(first, Unknown)
    assert first.type_name == "VIDEO"
    assert isinstance(second, Transform)


def test_a_name_longer_than_20_bytes_is_refused():
    with pytest.raises(InputError, match="longer than 20 bytes"):
        encode(Transform("ProbeTipToReferenceFrame"))


def test_a_name_of_exactly_20_bytes_is_kept():
    assert only(encode(Transform("ProbeTipToReferenceF"))).device == "ProbeTipToReferenceF"


def test_an_unsendable_message_is_refused():
    with pytest.raises(InputError, match="cannot be sent"):
        encode(Unknown("U"))


def test_a_nan_in_a_transform_is_rejected():
    body = struct.pack(">12f", *([np.nan] * 12))
    data = struct.pack(">H12s20sIIQQ", 1, b"TRANSFORM", b"T", 0, 0, 48, crc64(body)) + body
    assert isinstance(only(data), Rejected)


def test_qtdata_quaternions_have_w_last():
    body = struct.pack(">20sBB7f", b"Probe", 2, 0, 1, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5))
    data = struct.pack(">H12s20sIIQQ", 1, b"QTDATA", b"T", 0, 0, len(body), crc64(body)) + body
    np.testing.assert_allclose(only(data).tools[0].matrix, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-6)


def test_big_endian_pixels_are_swapped():
    data = bytearray(encode(Image("I", voxels=np.array([1, 2, -3], dtype=np.int16).reshape(1, 1, 3))))
    data[HEADER + 4] = 1
    data[HEADER + 72 :] = np.array([1, 2, -3], dtype=">i2").tobytes()
    data[50:58] = struct.pack(">Q", crc64(bytes(data[HEADER:])))
    assert only(bytes(data)).voxels.ravel().tolist() == [1, 2, -3]


def test_an_a_line_is_n_by_1_by_1_little_endian_ras():
    data = encode(a_line_image("ALine", np.array([5, -6, 7], dtype=np.int16), 3.0, spacing_mm=0.5))
    version, components, kind, endian, frame, i, j, k = struct.unpack_from(">HBBBB3H", data, HEADER)
    assert (version, components, kind, endian, frame, i, j, k) == (1, 1, 4, 2, 1, 3, 1, 1)
    assert data[HEADER + 72 :] == np.array([5, -6, 7], dtype="<i2").tobytes()
    assert struct.unpack_from(">3f", data, HEADER + 12 + 36) == (0.5, 0, 0)  # centre of 3 samples 0.5 mm apart


@pytest.mark.parametrize("frame", ["ras", "lps"])
def test_pyigtl_and_the_codec_mean_the_same_image(frame):
    voxels = np.arange(24, dtype=np.int16).reshape(2, 3, 4)
    theirs = pyigtl.ImageMessage(voxels, A_MATRIX, world_coordinate_system=frame, device_name="I", timestamp=5.0)
    mine = only(theirs.pack())
    assert np.array_equal(mine.voxels, voxels)
    flip = np.diag([-1, -1, 1, 1]) if frame == "lps" else np.eye(4)
    np.testing.assert_allclose(mine.ijk_to_ras, flip @ A_MATRIX, atol=1e-5)


@pytest.mark.parametrize(
    ("mine", "theirs"),
    [
        (
            Transform("ProbeToReference", 1700000000.25, matrix=A_MATRIX),
            pyigtl.TransformMessage(A_MATRIX, device_name="ProbeToReference", timestamp=1700000000.25),
        ),
        (String("S", 8.0, text="hello"), pyigtl.StringMessage("hello", device_name="S", timestamp=8.0)),
        (
            Image("I", 8.0, voxels=np.arange(6, dtype=np.int16).reshape(1, 2, 3), ijk_to_ras=A_MATRIX),
            pyigtl.ImageMessage(
                np.arange(6, dtype=np.int16).reshape(1, 2, 3),
                A_MATRIX,
                world_coordinate_system="ras",
                device_name="I",
                timestamp=8.0,
            ),
        ),
    ],
    ids=["transform", "string", "image"],
)
def test_pyigtl_packs_the_same_bytes(mine, theirs):
    assert encode(mine) == theirs.pack()
