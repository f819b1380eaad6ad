"""Figures (PNG, PDF) and tables (LaTeX, Markdown, CSV) of a sweep for papers."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from cable_rpc.study.metrics import Interval
from cable_rpc.study.rate_quality import PooledPoint, hull
from cable_rpc.study.run_record import write_text
from cable_rpc.study.sweep_report.comparison import LEVELLED_QUALITY, QualityResult
from cable_rpc.study.sweep_report.content import ReportContent
from cable_rpc.study.sweep_report.facts import CellFacts, byte_savings, facts_of
from cable_rpc.study.sweep_report.plots import BYTE_KINDS, axis_title, byte_bars, points_of_sequence
from cable_rpc.study.sweep_report.tables import paper_table
from cable_rpc.study.tables.draw_csv import draw_csv
from cable_rpc.study.tables.draw_latex import draw_latex
from cable_rpc.study.tables.draw_markdown import draw_markdown

COLUMN_IN, PAGE_IN = 3.5, 7.0
"""Widths of one column and of both."""
PLOT_IN, LEGEND_LINE_IN = 2.9, 0.13
"""Heights of a plot with its axes, and of one line of the legend."""
SUFFIXES = (".png", ".pdf")
PNG_DPI = 300
STYLE: Any = {
    "font.size": 7,
    "font.family": "sans-serif",
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.4,
    "grid.alpha": 0.4,
    "legend.frameon": False,
    "legend.fontsize": 6,
    "lines.linewidth": 1.1,
    "lines.markersize": 4,
    # Type 42 fonts are embedded whole; publishers refuse the default Type 3.
    "pdf.fonttype": 42,
    # Labels come from outside: a dollar sign is no formula.
    "text.parse_math": False,
}
HATCHES = ("", "////", "....", "xxxx")


def write_exports(content: ReportContent, folder: Path) -> None:
    """Write all of them, each file whole or not at all.

    Raises:
        OSError: the folder can't be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table = paper_table(content.results)
    write_text(folder / "bd_rates.tex", draw_latex(table))
    write_text(folder / "bd_rates.md", draw_markdown(table))
    write_text(folder / "bd_rates.csv", draw_csv(table))
    write_text(folder / "curves.csv", curves_csv(content))
    for result in content.results:
        name = f"rate_quality_{result.quality.name}"
        lines = len(result.methods)
        save(
            folder / name,
            COLUMN_IN,
            PLOT_IN + LEGEND_LINE_IN * lines,
            partial(draw_curves, content=content, result=result),
        )
        save(
            folder / f"{name}_wide",
            PAGE_IN,
            PLOT_IN + LEGEND_LINE_IN * (lines // 2 + 1),
            partial(draw_curves, content=content, result=result),
        )
    levelled = [result for result in content.results if result.quality.name == LEVELLED_QUALITY]
    if levelled:
        bars = byte_bars(levelled[0], content.methods, content.level)
        height = 1.1 + 0.34 * len(bars)
        save(folder / "byte_kinds", COLUMN_IN, height, lambda axes: draw_bytes(axes, bars))
    if byte_savings(content.methods):
        save(
            folder / "pixels_bytes",
            COLUMN_IN,
            PLOT_IN + LEGEND_LINE_IN * len(content.methods),
            lambda axes: draw_pixels(axes, content),
        )


def save(path: Path, width_in: float, height_in: float, draw: Callable[[Axes], None]) -> None:
    """One figure in each format."""
    with rc_context(STYLE):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        draw(figure.add_subplot())
        for suffix in SUFFIXES:
            part = path.with_name(f"{path.name}{suffix}.part")
            try:
                figure.savefig(part, format=suffix.removeprefix("."), dpi=PNG_DPI)
                part.replace(path.with_name(path.name + suffix))
            finally:
                with suppress(FileNotFoundError):
                    part.unlink()


def draw_curves(axes: Axes, content: ReportContent, result: QualityResult) -> None:
    """Pooled rate against quality with intervals; the points that others beat are hollow."""
    for one in result.methods:
        style = content.styles[one.label]
        kept = hull(one.points)
        beaten = [point for point in one.points if point not in kept]
        axes.plot(
            [point.rate_kbps for point in kept],
            [point.quality for point in kept],
            color=style.colour,
            marker=style.marker,
            label=one.label,
        )
        axes.plot(
            [point.rate_kbps for point in beaten],
            [point.quality for point in beaten],
            linestyle="none",
            marker=style.marker,
            markeredgecolor=style.colour,
            markerfacecolor="none",
        )
        for point in one.points:
            if point.quality_interval is not None:
                bounds = point.quality_interval
                axes.vlines(point.rate_kbps, bounds.low, bounds.high, color=style.colour, linewidth=0.6, alpha=0.6)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("uplink, kbit/s")
    axes.set_ylabel(axis_title(result.quality))
    legend_below(axes)


def draw_bytes(axes: Axes, bars: Sequence[tuple[str, str, CellFacts]]) -> None:
    """kbit/s by what they were spent on."""
    places = range(len(bars))
    left = [0.0] * len(bars)
    for (title, field, colour), hatch in zip(BYTE_KINDS, HATCHES, strict=True):
        values = [getattr(facts.uplink, field) * 8e-3 / facts.seconds for *_, facts in bars]
        axes.barh(places, values, left=left, color=colour, label=title, hatch=hatch, edgecolor="white", linewidth=0.3)
        left = [start + value for start, value in zip(left, values, strict=True)]
    axes.set_yticks(list(places), [f"{label}\n{setting}" for label, setting, _ in bars], fontsize=5.5)
    axes.invert_yaxis()
    axes.set_xlabel("uplink, kbit/s")
    legend_below(axes)


def draw_pixels(axes: Axes, content: ReportContent) -> None:
    """Pixels saved against bytes saved, a point for each cell."""
    axes.plot([0, 100], [0, 100], color="#98a2ae", linestyle=":")
    points: dict[str, list[tuple[float, float]]] = {}
    for measured, saved in byte_savings(content.methods):
        pixels = facts_of([measured]).pixel_saving
        if pixels is not None:
            points.setdefault(measured.cell.method, []).append((100 * pixels, 100 * saved))
    for label, pairs in points.items():
        style = content.styles[label]
        x, y = zip(*pairs, strict=True)
        axes.scatter(x, y, s=10, color=style.colour, marker=style.marker, label=label, linewidths=0)
    axes.set_xlabel("pixels not sent, %")
    axes.set_ylabel("bytes saved at equal setting, %")
    legend_below(axes)


def legend_below(axes: Axes) -> None:
    """Below the plot, where no curve runs."""
    figure = axes.get_figure(root=True)
    if figure is not None:
        columns = 1 if figure.get_figwidth() <= COLUMN_IN else 2
        figure.legend(loc="outside lower center", ncols=columns)


def curves_csv(content: ReportContent) -> str:
    """Every point of every curve, pooled (empty sequence) and of each sequence."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [
            "quality", "unit", "method", "sequence", "setting", "rate_kbps", "rate_kbps_low", "rate_kbps_high", "value",
            "value_low", "value_high", "beaten", "sequences", "cells",
        ]
    )  # fmt: skip
    for result in content.results:
        for one in result.methods:
            curves = [("", one.points)]
            curves += [(name, points_of_sequence(one.method, name)) for name in one.method.sequences]
            for name, points in curves:
                for row in point_rows(points):
                    writer.writerow([result.quality.name, result.quality.unit, one.label, name, *row])
    return text.getvalue()


def point_rows(points: Sequence[PooledPoint]) -> Iterator[list[str]]:
    """The rest of a row for each point."""
    kept = hull(points)
    for point in points:
        yield [
            point.setting,
            repr(point.rate_kbps),
            *bounds(point.rate_interval),
            repr(point.quality),
            *bounds(point.quality_interval),
            str(int(point not in kept)),
            str(point.sequences),
            " ".join(point.cells),
        ]


def bounds(interval: Interval | None) -> tuple[str, str]:
    """Low and high, empty without an interval."""
    return ("", "") if interval is None else (repr(interval.low), repr(interval.high))
