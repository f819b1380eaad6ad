"""The sweep report's tables: texts with what a column is sorted by, and the same for papers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cable_rpc.study.metrics import Interval
from cable_rpc.study.rate_quality import DeltaResult, FixedQuality, SavingAtQuality
from cable_rpc.study.sweep_report.comparison import OTHER_INTERPOLATIONS, MethodResult, QualityResult
from cable_rpc.study.tables.result_table import NOT_MEASURED, Column, ResultTable, Row, Value


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a table."""

    text: str
    order: float | None = None
    """What numbers are sorted by; None sorts by the text, and last among numbers."""
    detail: str = ""
    """Set small below the text: an interval."""
    remark: str = ""
    """Why there is no figure, shown on hover."""


@dataclass(frozen=True, slots=True)
class PageTable:
    """A table that the reader can sort."""

    heading: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def methods_table(result: QualityResult) -> PageTable:
    """Rates at fixed quality, BD-rate and BD-quality of every method."""
    unit = f", {result.quality.unit}" if result.quality.unit else ""
    heading = ["method", "BD-rate, %", f"BD-quality{unit}"]
    levels = result.methods[0].levels if result.methods else ()
    for one in levels:
        heading += [f"kbit/s at {one.level:g}\u00a0%", f"saved at {one.level:g}\u00a0%"]
    heading += ["overlap, %", "beaten points", "compared with"]
    return PageTable(tuple(heading), tuple(method_row(one) for one in result.methods))


def method_row(one: MethodResult) -> tuple[Cell, ...]:
    """One method."""
    cells = [Cell(one.label), delta_cell(one.bd_rate), delta_cell(one.bd_quality, decimals=2)]
    for level in one.levels:
        cells += [rate_cell(level.rate), saving_cell(level.saving)]
    cells.append(overlap_cell(one.bd_rate))
    beaten = "" if one.bd_rate is None else f"{one.bd_rate.dropped_test} (anchor {one.bd_rate.dropped_anchor})"
    cells.append(Cell(beaten or NOT_MEASURED, None if one.bd_rate is None else one.bd_rate.dropped_test))
    cells.append(Cell(one.anchor or NOT_MEASURED))
    return tuple(cells)


def rate_cell(rate: FixedQuality) -> Cell:
    """kbit/s."""
    if rate.rate_kbps is None:
        return Cell(NOT_MEASURED, remark=rate.reason)
    return Cell(f"{rate.rate_kbps:.0f}", rate.rate_kbps, interval_text(rate.interval, 0))


def saving_cell(saving: SavingAtQuality | None) -> Cell:
    """Percent of the anchor's rate."""
    if saving is None or saving.saving is None:
        return Cell(NOT_MEASURED, remark="" if saving is None else saving.reason)
    return Cell(f"{100 * saving.saving:.1f} %", saving.saving, interval_text(saving.interval, 1, 100.0))


def delta_cell(delta: DeltaResult | None, *, decimals: int = 1) -> Cell:
    """Percent of rate, or points of quality."""
    if delta is None or delta.value is None:
        return Cell(NOT_MEASURED, remark="" if delta is None else delta.reason)
    return Cell(f"{delta.value:+.{decimals}f}", delta.value, interval_text(delta.interval, decimals))


def overlap_cell(delta: DeltaResult | None) -> Cell:
    """Share of the range that two curves share."""
    if delta is None or delta.overlap is None:
        return Cell(NOT_MEASURED)
    return Cell(f"{100 * delta.overlap:.0f}", delta.overlap)


def interval_text(interval: Interval | None, decimals: int, scale: float = 1.0) -> str:
    """ "[-44.0, -31.2]"; empty without one."""
    if interval is None:
        return ""
    return f"[{scale * interval.low:.{decimals}f}, {scale * interval.high:.{decimals}f}]"


def sequences_table(result: QualityResult) -> PageTable:
    """BD-rates of every sequence, and their mean."""
    compared = [one for one in result.methods if one.bd_rate is not None]
    names = tuple(
        dict.fromkeys(name for one in compared if one.bd_rate is not None for name in one.bd_rate.by_sequence)
    )
    rows = []
    for one in compared:
        delta = one.bd_rate
        if delta is not None:
            values = [delta.mean_of_sequences, *(delta.by_sequence.get(name) for name in names)]
            rows.append((Cell(one.label), *(number_cell(value) for value in values)))
    return PageTable(("method", "mean", *names), tuple(rows))


def interpolations_table(result: QualityResult) -> PageTable:
    """BD-rates by each interpolation."""
    rows = [
        (
            Cell(one.label),
            delta_cell(one.bd_rate),
            *(delta_cell(one.other_bd_rates.get(kind)) for kind in OTHER_INTERPOLATIONS),
        )
        for one in result.methods
        if one.bd_rate is not None
    ]
    return PageTable(("method", "PCHIP", *(kind.capitalize() for kind in OTHER_INTERPOLATIONS)), tuple(rows))


def number_cell(value: float | None) -> Cell:
    """One decimal, with its sign."""
    return Cell(NOT_MEASURED) if value is None else Cell(f"{value:+.1f}", value)


def paper_table(results: Sequence[QualityResult]) -> ResultTable:
    """BD-rates and BD-qualities of all qualities, and rates at fixed quality, for LaTeX, Markdown and CSV."""
    columns: dict[str, list[Column]] = {"BD-rate and BD-quality": []}
    cells: dict[str, dict[str, Value]] = {}
    remarks: list[str] = []
    for result in results:
        name, unit = result.quality.name, result.quality.unit
        columns["BD-rate and BD-quality"] += [
            Column(f"{name}_bd_rate_percent", "BD-rate, %", result.quality.title, interval=True),
            Column(f"{name}_bd_quality", f"BD-q., {unit}".strip(", "), result.quality.title, 1.0, 2, interval=True),
        ]
        for one in result.methods:
            own = cells.setdefault(one.label, {})
            own[f"{name}_bd_rate_percent"] = delta_value(one.bd_rate)
            own[f"{name}_bd_quality"] = delta_value(one.bd_quality)
            for level in one.levels:
                key = f"{name}_{level.level:g}"
                part = columns.setdefault(f"Rate at fixed {result.quality.title}", [])
                group = f"at {level.level:g} %"
                part += [
                    Column(f"{key}_kbps", "kbit/s", group, 1.0, 0, interval=True),
                    Column(f"{key}_saved", "saved, %", group, 100.0, interval=True),
                ]
                own[f"{key}_kbps"] = value_of(level.rate.rate_kbps, level.rate.interval)
                saving = level.saving
                own[f"{key}_saved"] = Value() if saving is None else value_of(saving.saving, saving.interval)
            remarks += [f"{one.label}, {result.quality.title}: {remark}" for remark in one.remarks]
    anchors = dict.fromkeys(one.anchor for result in results for one in result.methods if one.anchor)
    parts = [(caption, list({column.key: column for column in found}.values())) for caption, found in columns.items()]
    return ResultTable(
        "bd-rates",
        "I",
        f"Rate against quality, compared with {'; '.join(anchors) or 'nothing'}",
        "Method",
        parts,
        [Row(one_line(label), own) for label, own in cells.items()],
        tuple(one_line(remark) for remark in remarks),
    )


def delta_value(delta: DeltaResult | None) -> Value:
    """With its interval."""
    return Value() if delta is None else value_of(delta.value, delta.interval)


def value_of(value: float | None, interval: Interval | None) -> Value:
    """A figure and its interval."""
    return Value(value) if interval is None else Value(value, interval.low, interval.high)


def one_line(text: str) -> str:
    """Without line feeds, and without the bar that parts the cells of a Markdown table."""
    return " ".join(text.split()).replace("|", "¦")
