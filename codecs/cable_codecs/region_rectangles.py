"""Covering a region by few rectangles, for interfaces that take no masks."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cable_codecs.base import BoolMask
from cable_codecs.errors import CodecError


@dataclass(frozen=True, slots=True)
class Rectangle:
    """Cells or pixels ``left <= x < right``, ``top <= y < bottom``."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def area(self) -> int:
        """Cells inside."""
        return (self.bottom - self.top) * (self.right - self.left)

    def union(self, other: Rectangle) -> Rectangle:
        """The smallest rectangle around both."""
        return Rectangle(
            min(self.top, other.top),
            max(self.bottom, other.bottom),
            min(self.left, other.left),
            max(self.right, other.right),
        )

    def scaled(self, size: int, height: int, width: int) -> Rectangle:
        """The pixels of cells of ``size`` pixels, cut to a picture."""
        return Rectangle(
            self.top * size, min(self.bottom * size, height), self.left * size, min(self.right * size, width)
        )


def covering_rectangles(blocks: BoolMask, most: int) -> tuple[Rectangle, ...]:
    """Rectangles whose union covers a region, and is the region where ``most`` allows.

    Runs of a row that the next row repeats become one rectangle. Where these are too many, neighbours in reading
    order are joined, the pair that adds the fewest cells first: the cover then grows beyond the region, but
    never leaves out a part of it.

    Args:
        blocks: bool [rows, columns].
        most: Rectangles at most, at least 1.

    Returns:
        In order of their top row; none for an empty region.

    Raises:
        CodecError: ``most`` below 1 or no two-dimensional bool array.
    """
    if most < 1:
        raise CodecError(f"a region can't be covered by at most {most} rectangles; allow at least 1")
    if blocks.dtype != np.bool_ or blocks.ndim != 2:
        raise CodecError(f"a region must be bool [rows, columns], got {blocks.dtype} {list(blocks.shape)}")
    return join_neighbours(run_rectangles(blocks), most)


def run_rectangles(blocks: BoolMask) -> list[Rectangle]:
    """The region exactly: its runs along the rows, each as tall as the rows below repeat it."""
    rows, columns = blocks.shape
    framed = np.zeros((rows, columns + 2), np.int8)
    framed[:, 1:-1] = blocks
    row, edge = np.nonzero(np.diff(framed, axis=1))
    found: list[Rectangle] = []
    open_runs: dict[tuple[int, int], int] = {}
    runs_of_row: list[list[tuple[int, int]]] = [[] for _ in range(rows + 1)]
    for number, left, right in zip(row[::2].tolist(), edge[::2].tolist(), edge[1::2].tolist(), strict=True):
        runs_of_row[number].append((left, right))
    for number, runs in enumerate(runs_of_row):
        still_open = {run: open_runs.get(run, number) for run in runs}
        found.extend(
            Rectangle(top, number, left, right)
            for (left, right), top in open_runs.items()
            if (left, right) not in still_open
        )
        open_runs = still_open
    return sorted(found, key=lambda one: (one.top, one.left))


def join_neighbours(rectangles: list[Rectangle], most: int) -> tuple[Rectangle, ...]:
    """At most so many rectangles, by joining neighbours in the list."""
    joined = list(rectangles)
    added = [growth(first, second) for first, second in pairwise(joined)]
    while len(joined) > most:
        place = min(range(len(added)), key=added.__getitem__)
        joined[place : place + 2] = [joined[place].union(joined[place + 1])]
        del added[place]
        if place > 0:
            added[place - 1] = growth(joined[place - 1], joined[place])
        if place < len(added):
            added[place] = growth(joined[place], joined[place + 1])
    return tuple(joined)


def growth(first: Rectangle, second: Rectangle) -> int:
    """Cells that joining two rectangles adds."""
    return first.union(second).area - first.area - second.area
