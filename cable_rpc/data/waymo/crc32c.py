"""CRC-32C (Castagnoli, RFC 3720 appendix B.4), the checksum of TFRecord files, many bytes at a time.

The register of a CRC is linear over GF(2): what four bytes make of it is what four zero bytes make of the register
XORed with them, and the registers of two neighbouring stretches join by sending the first through as many zero bytes
as the second has. So long data is cut into lanes of equal length that NumPy works through side by side.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

Registers = npt.NDArray[np.uint32]

POLYNOMIAL = 0x82F63B78
"""Bits reversed."""
ALL_ONES = 0xFFFFFFFF
WORD_BYTES = 4
LANE_WORDS_BITS = 7
"""Lanes have between 2 to the power of this and twice as many words."""
MASK_DELTA = 0xA282EAD8


def crc32c(data: bytes | memoryview) -> int:
    """The checksum of some bytes, 0 .. 2**32 - 1."""
    octets = np.frombuffer(data, np.uint8)
    words = -(-len(octets) // WORD_BYTES)
    lanes = 1 << max(words.bit_length() - 1 - LANE_WORDS_BITS, 0)
    lane_words = -(-words // lanes)
    # Zero bytes before the data leave a register of zero as it is.
    padded = np.zeros(lanes * lane_words * WORD_BYTES, np.uint8)
    padded[len(padded) - len(octets) :] = octets
    registers = np.zeros(lanes, np.uint32)
    for column in np.ascontiguousarray(padded.view("<u4").reshape(lanes, lane_words).T):
        registers = through_zeros(registers ^ column, WORD_BYTES)
    length = lane_words * WORD_BYTES
    while len(registers) > 1:
        registers = through_zeros(registers[::2], length) ^ registers[1::2]
        length *= 2
    start = through_zeros(np.array([ALL_ONES], np.uint32), len(octets))
    return int((registers ^ start)[0]) ^ ALL_ONES


def masked_crc32c(data: bytes | memoryview) -> int:
    """The checksum as TFRecord stores it: rotated right by 15 bits plus a constant."""
    value = crc32c(data)
    return (((value >> 15) | (value << 17)) + MASK_DELTA) & ALL_ONES


def through_zeros(registers: Registers, count: int) -> Registers:
    """Registers, uint32 [N], after ``count`` zero bytes."""
    bit = 0
    while count >> bit:
        if count >> bit & 1:
            registers = applied(zero_tables(bit), registers)
        bit += 1
    return registers


def applied(tables: Registers, registers: Registers) -> Registers:
    """A linear map, by what it makes of each value of a register's lower and upper half, on registers of any shape."""
    result: Registers = tables[0].take(registers & 0xFFFF)
    result ^= tables[1].take(registers >> 16)
    return result


@lru_cache(maxsize=48)
def zero_tables(exponent: int) -> Registers:
    """What 2**exponent zero bytes make of a register: uint32 [2, 65536], by its lower and its upper half."""
    if exponent > 0:
        half = zero_tables(exponent - 1)
        return applied(half, half)
    halves = np.arange(1 << 16, dtype=np.uint32)
    values: Registers = np.stack([halves, halves << 16])
    for _ in range(8):
        values = (values >> 1) ^ np.multiply(values & 1, POLYNOMIAL, dtype=np.uint32)
    return values
