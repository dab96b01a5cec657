"""CRC-64 of OpenIGTLink bodies (ECMA-182 polynomial, start 0, not reflected, no final xor).

The CRC is linear over GF(2): that of a block is the xor of one table entry a byte, taken at the byte's place. Whole
blocks are looked up at once, and blocks are chained by a second table that moves a CRC over one block's length.
"""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt

POLYNOMIAL = 0x42F0E1EBA9EA3693
BLOCK = 256  # bytes; its table is 512 kB and stays in a processor's cache
BLOCKS_AT_ONCE = 256  # bounds the memory of one look-up to 512 kB

UInt64 = npt.NDArray[np.uint64]


@functools.lru_cache(maxsize=1)
def _tables() -> tuple[UInt64, list[list[int]]]:
    """(BLOCK, 256) CRC of a byte followed by the zeros up to the block's end; 8 x 256 moves of a CRC over one block."""
    single = np.arange(256, dtype=np.uint64) << np.uint64(56)
    for _ in range(8):
        single = (single << np.uint64(1)) ^ np.where(single >> np.uint64(63), np.uint64(POLYNOMIAL), np.uint64(0))
    places = np.empty((BLOCK, 256), dtype=np.uint64)
    places[-1] = single
    for place in range(BLOCK - 2, -1, -1):
        later = places[place + 1]
        places[place] = (later << np.uint64(8)) ^ single[later >> np.uint64(56)]
    # A CRC stands like eight message bytes before the block: its byte k is at distance BLOCK + 8 - 1 - k from the end, less
    # the eight bytes that the register itself is ahead. So its top byte's move is that of the block's first byte.
    moves = [[int(value) for value in places[byte]] for byte in range(8)]
    return places, moves


def crc64(data: bytes | bytearray | memoryview) -> int:
    """CRC-64 of `data`; 0 for none.

    References
    ----------
    OpenIGTLink protocol, `igtl_util.c`: polynomial 0x42F0E1EBA9EA3693; `123456789` gives 0x6C40DF5F0B497347.
    """
    size = len(data)
    if size == 0:
        return 0
    places, moves = _tables()
    array = np.frombuffer(data, dtype=np.uint8)
    if size <= BLOCK:
        return int(np.bitwise_xor.reduce(places[np.arange(BLOCK - size, BLOCK), array]))
    crc = 0
    head = size % BLOCK
    if head:
        crc = int(np.bitwise_xor.reduce(places[np.arange(BLOCK - head, BLOCK), array[:head]]))
    blocks = array[head:].reshape(-1, BLOCK)
    columns = np.arange(BLOCK)
    m0, m1, m2, m3, m4, m5, m6, m7 = moves
    for start in range(0, len(blocks), BLOCKS_AT_ONCE):
        own = np.bitwise_xor.reduce(places[columns, blocks[start : start + BLOCKS_AT_ONCE]], axis=1)
        for value in own.tolist():
            crc = (
                m0[crc >> 56]
                ^ m1[crc >> 48 & 255]
                ^ m2[crc >> 40 & 255]
                ^ m3[crc >> 32 & 255]
                ^ m4[crc >> 24 & 255]
                ^ m5[crc >> 16 & 255]
                ^ m6[crc >> 8 & 255]
                ^ m7[crc & 255]
                ^ value
            )
    return crc
