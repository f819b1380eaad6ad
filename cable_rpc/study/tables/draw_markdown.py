"""A result table in Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cable_rpc.study.tables.draw_terminal import rows_of_part
from cable_rpc.study.tables.result_table import Column, ResultTable, Row


def draw_markdown(table: ResultTable) -> str:
    """The table with a heading, its parts and intervals; ends with a line feed."""
    lines = [f"## {table.title}", ""]
    for caption, columns in table.parts:
        lines += [f"**{caption}**", "", *part_lines(table, columns), ""]
    columns = table.columns_with_intervals()
    if columns:
        lines += ["**95 % intervals**", "", *part_lines(table, columns, intervals=True), ""]
    return "\n".join(lines)


def part_lines(table: ResultTable, columns: Sequence[Column], *, intervals: bool = False) -> Iterator[str]:
    """A pipe table, its columns padded so that it can be read as it is."""
    heading = [table.label_heading, *(column.heading for column in columns)]
    body = [row_texts(row, columns, intervals) for row, _ in rows_of_part(table, columns)
            if row.source == "ours" or not intervals]  # fmt: skip
    widths = [max(len(row[place]) for row in [heading, *body]) for place in range(len(heading))]
    yield padded(heading, widths)
    yield "|" + "|".join([":" + "-" * (widths[0] + 1), *("-" * (width + 1) + ":" for width in widths[1:])]) + "|"
    for row in body:
        yield padded(row, widths)


def row_texts(row: Row, columns: Sequence[Column], intervals: bool) -> list[str]:
    """A row's cells; printed figures in italics."""
    label = f"{row.block}, {row.label}" if row.block else row.label
    if row.source == "paper":
        return [f"*{label}*", *(f"*{row.text(column)}*" for column in columns)]
    return [label, *(row.interval_text(column) if intervals else row.text(column) for column in columns)]


def padded(cells: Sequence[str], widths: Sequence[int]) -> str:
    """One line of a pipe table, the first cell to the left, the others to the right."""
    texts = [cells[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))]
    return "| " + " | ".join(texts) + " |"
