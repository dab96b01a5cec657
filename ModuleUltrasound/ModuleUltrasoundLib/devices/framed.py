"""The framed protocol of the `serial` device: bytes to frames and back, no input or output of its own.

A frame, little-endian throughout:

    offset size
    0      4    sync A5 5A C3 3C
    4      1    kind: 1 line, 2 text
    5      1    flags: bit 0 a sample is clipped
    6      2    shots averaged into the line
    8      4    sequence number
    12     8    device time, microseconds, at the transmit pulse
    20     4    sampling rate, Hz
    24     4    gain, hundredths of a dB, signed
    28     4    first sample, in samples after the transmit pulse
    32     4    length of the payload, bytes
    36     2    CRC-16 of bytes 0..35
    38     ...  payload in blocks of up to 2048 bytes, each followed by a CRC-16

The CRC is CRC-16/CCITT (polynomial 0x1021, start 0xFFFF, most significant bit first). It runs on from the
header through the blocks: the CRC behind a block covers the header and every payload byte up to there. So a
block of another frame never fits; and blocks stay shorter than the 32751 bits up to which this CRC finds
every error of three bits. The payload of a line is int16 samples, of a text UTF-8.

The computer sends commands as ASCII lines, `NAME [key=value ...]*HHHH` LF, HHHH being the CRC-16 of what stands
before the asterisk in upper-case hex. Commands: `INFO`, `SET key=value ...` (gain_db, delay_us, range_us,
sampling_hz, averaging, trigger), `START`, `STOP`, `SHOT` (trigger=software). The device answers each with a text
frame that begins with `OK` or `ERR`; INFO and SET answer `OK key=value ...` with the settings in force.
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from typing import Optional

import numpy as np
import numpy.typing as npt
from CranioNavLib.errors import InputError

SYNC = b"\xa5\x5a\xc3\x3c"
HEADER = struct.Struct("<4sBBHIQIiII")
HEADER_BYTES = HEADER.size + 2
BLOCK_BYTES = 2048
LARGEST_PAYLOAD_BYTES = 262_144  # 131 072 samples: 1 ms at 125 MHz
KIND_LINE, KIND_TEXT = 1, 2
FLAG_CLIPPED = 1


def crc16(data: bytes, start: int = 0xFFFF) -> int:
    """CRC-16/CCITT (polynomial 0x1021, most significant bit first), continued from `start`."""
    return binascii.crc_hqx(data, start)


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of the protocol."""

    kind: int
    payload: bytes
    sequence: int = 0
    device_time_us: int = 0
    sampling_hz: int = 0
    gain_db: float = 0.0
    first_sample: int = 0
    averaging: int = 1
    clipped: bool = False

    @property
    def samples(self) -> npt.NDArray[np.int16]:
        """(N,) samples of a line."""
        return np.frombuffer(self.payload, dtype="<i2").astype(np.int16)

    @property
    def text(self) -> str:
        """Words of a text frame."""
        return self.payload.decode("utf-8", errors="replace")


def encode_frame(frame: Frame) -> bytes:
    """The bytes of a frame."""
    flags = FLAG_CLIPPED if frame.clipped else 0
    fields = (frame.sequence, frame.device_time_us, frame.sampling_hz, round(100 * frame.gain_db), frame.first_sample)
    header = HEADER.pack(SYNC, frame.kind, flags, frame.averaging, *fields, len(frame.payload))
    crc = crc16(header)
    parts = [header, struct.pack("<H", crc)]
    for start in range(0, len(frame.payload), BLOCK_BYTES):
        block = frame.payload[start : start + BLOCK_BYTES]
        crc = crc16(block, crc)
        parts += [block, struct.pack("<H", crc)]
    return b"".join(parts)


def encode_command(text: str) -> bytes:
    """The bytes of a command line."""
    return f"{text}*{crc16(text.encode('ascii')):04X}\n".encode("ascii")


def decode_command(line: bytes) -> Optional[str]:
    """The command in a received line without its LF, or None if it is damaged."""
    text, star, check = line.strip().rpartition(b"*")
    return text.decode("ascii", errors="replace") if star and check == f"{crc16(text):04X}".encode() else None


def parse_pairs(text: str) -> dict[str, str]:
    """`key=value` pairs of a command or answer.

    Raises
    ------
    InputError
        A word that is not key=value.
    """
    pairs = {}
    for word in text.split():
        key, equals, value = word.partition("=")
        if not equals:
            raise InputError(f"expected key=value, got {word!r}")
        pairs[key] = value
    return pairs


class FrameDecoder:
    """Frames out of a stream of bytes in any portions. Damage costs the frames it touches, never a wrong one."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.damaged_frames = 0  # headers or blocks whose CRC did not fit
        self.skipped_bytes = 0

    @property
    def mid_frame(self) -> bool:
        """Whether bytes of a frame wait for the rest of it."""
        return bool(self._buffer)

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes; give the frames that they complete."""
        self._buffer += data
        frames: list[Frame] = []
        while True:
            self._skip(self._to_sync())
            if len(self._buffer) < HEADER_BYTES:
                return frames
            verdict = self._take()
            if verdict is None:
                return frames
            if isinstance(verdict, Frame):
                frames.append(verdict)
            else:
                self.damaged_frames += 1
                self._skip(1)  # look for the next sync inside what was taken for a frame

    def give_up(self) -> list[Frame]:
        """The rest of a frame will not come (it was too long in coming): go on behind its sync."""
        if not self._buffer:
            return []
        self.damaged_frames += 1
        self._skip(1)
        return self.feed(b"")

    def _to_sync(self) -> int:
        found = self._buffer.find(SYNC)
        if found >= 0:
            return found
        for kept in (3, 2, 1):  # the end may be the beginning of a sync
            if self._buffer.endswith(SYNC[:kept]):
                return len(self._buffer) - kept
        return len(self._buffer)

    def _skip(self, count: int) -> None:
        del self._buffer[:count]
        self.skipped_bytes += count

    def _take(self) -> Frame | bool | None:
        """The frame at the start of the buffer; False if it is damaged, None if more bytes are needed."""
        header = bytes(self._buffer[: HEADER.size])
        crc = crc16(header)
        (expected,) = struct.unpack_from("<H", self._buffer, HEADER.size)
        _, kind, flags, averaging, sequence, time_us, rate, gain, first, length = HEADER.unpack(header)
        if crc != expected or length > LARGEST_PAYLOAD_BYTES or kind not in (KIND_LINE, KIND_TEXT):
            return False
        if kind == KIND_LINE and (length % 2 or length == 0 or rate == 0):
            return False
        payload, position = bytearray(), HEADER_BYTES
        while len(payload) < length:
            size = min(BLOCK_BYTES, length - len(payload))
            if len(self._buffer) < position + size + 2:
                return None
            block = bytes(self._buffer[position : position + size])
            crc = crc16(block, crc)
            (expected,) = struct.unpack_from("<H", self._buffer, position + size)
            if crc != expected:
                return False
            payload += block
            position += size + 2
        del self._buffer[:position]
        return Frame(
            kind=kind,
            payload=bytes(payload),
            sequence=sequence,
            device_time_us=time_us,
            sampling_hz=rate,
            gain_db=gain / 100.0,
            first_sample=first,
            averaging=averaging,
            clipped=bool(flags & FLAG_CLIPPED),
        )
