"""A result table as CSV: raw figures, nothing rounded or scaled."""

from __future__ import annotations

import csv
import io

from cable_rpc.study.tables.result_table import ResultTable, Value


def draw_csv(table: ResultTable) -> str:
    """One line for each row, shares as 0..1; an empty cell was not measured.

    A column that has an interval is followed by ``<key>_low`` and ``<key>_high``.
    """
    with_interval = {column.key for column in table.columns if column.interval}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heading = ["block", "row", "source"]
    for column in table.columns:
        heading += [column.key]
        heading += [f"{column.key}_low", f"{column.key}_high"] if column.key in with_interval else []
    writer.writerow(heading)
    for row in table.rows:
        cells = [row.block, row.label, row.source]
        for column in table.columns:
            cells += texts_of(row.value(column), intervals=column.key in with_interval)
        writer.writerow(cells)
    return text.getvalue()


def texts_of(value: Value, *, intervals: bool) -> list[str]:
    """A figure, and its interval, as they stand in the file."""
    figures = [value.estimate, value.low, value.high] if intervals else [value.estimate]
    return ["" if figure is None else repr(float(figure)) for figure in figures]
