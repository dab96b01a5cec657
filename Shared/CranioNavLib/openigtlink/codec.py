"""OpenIGTLink on the wire: bytes to messages and back, without any socket.

`encode` packs one message; a `Decoder` is fed bytes as they come and gives the messages that are complete.
"""

from __future__ import annotations

import struct
from typing import Callable, Optional, Union

from CranioNavLib.errors import InputError
from CranioNavLib.openigtlink import bodies
from CranioNavLib.openigtlink.crc64 import crc64
from CranioNavLib.openigtlink.messages import Message, Rejected, Unknown

HEADER = struct.Struct(">H12s20sIIQQ")
EXTENDED = struct.Struct(">HHII")
ENTRY = struct.Struct(">HHI")
LARGEST_BODY = 256 << 20  # bytes; a larger size means that the stream is out of step
NAME_BYTES = 20
UTF8 = 106


class StreamError(RuntimeError):
    """The byte stream is out of step and cannot be followed; close the connection and connect again."""


def encode(message: Message, header_version: int = 1, message_id: int = 0) -> bytes:
    """One message, packed.

    Parameters
    ----------
    message : Message
        What to send.
    header_version : int
        1, or 2 for a peer that has itself sent version 2; metadata travel in version 2 only.
    message_id : int
        Version 2 only.

    Raises
    ------
    InputError
        The device name is longer than 20 bytes, or the message cannot be packed.
    """
    type_name, body = bodies.pack(message)
    if header_version == 2:
        body = _with_extended_header(body, message.metadata, message_id)
    name = message.device.encode("utf-8")
    if len(name) > NAME_BYTES:
        raise InputError(f"OpenIGTLink device name {message.device!r} is longer than 20 bytes; peers would cut it, shorten it")
    seconds = int(message.time_s)
    fraction = min(int((message.time_s - seconds) * 2**32), 2**32 - 1)
    return HEADER.pack(header_version, type_name.encode("ascii"), name, seconds, fraction, len(body), crc64(body)) + body


class Decoder:
    """Bytes in, messages out, in any cut. What is not believed is counted and given as Rejected."""

    def __init__(self, largest_body: int = LARGEST_BODY) -> None:
        self.largest_body = largest_body
        self.received = 0  # messages, rejected ones included
        self.rejected = 0
        self.crc_errors = 0
        self.peer_version = 1  # highest header version seen
        self._buffer = bytearray()
        self._needed = HEADER.size

    def feed(self, data: Union[bytes, bytearray, memoryview]) -> list[Message]:
        """Take bytes; give the messages that they complete.

        Raises
        ------
        StreamError
            What stands where a header must be is none.
        """
        self._buffer += data
        messages: list[Message] = []
        start = 0
        while len(self._buffer) - start >= HEADER.size:
            header = HEADER.unpack_from(self._buffer, start)
            self._check_header(header)
            end = start + HEADER.size + header[5]
            if len(self._buffer) < end:
                break
            body = bytes(memoryview(self._buffer)[start + HEADER.size : end])
            messages.append(self._message(header, body))
            start = end
        if start:
            del self._buffer[:start]
        return messages

    def _check_header(self, header: tuple[int, bytes, bytes, int, int, int, int]) -> None:
        version, type_name, _, _, _, size, _ = header
        letters = type_name.rstrip(b"\0")
        if version not in (1, 2) or not letters or not all(33 <= letter < 127 for letter in letters):
            raise StreamError("what came is no OpenIGTLink header; is the peer an OpenIGTLink program, and the port right?")
        if size > self.largest_body:
            raise StreamError(f"a message of {size} bytes was announced (limit {self.largest_body}); the stream is out of step")

    def _message(self, header: tuple[int, bytes, bytes, int, int, int, int], body: bytes) -> Message:
        version, raw_type, raw_name, seconds, fraction, _, crc = header
        type_name, device = _text(raw_type), _text(raw_name)
        time_s = seconds + fraction / 2**32
        self.received += 1
        self.peer_version = max(self.peer_version, version)
        if crc64(body) != crc:
            self.crc_errors += 1
            self.rejected += 1
            return Rejected(device, time_s, type_name=type_name, reason="wrong checksum", crc_error=True)
        try:
            metadata: dict[str, str] = {}
            if version == 2:
                body, metadata = _without_extended_header(body)
            unpack: Optional[Callable[..., Message]] = bodies.UNPACK.get(type_name)
            if unpack is None:
                return Unknown(device, time_s, metadata, type_name=type_name, size=len(body))
            return unpack(body, device=device, time_s=time_s, metadata=metadata)
        except (struct.error, ValueError, IndexError) as error:
            self.rejected += 1
            return Rejected(device, time_s, type_name=type_name, reason=f"the body does not fit its type: {error}")


def _text(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("utf-8", "replace").strip()


def _with_extended_header(content: bytes, metadata: dict[str, str], message_id: int) -> bytes:
    entries = [(key.encode("utf-8"), value.encode("utf-8")) for key, value in metadata.items()]
    index = struct.pack(">H", len(entries)) + b"".join(ENTRY.pack(len(key), UTF8, len(value)) for key, value in entries)
    texts = b"".join(key + value for key, value in entries)
    return EXTENDED.pack(EXTENDED.size, len(index), len(texts), message_id) + content + index + texts


def _without_extended_header(body: bytes) -> tuple[bytes, dict[str, str]]:
    size, index_size, texts_size, _ = EXTENDED.unpack_from(body)
    end = len(body) - index_size - texts_size
    if size < EXTENDED.size or end < size:
        raise ValueError("the extended header does not fit the body")
    metadata: dict[str, str] = {}
    if index_size:
        (count,) = struct.unpack_from(">H", body, end)
        if 2 + count * ENTRY.size > index_size:
            raise ValueError("the metadata index does not fit")
        place = end + index_size
        for number in range(count):
            key_size, _, value_size = ENTRY.unpack_from(body, end + 2 + number * ENTRY.size)
            if place + key_size + value_size > len(body):
                raise ValueError("the metadata do not fit")
            key = body[place : place + key_size].decode("utf-8", "replace")
            metadata[key] = body[place + key_size : place + key_size + value_size].decode("utf-8", "replace")
            place += key_size + value_size
    return body[size:end], metadata
