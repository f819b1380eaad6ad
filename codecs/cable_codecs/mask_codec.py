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
6       the cells by their neighbours, arithmetically coded (`mask_context`)
======  =============================================================================

Deflated means raw RFC 1951 data. The size of the mask travels outside.

Form 6 is the smallest for all but noise and fine periodic patterns, and the slowest: it takes about half a
microsecond a decision to code and one to decode. So it has a budget of decisions, and a mask of a long outline
gets runs or bits.
"""

from __future__ import annotations

import zlib

import numpy as np
import numpy.typing as npt

from cable_codecs.base import MAX_DIMENSION, BoolMask
from cable_codecs.errors import CodecError
from cable_codecs.mask_context import MOST_DECISIONS, decode_by_context, encode_by_context
from cable_codecs.mask_runs import (
    bytes_to_column_runs,
    bytes_to_runs,
    changes_to_bytes,
    column_changes,
    largest_runs_size,
    most_changes,
    row_changes,
)

ALL_FALSE, ALL_TRUE, BITS, XOR_BITS, ROW_RUNS, COLUMN_RUNS, CONTEXT = range(7)

BLOCK_MASK_CELLS = 1 << 17
BLOCK_MASK_DECISIONS = 8192
PIXEL_MASK_DECISIONS = 3072
"""Decisions spent on larger masks, so that an edge device decodes them in 2 to 3 ms."""
CELLS_PER_CONTEXT_BIT = 4
"""Where form 6 needs a bit for fewer cells than this, the mask is so ragged that another form may be shorter."""
CELLS_PER_BITS_CHANGE = 128
"""Bits may be shorter than runs where the changes along the rows lie closer than this: found on thresholded frame
differences and noise."""
CELLS_PER_RUNS_CHANGE = 24
"""Closer than this, runs are longer."""
CLOSE_RUNS = 1.5
"""Runs along the direction with this many times the changes may still be shorter."""
FAST_DEFLATE_BYTES = 1024


def encode_mask(blocks: BoolMask, most_decisions: int | None = None) -> bytes:
    """Code a mask.

    Args:
        blocks: bool [rows, columns].
        most_decisions: Budget of form 6, 0..32768: more gives fewer bytes for masks of long outlines, at about
            half a microsecond each here and a whole one at the receiver. None: 8192 for masks of up to 2**17
            cells, 3072 for larger ones.

    Raises:
        CodecError: Not a two-dimensional bool array of 1..16384 cells a side, or a budget out of range.
    """
    if blocks.dtype != np.bool_ or blocks.ndim != 2:
        raise CodecError(f"a mask must be bool [rows, columns], got {blocks.dtype} {list(blocks.shape)}")
    check_size(*blocks.shape)
    if not blocks.any():
        return bytes([ALL_FALSE])
    if blocks.all():
        return bytes([ALL_TRUE])
    cells = np.ascontiguousarray(blocks)
    if most_decisions is None:
        most_decisions = BLOCK_MASK_DECISIONS if cells.size <= BLOCK_MASK_CELLS else PIXEL_MASK_DECISIONS
    elif not 0 <= most_decisions <= MOST_DECISIONS:
        raise CodecError(f"the budget of a mask must be 0..{MOST_DECISIONS} decisions, got {most_decisions}")
    payload = encode_by_context(cells, most_decisions)
    if payload is None:
        return min(ragged_forms(cells), key=len)
    data = bytes([CONTEXT]) + payload
    if 8 * CELLS_PER_CONTEXT_BIT * len(data) <= cells.size:
        return data
    return min([data, *ragged_forms(cells)], key=len)


def ragged_forms(cells: BoolMask) -> list[bytes]:
    """The coded mask in those of the forms 2 to 5 that may be short."""
    rows, columns = cells.shape
    small = cells.size <= BLOCK_MASK_CELLS
    along_rows = row_changes(cells)
    changes = along_rows[0].size
    forms = []
    if changes * CELLS_PER_BITS_CHANGE > cells.size:
        forms.append(bytes([BITS]) + deflate(np.packbits(cells).tobytes()))
        if small:
            forms.append(bytes([XOR_BITS]) + deflate(np.packbits(xor_rows(cells)).tobytes()))
    if small or not forms or changes * CELLS_PER_RUNS_CHANGE <= cells.size:
        along_columns = column_changes(cells)
        limit = min(most_changes(rows, columns), CLOSE_RUNS * min(changes, along_columns[0].size))
        if changes <= limit:
            forms.append(bytes([ROW_RUNS]) + deflate(changes_to_bytes(*along_rows, rows), zlib.Z_FILTERED))
        if along_columns[0].size <= limit:
            forms.append(bytes([COLUMN_RUNS]) + deflate(changes_to_bytes(*along_columns, columns), zlib.Z_FILTERED))
    return forms


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
        return bytes_to_column_runs(inflate(payload, largest_runs_size(columns, rows)), rows, columns)
    if tag == CONTEXT:
        return decode_by_context(payload, rows, columns)
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


def deflate(data: bytes, strategy: int = zlib.Z_DEFAULT_STRATEGY) -> bytes:
    """Raw deflate, at the highest effort where there is little to do.

    ``Z_FILTERED`` saves 1 to 5 % on runs, whose short matches cost more than the small numbers they replace.
    """
    level = 9 if len(data) <= FAST_DEFLATE_BYTES else 6
    compressor = zlib.compressobj(level=level, wbits=-15, memLevel=9, strategy=strategy)
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
