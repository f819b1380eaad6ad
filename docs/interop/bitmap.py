"""Decodes the bitmaps of cable.v1 (`Mask.data`, `Region.data`) as docs/wire-protocol.md tells, with nothing but zlib.

Plain and slow, to be read beside that page and to be carried over to other languages; no part of CABLE-RPC uses it.
"""

from __future__ import annotations

import zlib
from itertools import accumulate, chain, pairwise

Bitmap = list[list[bool]]


def decode_bitmap(data: bytes, rows: int, columns: int) -> Bitmap:
    """The cells, row by row. Data that are damaged raise ValueError, IndexError or zlib.error."""
    form, payload = data[0], data[1:]
    if form in (0, 1):
        return [[bool(form)] * columns for _ in range(rows)]
    if form in (2, 3):
        return unpacked(zlib.decompress(payload, -15), rows, columns, xor=form == 3)
    if form == 4:
        return from_runs(zlib.decompress(payload, -15), columns)
    if form == 5:
        return [list(row) for row in zip(*from_runs(zlib.decompress(payload, -15), rows), strict=True)]
    if form == 6:
        return Neighbours(payload).bitmap(rows, columns)
    raise ValueError(f"form {form} is none of 0..6")


def unpacked(packed: bytes, rows: int, columns: int, *, xor: bool) -> Bitmap:
    """Forms 2 and 3: eight cells to a byte, the most significant bit first."""
    cells = [bool(byte >> bit & 1) for byte in packed for bit in range(7, -1, -1)]
    bitmap = [cells[row * columns : (row + 1) * columns] for row in range(rows)]
    if xor:
        for above, row in pairwise(bitmap):
            row[:] = [cell != over for cell, over in zip(row, above, strict=True)]
    return bitmap


def from_runs(numbers: bytes, columns: int) -> Bitmap:
    """Form 4: bands of rows with equally many changes; form 5 is the same with rows and columns exchanged."""
    values, number, shift = [], 0, 0
    for byte in numbers:
        number |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            values.append(number)
            number = shift = 0
    bands, rest = values[0], iter(values[1:])
    heights = [next(rest) for _ in range(bands)]
    counts = [next(rest) for _ in range(bands)]
    signed = (value >> 1 ^ -(value & 1) for value in rest)
    bitmap: Bitmap = []
    start = 0
    for height, count in zip(heights, counts, strict=True):
        boundaries: list[list[int]] = []
        for _ in range(count):
            start += next(signed)
            boundaries.append(list(accumulate((next(signed) for _ in range(height - 1)), initial=start)))
        for row in range(height):
            changes = {boundary[row] for boundary in boundaries}
            bitmap.append(list(accumulate((column in changes for column in range(columns)), bool.__xor__)))
    return bitmap


class Neighbours:
    """Form 6: decisions in contexts, arithmetically coded."""

    def __init__(self, payload: bytes) -> None:
        self.data, self.check = payload[:-1], payload[-1]
        self.low, self.high, self.position = 0, 0xFFFFFFFF, 4
        self.value = int.from_bytes(self.data[:4].ljust(4, b"\0"), "big")
        self.counts = {context: [6, 2] if 18 <= context <= 49 else [2, 2] for context in range(128)}

    def decide(self, context: int) -> bool:
        """The next decision of a context."""
        no, yes = counts = self.counts[context]
        middle = self.low + (self.high - self.low) * yes // (no + yes)
        made = self.value <= middle
        self.low, self.high = (self.low, middle) if made else (middle + 1, self.high)
        counts[made] += 5
        if sum(counts) > 1024:
            counts[:] = [(count + 1) // 2 for count in counts]
        while self.low >> 24 == self.high >> 24:
            self.low = self.low << 8 & 0xFFFFFFFF
            self.high = self.high << 8 & 0xFFFFFFFF | 255
            following = self.data[self.position] if self.position < len(self.data) else 0
            self.value = self.value << 8 & 0xFFFFFFFF | following
            self.position += 1
        return made

    def bitmap(self, rows: int, columns: int) -> Bitmap:
        """All of it: first which rows equal the one above, then the others."""
        bitmap: Bitmap = []
        above2 = above = [False] * columns
        repeats = [False]
        for _ in range(rows):
            repeats.append(self.decide(int(repeats[-1])))
        for repeat in repeats[1:]:
            row = list(above) if repeat else self.row(above, above2, columns)
            bitmap.append(row)
            above2, above = above, row
        cells = list(chain.from_iterable(bitmap))
        cells += [False] * (-len(cells) % 8)
        packed = bytes(
            sum(cell << 7 - bit for bit, cell in enumerate(cells[at : at + 8])) for at in range(0, len(cells), 8)
        )
        if zlib.crc32(packed) & 255 != self.check:
            raise ValueError("the check byte differs")
        return bitmap

    def row(self, above: list[bool], above2: list[bool], columns: int) -> list[bool]:
        """A row, given the two above it."""
        row: list[bool] = []
        while (c := len(row)) < columns:
            north = above[c]
            west, north_west = (row[c - 1], above[c - 1]) if c else (north, north)
            north_east = above[c + 1] if c + 1 < columns else north
            if not west == north_west == north == north_east:
                signs = (west != north_west, north != west, north_east != west, above2[c] != west)
                differs = self.decide(2 + sum(sign << bit for bit, sign in enumerate(signs)))
                row.append(west != differs)
                continue
            end = c
            while end + 1 < columns and above[end + 1] == above[end]:
                end += 1
            at_row_end = end + 1 == columns
            length = end + 1 - c if at_row_end else end - c
            row += self.stretch(c, length, west, at_row_end)
        return row

    def stretch(self, start: int, length: int, west: bool, at_row_end: bool) -> list[bool]:
        """The cells of a stretch up to the one that differs, or all of them."""
        edge = 16 * at_row_end
        if not self.decide(18 + edge + length.bit_length()):
            return [west] * length
        bits = 1
        while bits < length.bit_length() and self.decide(50 + edge + bits):
            bits += 1
        distance = 1
        for k in range(bits - 2, -1, -1):
            distance = distance << 1 | self.decide(82 + k)
        same = distance - 1 if at_row_end else length - distance
        return [west] * same + [not west]
