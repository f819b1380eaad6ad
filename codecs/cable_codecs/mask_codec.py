"""Lossless coding of binary masks: block masks of the region upstream, pixel masks downstream.

A coded mask is one tag byte and a payload; the encoder keeps the smallest of the forms it tries:

======  =============================================================================
tag     payload
======  =============================================================================
0       none, every cell False
1       none, every cell True
2       the cells in row order, 8 to a byte (most significant bit first), deflated
3       as 2, after XOR of each row with the row above
4       runs along the rows, deflated (`runs_to_bytes`)
5       as 4, along the columns
======  =============================================================================

Deflated means raw RFC 1951 data. The size of the mask travels outside. Small masks are tried in every form;
in large ones the number of changes along the rows tells whether runs or bits will win, and only those are
tried.
"""

from __future__ import annotations

import zlib

import numpy as np
import numpy.typing as npt

from cable_codecs.base import MAX_DIMENSION, BoolMask
from cable_codecs.errors import CodecError
from cable_codecs.mask_runs import bytes_to_runs, largest_runs_size, runs_to_bytes

ALL_FALSE, ALL_TRUE, BITS, XOR_BITS, ROW_RUNS, COLUMN_RUNS = range(6)

SMALL_MASK_CELLS = 1 << 14
CELLS_PER_CHANGE = 24
"""About where runs and bits need equally many bytes, measured on thresholded noise of several grain sizes."""
FAST_DEFLATE_BYTES = 1024


def encode_mask(blocks: BoolMask) -> bytes:
    """Code a mask.

    Args:
        blocks: bool [rows, columns].

    Raises:
        CodecError: Not a two-dimensional bool array of 1..16384 cells a side.
    """
    if blocks.dtype != np.bool_ or blocks.ndim != 2:
        raise CodecError(f"a mask must be bool [rows, columns], got {blocks.dtype} {list(blocks.shape)}")
    check_size(*blocks.shape)
    if not blocks.any():
        return bytes([ALL_FALSE])
    if blocks.all():
        return bytes([ALL_TRUE])
    small = blocks.size <= SMALL_MASK_CELLS
    changes = np.count_nonzero(blocks[:, 1:] != blocks[:, :-1])
    few_changes = changes * CELLS_PER_CHANGE <= blocks.size
    candidates: list[bytes] = []
    if small or few_changes:
        candidates.append(bytes([ROW_RUNS]) + deflate(runs_to_bytes(blocks)))
        candidates.append(bytes([COLUMN_RUNS]) + deflate(runs_to_bytes(np.ascontiguousarray(blocks.T))))
    if small or not few_changes:
        candidates.append(bytes([BITS]) + deflate(np.packbits(blocks).tobytes()))
        candidates.append(bytes([XOR_BITS]) + deflate(np.packbits(xor_rows(blocks)).tobytes()))
    return min(candidates, key=len)


def decode_mask(data: bytes, rows: int, columns: int) -> BoolMask:
    """Decode a mask.

    Args:
        data: What `encode_mask` returned.
        rows: Rows of the mask.
        columns: Columns of the mask.

    Returns:
        bool [rows, columns], a new array.

    Raises:
        CodecError: The data are damaged or of a mask of another size.
    """
    check_size(rows, columns)
    if not data:
        raise CodecError("a coded mask has at least its tag byte, got no data")
    tag, payload = data[0], data[1:]
    if tag in (ALL_FALSE, ALL_TRUE):
        if payload:
            raise CodecError(f"coded mask with tag {tag} must be one byte, got {len(data)}")
        return np.full((rows, columns), tag == ALL_TRUE)
    if tag == BITS:
        return unpack_bits(payload, rows, columns)
    if tag == XOR_BITS:
        return np.bitwise_xor.accumulate(unpack_bits(payload, rows, columns), axis=0)
    if tag == ROW_RUNS:
        return bytes_to_runs(inflate(payload, largest_runs_size(rows, columns)), rows, columns)
    if tag == COLUMN_RUNS:
        turned = bytes_to_runs(inflate(payload, largest_runs_size(columns, rows)), columns, rows)
        return np.ascontiguousarray(turned.T)
    raise CodecError(f"coded mask has unknown tag {tag}; it is damaged or from a newer version")


def check_size(rows: int, columns: int) -> None:
    """Check the size of a mask.

    Raises:
        CodecError: A side outside 1..16384.
    """
    if not (1 <= rows <= MAX_DIMENSION and 1 <= columns <= MAX_DIMENSION):
        raise CodecError(f"a mask must have 1..{MAX_DIMENSION} rows and columns, got {rows} x {columns}")


def xor_rows(blocks: BoolMask) -> BoolMask:
    """Each row XOR the row above; the first row stays."""
    changed = blocks.copy()
    np.not_equal(blocks[1:], blocks[:-1], out=changed[1:])
    return changed


def unpack_bits(payload: bytes, rows: int, columns: int) -> BoolMask:
    """Inflate and unpack one bit per cell.

    Raises:
        CodecError: Another number of cells, or damaged data.
    """
    expected = -(-rows * columns // 8)
    packed = np.frombuffer(inflate(payload, expected), np.uint8)
    if packed.size != expected:
        raise CodecError(f"coded mask has {packed.size} bytes of cells, expected {expected} for {rows} x {columns}")
    cells: npt.NDArray[np.uint8] = np.unpackbits(packed)
    if cells[rows * columns :].any():
        raise CodecError(f"coded mask has more cells than {rows} x {columns}; check the size")
    return cells[: rows * columns].reshape(rows, columns).view(np.bool_)


def deflate(data: bytes) -> bytes:
    """Raw deflate, at the highest effort where there is little to do."""
    compressor = zlib.compressobj(level=9 if len(data) <= FAST_DEFLATE_BYTES else 6, wbits=-15, memLevel=9)
    return compressor.compress(data) + compressor.flush()


def inflate(data: bytes, largest: int) -> bytes:
    """Undo `deflate` without ever making more than ``largest`` bytes.

    Raises:
        CodecError: Damaged, cut, longer than allowed, or followed by other data.
    """
    decompressor = zlib.decompressobj(wbits=-15)
    try:
        output = decompressor.decompress(data, largest + 1)
    except zlib.error as error:
        raise CodecError(f"coded mask is damaged: {error}") from error
    if len(output) > largest:
        raise CodecError(f"coded mask grows beyond {largest} bytes; it is damaged or of a larger mask")
    if not decompressor.eof:
        raise CodecError("coded mask is cut short")
    if decompressor.unused_data:
        raise CodecError(f"coded mask is followed by {len(decompressor.unused_data)} bytes of other data")
    return output
