"""Masks cell by cell, each predicted from its neighbours, by adaptive arithmetic coding.

Most cells have neighbours that all agree. Such cells are coded a stretch at a time, so that the work grows with the
length of the outline and not with the area. For the cell at column c of row y,

* NW, N, NE are the cells at c - 1, c, c + 1 of the row above, W the one before, NN the one two rows above;
* rows above the mask are False; NW of the first column is N, NE of the last is N, and W of the first column is N.

The decisions, in this order:

1. for each row whether it equals the row above;
2. for each other row, from left to right: where W = NW = N = NE, the *stretch* that begins here and ends before the
   first cell whose NE differs, or with the row. One decision tells whether it holds a cell that differs from W. If
   not, its cells all equal W. If so, the distance of the first such cell is given: counted from the stretch's end
   where NE ended it, from its begin where the row did, starting with 1. The bit length of that number minus 1 is
   given in unary (no further 1 where the stretch's own length allows none), then its bits below the leading one,
   from the highest on. The next cell is the one after;
3. where they don't all agree: whether the cell differs from W.

A check byte follows: arithmetic coding itself would let one damage of twenty pass.

`docs/wire-protocol.md` numbers the contexts.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cable_codecs.base import BoolMask
from cable_codecs.binary_arithmetic import DecisionDecoder, encode_decisions, open_decisions
from cable_codecs.errors import CodecError

MOST_DECISIONS = 1 << 15
DECISIONS_PER_CHANGE = 2
"""About so many or more go with each change along the rows: a quick estimate, for the encoder only."""

REPEAT = 0
"""Two contexts: by whether the row above equalled the one above it; False for the first."""
CELL = REPEAT + 2
"""Sixteen: 1 where NW differs from W, 2 where N does, 4 where NE does, 8 where NN does."""
BROKEN = CELL + 16
"""Sixteen each for stretches that NE and that the row ends: by the bit length of the stretch."""
LONGER = BROKEN + 32
"""Sixteen each likewise: by the bit length reached so far."""
DIGIT = LONGER + 32
"""Sixteen: by the place of the bit, 0 for the lowest."""
CONTEXTS = DIGIT + 16

START_COUNTS = [(2, 2)] * BROKEN + [(6, 2)] * 32 + [(2, 2)] * (CONTEXTS - LONGER)

Cells = npt.NDArray[np.uint8]
Integers = npt.NDArray[np.int64]


def encode_by_context(mask: BoolMask, most_decisions: int = MOST_DECISIONS) -> bytes | None:
    """Code a C-contiguous mask bool [rows, columns]; None where that needs too many decisions."""
    cells = mask.view(np.uint8)
    repeats = repeated_rows(cells)
    rows = np.flatnonzero(~repeats)
    if len(repeats) + DECISIONS_PER_CHANGE * count_changes(cells[rows]) > most_decisions:
        return None
    contexts, bits, stretches = row_decisions(cells, rows)
    if len(repeats) + len(contexts) + stretches.most_decisions > most_decisions:
        return None
    flags = repeats.tolist()
    decisions = list(zip([REPEAT, *map(int, flags[:-1])], flags, strict=True))
    cell_decisions = list(zip(contexts.tolist(), bits.tolist(), strict=True))
    done = 0
    for event, length, number, by_row in stretches:
        decisions += cell_decisions[done : event + 1]
        decisions += number_decisions(number, length, by_row)
        done = event + 1
    decisions += cell_decisions[done:]
    return encode_decisions(decisions, START_COUNTS) + check_byte(mask)


def check_byte(mask: BoolMask) -> bytes:
    """The low byte of the CRC-32 of the cells in row order, 8 to a byte."""
    return bytes([zlib.crc32(np.packbits(mask).tobytes()) & 0xFF])


def count_changes(cells: Cells) -> int:
    """Cells that differ from the one before in their row."""
    return int(np.count_nonzero(cells[:, 1:] != cells[:, :-1]))


def repeated_rows(cells: Cells) -> BoolMask:
    """bool [rows], True where a row equals the one above; the row above the first is False."""
    repeats = np.empty(len(cells), np.bool_)
    repeats[0] = not cells[0].any()
    repeats[1:] = ~(cells[1:] != cells[:-1]).any(axis=1)
    return repeats


@dataclass(frozen=True, slots=True)
class BrokenStretches:
    """The stretches that hold a cell unlike the one before them, as parallel arrays."""

    events: Integers
    """Index of each among the decisions of its mask."""
    lengths: Integers
    """Cells of the whole stretch."""
    numbers: Integers
    """Where the unlike cell is, from 1 to the length."""
    by_row: BoolMask
    """True where the row ends the stretch."""

    @property
    def most_decisions(self) -> int:
        """Upper limit of the decisions that give the numbers."""
        return int((2 * np.log2(self.numbers) + 1).sum())

    def __iter__(self) -> Iterator[tuple[int, int, int, bool]]:
        """(event, length, number, by_row) of each."""
        columns = (self.events, self.lengths, self.numbers, self.by_row)
        return zip(*(column.tolist() for column in columns), strict=True)


def row_decisions(cells: Cells, rows: Integers) -> tuple[Integers, Cells, BrokenStretches]:
    """Context and bit of every decision in the given rows, without those that give numbers."""
    columns = cells.shape[1]
    current, above = cells[rows], cells[rows - 1]
    if len(rows) and rows[0] == 0:
        above[0] = 0
    west = np.concatenate([above[:, :1], current[:, :-1]], axis=1)
    north = above ^ west
    context = north << 1
    context[:, 1:] |= above[:, :-1] ^ west[:, 1:]
    context[:, :-1] |= (above[:, 1:] ^ west[:, :-1]) << 2
    context[:, -1] |= north[:, -1] << 2
    agree = context == 0
    is_event = ~agree
    is_event[:, 1:] |= agree[:, 1:] > agree[:, :-1]
    is_event[:, 0] = True
    place = np.flatnonzero(is_event)
    row, column = np.divmod(place, columns)
    event_west = west.reshape(-1)[place]
    event_context = context.reshape(-1)[place]
    far_north = (cells[np.maximum(rows - 2, 0)[row], column] & (rows >= 2)[row]) ^ event_west
    contexts = CELL + event_context.astype(np.int64) + 8 * far_north
    bits = current.reshape(-1)[place] ^ event_west

    stretch = np.flatnonzero(event_context == 0)
    begin, end = place[stretch], np.append(place, agree.size)[stretch + 1]
    limit, by_row = stretch_limits(above, begin)
    length = limit - begin
    unlike = current.reshape(-1)[end - 1] != event_west[stretch]
    contexts[stretch] = BROKEN + 16 * by_row + bit_lengths(length)
    bits[stretch] = unlike
    number = np.where(by_row, end - begin, limit - end + 1)
    return contexts, bits, BrokenStretches(stretch[unlike], length[unlike], number[unlike], by_row[unlike])


def stretch_limits(above: Cells, begin: Integers) -> tuple[Integers, BoolMask]:
    """Where stretches end if all their cells are alike, and whether the row ends them; flat indices."""
    columns = above.shape[1]
    turn = np.flatnonzero(above[:, 1:] != above[:, :-1])
    # One column fewer in each row of the comparison.
    turn += turn // max(1, columns - 1) + 1
    row_end = (begin // columns + 1) * columns
    turn = np.append(turn, above.size + 1)
    following = turn[np.searchsorted(turn, begin, side="right")]
    by_row = following >= row_end
    return np.where(by_row, row_end, following - 1), by_row


def bit_lengths(values: Integers) -> Integers:
    """Bits of positive numbers below 2**53."""
    return np.frexp(values)[1].astype(np.int64)


def number_decisions(number: int, largest: int, by_row: bool) -> Iterable[tuple[int, int]]:
    """The decisions that give a number of 1..largest."""
    bits = number.bit_length()
    for reached in range(1, largest.bit_length()):
        yield LONGER + 16 * by_row + reached, int(reached < bits)
        if reached == bits:
            break
    for place in range(bits - 2, -1, -1):
        yield DIGIT + place, number >> place & 1


def decode_by_context(data: bytes, rows: int, columns: int) -> BoolMask:
    """Undo `encode_by_context`.

    Raises:
        CodecError: The data are damaged, or of a mask of another size.
    """
    decoder = open_decisions(data[:-1], START_COUNTS, MOST_DECISIONS)
    repeats: list[int] = []
    flag = 0
    for _ in range(rows):
        flag = decoder.decide(REPEAT + flag)
        repeats.append(flag)
    # A row with its neighbours beyond both ends.
    two_above = above = bytes(columns + 2)
    different = [above]
    before = 1
    for repeat in repeats:
        if not repeat:
            row = decode_row(decoder, above, above if before else two_above)
            two_above, above = above, row
            different.append(row)
        before = repeat
    decoder.finish()
    lines = np.frombuffer(b"".join(different), np.bool_).reshape(len(different), columns + 2)
    mask = np.ascontiguousarray(lines[np.cumsum(np.logical_not(repeats)), 1:-1])
    if check_byte(mask) != data[-1:]:
        raise CodecError("coded mask is damaged, or of a mask of another size: its check byte doesn't fit")
    return mask


def decode_row(decoder: DecisionDecoder, above: bytes, two_above: bytes) -> bytes:
    """Decode a row; each row comes with a copy of its outermost cells beyond its ends."""
    decide = decoder.decide
    columns = len(above) - 2
    row = bytearray(columns + 2)
    west = row[0] = above[1]
    column = 1
    while column <= columns:
        context = above[column - 1] ^ west | (above[column] ^ west) << 1 | (above[column + 1] ^ west) << 2
        if context:
            west ^= decide(CELL + context + 8 * (two_above[column] ^ west))
            row[column] = west
            column += 1
            continue
        turn = above.find(1 - west, column + 2, columns + 1)
        by_row = turn < 0
        limit = columns + 1 if by_row else turn - 1
        length = limit - column
        unlike = limit
        if decide(BROKEN + 16 * by_row + length.bit_length()):
            number = decode_number(decoder, length, by_row)
            unlike = column + number - 1 if by_row else limit - number
        if west:
            row[column:unlike] = b"\1" * (unlike - column)
        column = unlike
        if unlike < limit:
            west ^= 1
            row[column] = west
            column += 1
    row[0], row[-1] = row[1], row[columns]
    return bytes(row)


def decode_number(decoder: DecisionDecoder, largest: int, by_row: bool) -> int:
    """A number of 1..largest.

    Raises:
        CodecError: It is larger.
    """
    bits = 1
    while bits < largest.bit_length() and decoder.decide(LONGER + 16 * by_row + bits):
        bits += 1
    number = 1
    for place in range(bits - 2, -1, -1):
        number = number << 1 | decoder.decide(DIGIT + place)
    if number > largest:
        raise CodecError(f"coded mask has a cell {number} places away in a stretch of {largest}; it is damaged")
    return number
