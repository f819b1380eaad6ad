"""Masks as the columns where their rows change, each predicted from the row above.

The byte form is a sequence of LEB128 numbers. Rows are gathered in bands, a band being consecutive rows with
the same number of changes n:

1. the number of bands, the rows of each band, the n of each band;
2. band by band, for each of the n boundaries its chain down the band: where it starts, relative to the start
   of the chain before (the first: to 0), then its shift from row to row; all signed, in zigzag form.

A change at column c means that cell c differs from cell c - 1, where the cell before the first is False.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask
from cable_codecs.errors import CodecError

Integers = npt.NDArray[np.int64]
Changes = tuple[Integers, Integers]
"""Row and column of each change."""

NUMBER_BYTES = 3
"""Bytes of the longest number: zigzag shifts are below 2**15, numbers of rows and changes below 2**16."""
SMALL_MASK_CELLS = 1 << 14
LEAST_CELLS_PER_CHANGE = 8
"""In larger masks; with more changes plain bits are no longer, and the cells are far cheaper to decode."""


def most_changes(rows: int, columns: int) -> int:
    """Changes that the byte form of a mask of a size may have."""
    return max(min(rows * columns, SMALL_MASK_CELLS), rows * columns // LEAST_CELLS_PER_CHANGE)


def largest_runs_size(rows: int, columns: int) -> int:
    """Bytes of the longest byte form of a mask of a size."""
    return NUMBER_BYTES * (1 + 2 * rows + most_changes(rows, columns))


def row_changes(mask: BoolMask) -> Changes:
    """Row and column of each change along the rows, row by row."""
    cells = mask.view(np.uint8)
    changes = cells.copy()
    np.bitwise_xor(cells[:, 1:], cells[:, :-1], out=changes[:, 1:])
    # Searching the flat array is several times faster than np.nonzero of a matrix.
    row, column = np.divmod(np.flatnonzero(changes.view(np.bool_)), mask.shape[1])
    return row, column


def column_changes(mask: BoolMask) -> Changes:
    """Column and row of each change along the columns, column by column: `row_changes` of the mask turned over."""
    cells = mask.view(np.uint8)
    changes = cells.copy()
    np.bitwise_xor(cells[1:], cells[:-1], out=changes[1:])
    row, column = np.divmod(np.flatnonzero(changes.view(np.bool_)), mask.shape[1])
    order = np.argsort(column, kind="stable")
    return column[order], row[order]


def runs_to_bytes(mask: BoolMask) -> bytes:
    """The byte form of a C-contiguous mask bool [rows, columns]."""
    return changes_to_bytes(*row_changes(mask), mask.shape[0])


def changes_to_bytes(row: Integers, column: Integers, rows: int) -> bytes:
    """The byte form of changes given row by row."""
    counts = np.bincount(row, minlength=rows)
    band_starts = np.flatnonzero(np.diff(counts, prepend=-1))
    band_rows = np.diff(band_starts, append=rows)
    band_counts = counts[band_starts]

    chained = np.empty_like(column)
    chained[chain_places(row, counts, band_starts, band_rows)] = column
    header = np.concatenate([[band_starts.size], band_rows, band_counts])
    shifts = np.diff(chained, prepend=0)
    starts = chain_starts(np.repeat(band_rows, band_counts))
    shifts[starts] = np.diff(chained[starts], prepend=0)
    return write_numbers(np.concatenate([header, zigzag(shifts)]))


def bytes_to_runs(data: bytes, rows: int, columns: int) -> BoolMask:
    """The mask bool [rows, columns] of a byte form.

    Raises:
        CodecError: The data don't describe a mask of that size.
    """
    row, column = bytes_to_changes(data, rows, columns)
    change = np.sort(row * columns + column)
    check_apart(change)
    # A row that ends True needs one more turn for the next to begin False.
    odd_rows = np.flatnonzero(np.bincount(row, minlength=rows) & 1)
    turns = np.sort(np.concatenate([change, (odd_rows + 1) * columns]))
    lengths = np.diff(turns, prepend=0, append=rows * columns)
    return np.repeat(np.arange(lengths.size) % 2 == 1, lengths).reshape(rows, columns)


def bytes_to_column_runs(data: bytes, rows: int, columns: int) -> BoolMask:
    """The mask bool [rows, columns] of the byte form of the mask turned over.

    Raises:
        CodecError: The data don't describe a mask of that size.
    """
    column, row = bytes_to_changes(data, columns, rows)
    change = np.sort(row * columns + column)
    check_apart(change)
    cells = np.zeros((rows, columns), np.bool_)
    cells.reshape(-1)[change] = True
    # Row by row: NumPy's own accumulation down the columns takes four times as long.
    for y in range(1, rows):
        np.not_equal(cells[y], cells[y - 1], out=cells[y])
    return cells


def check_apart(change: Integers) -> None:
    """Check that no two changes, given in order, are in one place.

    Raises:
        CodecError: They are.
    """
    if not np.diff(change).all():
        raise CodecError("coded mask has two boundaries in one place; it is damaged")


def bytes_to_changes(data: bytes, rows: int, columns: int) -> Changes:
    """Row and column of each change in a byte form, chain by chain.

    Raises:
        CodecError: The data don't describe a mask of that size.
    """
    numbers = read_numbers(data)
    bands = int(numbers[0]) if numbers.size else 0
    if not 1 <= bands <= rows or numbers.size < 1 + 2 * bands:
        raise CodecError(f"coded mask has {bands} bands of rows in {numbers.size} numbers; it is damaged")
    band_rows, band_counts = numbers[1 : 1 + bands], numbers[1 + bands : 1 + 2 * bands]
    coded = numbers[1 + 2 * bands :]
    total = int((band_rows * band_counts).sum())
    if band_rows.min() < 1 or band_rows.sum() != rows or band_counts.max() > columns or coded.size != total:
        raise CodecError(f"coded mask doesn't describe {rows} x {columns} cells; it is damaged or of another size")
    if total > most_changes(rows, columns):
        raise CodecError(f"coded mask has {total} boundaries, too many for {rows} x {columns} cells; it is damaged")
    lengths = np.repeat(band_rows, band_counts)
    starts = chain_starts(lengths)
    shifts = unzigzag(coded)
    origins = np.cumsum(shifts[starts])
    shifts[starts] = 0
    walked = np.cumsum(shifts)
    column = walked + np.repeat(origins - walked[starts], lengths)
    first_rows = np.repeat(np.cumsum(band_rows) - band_rows, band_counts)
    row = np.arange(total) + np.repeat(first_rows - starts, lengths)
    if total and (column.min() < 0 or column.max() >= columns):
        raise CodecError(f"coded mask has a boundary outside its {columns} columns; it is damaged or of another size")
    return row, column


def chain_places(row: Integers, counts: Integers, band_starts: Integers, band_rows: Integers) -> Integers:
    """Where each change, given row by row, stands in the order of the chains."""
    before_row = np.cumsum(counts) - counts
    boundary = np.arange(row.size) - before_row[row]
    band = np.repeat(np.arange(band_starts.size), band_rows)[row]
    places = before_row[band_starts][band] + boundary * band_rows[band] + row - band_starts[band]
    return np.asarray(places, np.int64)


def chain_starts(lengths: Integers) -> Integers:
    """Where each chain begins, from the chain lengths."""
    return np.cumsum(lengths) - lengths


def zigzag(values: Integers) -> Integers:
    """0, -1, 1, -2 ... to 0, 1, 2, 3 ..."""
    return np.where(values < 0, -2 * values - 1, 2 * values)


def unzigzag(values: Integers) -> Integers:
    """0, 1, 2, 3 ... to 0, -1, 1, -2 ..."""
    return np.where(values & 1, -(values + 1) // 2, values // 2)


def write_numbers(values: Integers) -> bytes:
    """LEB128 of numbers below 2**21: seven bits a byte, low bits first, the top bit set where more follow."""
    groups = np.stack([values & 127, (values >> 7) & 127, values >> 14], axis=1)
    sizes = 1 + (values >= 1 << 7) + (values >= 1 << 14)
    position = np.arange(NUMBER_BYTES)
    groups |= np.where(position < sizes[:, None] - 1, 128, 0)
    return groups[position < sizes[:, None]].astype(np.uint8).tobytes()


def read_numbers(data: bytes) -> Integers:
    """Undo `write_numbers`.

    Raises:
        CodecError: The last number is cut, or one is too long.
    """
    values = np.frombuffer(data, np.uint8).astype(np.int64)
    if not values.size:
        return values
    ends = np.flatnonzero(values < 128)
    if not ends.size or ends[-1] != values.size - 1:
        raise CodecError("coded mask ends inside a number; it is damaged")
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts + 1
    if lengths.max() > NUMBER_BYTES:
        raise CodecError(f"coded mask has a number of more than {NUMBER_BYTES} bytes; it is damaged")
    place = np.arange(values.size) - np.repeat(starts, lengths)
    return np.asarray(np.add.reduceat((values & 127) << (7 * place), starts), np.int64)
