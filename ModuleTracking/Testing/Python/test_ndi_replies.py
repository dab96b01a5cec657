"""Commands and text replies: exact bytes, and everything damaged refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ModuleTrackingLib.ndi.replies import (
    BadReplyError,
    DeviceError,
    HandleStatus,
    check_okay,
    command_bytes,
    parse_handle,
    parse_parameters,
    parse_phinf,
    parse_phsr,
    pvwr_command,
    raise_if_error,
    rom_chunks,
    text_payload,
    text_reply_bytes,
)


def test_command_is_name_colon_parameters_checksum_and_return():
    assert command_bytes("INIT:") == b"INIT:E3A5\r"
    assert command_bytes("PHRQ:*********1****") == b"PHRQ:*********1****A4C1\r"
    assert command_bytes("COMM:50000") == b"COMM:500000048\r"


def test_text_reply_is_payload_checksum_and_return():
    assert text_reply_bytes(b"RESET") == b"RESETBE6F\r"
    assert text_payload(b"OKAYA896") == b"OKAY"


@given(st.binary(max_size=200).filter(lambda data: b"\r" not in data))
def test_text_replies_survive_the_round_trip(payload):
    assert text_payload(text_reply_bytes(payload)[:-1]) == payload


@given(st.binary(min_size=1, max_size=60), st.integers(0, 59), st.integers(1, 255))
def test_a_changed_byte_in_a_text_reply_is_refused(payload, at, change):
    reply = bytearray(text_reply_bytes(payload)[:-1])
    reply[at % len(reply)] ^= change
    with pytest.raises(BadReplyError, match="CRC"):
        text_payload(bytes(reply))


@pytest.mark.parametrize("reply", [b"", b"OKA", b"OKAYa896", b"OKAYA89"])
def test_short_or_lower_case_checksums_are_refused(reply):
    with pytest.raises(BadReplyError):
        text_payload(reply)


def test_device_errors_say_command_meaning_and_advice():
    with pytest.raises(DeviceError, match=r"PINIT was answered with ERROR13: the tool could not be initialised; check .*\.rom"):
        raise_if_error(b"ERROR13", "PINIT:01")
    with pytest.raises(DeviceError, match="ERROR99: an error that this program does not know"):
        raise_if_error(b"ERROR99")
    raise_if_error(b"ERROR1")
    raise_if_error(b"xERROR13")


def test_warning_counts_as_okay_and_nothing_else_does():
    check_okay(b"OKAY")
    check_okay(b"WARNING")
    with pytest.raises(BadReplyError, match="expected OKAY"):
        check_okay(b"0101001")


def test_handles_and_their_status_are_read():
    assert parse_handle(b"0A") == 10
    assert parse_phsr(b"00") == ()
    assert parse_phsr(b"0201031FF001") == (HandleStatus(1, 0x031), HandleStatus(255, 0x001))


@pytest.mark.parametrize("payload", [b"", b"1", b"00", b"G1", b"OKAY", b"010"])
def test_a_reply_that_is_no_handle_is_refused(payload):
    with pytest.raises(BadReplyError):
        parse_handle(payload)


@pytest.mark.parametrize("payload", [b"", b"01", b"0201031", b"0101031FF001", b"OKAY", b"010103"])
def test_a_handle_list_of_the_wrong_length_is_refused(payload):
    with pytest.raises(BadReplyError):
        parse_phsr(payload)


def test_port_information_is_cut_into_its_fields():
    payload = b"02000000" + b"NDI         " + b"003" + b"0A1B2C3D" + b"31" + b"8700339             " + b"********110100"
    info = parse_phinf(payload, 0x0025)
    assert (info.main_type, info.kind, info.maker, info.revision) == (2, "probe", "NDI", "003")
    assert (info.serial_number, info.port_status, info.part_number) == ("0A1B2C3D", 0x31, "8700339")
    assert info.location == "********110100"
    assert len(payload) == 67
    assert parse_phinf(b"UNOCCUPIED") is None


def test_port_information_of_another_length_is_refused():
    with pytest.raises(BadReplyError, match="expected 67 characters"):
        parse_phinf(b"0" * 66, 0x0025)
    with pytest.raises(BadReplyError, match="not as described"):
        parse_phinf(b"zz" + b"0" * 65, 0x0025)


def test_user_parameters_are_read_line_by_line():
    assert parse_parameters(b"A.B=1\nA.C=x=y\n") == {"A.B": "1", "A.C": "x=y"}
    with pytest.raises(BadReplyError):
        parse_parameters(b"OKAY")


@given(st.binary(min_size=1, max_size=1024))
def test_a_tool_file_becomes_sixteen_padded_chunks(rom):
    chunks = rom_chunks(rom)
    assert [address for address, _ in chunks] == list(range(0, 1024, 64))
    assert {len(chunk) for _, chunk in chunks} == {64}
    assert b"".join(chunk for _, chunk in chunks) == rom + bytes(1024 - len(rom))


@pytest.mark.parametrize("size", [0, 1025])
def test_a_tool_file_of_an_impossible_size_is_refused(size):
    with pytest.raises(ValueError, match=f"got {size}"):
        rom_chunks(bytes(size))


def test_upload_command_carries_handle_address_and_128_hex_digits():
    command = pvwr_command(1, 0x03C0, bytes(range(64)))
    assert command == "PVWR:0103C0" + "".join(f"{value:02X}" for value in range(64))
    assert len(command) == len("PVWR:") + 2 + 4 + 128
