"""The sweep report's interactive plots, as Plotly figures.

Names from outside are escaped, for Plotly reads its texts as HTML.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

import plotly.graph_objects as go

from cable_rpc.study.metrics import Interval
from cable_rpc.study.rate_quality import Method, PooledPoint, hull, pareto_points, pooled_points
from cable_rpc.study.report_plots import BLUE, GREEN, GREY, ORANGE, new_figure
from cable_rpc.study.sweep.cell import MeasuredCell
from cable_rpc.study.sweep.qualities import Quality
from cable_rpc.study.sweep_report.comparison import LEVELLED_QUALITY, MethodResult, QualityResult
from cable_rpc.study.sweep_report.facts import CellFacts, byte_savings, facts_of, settings_facts
from cable_rpc.study.sweep_report.methods import MethodStyle

POOLED = ""
"""Stands for all sequences together."""
RATE_AXIS = "uplink, kbit/s (log)"
BYTE_KINDS = (
    ("keyframe pictures", "keyframe_pictures", BLUE),
    ("region pictures", "region_pictures", GREEN),
    ("side information", "side_information", ORANGE),
    ("message overhead", "message_overhead", GREY),
)
TIME_COLOURS = [[0.0, "#3b6fb5"], [0.33, "#21918c"], [0.66, "#5ec962"], [1.0, "#fde725"]]
"""Viridis without its dark end, which vanishes on a dark page."""
LABEL_LETTERS = 22
"""Of a line of a long label beside an axis."""

Styles = Mapping[str, MethodStyle]
Cells = Mapping[str, Sequence[MeasuredCell]]


def rate_figures(result: QualityResult, methods: Cells, styles: Styles) -> dict[str, go.Figure]:
    """Rate against quality, of all sequences together and of each."""
    pooled = [(one.label, one.points) for one in result.methods]
    figures = {POOLED: rate_figure(result.quality, pooled, methods, styles)}
    for name in result.sequences:
        curves = [(one.label, points_of_sequence(one.method, name)) for one in result.methods]
        of_it = {
            label: [cell for cell in cells if cell.result is not None and cell.result.sequence == name]
            for label, cells in methods.items()
        }
        figures[name] = rate_figure(result.quality, curves, of_it, styles)
    return figures


def points_of_sequence(method: Method, name: str) -> tuple[PooledPoint, ...]:
    """The curve of one sequence; empty where the method lacks it."""
    return pooled_points(method.of_sequence(name)) if name in method.sequences else ()


def rate_figure(
    quality: Quality, curves: Sequence[tuple[str, Sequence[PooledPoint]]], methods: Cells, styles: Styles
) -> go.Figure:
    """Curves through the points that no other beats; beaten points are hollow."""
    figure = new_figure(RATE_AXIS, axis_title(quality))
    for label, points in curves:
        if not points:
            continue
        facts = settings_facts(methods[label])
        kept = hull(points)
        beaten = [point for point in points if point not in kept]
        figure.add_trace(curve_trace(label, kept, facts, styles[label], quality))
        if beaten:
            figure.add_trace(curve_trace(label, beaten, facts, styles[label], quality, beaten=True))
    log_rates(figure)
    figure.update_yaxes(rangemode="normal")
    figure.update_layout(height=460)
    return figure


def curve_trace(
    label: str,
    points: Sequence[PooledPoint],
    facts: Mapping[str, CellFacts],
    style: MethodStyle,
    quality: Quality,
    *,
    beaten: bool = False,
) -> go.Scatter:
    """Points of a method, joined unless they are beaten ones."""
    rows = [
        [
            escape(point.setting),
            interval_text(point.quality_interval),
            interval_text(point.rate_interval),
            facts[point.setting].frames,
            facts[point.setting].dropped,
            escape(facts[point.setting].key_text),
        ]
        for point in points
    ]
    return go.Scatter(
        x=[point.rate_kbps for point in points],
        y=[point.quality for point in points],
        name=escape(label),
        meta={"method": label},
        mode="markers" if beaten else "lines+markers",
        line={"color": style.colour, "width": 2},
        marker={"color": style.colour, "symbol": style.symbol + ("-open" if beaten else ""), "size": 8},
        error_y=error_bars([(point.quality, point.quality_interval) for point in points], style.colour),
        showlegend=False,
        customdata=rows,
        hovertemplate=(
            "<b>%{fullData.name}</b><br>%{customdata[0]}"
            + (", beaten" if beaten else "")
            + "<br>%{x:.4~g} kbit/s%{customdata[2]}<br>%{y:.4~g} "
            + f"{quality.unit} {quality.title}"
            + "%{customdata[1]}<br>%{customdata[3]} frames, %{customdata[4]} dropped<br>cell %{customdata[5]}"
            + "<extra></extra>"
        ),
    )


def error_bars(values: Sequence[tuple[float, Interval | None]], colour: str) -> dict[str, Any] | None:
    """Unequal bars up and down; None without any interval."""
    if not any(interval for _, interval in values):
        return None
    return {
        "type": "data",
        "symmetric": False,
        "array": [interval.high - value if interval else 0.0 for value, interval in values],
        "arrayminus": [value - interval.low if interval else 0.0 for value, interval in values],
        "thickness": 1,
        "width": 2,
        "color": colour,
    }


def interval_text(interval: Interval | None) -> str:
    """ " [93.1, 95.2]"; empty without one."""
    return "" if interval is None else f" [{interval.low:.4g}, {interval.high:.4g}]"


def pareto_figure(result: QualityResult, methods: Cells, styles: Styles) -> go.Figure:
    """Rate, quality and end-to-end time of every setting; those that nothing beats in all three are ringed."""
    rows = list(timed_points(result.methods, methods))
    marks = pareto_points(
        [f"{label} {point.setting}" for label, point, _ in rows],
        [(point.rate_kbps, p95) for _, point, p95 in rows],
        [point.quality for _, point, _ in rows],
    )
    figure = new_figure(RATE_AXIS, axis_title(result.quality))
    times = [p95 for *_, p95 in rows]
    for label in dict.fromkeys(label for label, *_ in rows):
        own = [(point, p95, mark) for (name, point, p95), mark in zip(rows, marks, strict=True) if name == label]
        figure.add_scatter(
            x=[point.rate_kbps for point, *_ in own],
            y=[point.quality for point, *_ in own],
            mode="markers",
            name=escape(label),
            meta={"method": label},
            showlegend=False,
            customdata=[
                [escape(point.setting), p95, "dominated" if mark.dominated else "not dominated"]
                for point, p95, mark in own
            ],
            marker={
                "symbol": styles[label].symbol,
                "size": [8 if mark.dominated else 13 for *_, mark in own],
                "opacity": [0.55 if mark.dominated else 1.0 for *_, mark in own],
                "color": [p95 for _, p95, _ in own],
                "coloraxis": "coloraxis",
                "line": {"color": "#e0322e", "width": [0 if mark.dominated else 2 for *_, mark in own]},
            },
            hovertemplate=(
                "<b>%{fullData.name}</b><br>%{customdata[0]}, %{customdata[2]}<br>%{x:.4~g} kbit/s, %{y:.4~g} "
                + f"{result.quality.unit} {result.quality.title}<br>"
                + "p95 %{customdata[1]:.0f} ms<extra></extra>"
            ),
        )
    log_rates(figure)
    figure.update_yaxes(rangemode="normal")
    bar = {"title": {"text": "p95, ms", "side": "top"}, "thickness": 10, "outlinewidth": 0}
    bounds = {"cmin": min(times), "cmax": max(times)} if times else {}
    figure.update_layout(height=400, coloraxis={"colorscale": TIME_COLOURS, "colorbar": bar, **bounds})
    return figure


def timed_points(results: Sequence[MethodResult], methods: Cells) -> Iterator[tuple[str, PooledPoint, float]]:
    """(method, point, p95 of its end-to-end times in ms) of every point that has times."""
    for one in results:
        facts = settings_facts(methods[one.label])
        for point in one.points:
            p95 = facts[point.setting].p95_ms
            if p95 is not None:
                yield one.label, point, p95


def bytes_figure(bars: Sequence[tuple[str, str, CellFacts]]) -> go.Figure:
    """kbit/s by what they were spent on, one bar for each (method, setting, facts)."""
    figure = new_figure("uplink, kbit/s", "")
    names = [f"{wrapped(label)}<br>{escape(setting)}" for label, setting, _ in bars]
    for title, field, colour in BYTE_KINDS:
        figure.add_bar(
            y=names,
            x=[getattr(facts.uplink, field) * 8e-3 / facts.seconds for *_, facts in bars],
            orientation="h",
            name=title,
            marker={"color": colour, "line": {"width": 0}},
            customdata=[100 * getattr(facts.uplink, field) / max(1, facts.uplink.total) for *_, facts in bars],
            hovertemplate="%{y}<br>" + title + ": %{x:.4~g} kbit/s, %{customdata:.1f} %<extra></extra>",
        )
    figure.update_layout(barmode="stack", height=150 + 62 * len(bars), legend={"traceorder": "normal"})
    figure.update_yaxes(autorange="reversed", automargin=True, tickfont={"size": 11})
    return figure


def byte_bars(result: QualityResult, methods: Cells, level: float) -> list[tuple[str, str, CellFacts]]:
    """Each method's cheapest setting that reaches a quality; where none does, its best, which is said."""
    bars = []
    for one in result.methods:
        facts = settings_facts(methods[one.label])
        reaching = [point for point in one.points if point.quality >= level]
        chosen = reaching[0] if reaching else max(one.points, key=lambda point: point.quality)
        said = f"{chosen.setting}: {chosen.quality:.4g} {result.quality.unit}".strip()
        bars.append((one.label, said if reaching else f"{said}, at best", facts[chosen.setting]))
    return bars


def setting_bars(setting: str, methods: Cells) -> list[tuple[str, str, CellFacts]]:
    """Every method that has a setting, at it."""
    found = ((label, settings_facts(cells).get(setting)) for label, cells in methods.items())
    return [(label, setting, facts) for label, facts in found if facts is not None]


def bytes_figures(results: Sequence[QualityResult], methods: Cells, level: float) -> dict[str, go.Figure]:
    """By what the reader chooses: equal quality, or one of the settings."""
    figures = {}
    levelled = [result for result in results if result.quality.name == LEVELLED_QUALITY]
    if levelled:
        figures[f"at {level:g} % of detections kept"] = bytes_figure(byte_bars(levelled[0], methods, level))
    settings = dict.fromkeys(cell.cell.setting for cells in methods.values() for cell in cells)
    return figures | {setting: bytes_figure(setting_bars(setting, methods)) for setting in settings}


def pixels_figure(methods: Cells, styles: Styles) -> go.Figure | None:
    """Pixels saved against bytes saved, a point for each cell; None without any."""
    points: dict[str, list[tuple[float, float, str]]] = {}
    for measured, saving in byte_savings(methods):
        facts = facts_of([measured])
        if facts.pixel_saving is not None and measured.result is not None:
            where = f"{escape(measured.result.sequence)}, {escape(measured.cell.setting)}"
            points.setdefault(measured.cell.method, []).append((100 * facts.pixel_saving, 100 * saving, where))
    if not points:
        return None
    figure = new_figure("pixels not sent, %", "bytes saved, %")
    figure.add_scatter(
        x=[0, 100], y=[0, 100], mode="lines", line={"color": GREY, "dash": "dot", "width": 1.4}, hoverinfo="skip",
        showlegend=False,
    )  # fmt: skip
    for label, rows in points.items():
        figure.add_scatter(
            x=[row[0] for row in rows],
            y=[row[1] for row in rows],
            customdata=[row[2] for row in rows],
            name=escape(label),
            meta={"method": label},
            mode="markers",
            showlegend=False,
            marker={"color": styles[label].colour, "symbol": styles[label].symbol, "size": 7, "opacity": 0.8},
            hovertemplate="<b>%{fullData.name}</b><br>%{customdata}<br>pixels %{x:.1f} %, bytes %{y:.1f} %"
            "<extra></extra>",
        )
    figure.update_layout(height=400, hovermode="closest")
    return figure


def log_rates(figure: go.Figure) -> None:
    """A logarithmic rate axis with readable ticks, and hover over single points."""
    figure.update_xaxes(type="log", rangemode="normal", dtick="D2", tickformat="~s")
    figure.update_layout(hovermode="closest", margin={"l": 58, "b": 48})


def axis_title(quality: Quality) -> str:
    """ "detections kept, %"."""
    return f"{quality.title}, {quality.unit}" if quality.unit else quality.title


def wrapped(label: str) -> str:
    """A method's label in short lines, broken between its parts, escaped."""
    lines = [""]
    for part in label.split(" · "):
        longer = f"{lines[-1]} · {part}" if lines[-1] else part
        if len(longer) <= LABEL_LETTERS or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(part)
    return "<br>".join(map(escape, lines))
