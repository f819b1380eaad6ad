"""The report's interactive plots, as Plotly figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import plotly.graph_objects as go

from cable_rpc.study.run_record import FrameRecord

INK = "#5b6573"
GRID = "rgba(128,138,150,0.25)"
BLUE, ORANGE, GREEN, PURPLE, RED, GREY = "#3b82c4", "#e08a2e", "#3a9a6b", "#8e63b5", "#cf4f4f", "#98a2ae"

WORK_STAGES = {
    "roi_ns": ("ROI prediction", BLUE),
    "fill_ns": ("background fill", "#7db4e0"),
    "encode_ns": ("encode", GREEN),
    "uplink_ns": ("uplink", ORANGE),
    "queue_ns": ("server wait", GREY),
    "decode_ns": ("decode", "#8cc9a8"),
    "detect_ns": ("detect", PURPLE),
    "segment_ns": ("segment", "#c3a5dd"),
    "downlink_ns": ("downlink", "#f0be85"),
    "apply_ns": ("apply mask", "#5b7794"),
}
"""Disjoint parts of the end-to-end time, in the order of a frame's way."""


@dataclass(frozen=True, slots=True)
class Plot:
    """A figure with what a reader needs beside it."""

    name: str
    title: str
    caption: str
    figure: go.Figure


def plots_of(records: Sequence[FrameRecord], fps: float) -> list[Plot]:
    """All plots that the records have the data for."""
    sent = [record for record in records if record.outcome in ("answered", "rejected")]
    candidates = (
        bytes_plot(sent),
        coverage_plot(sent),
        latency_plot(sent),
        stage_plot(sent),
        quality_plot(sent),
        prefill_plot(sent),
    )
    return [plot for plot in candidates if plot is not None]


def bytes_plot(sent: Sequence[FrameRecord]) -> Plot | None:
    """Bytes of each frame: picture, region, rest of the message; the same frame whole as a line."""
    if not sent:
        return None
    x = [record.index for record in sent]
    figure = new_figure("frame", "bytes")
    parts = (
        ("coded picture", BLUE, [record.bitstream_bytes for record in sent]),
        ("region", ORANGE, [record.roi_bytes for record in sent]),
        (
            "rest of message",
            GREY,
            [record.uplink_message_bytes - record.bitstream_bytes - record.roi_bytes for record in sent],
        ),
    )
    for name, colour, values in parts:
        figure.add_bar(x=x, y=values, name=name, marker={"color": colour, "line": {"width": 0}})
    if any(record.baseline_message_bytes is not None for record in sent):
        baseline = [record.baseline_message_bytes for record in sent]
        figure.add_scatter(x=x, y=baseline, name="same frame whole", mode="lines", line={"color": RED, "width": 1.6})
    whole = [record for record in sent if record.keyframe]
    figure.add_scatter(
        x=[record.index for record in whole],
        y=[record.uplink_message_bytes for record in whole],
        name="sent whole",
        mode="markers",
        marker={"color": INK, "symbol": "diamond", "size": 7},
    )
    figure.update_layout(barmode="stack", bargap=0)
    caption = "Uplink bytes of each frame. The line is the same frame sent whole at the same codec setting."
    return Plot("bytes", "Bytes per frame", caption, figure)


def coverage_plot(sent: Sequence[FrameRecord]) -> Plot | None:
    """Share of pixels sent, R_k and mask."""
    if not sent:
        return None
    x = [record.index for record in sent]
    figure = new_figure("frame", "% of pixels")
    lines = (
        ("sent", BLUE, [record.coverage for record in sent]),
        ("region R_k", ORANGE, [record.roi_coverage for record in sent]),
        ("cloud's mask", PURPLE, [record.mask_coverage for record in sent]),
    )
    for name, colour, values in lines:
        y = [None if value is None else 100 * value for value in values]
        figure.add_scatter(x=x, y=y, name=name, mode="lines", line={"color": colour, "width": 1.6})
    figure.update_yaxes(range=[0, 103])
    caption = "Peaks at 100 % are frames that the loop chose to send whole. Pixels are not bytes."
    return Plot("coverage", "Coverage", caption, figure)


def latency_plot(sent: Sequence[FrameRecord]) -> Plot | None:
    """End-to-end time of each frame, stacked by stage."""
    timed = [record for record in sent if record.end_to_end_ns is not None]
    if not timed:
        return None
    x = [record.index for record in timed]
    figure = new_figure("frame", "ms")
    for stage, (label, colour) in WORK_STAGES.items():
        values = [getattr(record, stage) for record in timed]
        if any(value is not None for value in values):
            y = [0 if value is None else max(value, 0) / 1e6 for value in values]
            figure.add_bar(x=x, y=y, name=label, marker={"color": colour, "line": {"width": 0}})
    figure.add_scatter(
        x=x,
        y=[(record.end_to_end_ns or 0) / 1e6 for record in timed],
        name="end to end",
        mode="lines",
        line={"color": INK, "width": 1.4},
    )
    figure.update_layout(barmode="stack", bargap=0)
    caption = "From the frame in hand at the edge to its mask applied. The gap above the stack is waiting for credit."
    return Plot("latency", "Latency of each frame", caption, figure)


def stage_plot(sent: Sequence[FrameRecord]) -> Plot | None:
    """Spread of each stage."""
    figure = new_figure("ms (log)", "")
    for stage, (label, colour) in reversed(WORK_STAGES.items()):
        values = [getattr(record, stage) for record in sent]
        milliseconds = [value / 1e6 for value in values if value is not None and value > 0]
        if milliseconds:
            figure.add_box(x=milliseconds, name=label, marker={"color": colour, "size": 3}, line={"width": 1.2})
    if not figure.data:
        return None
    figure.update_xaxes(type="log")
    figure.update_layout(showlegend=False, margin={"l": 105})
    return Plot("stages", "Latency by stage", "Box: quartiles; whiskers: 1.5 times their distance.", figure)


def quality_plot(sent: Sequence[FrameRecord]) -> Plot | None:
    """Detections kept and objects found, pooled over a sliding second or so."""
    series = (
        ("retention (of full-frame detections)", BLUE, "retained", "reference_count"),
        ("recognition (≥ 5 % of the box sent)", ORANGE, "recognised", "truth_count"),
    )
    figure = new_figure("frame", "%")
    for name, colour, part, whole in series:
        points = pooled_share(sent, part, whole)
        if points:
            x, y = zip(*points, strict=True)
            figure.add_scatter(x=x, y=y, name=name, mode="lines", line={"color": colour, "width": 1.6})
    scored = [(record, recall_counts(record)) for record in sent]
    recall = [(record.index, counts) for record, counts in scored if counts is not None]
    if recall:
        windows = [recall[max(0, i - WINDOW + 1) : i + 1] for i in range(len(recall))]
        shares = [share(sum(c[0] for _, c in window), sum(c[1] for _, c in window)) for window in windows]
        x_recall = [index for index, _ in recall]
        figure.add_scatter(x=x_recall, y=shares, name="recall", mode="lines", line={"color": GREEN, "width": 1.6})
    if not figure.data:
        return None
    figure.update_yaxes(range=[0, 103])
    figure.update_layout(showlegend=True)
    return Plot("quality", "Quality", f"Pooled over the {WINDOW} frames up to each one.", figure)


def prefill_plot(sent: Sequence[FrameRecord]) -> Plot | None:
    """Speed-up of each frame's prefill: estimated, by operations, by the clock; where a language model tells it."""
    told = [record for record in sent if record.prefill_quadratic is not None]
    if not told:
        return None
    measured = [r.prefill_whole_ns / r.prefill_ns if r.prefill_whole_ns and r.prefill_ns else None for r in told]
    lines = (
        ("paper's estimate", ORANGE, [record.prefill_quadratic for record in told]),
        ("operations", BLUE, [record.prefill_flops for record in told]),
        ("measured", GREEN, measured),
    )
    figure = new_figure("frame", "times faster")
    for name, colour, values in lines:
        x = [record.index for record in told]
        figure.add_scatter(x=x, y=values, name=name, mode="lines", line={"color": colour, "width": 1.6})
    caption = "Prefill of the whole frame over this frame's. The estimate takes all work for attention."
    return Plot("prefill", "Prefill", caption, figure)


WINDOW = 10


def recall_counts(record: FrameRecord) -> tuple[int, int] | None:
    """(found, asked for), None without truth."""
    if record.true_positives is None or record.false_negatives is None:
        return None
    return record.true_positives, record.true_positives + record.false_negatives


def pooled_share(records: Sequence[FrameRecord], part: str, whole: str) -> list[tuple[int, float | None]]:
    """(frame, percentage pooled over the window up to it) for frames that have both counts."""
    rows = [(r.index, getattr(r, part), getattr(r, whole)) for r in records]
    rows = [row for row in rows if row[1] is not None and row[2] is not None]
    points = []
    for position, row in enumerate(rows):
        window = rows[max(0, position - WINDOW + 1) : position + 1]
        points.append((row[0], share(sum(w[1] for w in window), sum(w[2] for w in window))))
    return points


def share(part: int, whole: int) -> float | None:
    """Percentage; None of nothing."""
    return 100 * part / whole if whole else None


def new_figure(x_title: str, y_title: str) -> go.Figure:
    """An empty figure that suits a light and a dark page."""
    axis: dict[str, Any] = {"gridcolor": GRID, "zerolinecolor": GRID, "linecolor": GRID, "title_font": {"size": 12}}
    figure = go.Figure()
    figure.update_layout(
        template="none",
        height=300,
        margin={"l": 52, "r": 12, "t": 8, "b": 40},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        font={"color": INK, "size": 12, "family": "system-ui, sans-serif"},
        hovermode="x unified" if y_title else "closest",
        hoverlabel={"bgcolor": "#ffffff", "font": {"color": "#222222"}},
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
        xaxis={**axis, "title": {"text": x_title, "font": {"size": 12}}},
        yaxis={**axis, "title": {"text": y_title, "font": {"size": 12}}, "rangemode": "tozero"},
    )
    return figure
