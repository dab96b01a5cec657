"""The checksum of every command and reply: CRC-16/ARC (polynomial 0x8005, reflected, start 0, no final xor)."""

from __future__ import annotations

REFLECTED_POLYNOMIAL = 0xA001


def _table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ REFLECTED_POLYNOMIAL if value & 1 else value >> 1
        table.append(value)
    return tuple(table)


_TABLE = _table()


def crc16(data: bytes, start: int = 0) -> int:
    """CRC-16/ARC of `data`; `start` is the CRC of what came before."""
    crc = start
    for byte in data:
        crc = (crc >> 8) ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc


def crc_text(data: bytes) -> bytes:
    """The CRC as commands and text replies carry it: four upper-case hex digits."""
    return b"%04X" % crc16(data)


def crc_binary(data: bytes) -> bytes:
    """The CRC as binary replies carry it: two bytes, low byte first."""
    return crc16(data).to_bytes(2, "little")
