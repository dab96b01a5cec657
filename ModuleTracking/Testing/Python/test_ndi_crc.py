"""CRC-16/ARC against published values and a bitwise definition."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ModuleTrackingLib.ndi.crc import crc16, crc_binary, crc_text

KNOWN = {
    "123456789": "BB3D",
    "RESET": "BE6F",
    "OKAY": "A896",
    "INIT:": "E3A5",
    "VER:0": "65EE",
    "GETINFO:Features.Firmware.Version": "0492",
    "PHSR:00": "20FF",
    "PHSR:02": "E17E",
    "ERROR01": "6BC2",
    "ERROR04": "6802",
    "ERROR0C": "4E42",
    "PHRQ:*********1****": "A4C1",
    "PINIT:01": "31EA",
    "PENA:01D": "6D3B",
    "COMM:50000": "0048",
    "TSTART:": "5423",
    "TSTOP:": "2C14",
    "TX:0001": "031A",
    "TX:0801": "C19B",
    "BX:0001": "C26D",
    "BX:0801": "00EC",
}


def bitwise_crc(data: bytes) -> int:
    """The definition: message bits, lowest first, through the shift register of x^16 + x^15 + x^2 + 1."""
    register = 0
    for byte in data:
        for bit in range(8):
            carry = (register ^ (byte >> bit)) & 1
            register = (register >> 1) ^ (0xA001 if carry else 0)
    return register


@pytest.mark.parametrize(("text", "crc"), KNOWN.items())
def test_published_checksums_come_out(text, crc):
    assert crc_text(text.encode()) == crc.encode()


@given(st.binary(max_size=300), st.binary(max_size=50))
def test_table_agrees_with_the_bitwise_definition_and_can_go_on(first, second):
    assert crc16(first + second) == bitwise_crc(first + second) == crc16(second, crc16(first))


@given(st.binary(max_size=300))
def test_data_followed_by_its_binary_checksum_has_checksum_zero(data):
    assert crc16(data + crc_binary(data)) == 0


@given(st.binary(min_size=3, max_size=300), st.integers(0, 10**6), st.integers(1, 0xFFFF))
def test_any_burst_of_up_to_sixteen_bits_is_noticed(data, place, burst):
    at = place % (8 * len(data))
    damaged = (int.from_bytes(data, "little") ^ (burst << at)) % (1 << 8 * len(data))
    if damaged != int.from_bytes(data, "little"):
        assert crc16(damaged.to_bytes(len(data), "little")) != crc16(data)
