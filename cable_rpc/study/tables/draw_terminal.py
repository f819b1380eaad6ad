"""A result table in a terminal of 120 columns, set as a paper sets it: groups of columns under one ruled heading."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

from rich.console import Group, RenderableType
from rich.text import Text

from cable_rpc.study.tables.result_table import Column, ResultTable, Row

GAP = "  "
INDENT = "  "


@dataclass(frozen=True, slots=True)
class Layout:
    """Columns with their texts for each row."""

    heading: str
    """Of the rows' labels."""
    columns: Sequence[Column]
    rows: Sequence[tuple[Row, bool]]
    """(row, whether a new block begins with it)."""
    texts: Sequence[Sequence[str]]
    """By row and column."""

    @property
    def label_width(self) -> int:
        """Of the first column; a block's title may run on."""
        return max(len(self.heading), *(len(label_of(row)) for row, _ in self.rows))

    @property
    def widths(self) -> list[int]:
        """Of the columns; the last of a group is widened where the group's heading needs it."""
        widths = [
            max(len(column.name), *(len(texts[place]) for texts in self.texts))
            for place, column in enumerate(self.columns)
        ]
        for group, places in grouped(self.columns):
            missing = len(group) - joined_width(widths, places)
            widths[places[-1]] += max(0, missing)
        return widths


def draw_terminal(table: ResultTable) -> RenderableType:
    """The table's parts one below the other, and its intervals."""
    drawn: list[RenderableType] = [Text(table.title, style="bold")]
    for caption, columns in table.parts:
        rows = list(rows_of_part(table, columns))
        texts = [[row.text(column) for column in columns] for row, _ in rows]
        drawn += [Text(), *part_lines(caption, Layout(table.label_heading, columns, rows, texts))]
    columns = table.columns_with_intervals()
    if columns:
        rows = [(row, is_first) for row, is_first in rows_of_part(table, columns) if row.source == "ours"]
        texts = [[row.interval_text(column) for column in columns] for row, _ in rows]
        drawn += [Text(), *part_lines("95 % intervals", Layout(table.label_heading, columns, rows, texts))]
    return Group(*drawn)


def part_lines(caption: str, layout: Layout) -> Iterator[Text]:
    """One part's lines."""
    if not layout.rows:
        return
    widths, label_width = layout.widths, layout.label_width
    groups = [
        centred(group, joined_width(widths, places)) if group else " " * joined_width(widths, places)
        for group, places in grouped(layout.columns)
    ]
    names = [column.name.rjust(width) for column, width in zip(layout.columns, widths, strict=True)]
    yield line(caption, "italic")
    yield line(GAP.join([" " * label_width, *groups]), "dim")
    yield line(GAP.join([layout.heading.ljust(label_width), *names]), "dim")
    yield line("─" * (label_width + sum(len(GAP) + width for width in widths)), "dim")
    for (row, is_first), texts in zip(layout.rows, layout.texts, strict=True):
        if is_first:
            yield line(row.block, "bold")
        cells = [text.rjust(width) for text, width in zip(texts, widths, strict=True)]
        yield line(GAP.join([label_of(row).ljust(label_width), *cells]), "dim" if row.source == "paper" else "")


def grouped(columns: Sequence[Column]) -> list[tuple[str, list[int]]]:
    """(group, places of its columns) of neighbours; columns without a group stand alone."""
    found: list[tuple[str, list[int]]] = []
    for group, members in groupby(enumerate(columns), key=lambda pair: pair[1].group):
        places = [place for place, _ in members]
        found += [(group, places)] if group else [("", [place]) for place in places]
    return found


def joined_width(widths: Sequence[int], places: Sequence[int]) -> int:
    """Characters that neighbouring columns take with the gaps between them."""
    return sum(widths[place] for place in places) + len(GAP) * (len(places) - 1)


def centred(text: str, width: int) -> str:
    """A group's heading in a rule, where there is room for one."""
    return f" {text} ".center(width, "─") if width >= len(text) + 4 else text.rjust(width)


def line(text: str, style: str) -> Text:
    """One line that is never broken."""
    return Text(text.rstrip(), style=style, no_wrap=True, overflow="ignore")


def rows_of_part(table: ResultTable, columns: Sequence[Column]) -> Iterator[tuple[Row, bool]]:
    """(row, whether a new block begins with it) of the rows that have a figure in one of the columns."""
    block = ""
    for row in table.rows:
        if all(row.value(column).estimate is None for column in columns):
            continue
        yield row, row.block != block
        block = row.block


def label_of(row: Row) -> str:
    """The row's heading; rows of a block are set in."""
    return f"{INDENT}{row.label}" if row.block else row.label
