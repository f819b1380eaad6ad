"""A table of results, free of any way to draw it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

Source = Literal["ours", "paper"]

NOT_MEASURED = "–"


@dataclass(frozen=True, slots=True)
class Column:
    """One figure."""

    key: str
    """Its name in the CSV file, units included."""
    name: str
    """Heading for people."""
    group: str = ""
    """What stands above the headings of neighbours that belong together."""
    scale: float = 1.0
    """What a value is multiplied with before it is printed."""
    decimals: int = 1
    leading_zero: bool = True
    """False prints .88, as detection papers do."""
    interval: bool = False
    """Whether its interval is printed, where there is one."""

    def text(self, value: float | None) -> str:
        """A value as printed."""
        if value is None:
            return NOT_MEASURED
        shown = f"{self.scale * value:.{self.decimals}f}"
        return shown if self.leading_zero else shown.replace("0.", ".", 1) if shown.startswith(("0.", "-0.")) else shown

    @property
    def heading(self) -> str:
        """Group and name in one line."""
        return f"{self.group} {self.name}".strip()


@dataclass(frozen=True, slots=True)
class Value:
    """A figure with its 95 % interval; None where it was not measured, or where too few sequences give none."""

    estimate: float | None = None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one data set or strategy."""

    label: str
    cells: Mapping[str, Value]
    source: Source = "ours"
    block: str = ""
    """Data set of a strategy's row."""

    def value(self, column: Column) -> Value:
        """The column's figure."""
        return self.cells.get(column.key, Value())

    def text(self, column: Column) -> str:
        """The same as printed."""
        return column.text(self.value(column).estimate)

    def interval_text(self, column: Column) -> str:
        """ "[22.1, 25.0]"; empty without an interval."""
        value = self.value(column)
        if value.low is None or value.high is None:
            return ""
        return f"[{column.text(value.low)}, {column.text(value.high)}]"


@dataclass(frozen=True, slots=True)
class ResultTable:
    """Rows under several parts of columns, which are drawn one below the other."""

    key: str
    """Name of its files."""
    number: str
    """Roman, as the paper counts."""
    caption: str
    """What the rows are, without the number: LaTeX counts by itself."""
    label_heading: str
    parts: Sequence[tuple[str, Sequence[Column]]]
    """(caption, columns)."""
    rows: Sequence[Row]
    notes: Sequence[str] = field(default=())

    @property
    def title(self) -> str:
        """Number and caption."""
        return f"Table {self.number}. {self.caption}"

    @property
    def columns(self) -> list[Column]:
        """All of them, each once."""
        return list({column.key: column for _, columns in self.parts for column in columns}.values())

    def columns_with_intervals(self) -> list[Column]:
        """Those that have an interval in some row."""
        return [
            column for column in self.columns if column.interval and any(row.interval_text(column) for row in self.rows)
        ]
