"""The sweep's report as one HTML file that needs no network."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import plotly.graph_objects as go

from cable_rpc.study.report_page import Tile, in_script, render_page
from cable_rpc.study.sweep.cell import MeasuredCell
from cable_rpc.study.sweep_report.comparison import MethodResult, QualityResult
from cable_rpc.study.sweep_report.content import ReportContent
from cable_rpc.study.sweep_report.examples import example_rows
from cable_rpc.study.sweep_report.facts import byte_savings, facts_of
from cable_rpc.study.sweep_report.plots import bytes_figures, pareto_figure, pixels_figure, rate_figures
from cable_rpc.study.sweep_report.tables import (
    interpolations_table,
    interval_text,
    methods_table,
    sequences_table,
)

TEMPLATE = "sweep_report/page.html.j2"


def page_text(content: ReportContent) -> str:
    """The whole file.

    Raises:
        ConfigurationError: the ``study`` extra is not installed.
    """
    views = views_of(content)
    return render_page(
        TEMPLATE,
        run=content.run,
        lead=lead_text(content),
        tiles=tiles_of(content),
        notes=notes_of(content),
        styles=list(content.styles.values()),
        anchors=content.anchors,
        qualities=[quality_content(result) for result in content.results],
        sequences=list(dict.fromkeys(name for result in content.results for name in result.sequences)),
        byte_choices=list(views["bytes"]),
        has_pixels=views["pixels"] is not None,
        examples=example_rows(content.methods, content.anchors),
        failed=content.failed,
        views=in_script(json.dumps(views)),
    )


def quality_content(result: QualityResult) -> dict[str, Any]:
    """The tables of one quality."""
    return {
        "quality": result.quality,
        "methods": methods_table(result),
        "sequences": sequences_table(result),
        "interpolations": interpolations_table(result),
        "remarks": [(one.label, remark) for one in result.methods for remark in one.remarks],
    }


def views_of(content: ReportContent) -> dict[str, Any]:
    """Every state of every plot, as JSON values: by quality and sequence, by quality, by choice, and one."""
    pixels = pixels_figure(content.methods, content.styles)
    return {
        "rate": {
            result.quality.name: {
                name: plain(figure) for name, figure in rate_figures(result, content.methods, content.styles).items()
            }
            for result in content.results
        },
        "pareto": {
            result.quality.name: plain(pareto_figure(result, content.methods, content.styles))
            for result in content.results
        },
        "bytes": {
            name: plain(figure)
            for name, figure in bytes_figures(content.results, content.methods, content.level).items()
        },
        "pixels": None if pixels is None else plain(pixels),
    }


def plain(figure: go.Figure) -> Any:
    """A figure as JSON values, numbers to six digits."""
    return json.loads(figure.to_json(engine="json"), parse_float=lambda text: float(f"{float(text):.6g}"))


def lead_text(content: ReportContent) -> str:
    """What was swept."""
    measured = content.measured
    sequences = {cell.result.sequence for cell in measured if cell.result is not None}
    parts = [
        f"{len(measured)} cells",
        f"{len(sequences)} sequences",
        f"{len(content.methods)} methods",
        f"{sum(facts_of([cell]).frames for cell in measured):,} frames".replace(",", "\u00a0"),
    ]
    parts += [f"all {content.common}"] if content.common else []
    parts += [f"{len(content.failed)} failed"] if content.failed else []
    parts += [f"{content.run.missing} not measured yet"] if content.run.missing else []
    when = content.run.finished or content.run.started
    parts += [when.replace("T", " ").replace("+00:00", " UTC")] if when else []
    return " · ".join(parts)


def tiles_of(content: ReportContent) -> list[Tile]:
    """The figures that a reader asks for first."""
    best = content.main.best
    tiles = [best_tile(content.main, best)]
    if best is not None:
        for level in best.levels:
            saving = level.saving
            if saving is not None and saving.saving is not None:
                spread = interval_text(saving.interval, 1, 100.0)
                tiles.append(
                    Tile(
                        f"saved at {level.level:g} % kept",
                        f"{100 * saving.saving:.1f} %",
                        f"{spread} {saving.test_kbps:.0f} of {saving.anchor_kbps:.0f} kbit/s".strip(),
                    )
                )
        tiles += pixel_tiles(content, best.label)
        p95 = facts_of(content.methods[best.label]).p95_ms
        if p95 is not None:
            tiles.append(Tile("end to end, p95", f"{p95:.0f} ms", time_source(content.methods[best.label])))
    return tiles


def best_tile(result: QualityResult, best: MethodResult | None) -> Tile:
    """The lowest BD-rate."""
    label = f"BD-rate, {result.quality.title}"
    if best is None or best.bd_rate is None or best.bd_rate.value is None:
        return Tile(label, "–", "no two curves can be compared; the reasons stand below the table")
    spread = interval_text(best.bd_rate.interval, 1) or "no interval"
    return Tile(label, f"{best.bd_rate.value:+.1f} %", f"{spread}; {best.label} against {best.anchor}")


def pixel_tiles(content: ReportContent, label: str) -> list[Tile]:
    """What a method leaves out in pixels and in bytes."""
    saving = facts_of(content.methods[label]).pixel_saving
    bytes_saved = [saved for cell, saved in byte_savings(content.methods) if cell.cell.method == label]
    tiles = [] if saving is None else [Tile("pixels not sent", f"{100 * saving:.1f} %", "no measure of bytes")]
    if bytes_saved:
        mean = sum(bytes_saved) / len(bytes_saved)
        detail = "mean over cells, against whole frames at the same setting of the same codec"
        tiles.append(Tile("bytes saved", f"{100 * mean:.1f} %", detail))
    return tiles


def time_source(cells: Sequence[MeasuredCell]) -> str:
    """Whether times are simulated."""
    links = {cell.cell.link is not None for cell in cells}
    return "simulated link" if links == {True} else "sum of stages on the machine that ran it, no link"


def notes_of(content: ReportContent) -> list[str]:
    """What keeps the figures from being misread."""
    results = [cell.result for cell in content.measured if cell.result is not None]
    truths = {result.truth for result in results}
    notes = [
        "Rates are true bytes at the message layer over the clip's duration. Pixels not sent are no measure of bytes.",
        f"{content.main.quality.title}: {content.main.quality.meaning}.",
    ]
    if "detector" in truths:
        notes.append(
            "Objects are judged by pseudo ground truth on some or all sequences: what the same detector finds on the "
            "uncompressed whole frame. Its own mistakes count as truth."
        )
    if any(cell.cell.link is not None for cell in content.measured):
        notes.append(
            "Times of methods with a link are simulated from true bytes and the link's set rate and delays; loss is "
            "not modelled."
        )
    if any(cell.cell.link is None for cell in content.measured):
        notes.append("Times of methods without a link are sums of stages, timed beside other cells on one machine.")
    if len(content.methods) > 2:
        notes.append(
            "The headline names the best of several methods after the fact; its interval does not account for that "
            "choice."
        )
    if len(content.main.sequences) < 10:
        notes.append(
            f"{len(content.main.sequences)} sequences: intervals from so few are too narrow, and below three there are "
            "none."
        )
    if len(content.anchors) > 1:
        notes.append("Methods are compared with the anchor at their own frame rate; the table names it in each row.")
    names = {(result.detector, result.segmenter) for result in results}
    notes += [f"Detector: {detector}; segmenter: {segmenter}." for detector, segmenter in sorted(names)]
    return [*notes, *content.run.notes]
